"""The source `spherical-levels`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sobolev_batch import Mesh, MeshError, icosphere
from sobolev_batch.surfaces.sources.registry import Member
from tests.support.members import BALL, connectivity, listed, loaded, members
from tests.support.mesh_files import off


def levels(surface: int, sphere: int, wanted: list[int]) -> tuple[Member, ...]:
    table = {
        "source": "spherical-levels",
        "mesh": {"source": "icosphere", "levels": [surface]},
        "sphere": {"source": "icosphere", "levels": [sphere]},
        "levels": wanted,
    }
    return members(table)


def test_the_levels_of_an_icosphere_are_the_coarser_icospheres() -> None:
    found = levels(3, 3, [3, 1, 0, 2, 1])
    assert listed(found) == [("0", 0), ("1", 1), ("2", 2), ("3", 3)]
    for member in found:
        mesh, expected = loaded(member), icosphere(member.level)
        assert connectivity(mesh) == connectivity(expected)
        assert mesh.area == pytest.approx(expected.area, rel=1e-14)


def test_levels_take_vertices_from_the_surface_and_triangles_from_the_sphere(tmp_path: Path) -> None:
    ball = icosphere(2)
    # A potato: it is not convex, so that its own hull would leave vertices out.
    radii = 1 + 0.5 * np.sin(5 * ball.vertices[:, :1])
    (tmp_path / "potato.off").write_bytes(off(radii * ball.vertices, ball.triangles.tolist()))
    # The map need not be centred at the origin, nor its radius be one.
    (tmp_path / "sphere.off").write_bytes(off(100 * ball.vertices + 300, ball.triangles.tolist()))
    table = {
        "source": "spherical-levels",
        "mesh": {"source": "files", "paths": ["potato.off"]},
        "sphere": {"source": "files", "paths": ["sphere.off"]},
        "levels": [1, 2],
    }
    coarse, fine = (loaded(member) for member in members(table, tmp_path))
    assert np.array_equal(coarse.vertices, (radii * ball.vertices)[:42])
    assert connectivity(coarse) == connectivity(icosphere(1))
    assert connectivity(fine) == connectivity(ball)
    assert fine.area == pytest.approx(Mesh(radii * ball.vertices, ball.triangles).area, rel=1e-14)


def test_levels_need_enough_vertices() -> None:
    (member,) = levels(2, 2, [3])
    with pytest.raises(MeshError, match=r"level 3 needs the first 642 vertices .*, found 162 and 162"):
        member.load()
    (member,) = levels(3, 2, [1])
    with pytest.raises(MeshError, match=r"level 1 needs the first 42 vertices .*, found 642 and 162"):
        member.load()


def test_levels_need_a_map_to_a_convex_surface(tmp_path: Path) -> None:
    ball = icosphere(1)
    dented = ball.vertices.copy()
    dented[5] *= 0.5
    (tmp_path / "dented.off").write_bytes(off(dented, ball.triangles.tolist()))
    table = {
        "source": "spherical-levels",
        "mesh": {"source": "icosphere", "levels": [1]},
        "sphere": {"source": "files", "paths": ["dented.off"]},
        "levels": [1],
    }
    (member,) = members(table, tmp_path)
    with pytest.raises(MeshError, match="the first 42 vertices of dented are not in convex position"):
        member.load()


def test_levels_need_meshes() -> None:
    for surface, sphere in (("sphere", "icosphere"), ("icosphere", "sphere")):
        tables = {"sphere": {"source": "sphere"}, "icosphere": BALL}
        table = {"source": "spherical-levels", "mesh": tables[surface], "sphere": tables[sphere], "levels": [1]}
        (member,) = members(table)
        with pytest.raises(MeshError, match="sphere is no mesh; its triangles are needed"):
            member.load()


def test_the_fingerprint_of_a_level_is_that_of_both_meshes_and_the_level() -> None:
    found = [
        json.dumps(dict(levels(*key)[0].fingerprint())) for key in ((3, 3, [1]), (3, 3, [2]), (3, 2, [1]), (2, 3, [1]))
    ]
    assert len(set(found)) == 4
    assert json.dumps(dict(levels(3, 3, [1])[0].fingerprint())) == found[0]


@pytest.mark.slow
def test_the_levels_of_a_cortex() -> None:
    pytest.importorskip("nilearn", reason="the cortical surface needs the extra `studies`")

    def part(name: str) -> dict[str, Any]:
        path = f"nilearn/datasets/data/fsaverage5/{name}_left.gii.gz"
        return {"source": "files", "distribution": "nilearn", "paths": [path]}

    table = {"source": "spherical-levels", "mesh": part("pial"), "sphere": part("sphere"), "levels": [0, 3, 5]}
    found = members(table)
    made = [loaded(member) for member in found]
    assert [(len(mesh.vertices), len(mesh.triangles)) for mesh in made] == [(12, 20), (642, 1280), (10242, 20480)]
    # The finest level is the surface itself, triangle by triangle.
    whole = loaded(members(part("pial"))[0])
    assert connectivity(made[2]) == connectivity(whole)
    assert made[2].area == pytest.approx(whole.area, rel=1e-12)
    for mesh in made:
        assert (mesh.counts.boundary_edges, mesh.counts.nonmanifold_edges) == (0, 0)
    # In square millimetres; coarser levels lose folds.
    assert 60_000 < whole.area < 120_000
    assert made[0].area < made[1].area < made[2].area
