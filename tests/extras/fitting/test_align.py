"""Rigid motions that are undone, on shapes without symmetry."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sobolev_batch as sb
from sobolev_batch.arrays import Reals


def moved_by(mesh: sb.Mesh, matrix: Reals) -> sb.Mesh:
    return sb.Mesh(mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3], mesh.triangles)


def shape(level: int) -> sb.Mesh:
    """A lump with a horn, which no rotation or reflection takes to itself."""
    unit = sb.shapes.icosphere(level).vertices
    x, y, z = unit.T
    radii = 1 + 0.8 * np.exp(-8 * ((x - 0.6) ** 2 + (y - 0.8) ** 2 + z**2)) + 0.3 * y * z + 0.2 * x**3
    return sb.Mesh(30 * radii[:, None] * unit + [100.0, 0.0, -20.0], sb.shapes.icosphere(level).triangles)


def motion(degrees: float, seed: int) -> Reals:
    rng = np.random.default_rng(seed)
    matrix, axis = np.eye(4), rng.normal(size=3)
    matrix[:3, :3] = Rotation.from_rotvec(degrees * axis / np.linalg.norm(axis), degrees=True).as_matrix()
    matrix[:3, 3] = rng.uniform(-5, 5, size=3)
    return matrix


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "level"), [(0, 4), (40, 4), (40, 3), (110, 4), (180, 4)])
def test_a_motion_is_undone(degrees: float, level: int) -> None:
    mesh, target = shape(level), shape(4)
    radius = target.bounding_sphere[1]
    there = motion(degrees, seed=int(degrees))
    back = sb.fitting.align(moved_by(mesh, there), target)
    assert np.linalg.det(back[:3, :3]) == pytest.approx(1.0, rel=1e-12)
    found = moved_by(moved_by(mesh, there), back).vertices
    # A coarser mesh is another shape, whose best place is a little off; the search finds the same from everywhere.
    still = moved_by(mesh, sb.fitting.align(mesh, target)).vertices
    assert np.abs(found - still).max() < 1e-5 * radius
    assert np.abs(found - mesh.vertices).max() < (1e-6 if level == 4 else 3e-3) * radius


@pytest.mark.slow
def test_a_mesh_with_symmetries_stays_where_it_is() -> None:
    coarse, fine = (sb.shapes.Torus().mesh(*cells) for cells in ((20, 10), (34, 18)))
    assert np.array_equal(sb.fitting.align(coarse, fine), np.eye(4))
    elsewhere = np.eye(4)
    elsewhere[:3, 3] = 0.3, 0.0, 0.1
    back = sb.fitting.align(moved_by(coarse, elsewhere), fine)
    center = coarse.vertices.mean(axis=0)
    assert back[:3, :3] @ (center + elsewhere[:3, 3]) + back[:3, 3] == pytest.approx(center, abs=1e-3)


@pytest.mark.slow
def test_a_mirror_image_stays_one() -> None:
    target = shape(3)
    mirrored = sb.Mesh(target.vertices * [1, 1, -1], target.triangles[:, ::-1])
    back = sb.fitting.align(mirrored, target)
    assert np.linalg.det(back[:3, :3]) == pytest.approx(1.0, rel=1e-12)
    similarity = sb.shapes.Similarity.to_unit_ball(target)
    pair = similarity.apply(moved_by(mirrored, back)), similarity.apply(target)
    assert sb.distance(*pair, order=-2, rtol=0.1)["relative"] > 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    ("angle", "shift"),
    [(0.34, (5.0, 0.0, 0.0)), (0.38, (5.0, 0.0, 0.0)), (0.54, (5.0, 0.0, 0.0)), (2.0, (2e5, 1e5, 7.0))],
)
def test_a_mesh_in_another_place_is_brought_back(angle: float, shift: tuple[float, float, float]) -> None:
    # A lattice of five radii does not tell the first three from meshes in place.
    mesh = shape(2)
    radius, middle = mesh.bounding_sphere[1], mesh.vertices.mean(axis=0)
    turn = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    there = sb.Mesh((mesh.vertices - middle) @ turn.T + middle + radius * np.array(shift), mesh.triangles)
    found = moved_by(there, sb.fitting.align(there, mesh)).vertices
    assert np.abs(found - mesh.vertices).max() < (1e-9 if max(shift) > 10 else 1e-12) * radius


@pytest.mark.slow
def test_a_bumpy_ball_whose_long_wavelengths_hardly_tell_rotations_apart_is_brought_back() -> None:
    def bumpy(level: int, turn: Rotation) -> sb.Mesh:
        ball = sb.shapes.icosphere(level)
        unit = ball.vertices @ turn.as_matrix().T
        x, y, _ = unit.T
        return sb.Mesh(unit * (1 + 0.15 * np.sin(4 * x) * np.cos(3 * y))[:, None], ball.triangles)

    mesh, there = bumpy(3, Rotation.from_rotvec([0.4, 0.5, -0.3])), Rotation.from_rotvec([1.0, -2.0, 0.5])
    moved = sb.Mesh(mesh.vertices @ there.as_matrix().T + 3, mesh.triangles)
    found = sb.fitting.align(moved, bumpy(4, Rotation.identity()))[:3, :3] @ there.as_matrix()
    # A half turn around x takes the ball to itself.
    assert min(np.abs(found - np.diag(turn)).max() for turn in ((1, 1, 1), (1, -1, -1))) < 1e-2
