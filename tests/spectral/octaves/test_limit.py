"""The limit of the energy, and what follows from it for frequencies beyond all octaves."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sobolev_batch import Mesh
from sobolev_batch.spectral.octaves.limit import EnergyLimit, beyond, tail_integral
from sobolev_batch.spectral.octaves.partition import Octave
from sobolev_batch.spectral.octaves.sums import OctaveSums
from sobolev_batch.spectral.octaves.tail import Tail
from sobolev_batch.spectral.shells import smooth_step
from tests.support.rectangles import Rectangles

Reals = NDArray[np.float64]

BOX = Rectangles.box((-0.5, -0.3, -0.2), (0.5, 0.3, 0.2)).mesh()


def test_the_energy_tends_to_twice_the_area() -> None:
    other = BOX.vertices @ np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]) + 0.01
    for surfaces, area in (([BOX], BOX.area), ([BOX, Mesh(other, BOX.triangles)], 2 * BOX.area)):
        limit = EnergyLimit.from_surfaces(surfaces, [1, -1][: len(surfaces)])
        assert limit.value == pytest.approx(2 * area)
        assert limit.deviation == 0


def test_parts_that_coincide_cancel() -> None:
    assert EnergyLimit.from_surfaces([BOX, Mesh(BOX.vertices, BOX.triangles)], [1, -1]).value == 0
    # Moved along x by a quarter of its length: three quarters of the four long faces coincide.
    moved = Mesh(BOX.vertices + np.array([0.25, 0, 0]), BOX.triangles)
    limit = EnergyLimit.from_surfaces([BOX, moved], [1, -1])
    long_faces = 2 * (1.0 * 0.6 + 1.0 * 0.4)
    assert limit.value == pytest.approx(2 * (2 * BOX.area - 2 * 0.75 * long_faces), abs=4 * limit.deviation)
    # Counted twice, an area weighs four times as much.
    twice = Mesh(np.concatenate([BOX.vertices] * 2), np.concatenate([BOX.triangles, BOX.triangles + len(BOX.vertices)]))
    assert EnergyLimit.from_surfaces([twice], [1]).value == pytest.approx(8 * BOX.area)


def beyond_energies(energies: Reals, limit: float, deviation: float = 0.0) -> tuple[float, float]:
    """Mean energy beyond octaves of known energies, and how far off it may be."""
    octaves = [Octave(1.0, index) for index in range(1, len(energies) + 1)]
    zero = np.zeros(1)
    sums = [OctaveSums(zero, zero, zero, float(energy), deviation, 7, 0) for energy in energies]
    mean, uncertain = beyond(octaves, sums, EnergyLimit(limit), (-1.0,))
    tail = tail_integral(octaves[-1].highest, -1.0)
    return mean.item() / tail, uncertain.item() / tail


@pytest.mark.slow
@pytest.mark.parametrize("gap", np.geomspace(0.01, 0.3, 25))
def test_swings_about_the_limit_are_allowed_for(gap: float) -> None:
    # Parallel surfaces: the energy swings about its limit, and is averaged over octaves.
    def energy(cutoff: float) -> float:
        radii = np.linspace(cutoff / 4, cutoff, 4001)
        window = smooth_step(radii, cutoff) - smooth_step(radii, cutoff / 2)
        return float(np.sum(window * (1 - np.cos(2 * np.pi * radii * gap))) / np.sum(window))

    radii = np.linspace(1, 4096, 400_001)
    for count in range(3, 8):
        found, uncertain = beyond_energies(np.array([energy(2.0**k) for k in range(1, count + 1)]), 1.0)
        weights = (1 - smooth_step(radii, 2.0**count)) / (1 + radii**2)
        true = float(np.sum(weights * (1 - np.cos(2 * np.pi * radii * gap))) / np.sum(weights))
        assert abs(true - found) <= uncertain + 1e-3, count


def test_a_regular_approach_to_the_limit_goes_on() -> None:
    found, uncertain = beyond_energies(np.array([1 - 0.5**k for k in range(1, 6)]), 1.0)
    assert pytest.approx(found, abs=0.02) == 1 - 0.5**6
    assert uncertain < 0.02


def test_energies_that_grew_steeply_may_swing_through_the_limit() -> None:
    # Two spheres whose radii differ by a hundredth: after 8.1 the octaves have energies of 17.5, 16, 15.
    found, uncertain = beyond_energies(np.array([1.14, 4.08, 8.12]), 12.78)
    assert found + uncertain > 17.5
    # Growth like |ξ|² foretells a swing, however far the energy still is from the limit.
    found, uncertain = beyond_energies(np.array([0.04, 0.16, 0.63]), 1.0)
    assert found + uncertain > 1.85


def test_irregular_distances_from_the_limit_may_come_back_and_more() -> None:
    found, uncertain = beyond_energies(np.array([1.3, 0.8, 1.2]), 1.0)
    assert found == 1.0
    assert 1.2 * 0.2 < uncertain < 0.4
    # One octave that happens to hit the limit proves little.
    _, uncertain = beyond_energies(np.array([1.3, 0.8, 1.0]), 1.0)
    assert uncertain > 0.1


def test_noise_is_no_distance_from_the_limit() -> None:
    _, uncertain = beyond_energies(np.array([0.9, 1.08, 0.93]), 1.0, deviation=0.05)
    assert uncertain < 0.03


def test_what_an_octave_foretold_holds_on_if_later_ones_agree() -> None:
    approach = [1 - 0.5**k for k in range(1, 5)]
    _, before = beyond_energies(np.array(approach), 1.0)
    _, later = beyond_energies(np.array([*approach, 1.005]), 1.0)
    assert later == pytest.approx(before)
    _, contradicted = beyond_energies(np.array([*approach, 1.3]), 1.0)
    assert contradicted > 0.3


def test_vertices_that_no_triangle_uses_do_not_matter() -> None:
    stray = Mesh(np.concatenate([BOX.vertices, [[1e8, 0, 0]]]), BOX.triangles)
    moved = Mesh(stray.vertices + 0.01, BOX.triangles)
    assert EnergyLimit.from_surfaces([stray], [1]).value == pytest.approx(2 * BOX.area)
    assert EnergyLimit.from_surfaces([stray, moved], [1, -1]).value == pytest.approx(4 * BOX.area)


def test_triangles_coincide_whichever_side_is_their_front() -> None:
    # One rectangle, cut along its two diagonals, in planes whose normals are small whole numbers.
    along, across = np.array([3.0, 5.0, 0.0]), np.array([0.0, 0.0, 1.0])
    corners = 0.7 * np.array([np.zeros(3), along, along + across, across]) + np.array([0.1, 0.2, 0.3])
    for flipped in ([[0, 1, 3], [1, 2, 3]], [[3, 1, 0], [1, 2, 3]], [[3, 1, 0], [3, 2, 1]]):
        limit = EnergyLimit.from_surfaces([Mesh(corners, [[0, 1, 2], [0, 2, 3]]), Mesh(corners, flipped)], [1, -1])
        assert limit.value == pytest.approx(0, abs=1e-9)


@pytest.mark.all
def test_thousands_of_triangles_in_a_plane_are_all_looked_up() -> None:
    def sheet(is_other_diagonal: bool) -> Mesh:
        count = 40
        x, y = np.meshgrid(np.linspace(0, 1, count + 1), np.linspace(0, 1, count + 1))
        corner = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).ravel()
        a, b, c, d = corner, corner + 1, corner + count + 2, corner + count + 1
        pairs = ((a, b, d), (b, c, d)) if is_other_diagonal else ((a, b, c), (a, c, d))
        triangles = np.concatenate([np.stack(pair, axis=1) for pair in pairs])
        return Mesh(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1), triangles)

    limit = EnergyLimit.from_surfaces([sheet(True), sheet(False)], [1, -1])
    assert limit.value == pytest.approx(0, abs=1e-9)


def test_a_tail_without_octaves_is_unknown() -> None:
    tail = Tail.from_sums([], [], EnergyLimit(1.0), (-1.0, -2.0), [0.5, 0.5])
    assert np.isinf(tail.uncertainty).all()
    assert np.isinf(tail.estimate(np.ones(2), np.zeros(2), np.zeros(2)).errors).all()
