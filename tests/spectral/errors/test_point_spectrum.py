from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from sobolev_batch import PointCloud
from sobolev_batch.spectral.errors import point_spectrum
from sobolev_batch.spectral.errors.point_spectrum import PointPairs, PointSpectrum, octave_masses
from sobolev_batch.spectral.shells import smooth_step

RNG = np.random.default_rng(8)
CLOUD = PointCloud(RNG.uniform(-0.3, 0.3, (40, 3)), RNG.uniform(0.5, 1.5, 40))
START = 6.0


def directional_mean(radius: float) -> float:
    """The equation of Debye."""
    return float(CLOUD.weights @ np.sinc(2 * radius * cdist(CLOUD.points, CLOUD.points)) @ CLOUD.weights)


@pytest.mark.parametrize("order", [-1.7, -2.0, -5.0])
def test_masses_of_octaves_add_up_to_the_whole_tail(order: float) -> None:
    def density(radius: float) -> float:
        return float((1 - smooth_step(np.array(radius), START)) * 4 * np.pi * radius**2 * (1 + radius**2) ** order)

    whole = quad(density, START / 2, START)[0] + quad(lambda t: density(1 / t) / t**2, 1e-12, 1 / START, limit=200)[0]
    assert octave_masses(START, 5, [order]).sum() == pytest.approx(whole, rel=1e-3 if order > -2 else 1e-8)
    assert octave_masses(START, 5, [order]).sum() == pytest.approx(octave_masses(START, 1, [order]).sum(), rel=1e-12)


def test_pairs_tell_the_square_beyond_a_frequency() -> None:
    edges = START * 2.0 ** np.arange(-1, 6)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    expected = 0.0
    for low, high in itertools.pairwise(edges):
        radii = (low + high) / 2 + (high - low) / 2 * nodes
        values = [directional_mean(radius) for radius in radii]
        density = (1 - smooth_step(radii, START)) * 4 * np.pi * radii**2 * (1 + radii**2) ** -4.0
        expected += (high - low) / 2 * float(weights @ (density * values))
    square, error = PointPairs.of([CLOUD], START).beyond([-4.0])
    assert square[0] == pytest.approx(expected, rel=1e-5)
    assert abs(square[0] - expected) <= error[0]


def test_levels_end_at_the_sum_of_squared_weights() -> None:
    spectrum = PointSpectrum.of([CLOUD], START)
    assert spectrum is not None
    assert spectrum.levels[-1] == pytest.approx(CLOUD.weights @ CLOUD.weights, rel=1e-12)
    doubled = PointCloud(np.concatenate([CLOUD.points] * 2), np.concatenate([CLOUD.weights] * 2))
    merged = PointSpectrum.of([doubled], START)
    assert merged is not None
    np.testing.assert_allclose(merged.levels, 4 * spectrum.levels, rtol=1e-9)
    assert PointSpectrum.from_table(spectrum.to_table()).levels.tolist() == spectrum.levels.tolist()  # type: ignore[union-attr]


@pytest.mark.slow
def test_some_points_stand_for_all_where_pairs_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    many = PointCloud.uniform(RNG.uniform(-0.5, 0.5, (3000, 3)), 1.0)
    exact, _ = PointPairs.of([many], START).beyond([-2.0])
    monkeypatch.setattr(point_spectrum, "_MOST_PAIRS", 500_000)
    square, error = PointPairs.of([many], START).beyond([-2.0])
    assert 0 < abs(square[0] - exact[0]) <= error[0] < 0.5 * exact[0]


def test_points_in_one_spot_are_looked_at_a_few_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    held: list[int] = []

    class CountingTree(cKDTree):
        def sparse_distance_matrix(self, *args: Any, **options: Any) -> Any:
            pairs = super().sparse_distance_matrix(*args, **options)
            held.append(len(pairs))
            return pairs

    spot = RNG.normal(0.3, 1e-4, (200, 3))
    cloud = PointCloud.uniform(np.concatenate([RNG.uniform(-40.0, 40.0, (5000, 3)), spot]), 1.0)
    at_once, _ = PointPairs.of([cloud], START).beyond([-2.0])
    monkeypatch.setattr(point_spectrum, "_tree", CountingTree)
    monkeypatch.setattr(point_spectrum, "_HELD_PAIRS", 1000)
    square, _ = PointPairs.of([cloud], START).beyond([-2.0])
    assert max(held) <= 1000
    assert sum(held) >= 200**2
    assert square[0] == pytest.approx(at_once[0], rel=1e-12)


def test_nothing_is_known_of_a_difference_but_its_bounds() -> None:
    first, second = (PointSpectrum.of([PointCloud([[x, 0.0, 0.0]], [2.0])], START) for x in (0.0, 0.1))
    between = PointSpectrum.between(first, second)
    assert between is not None
    assert (between.levels[-1], between.highest[-1]) == (8.0, 16.0)
    assert PointSpectrum.between(first, None) is first
