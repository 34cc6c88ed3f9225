"""Wrong arguments of public functions: each is refused by an error of the package, which says what was found."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.errors import InputError, MeshError, SobolevBatchError
from sobolev_batch.shapes import Interval, icosphere
from tests.support.repository import public_names
from tests.support.studies import small_table

pytestmark = pytest.mark.extras

LATTICE = sb.Lattice(3.0, 16)
A, B = icosphere(0), icosphere(1)
MANY, ONE = "memory://arguments-many.zarr", "memory://arguments-one.zarr"
# In place of these, opened once.
OPEN_MANY, OPEN = "open many", "open one"
# Right ones of some function, and wrong ones of most.
VALUES: tuple[Any, ...] = (None, -1, np.nan, "x", b"x", {1, 2}, [], [None], np.arange(4.0), object())
# What is wrong for every parameter of these names: a text is true, and most objects serve as none.
REFUSED: dict[str, tuple[Any, ...]] = {
    **dict.fromkeys(("lattice",), ((3, 32), "x", 3)),
    **dict.fromkeys(("on_progress",), (3, "x", [])),
    **dict.fromkeys(("eps", "factor", "gap", "tolerance", "xi_max", "M", "radius", "level"), ("3", np.nan, -1, {3})),
    **dict.fromkeys(("rtol", "threshold", "smoothing"), ("3", np.nan, -1)),
    **dict.fromkeys(("points",), ("3", np.nan, -1)),
    **dict.fromkeys(("seed", "threads", "steps"), ("3", np.nan, -1, 1.5)),
    **dict.fromkeys(("order", "orders"), ("x", "-2", np.nan, {-2.0}, True)),
    **dict.fromkeys(("methods", "family", "changes", "witnesses", "only"), (3, {3}, [None], b"x")),
    **dict.fromkeys(("a", "b", "mesh", "other", "target", "surface"), (3, {1, 2}, [None])),
    **dict.fromkeys(("center", "origin", "axes"), (None, 3, "x", "123", (1.0, np.nan, 1.0), {1.0, 2.0, 3.0})),
    **dict.fromkeys(("allow_commands", "best_effort", "distances", "force", "keep_boundary"), ("no", None, 2)),
    **dict.fromkeys(("one_way", "scaling", "signed"), ("no", None, 2)),
    **dict.fromkeys(("by", "dtype", "backend", "values", "quadrature"), ("x", 1.5, np.arange(4.0))),
    **dict.fromkeys(("client", "ax", "similarity", "league", "position", "u"), (3, "x", ())),
    **dict.fromkeys(("store", "new", "old", "path", "output"), (3, "\0")),
    **dict.fromkeys(("x", "y"), (3, {3}, "order", "rate", "within", ())),
}
# It judges sources of other packages.
EXEMPT = {"sources.check_source"}
_OF_DISTANCES = {"order": -4.0, "best_effort": False, "seed": 0, "on_progress": None}
_ON_LATTICE = {**_OF_DISTANCES, "lattice": LATTICE, "rtol": None}
_OF_FITS = {
    "mesh": A,
    "target": B,
    "order": -4.0,
    "lattice": LATTICE,
    "steps": 1,
    "smoothing": 0.25,
    "keep_boundary": False,
    "threads": 1,
    "on_progress": None,
}
_OF_VERDICTS = {"a": A, "b": B, "tolerance": 0.5, "order": -4.0, "scaling": True, "memory": None, "seed": 0}
RIGHT: dict[str, dict[str, Any]] = {
    "Lattice": {"xi_max": 3.0, "M": 16},
    "Mesh": {"vertices": A.vertices, "triangles": A.triangles, "notes": ()},
    "as_mesh": {"mesh": A},
    "compare_studies": {"new": OPEN, "old": OPEN, "order": -3.0, "y": "relative", "methods": ["ico"]},
    "convergence": {"meshes": [A, B], "reference": B, **_ON_LATTICE},
    "distance": {"a": A, "b": B, **_ON_LATTICE, "memory": None},
    "evolution": {"store": OPEN, "order": -3.0, "factor": 2.0},
    "fit": _OF_FITS,
    "fitting.align": {"a": A, "b": B, "order": -4.0},
    "fitting.gradient": {
        "mesh": A,
        "target": B,
        "order": -4.0,
        "lattice": LATTICE,
        "eps": None,
        "threads": 1,
        "backend": "cpu",
    },
    "fitting.refine": {**_OF_FITS, "triangles": 40},
    "fourier_transform": {
        "surface": A,
        "lattice": LATTICE,
        "eps": 1e-6,
        "dtype": "complex128",
        "quadrature": "auto",
        "backend": "cpu",
        "threads": 1,
        "order": -4.0,
    },
    "init_study": {"folder": ".", "output": "study.toml"},
    "largest_deviation": {"a": A, "b": B, "gap": 0.1, "within": None},
    "league": {"store": OPEN_MANY, "order": -3.0, "by": "size", "x": "triangles", "y": "relative", "methods": ["ico"]},
    "matrix": {"store": OPEN, "order": -3.0, "values": "distance"},
    "norm": {"a": A, **_ON_LATTICE, "memory": None},
    "open_store": {"store": ONE},
    "plan": {"study": "", "store": ONE, "client": None, "allow_commands": False, "on_progress": None},
    "plot.convergence": {"store": OPEN, "order": -3.0, "ax": None, "family": None, "x": "edge_length"},
    "plot.energy": {"store": OPEN, "ax": None, "family": None},
    "plot.league": {"league": None, "ax": None},
    "plot.matrix": {"store": OPEN, "order": -3.0, "ax": None, "family": None},
    "plot.over_time": {"store": OPEN, "order": -3.0, "ax": None, "family": None},
    "plot.spectrum": {"store": OPEN, "order": -3.0, "ax": None, "family": None},
    "plot.witness": {
        "store": OPEN,
        "mesh": "ico/1",
        "order": -3.0,
        "ax": None,
        "folder": ".",
        "up": None,
        "limit": None,
    },
    "proximity": {"a": A, "b": B, "points": 10, "threshold": None, "seed": 0},
    "read_mesh": {"path": "a.ply"},
    "reduce": {
        "meshes": {"b": B},
        "within": 0.1,
        "order": None,
        "measure": None,
        "unit": None,
        "method": "decimate",
        "search": None,
        "precision": 0.05,
        "output": None,
        "client": None,
        "workers": 1,
        "on_progress": None,
    },
    "report": {"store": ONE, "path": "page.html", "folder": ".", "witnesses": (), "up": None},
    "run": {
        "study": "",
        "store": ONE,
        "client": None,
        "workers": None,
        "memory": None,
        "on_progress": None,
        "allow_commands": False,
        "only": (),
    },
    "shapes.Ellipsoid": {"axes": (1.0, 1.0, 1.0), "center": (0.0, 0.0, 0.0)},
    "shapes.Interval": {"low": 0.0, "high": 1.0, "periodic": False},
    "shapes.ParametrisedSurface": {
        "position": lambda u, v: (u, v, 0 * u),
        "u": Interval(0, 1),
        "v": Interval(0, 1),
        "scale": 1.0,
        "origin": (0.0, 0.0, 0.0),
    },
    "shapes.Similarity": {"scale": 1.0, "origin": (0.0, 0.0, 0.0)},
    "shapes.Sphere": {"radius": 1.0, "center": (0.0, 0.0, 0.0)},
    "shapes.Torus": {"R": 1.0, "r": 0.4, "center": (0.0, 0.0, 0.0)},
    "shapes.icosphere": {"level": 1},
    "smallest_below": {"store": OPEN, "relative": 0.5, "order": -3.0},
    "spectrum": {"a": A, "b": B, "order": -4.0, "bands": 3, "lattice": LATTICE, "similarity": None},
    "status": {"store": ONE},
    "submit": {"study": "", "store": ONE, "client": None, "allow_commands": False, "only": ()},
    "table": {"store": OPEN, "order": -3.0},
    "testing.assert_same_surface": {**_OF_VERDICTS, "witness": None},
    "testing.assert_within": {"a": A, "b": B, "length": 1.0, "unit": None, "one_way": False},
    "testing.same_surface": _OF_VERDICTS,
    "unlock": {"store": ONE, "force": False},
    "verify": {"store": ONE, "on_progress": None},
    "vertex_distances": {"mesh": A, "other": B, "signed": False},
    "witness": {
        "a": A,
        "b": B,
        "order": -4.0,
        "points": A.vertices,
        "lattice": LATTICE,
        "eps": 1e-6,
        "dtype": "complex128",
        "threads": 1,
    },
    "write_mesh": {"mesh": A, "path": "out.ply"},
    "write_witness": {
        "store": OPEN,
        "mesh": "ico/1",
        "path": "w.ply",
        "order": -3.0,
        "folder": ".",
        "distances": False,
    },
    "yardsticks": {"a": A, "b": B, **_ON_LATTICE, "memory": None},
}


@pytest.fixture(scope="module")
def right(threads: Client) -> dict[str, Any]:
    """What takes the place of right arguments by their names: a client, a study and stores of one and two objects."""
    objects = [{"name": "one"}, {"name": "two"}]
    small = {"levels": [0, 1], "source": "icosphere", "name": "ico"}
    study = sb.Study.from_table(small_table(family=[small]))
    sb.run(study, ONE, threads)
    sb.run(sb.Study.from_table(small_table(family=[small, {**small, "name": "other"}], object=objects)), MANY, threads)
    opened = {OPEN: sb.open_store(ONE), OPEN_MANY: sb.open_store(MANY)}
    return {"client": threads, "study": study, "league": sb.league(MANY, -3.0)[0], **opened}


def faults(function: Callable[..., object], right: dict[str, Any]) -> list[str]:
    """Call a function once for each parameter and value, and tell what is no refusal of the package."""
    found = []
    for name in right:
        refused = REFUSED.get(name, ())
        for value in (*refused, *VALUES):
            where = f"{name}={value!r}"
            try:
                function(**{**right, name: value})
            except (SobolevBatchError, AssertionError):
                continue
            except Exception as error:
                found.append(f"{where}: {type(error).__name__}: {error}")
            else:
                if any(value is one for one in refused):
                    found.append(f"{where} is taken")
    return found


def test_all_public_functions_are_called_with_wrong_arguments() -> None:
    functions = {name for name, value in public_names().items() if inspect.isfunction(value)}
    assert functions - EXEMPT <= {*RIGHT}


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda mesh: sb.distance(A, mesh, lattice=LATTICE), "b"),
        (lambda mesh: sb.distance(mesh, A, rtol=0.1), "a"),
        (lambda mesh: sb.proximity(A, mesh), "b"),
        (lambda mesh: sb.spectrum(mesh, A, lattice=LATTICE), "a"),
        (lambda mesh: sb.testing.same_surface(A, mesh), "b"),
        (lambda mesh: sb.fit(A, mesh), "target"),
        (lambda mesh: sb.convergence({"fine": A, "broken": mesh}, A, lattice=LATTICE), "mesh 'broken'"),
        (lambda mesh: sb.convergence([mesh, A], A, lattice=LATTICE), "mesh '0'"),
        (lambda mesh: sb.convergence([A], mesh, lattice=LATTICE), "reference"),
    ],
)
def test_of_several_meshes_the_wrong_one_is_named(call: Callable[[Any], object], name: str) -> None:
    with pytest.raises(MeshError, match=f"^{name}: .*#3"):
        call((np.where(np.arange(12)[:, None] == 3, np.nan, A.vertices), A.triangles))


def test_what_takes_no_field_asks_for_none() -> None:
    field = sb.fourier_transform(A, LATTICE)
    with pytest.raises(InputError, match=r"^a: expected a Mesh(?!.*Fourier field).*; found xarray.DataArray$"):
        sb.testing.same_surface(field, A)
    with pytest.raises(InputError, match="or a Fourier field; found int"):
        sb.distance(3, field)


def test_truth_values_of_numpy_are_some() -> None:
    assert sb.vertex_distances(A, B, signed=np.True_).shape == (12,)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize("name", RIGHT)
def test_wrong_arguments_are_refused(
    name: str, right: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    sb.write_mesh(A, "a.ply")
    given = {
        key: right.get(key, right.get(value) if isinstance(value, str) and value in right else value)
        for key, value in RIGHT[name].items()
    }
    assert faults(public_names()[name], given) == []
