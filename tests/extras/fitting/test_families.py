"""Studies of fitted meshes: nearer than what they start from, the same in every process, kept like all others."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.extras.fitting import families
from sobolev_batch.extras.fitting.fit import FitRun
from sobolev_batch.extras.fitting.objective import FitProblem
from sobolev_batch.sources.registry import parse_source
from tests.support.members import listed, loaded, members

SPHERE: dict[str, Any] = {"source": "sphere", "radius": 30.0, "center": [100.0, 0.0, 0.0]}
STARTS: dict[str, Any] = {"source": "ellipsoid", "axes": [30, 28, 27], "center": [100, 0, 0], "levels": [1, 2]}
FIT: dict[str, Any] = {"source": "fit", "mesh": STARTS, "steps": 15}
REFINE: dict[str, Any] = {"source": "refine", "mesh": {**STARTS, "levels": [1]}, "steps": 5, "triangles": [200, 120]}


def table(**fit: Any) -> dict[str, Any]:
    return {
        "study": {"name": "fitted"},
        "lattice": {"xi_max": 3.0, "M": 32},
        "norm": {"orders": [-2.0]},
        "reference": SPHERE,
        "family": [{"name": "start", **STARTS}, {"name": "fitted", **FIT, **fit}],
    }


def test_a_study_fits_to_its_reference_and_reuses_what_it_has(client: Client, tmp_path: Path) -> None:
    study = sb.Study.from_table(table())
    assert len(sb.run(study, store=tmp_path / "store.zarr", client=client).computed) == 5
    tree = sb.open_store(tmp_path / "store.zarr")
    distances = sb.table(tree).set_index("mesh")["distance"]
    assert distances["fitted/1"] < distances["start/1"] / 3
    assert distances["fitted/2"] < distances["start/2"] / 3
    again = sb.run(study, store=tmp_path / "store.zarr", client=client)
    assert (len(again.computed), len(again.reused)) == (0, 5)
    assert sb.verify(tmp_path / "store.zarr").is_sound
    other = sb.Study.from_table(table(order=-4.0))
    assert sb.run(other, store=tmp_path / "store.zarr", client=client).computed == ("fitted/1", "fitted/2")


@pytest.mark.parametrize("source", ["fit", "refine"])
def test_what_to_begin_with_has_no_default(source: str) -> None:
    with pytest.raises(sb.errors.StudyError, match=r"mesh is missing; give one, such as mesh = \{ source = "):
        sb.Study.from_table({**table(), "family": [{"name": "f", "source": source}]})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("table", "make"),
    [
        (FIT, lambda mesh: sb.fit(mesh, sb.shapes.Sphere(), steps=15, threads=1)),
        (REFINE, lambda mesh: sb.fitting.refine(mesh, sb.shapes.Sphere(), triangles=120, steps=5, threads=1)),
    ],
)
def test_a_member_is_the_fit_in_the_unit_ball_of_its_target(
    table: dict[str, Any], make: Callable[[sb.Mesh], sb.fitting.Fit]
) -> None:
    start, found = loaded(members(table["mesh"])[0]), loaded(members({**table, "target": SPHERE})[0])
    expected = make(sb.Mesh((start.vertices - [100, 0, 0]) / 30, start.triangles)).mesh
    assert np.array_equal(found.triangles, expected.triangles)
    np.testing.assert_allclose((found.vertices - [100, 0, 0]) / 30, expected.vertices, rtol=0, atol=1e-9)


def test_refined_members_have_levels_and_more_triangles_than_their_start() -> None:
    assert listed(members({**REFINE, "target": SPHERE})) == [("120", 0), ("200", 1)]
    (too_many,) = members({**REFINE, "target": SPHERE, "triangles": [60]})
    with pytest.raises(sb.errors.MeshError, match="cannot be fitted to sphere: the mesh has 80 triangles already"):
        too_many.load()


@pytest.mark.process
def test_every_process_makes_the_same_mesh() -> None:
    member = members({**FIT, "target": SPHERE})[0]
    program = "import pickle, sys; print(pickle.load(sys.stdin.buffer).load().digest)"
    found = subprocess.run(
        [sys.executable, "-c", program], input=pickle.dumps(member), capture_output=True, check=True
    ).stdout.decode()
    assert found.strip() == loaded(member).digest


def test_one_process_fits_once(monkeypatch: pytest.MonkeyPatch) -> None:
    member = members({**FIT, "target": SPHERE, "steps": 2})[0]
    first = member.load()
    monkeypatch.setattr(families, "fitted_mesh", None)
    assert pickle.loads(pickle.dumps(member)).load() is first


@pytest.mark.parametrize("table", [FIT, REFINE])
def test_an_interrupted_fit_is_no_mesh(monkeypatch: pytest.MonkeyPatch, table: dict[str, Any]) -> None:
    member = members({**table, "target": SPHERE, "steps": 3})[0]
    monkeypatch.setattr(FitRun, "_descend", Mock(side_effect=KeyboardInterrupt))
    # That it lies farther away at last does not hide the interrupt.
    monkeypatch.setattr(FitProblem, "squares", Mock(side_effect=[[1.0], [1.0], [2.0]]))
    with pytest.raises(KeyboardInterrupt):
        member.load()
    assert member.fingerprint_digest() not in families._fits


def test_a_fit_of_a_file_that_is_changed_meanwhile_is_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def change(*_: object) -> sb.Mesh:
        sb.write_mesh(sb.shapes.icosphere(1), tmp_path / "a.ply")
        return sb.shapes.icosphere(0)

    sb.write_mesh(sb.shapes.icosphere(0), tmp_path / "a.ply")
    (member,) = members({**FIT, "mesh": {"source": "files", "paths": ["a.ply"]}, "target": SPHERE}, tmp_path)
    before, kept = member.fingerprint_digest(), dict(families._fits)
    monkeypatch.setattr(families, "fitted_mesh", change)
    member.load()
    assert member.fingerprint_digest() != before
    assert families._fits == kept


def test_a_fit_of_what_no_one_knows_the_size_of_has_a_size() -> None:
    (member,) = members(
        {**REFINE, "mesh": {"source": "files", "paths": ["gone.ply"]}, "target": SPHERE, "triangles": [90]}
    )
    size = member.expected_size()
    assert size.triangles == 90
    assert size.projected_bytes < 1e9


def test_fits_have_the_parameters_of_the_remesher_before_them() -> None:
    sphere = {"source": "icosphere", "levels": [1]}
    remeshed = {
        "source": "command",
        "mesh": sphere,
        "command": ["true", "{input}", "{output}", "{triangles}"],
        "triangles": [9],
    }
    study = sb.Study.from_table(table(mesh={**FIT, "mesh": remeshed}))
    assert study.object.members["fitted/9"][1].metadata == (("target_triangles", 9.0),)


def test_the_reference_is_handed_down_to_nested_sources() -> None:
    nested = parse_source({"source": "fit", "mesh": {**FIT, "steps": 1}, "steps": 1})
    found = nested.with_reference(parse_source(SPHERE)).members(Path())
    assert [member.name for member in found] == ["1", "2"]
    with pytest.raises(sb.errors.StudyError, match="there is nothing to fit to"):
        nested.members(Path())
    # A target of its own stays.
    with_own = parse_source({**FIT, "target": {**SPHERE, "radius": 29.0}})
    assert with_own.with_reference(parse_source(SPHERE)) == with_own


def test_a_mesh_that_cannot_be_fitted_is_named() -> None:
    (member,) = members({**FIT, "mesh": {**STARTS, "levels": [1]}, "target": {"source": "sphere"}})
    with pytest.raises(sb.errors.MeshError, match=r"1 cannot be fitted to sphere: .*both in the same unit"):
        member.load()
    (closed_form,) = members({**FIT, "mesh": {"source": "sphere"}, "target": SPHERE})
    with pytest.raises(sb.errors.MeshError, match="is no mesh; its triangles are needed"):
        closed_form.load()


@pytest.mark.parametrize(
    ("fit", "message"),
    [
        *(
            ({key: value}, key)
            for key, value in (
                ("order", -0.5),
                ("order", "-2"),
                ("steps", 0),
                ("smoothing", -1),
                ("smoothing", 1e300),
                ("smoothing", True),
                ("speed", 1),
            )
        ),
        ({"target": 3}, "must be a table that names a source"),
        ({"mesh": "ball.ply"}, "no mesh is named 'ball.ply'"),
    ],
)
def test_wrong_keys_are_named(fit: dict[str, Any], message: str) -> None:
    with pytest.raises(sb.errors.StudyError, match=message):
        sb.Study.from_table(table(**fit))


def test_a_reference_of_a_family_needs_a_target() -> None:
    study = {**table(), "reference": {"source": "family", "family": "start"}}
    with pytest.raises(sb.errors.StudyError, match="family 'fitted': there is nothing to fit to"):
        sb.plan(sb.Study.from_table(study))
