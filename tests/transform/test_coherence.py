"""Fields keep eps at every frequency: also where pieces of a mesh repeat, and whatever the order of its triangles."""

from __future__ import annotations

import numpy as np
import pytest

from sobolev_batch import Lattice, Mesh
from sobolev_batch.arrays import Reals
from sobolev_batch.geometry.subdivision import subdivided
from sobolev_batch.shapes import icosphere
from sobolev_batch.transform.coherence import coherence
from sobolev_batch.transform.fourier import TransformSettings, transform_block
from tests.support.shapes import box

LATTICE = Lattice(5.0, 64)
# The pitch at which its pieces are in phase at the lattice's ends.
PITCH = 0.2
CUBE = subdivided(Mesh(0.06 * box().vertices / [1, 2, 4], box().triangles))
TILTED = Mesh(0.02 * np.array([[0, 0, 0], [1, 0, 1], [0, 1, 1]]), [[0, 1, 2]])
SPHERE = icosphere(6)


def repeated(piece: Mesh, places: Reals) -> Mesh:
    vertices = piece.vertices + places[:, None]
    triangles = piece.triangles + len(piece.vertices) * np.arange(len(places))[:, None, None]
    return Mesh(vertices.reshape(-1, 3), triangles.reshape(-1, 3))


def turned(mesh: Mesh, seed: int) -> Mesh:
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return Mesh(mesh.vertices @ rotation.T, mesh.triangles)


def joined(*meshes: Mesh) -> Mesh:
    firsts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangles = [mesh.triangles + first for mesh, first in zip(meshes, firsts, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles))


def array(piece: Mesh, counts: tuple[int, int, int], pitch: float = PITCH) -> Mesh:
    places = np.stack(np.meshgrid(*(pitch * (np.arange(n) - n / 2) for n in counts)), axis=-1).reshape(-1, 3)
    return repeated(piece, places)


def shuffled(mesh: Mesh) -> Mesh:
    order = np.random.default_rng(3).permutation(len(mesh.triangles))
    return Mesh(mesh.vertices, mesh.triangles[order])


# Equal triangles behind many small ones, which have next to no area.
PLATES = repeated(TILTED, np.random.default_rng(2).uniform(-2, 2, size=(2000, 3)) * [1, 1, 0])
HIDDEN = joined(Mesh(0.04 * SPHERE.vertices, SPHERE.triangles), PLATES)


def largest_error(mesh: Mesh, eps: float) -> float:
    """Return the largest error of a field over eps · area, against the field of a far finer eps."""
    settings = TransformSettings(eps), TransformSettings(eps / 1e4)
    values, exact = (transform_block(mesh, LATTICE, LATTICE.half, one).values for one in settings)
    return float(np.abs(values - exact).max()) / (eps * mesh.area)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mesh", "eps"),
    [
        (array(CUBE, (8, 8, 8)), 1e-4),
        (array(CUBE, (20, 20, 1)), 1e-6),
        (turned(array(CUBE, (8, 8, 8), 0.17), 2), 1e-4),
        (array(turned(CUBE, 1), (10, 10, 10)), 1e-6),
        (HIDDEN, 1e-4),
    ],
    ids=["cubes", "plane of cubes", "turned array", "array of turned cubes", "equal triangles last in the file"],
)
def test_no_frequency_exceeds_eps_where_errors_add_up(mesh: Mesh, eps: float) -> None:
    assert largest_error(mesh, eps) < 2


def expected_points(mesh: Mesh, eps: float) -> float:
    return TransformSettings(eps).kind_for(mesh, LATTICE).expected_points


@pytest.mark.slow
@pytest.mark.parametrize("eps", [1e-4, 1e-6])
@pytest.mark.parametrize("mesh", [HIDDEN, array(CUBE, (12, 12, 4)), SPHERE], ids=["hidden", "array", "sphere"])
def test_the_order_of_triangles_changes_no_rule(mesh: Mesh, eps: float) -> None:
    backwards = Mesh(mesh.vertices, mesh.triangles[::-1])
    expected = expected_points(mesh, eps)
    assert expected_points(shuffled(mesh), eps) == expected_points(backwards, eps) == expected


def test_arrays_are_told_from_surfaces() -> None:
    highest = LATTICE.highest_frequency
    assert coherence(array(CUBE, (8, 8, 8)), highest).max() > 0.15
    assert coherence(array(CUBE, (4, 4, 4)), highest).max() > 0.15
    # Far larger than the shortest wavelength, and sampled: the array is the box with the most area.
    far = Mesh(0.05 * icosphere(4).vertices + 20, icosphere(4).triangles)
    assert coherence(joined(array(CUBE, (8, 8, 8)), far), highest).max() > 0.15
    assert not coherence(icosphere(5), highest).any()
