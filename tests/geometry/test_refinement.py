"""A mesh that is another one, cut finer and rounded, is told from one that differs."""

from __future__ import annotations

import numpy as np
import pytest

from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.refinement import refinement_of
from sobolev_batch.geometry.subdivision import icosphere, subdivided

ROUNDING = 2.0**-22


def rounded(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices.astype(np.float32), mesh.triangles)


def wedge(length: float = 40.0, thickness: float = 1e-3) -> Mesh:
    """Long thin triangles, as bores and fans of parts have them."""
    ends = np.array([[0, 0, 0], [length, 0, 0], [length, thickness, 0], [0, 0.5, 0.3]])
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    return Mesh(ends @ turn, [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize("coarse", [icosphere(2), wedge(), rounded(icosphere(3))])
@pytest.mark.parametrize("times", [0, 1, 3])
def test_cut_and_rounded_meshes_are_refinements(coarse: Mesh, times: int) -> None:
    fine, size = coarse, float(np.abs(coarse.vertices).max())
    for _ in range(times):
        fine = subdivided(fine)
    fine = rounded(fine)
    found = refinement_of(fine, coarse, ROUNDING * size)
    assert found is not None
    # Half a unit in the last place along three axes, in both meshes.
    assert found[0] <= 2 * 3**0.5 * 2.0**-25 * size


def changed(fine: Mesh, how: str) -> Mesh:
    """The mesh with a change of one triangle."""
    triangles, vertices = fine.triangles.copy(), fine.vertices.copy()
    if how == "bare":
        triangles = triangles[1:]
    elif how == "covered twice":
        triangles = np.concatenate([triangles, triangles[:1]])
    elif how == "bare here and twice there":
        triangles[0] = triangles[1]
    elif how == "bare in the middle and twice around":
        # The middle of four triangles; each of the others is a third larger, so that area and centre stay.
        corners = vertices[triangles[:3]]
        outer = corners[np.arange(3), np.arange(3)][:, None]
        vertices = np.concatenate([vertices, (outer + (4 / 3) ** 0.5 * (corners - outer)).reshape(-1, 3)])
        triangles = np.concatenate([triangles[4:], len(fine.vertices) + np.arange(9).reshape(3, 3)])
    elif how == "dented":
        vertices[triangles[0, 1], 2] += 1e-5
    return Mesh(vertices, triangles)


def test_a_hole_as_small_as_the_rounding_permits_is_told_by_its_area() -> None:
    coarse = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    width = 4e-4
    hole = np.array([[0.3, 0.3, 0], [0.3 + width, 0.3, 0], [0.3, 0.3 + width, 0]])
    vertices = np.concatenate([coarse.vertices, hole])
    fine = Mesh(vertices, [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]])
    assert fine.area == pytest.approx(0.5 - width**2 / 2, abs=1e-12)
    found = refinement_of(fine, coarse, ROUNDING)
    assert found is not None
    assert found[1] == pytest.approx(width**2 / 2, rel=1e-6)
    assert refinement_of(fine, coarse, ROUNDING / 10) is None


@pytest.mark.parametrize(
    "how",
    ["bare", "covered twice", "bare here and twice there", "bare in the middle and twice around", "dented"],
)
def test_edits_are_no_refinements(how: str) -> None:
    coarse = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0.2, 0.9, 0], [1.1, 1.2, 0.4]]), [[0, 1, 2], [1, 3, 2]])
    fine = subdivided(coarse)
    assert refinement_of(fine, coarse, ROUNDING) is not None
    assert refinement_of(changed(fine, how), coarse, ROUNDING) is None
    assert refinement_of(fine, changed(coarse, "bare"), ROUNDING) is None
