"""Studies that ask for an accuracy: what is chosen, from which pilots, and what is kept, grown, refused and flagged."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import trimesh
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.arrays import ComplexDtype
from sobolev_batch.batch import object_run
from sobolev_batch.norms.accuracy.problem import Problem
from sobolev_batch.norms.accuracy.solve import run_pilot
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.norms.estimate import NormEstimate
from sobolev_batch.store.layout import stored_choice
from sobolev_batch.study import pilots as search_module
from sobolev_batch.study.lattice_choice import LatticeChoice
from sobolev_batch.study.pilots import Look, choose_pilots
from sobolev_batch.study.plan import make_plan
from sobolev_batch.tables.convergence import format_table
from tests.support.commands import call
from tests.support.members import members
from tests.support.rectangles import Rectangles
from tests.support.studies import small_table, variable

# So high that one lattice is chosen, and no octaves.
RTOL = 5e-4


def on_lattice(lattice: sb.Lattice) -> Callable[[Problem], tuple[Any, sb.Lattice, ComplexDtype]]:
    """A pilot that finds another lattice."""

    def run(problem: Problem) -> tuple[Any, sb.Lattice, ComplexDtype]:
        distances, _, dtype = run_pilot(problem)
        return distances, lattice, dtype

    return run


def asking(rtol: float = RTOL, **changes: Any) -> sb.Study:
    own = {"accuracy": {"rtol": rtol}, "lattice": None, "norm": {"orders": [-10.0, -4.0]}}
    return sb.Study.from_table(small_table(**{**own, **changes}))


def test_every_distance_to_the_reference_is_as_accurate_as_asked(client: Client, store_path: Path) -> None:
    sb.run(asking(), store_path, client)
    tree = sb.open_store(store_path)
    assert tree["fourier"]["fourier"].dtype == np.complex64
    convergence = tree["convergence"].to_dataset().drop_sel(mesh="reference")
    assert convergence["within"].all()
    assert (convergence["error"] <= RTOL * convergence["distance"]).all()
    for level in range(4):
        truth = sb.distance(sb.shapes.icosphere(level), sb.shapes.Sphere(), [-10.0, -4.0], rtol=1e-5)
        here = convergence.sel(mesh=f"ico/{level}")
        gap = np.abs(here["distance"].values - truth["distance"].values)
        assert (gap <= here["error"] + truth["error"].values).all()
    assert "!" not in format_table(tree).split("marked !")[0]
    assert f"at most {RTOL:g} of each distance" in format_table(tree)


@pytest.mark.parametrize(
    ("rtol", "dtypes"),
    [(1e-2, ("complex64", "complex64")), (RTOL, ("complex64", "complex128")), (1e-5, ("complex128", "complex128"))],
)
def test_fields_are_stored_in_single_precision_where_that_loses_no_digit(rtol: float, dtypes: tuple[str, str]) -> None:
    choice = make_plan(asking(rtol, norm={"orders": [-4.0]})).choice
    assert (choice.dtype, choice.transform_dtype) == dtypes
    asked = make_plan(asking(rtol, norm={"orders": [-4.0]}, transform={"dtype": "complex128"})).choice
    assert (asked.dtype, asked.transform_dtype) == ("complex128", "complex128")


def test_the_choice_is_kept_when_meshes_are_added(client: Client, store_path: Path, tmp_path: Path) -> None:
    sb.run(asking(), store_path, client)
    first = stored_choice(store_path)
    more = [{"name": "ico", "source": "icosphere", "levels": [0, 1, 2, 3, 4]}]
    summary = sb.run(asking(family=more), store_path, client)
    assert summary.computed == ("ico/4",)
    assert stored_choice(store_path) == first
    assert sb.run(asking(family=more), store_path, client).computed == ()
    # A mesh that reaches further hears what to do.
    trimesh.creation.box(extents=(20.0, 1.0, 1.0)).export(tmp_path / "far.off")
    far = {"name": "far", "source": "files", "paths": [str(tmp_path / "far.off")]}
    summary = sb.run(asking(family=[*more, far]), store_path, client)
    assert set(summary.failed) == {"far/far"}
    assert "that reach less far. Is this one in the same unit of length?" in summary.failed["far/far"]


def test_a_period_beyond_a_small_lattice_leads_to_octaves(tmp_path: Path) -> None:
    for name, offset in (("first", 0.0), ("moved", 0.5)):
        sb.write_mesh(Rectangles.tapered(35, 1 / 35, 0.3, offset).mesh(), tmp_path / f"{name}.ply")
    reference, family = ({"source": "files", "paths": [str(tmp_path / f"{name}.ply")]} for name in ("first", "moved"))
    study = asking(0.1, norm={"orders": [-5.0]}, reference=reference, family=[{"name": "moved", **family}])
    assert make_plan(study).choice.tail is not None


def test_a_lattice_that_turns_out_too_small_grows(
    threads: Client, store_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = make_plan(asking()).choice
    small = sb.Lattice(0.6 * chosen.lattice.xi_max, chosen.lattice.M)
    monkeypatch.setattr(search_module, "run_pilot", on_lattice(small))
    summary = sb.run(asking(), store_path, threads)
    grown = stored_choice(store_path)
    assert grown is not None
    assert "grown" in grown.reasons[-1]
    assert grown.lattice.xi_max > small.xi_max
    assert variable(sb.open_store(store_path), "convergence", "within").all()
    assert len(summary.computed) == 5


def test_a_lattice_that_grows_in_a_run_of_a_part_takes_the_other_fields_along(
    threads: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = asking(norm={"orders": [-4.0]})
    chosen = make_plan(study).choice.lattice
    monkeypatch.setattr(search_module, "run_pilot", on_lattice(sb.Lattice(0.6 * chosen.xi_max, chosen.M)))
    tables = []
    runs: tuple[list[list[str]], ...] = [[]], [["ico/0"], ["ico/3"], []]
    for parts in runs:
        path = tmp_path / f"{len(parts)}.zarr"
        computed = [set(sb.run(study, path, threads, only=only).computed) for only in parts]
        assert sb.verify(path).is_sound
        tables.append(sb.table(path).drop(columns="seconds"))
    assert computed == [{"ico/0", "reference"}, {"ico/0", "ico/3", "reference"}, {"ico/1", "ico/2"}]
    pd.testing.assert_frame_equal(*tables, rtol=1e-12, atol=0)


def test_what_falls_short_in_the_end_is_marked(
    threads: Client, store_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(object_run, "_MOST_ROUNDS", 1)
    monkeypatch.setattr(search_module, "run_pilot", on_lattice(sb.Lattice(1.2, 12)))
    sb.run(asking(), store_path, threads)
    tree = sb.open_store(store_path)
    assert not variable(tree, "convergence", "within").sel(mesh="ico/1", order=-4.0)
    assert re.search(r"^ico/1 .*[!*]", format_table(tree), re.MULTILINE)


def test_what_cannot_be_met_is_refused_before_anything_is_written(client: Client, store_path: Path) -> None:
    study = asking(accuracy={"rtol": 1e-7, "memory": "700MB"}, norm={"orders": [-2.0]})
    with pytest.raises(
        sb.errors.AccuracyError, match=r"ico/\d: rtol 1e-07 is out of reach at order -2 .* can be reached"
    ):
        sb.run(study, store_path, client)
    assert not store_path.exists()


def test_growth_goes_by_what_is_short() -> None:
    choice = LatticeChoice(sb.Lattice(3.0, 32), "complex64", "complex128", (1.0,), (), "basis")

    def grown(truncation: float, aliasing: float, unknown: float = 0.0, most: float = 1e9) -> LatticeChoice | None:
        parts = [np.array([[value]]) for value in (1.0, truncation, aliasing, unknown)]
        return choice.grown(NormEstimate(*parts), (-4.0,), Accuracy(1e-3, most))

    cut, folded = grown(1e-2, 1e-5), grown(1e-4, 1e-2)
    assert cut is not None
    assert cut.lattice.xi_max > 3.0
    assert folded is not None
    assert folded.lattice.spacing < choice.lattice.spacing
    assert grown(1e-4, 1e-5) is None
    # A copy up to rounding, whose fields are not exact enough to tell; and no memory to grow into.
    assert grown(1e-2, 1e-2, 2.0) is None
    assert grown(0.9, 0.9, 0.0, 3.1e8) is None


def test_the_reference_may_be_a_mesh_of_a_family(client: Client, store_path: Path) -> None:
    study = asking(reference={"source": "family", "family": "ico", "member": "3"})
    sb.run(study, store_path, client)
    convergence = sb.open_store(store_path)["convergence"].to_dataset()
    assert convergence["within"].sel(mesh=["ico/0", "ico/1", "ico/2"]).all()
    assert (convergence["distance"].sel(mesh="ico/3") == 0).all()


@pytest.mark.all
def test_another_accuracy_is_another_choice(client: Client, store_path: Path) -> None:
    lattices = []
    for rtol in (RTOL, 1e-4):
        assert len(sb.run(asking(rtol), store_path, client).computed) == 5
        choice = stored_choice(store_path)
        assert choice is not None
        lattices.append(choice.lattice)
    assert lattices[1].xi_max > lattices[0].xi_max
    assert variable(sb.open_store(store_path), "fourier", "fourier").shape[1:] == lattices[1].shape
    assert variable(sb.open_store(store_path), "convergence", "within").all()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Balls whose names are not in the order of their triangles, one in another unit, and one that is no mesh."""
    for level, name in enumerate("zxy"):
        sb.write_mesh(sb.shapes.icosphere(level), tmp_path / f"{name}.off")
    ball = sb.shapes.icosphere(3)
    sb.write_mesh(sb.Mesh(25.4 * ball.vertices, ball.triangles), tmp_path / "inches.off")
    (tmp_path / "broken.off").write_text("OFF\n" + "1 2 3\n" * 10_000)
    return tmp_path


def study(folder: Path) -> sb.Study:
    family = [{"name": "f", "source": "files", "paths": ["*.off"]}]
    table = small_table(accuracy={"rtol": 0.1}, lattice=None, norm={"orders": [-4.0]}, family=family)
    return sb.Study.from_table(table, folder=folder)


@pytest.mark.slow
def test_a_mesh_beyond_the_pilots_has_its_place_in_the_lattice_and_wrong_ones_have_none(folder: Path) -> None:
    ball = sb.shapes.icosphere(1)
    sb.write_mesh(sb.Mesh(1.5 * ball.vertices, ball.triangles), folder / "large.off")
    found = {f"f/{member.name}": ("f", member) for member in members({"source": "files", "paths": ["*.off"]}, folder)}
    pilots = choose_pilots(found, sb.shapes.Similarity(), sb.shapes.Sphere().extent, Look())
    # The coarsest and the finest that can be compared, by their triangles.
    assert set(pilots) == {"f/z", "f/y"}
    plan = sb.plan(study(folder), folder / "s.zarr")
    assert plan.object.lattice.half_period > 1.5
    assert (set(plan.object.failing), set(plan.object.doubtful)) == ({"f/broken"}, {"f/inches"})
    assert "failing:       f/broken:" in str(plan)
    assert "doubtful:      f/inches: its extent is 25.4 times that" in str(plan)
    for name in ("x", "y", "z", "large"):
        (folder / f"{name}.off").unlink()
    with pytest.raises(sb.errors.StudyError, match=r"none of the study's surfaces can serve .*f/(broken|inches): "):
        sb.plan(study(folder), folder / "s.zarr")


def test_wrong_meshes_fail_by_their_own_names_and_the_others_have_their_accuracy(client: Client, folder: Path) -> None:
    summary = sb.run(study(folder), folder / "mixed.zarr", client)
    assert set(summary.failed) == {"f/broken", "f/inches"}
    assert "in the same unit of length?" in summary.failed["f/inches"]
    table = sb.table(folder / "mixed.zarr").set_index("mesh").drop(["f/broken", "f/inches"])
    assert table["within"].all()
    exact = [
        sb.distance(sb.shapes.icosphere(level), sb.shapes.Sphere(), -4.0, rtol=1e-3)["distance"].item()
        for level in range(3)
    ]
    for name, value in zip("zxy", exact, strict=True):
        assert abs(table["distance"][f"f/{name}"] - value) <= 1.01 * table["error"][f"f/{name}"] + 1e-3 * value


@pytest.mark.all
def test_a_best_effort_serves_the_meshes_that_can_be_served(client: Client, folder: Path) -> None:
    near = sb.shapes.icosphere(2)
    rough = np.random.default_rng(0).normal(size=near.vertices.shape)
    twin = sb.Mesh(near.vertices + 1e-5 * rough, near.triangles)
    sb.write_mesh(twin, folder / "near.off")
    for name in ("inches", "broken"):
        (folder / f"{name}.off").unlink()
    table = {**study(folder).table, "norm": {"orders": [-0.7]}}
    table["reference"] = {"source": "icosphere", "levels": [2]}
    strict = sb.Study.from_table(table, folder=folder)
    with pytest.raises(sb.errors.AccuracyError, match=r"rtol 0\.1 .* at order -0\.7"):
        sb.plan(strict, folder / "s.zarr")
    table["accuracy"]["best_effort"] = True
    best = sb.Study.from_table(table, folder=folder)
    assert sb.run(best, folder / "best.zarr", client).failed == {}
    found = sb.table(folder / "best.zarr").set_index("mesh")
    assert found["within"][["f/z", "f/x", "f/near"]].all()
    # The lattice shows next to nothing of the third: close points do.
    exact = sb.distance(twin, near, -0.7, rtol=0.02)
    difference = abs(found["distance"]["f/near"] - exact["distance"].item())
    assert difference <= found["error"]["f/near"] + exact["error"].item()
    # The last one is the reference itself.
    assert found["distance"]["f/y"] <= found["error"]["f/y"]


def test_units_are_doubted_where_numbers_are_shown(client: Client, folder: Path) -> None:
    small = sb.shapes.icosphere(2)
    sb.write_mesh(sb.Mesh(small.vertices / 10, small.triangles), folder / "small.off")
    store = folder / "mixed.zarr"
    sb.run(study(folder), store, client)
    doubt = "f/small: it is 10 times as small as the reference: is one in millimetres and the other in centimetres?"
    assert doubt in call("table", store).stdout
    page = sb.report(store, folder / "report.html").read_text()
    assert "1 mesh may be in another unit or place" in page
    compared = call("compare", "small.off", "z.off", "--order", "-4", "--no-scaling", folder=folder)
    assert "note: small.off: it is 9.73 times as small as the reference" in compared.stderr
