"""The source `decimate`, and what it has in common with `remesh`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sobolev_batch import MeshError, StudyError, icosphere
from tests.support.members import BALL, listed, loaded, members
from tests.support.mesh_files import obj, off, ply, stl_text
from tests.support.shapes import BOX_TRIANGLES, BOX_VERTICES

OFF_BOX = off(BOX_VERTICES, BOX_TRIANGLES)


def test_decimated_meshes_have_the_counts_asked_for() -> None:
    found = members({"source": "decimate", "mesh": BALL, "triangles": [320, 20, 80, 20]})
    assert listed(found) == [("20", 0), ("80", 1), ("320", 2)]
    made = [loaded(member) for member in found]
    assert [len(mesh.triangles) for mesh in made] == [20, 80, 320]
    for mesh in made:
        assert (mesh.counts.boundary_edges, mesh.counts.nonmanifold_edges, mesh.counts.duplicate) == (0, 0, 0)
    # Each is nearer to the original than the last; the coarsest is about an icosahedron.
    errors = [abs(mesh.area / icosphere(3).area - 1) for mesh in made]
    assert 0.25 > errors[0] > errors[1] > errors[2] > 0
    assert errors[2] < 0.01


def test_decimation_is_done_in_double_precision() -> None:
    (member,) = members({"source": "decimate", "mesh": BALL, "triangles": [1278]})
    mesh = loaded(member)
    assert len(mesh.triangles) == 1278
    # One edge was collapsed: all vertices but one are vertices of the original, to the last digit.
    gaps = np.linalg.norm(mesh.vertices[:, None] - icosphere(3).vertices[None], axis=2).min(axis=1)
    assert np.count_nonzero(gaps > 1e-12) <= 1


def test_decimation_gives_the_same_mesh_every_time() -> None:
    (member,) = members({"source": "decimate", "mesh": BALL, "triangles": [80]})
    assert loaded(member).digest == loaded(member).digest


@pytest.mark.parametrize("kind", ["decimate", "remesh"])
def test_reduction_to_as_many_triangles_or_more_is_refused(kind: str, tmp_path: Path) -> None:
    if kind == "remesh":
        pytest.importorskip("pyacvd", reason="remeshing needs the extra `studies`")
    (tmp_path / "box.off").write_bytes(OFF_BOX)
    for count in (12, 13, 10**9):
        table = {"source": kind, "mesh": {"source": "files", "paths": ["box.off"]}, "triangles": [count]}
        (member,) = members(table, tmp_path)
        message = f"box has 12 triangles and cannot be reduced to {count}: ask for fewer"
        with pytest.raises(MeshError, match=message):
            member.load()


@pytest.mark.parametrize("kind", ["decimate", "remesh"])
def test_spheres_cannot_be_reduced(kind: str) -> None:
    if kind == "remesh":
        pytest.importorskip("pyacvd", reason="remeshing needs the extra `studies`")
    (member,) = members({"source": kind, "mesh": {"source": "sphere"}, "triangles": [80]})
    with pytest.raises(MeshError, match="sphere is no mesh; its triangles are needed"):
        member.load()


@pytest.mark.parametrize("kind", ["decimate", "remesh"])
def test_one_mesh_is_reduced_at_a_time(kind: str) -> None:
    two = {"source": "icosphere", "levels": [2, 3]}
    with pytest.raises(StudyError, match="exactly one surface is needed here, but the source makes 2: 2, 3"):
        members({"source": kind, "mesh": two, "triangles": [20]})


def test_the_fingerprint_of_a_reduction_is_that_of_the_original_and_the_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "box.off").write_bytes(OFF_BOX)
    (tmp_path / "same.off").write_bytes(OFF_BOX)
    (tmp_path / "box2.off").write_bytes(OFF_BOX.replace(b"4.0", b"8.0"))

    def of(name: str, count: int) -> dict[str, Any]:
        table = {"source": "decimate", "mesh": {"source": "files", "paths": [name]}, "triangles": [count]}
        (member,) = members(table, tmp_path)
        return dict(member.fingerprint())

    assert of("box.off", 8) == of("same.off", 8)
    assert of("box.off", 8) != of("box2.off", 8)
    assert of("box.off", 8) != of("box.off", 6)
    # It does not depend on what else is asked for.
    table = {"source": "decimate", "mesh": {"source": "files", "paths": ["box.off"]}, "triangles": [4, 8]}
    assert dict(members(table, tmp_path)[1].fingerprint()) == of("box.off", 8)
    before = of("box.off", 8)
    monkeypatch.setattr("sobolev_batch.surfaces.sources.derived.decimation.installed_version", lambda name: "99")
    assert of("box.off", 8) != before


def test_reductions_may_be_nested() -> None:
    inner = {"source": "decimate", "mesh": BALL, "triangles": [320]}
    (member,) = members({"source": "decimate", "mesh": inner, "triangles": [80]})
    assert len(loaded(member).triangles) == 80


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("box.obj", obj(BOX_VERTICES, BOX_TRIANGLES)),
        ("box.ply", ply(BOX_VERTICES, BOX_TRIANGLES)),
        ("box.stl", stl_text(BOX_VERTICES, BOX_TRIANGLES)),
    ],
)
def test_files_are_decimated(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    (member,) = members(
        {"source": "decimate", "mesh": {"source": "files", "paths": [name]}, "triangles": [8]}, tmp_path
    )
    assert len(loaded(member).triangles) == 8
