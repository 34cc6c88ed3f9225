"""Distances at low orders, whose tails are measured, against closed forms and the heat traces of rectangles."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from sobolev_batch import AccuracyError, InputError, Mesh, Sphere, distance, icosphere, norm
from sobolev_batch.spectral.adaptive import octaves
from sobolev_batch.spectral.octaves.remainder import Remainder, remainder
from tests.support.rectangles import Rectangles

BOX = Rectangles.box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
PAIRS = {
    "moved box": (BOX, BOX.moved(0.01, 0.03, 0.02)),
    "box slid along its faces": (BOX, BOX.moved(0.25, 0.0, 0.0)),
    "fins": (Rectangles.fins(12), Rectangles.fins(12).moved(0, 0, 1 / 24)),
    "perforated": (Rectangles.perforated(3), Rectangles.perforated(3).moved(1 / 6, 0, 0)),
}
ORDERS = (-0.7, -1.0, -2.0, -3.0)


@lru_cache
def exact_distances(name: str) -> dict[float, float]:
    """The heat trace takes longest, and serves all orders."""
    a, b = PAIRS[name]
    return dict(zip(ORDERS, a.distance(b, ORDERS).tolist(), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize(("order", "rtol"), [(-0.7, 1e-1), (-1.0, 3e-2), (-2.0, 1e-2), (-3.0, 1e-3)])
def test_flat_and_periodic_faces_against_their_heat_trace(name: str, order: float, rtol: float) -> None:
    a, b = PAIRS[name]
    exact = exact_distances(name)[order]
    dataset = distance(a.mesh(), b.mesh(), order, rtol=rtol)
    assert dataset["within"].item()
    assert abs(dataset["distance"].item() - exact) <= dataset["error"].item() <= rtol * dataset["distance"].item()


@pytest.mark.parametrize("order", [-0.6, -1.0, -1.5, -2.0])
def test_spheres_against_their_closed_form(order: float) -> None:
    a, b = Sphere(), Sphere(0.9, (0.1, 0.05, 0.0))
    exact = distance(a, b, order)["distance"].item()
    dataset = distance(a, b, order, rtol=1e-2)
    assert abs(dataset["distance"].item() - exact) <= dataset["error"].item() <= 1e-2 * exact
    assert abs(norm(a, order, rtol=1e-2)["norm"].item() / norm(a, order)["norm"].item() - 1) < 1e-2


@pytest.mark.slow
def test_a_seed_makes_results_reproducible_and_another_one_changes_them() -> None:
    pair = icosphere(1), icosphere(2)
    first, again, other = (distance(*pair, -1.0, rtol=0.01, seed=seed) for seed in (1, 1, 2))
    # Sums of several threads round differently, here in single precision.
    assert first["distance"].item() == pytest.approx(again["distance"].item(), rel=1e-5)
    assert first["distance"].item() != other["distance"].item()
    assert abs(first["distance"] - other["distance"]) <= first["error"] + other["error"]
    assert first["statistical"].item() > 0
    parts = first["truncation"] + first["aliasing"] + first["discretisation"] + first["statistical"]
    assert first["error"].item() == pytest.approx(parts.item(), rel=1e-14)


@pytest.mark.parametrize("seed", [-1, 1.5, "a", True, None])
def test_a_seed_is_a_whole_number(seed: Any) -> None:
    with pytest.raises(InputError, match="seed must be a whole number from 0 on"):
        distance(icosphere(1), icosphere(2), -1.0, rtol=0.05, seed=seed)


@pytest.mark.all
def test_the_unit_of_length_may_be_tiny_beside_the_surfaces() -> None:
    scale, ball, smaller = 1e9, icosphere(1), icosphere(1).moved(0.9, (0.0, 0.0, 0.0))
    pair = (ball.moved(scale, (0.0, 0.0, 0.0)), smaller.moved(scale, (0.0, 0.0, 0.0)))
    found = distance(*pair, -1.0, rtol=3e-2)
    assert found["within"].item()
    # Far beyond a wavelength of one unit the measures have nothing in common: the energy is at its limit everywhere.
    squares = 2 * (pair[0].area + pair[1].area) * np.pi / 2
    assert found["distance"].item() == pytest.approx(np.sqrt(squares), rel=0.05)


@pytest.mark.slow
def test_very_negative_orders_beside_low_ones_have_no_tail() -> None:
    found = distance(icosphere(1), icosphere(2), [-0.6, -4.0, -100.0], rtol=5e-2)
    assert found["within"].all()
    exact = distance(icosphere(1), icosphere(2), -100.0, rtol=1e-4)
    assert found["distance"].values[2] == pytest.approx(exact["distance"].item(), rel=1e-3)


@pytest.mark.all
def test_many_orders_are_served_by_the_same_octaves() -> None:
    pair = icosphere(1), icosphere(2)
    together = distance(*pair, [-1.0, -2.0, -6.0], rtol=0.02)
    for order in (-1.0, -2.0, -6.0):
        alone = distance(*pair, order, rtol=0.02)
        at_order = together.sel(order=order)
        assert abs(alone["distance"] - at_order["distance"]) <= alone["error"] + at_order["error"]


@pytest.mark.slow
def test_real_distances_at_a_common_scale() -> None:
    # A mesh that is a thousand times larger has, at frequencies a thousand times lower, the same distance but for
    # the length in the weight: octaves must follow the size of the surfaces, not the unit.
    large = [Mesh(50 * icosphere(level).vertices, icosphere(level).triangles) for level in (1, 2)]
    dataset = distance(large[0], large[1], -1.0, rtol=0.1)
    assert dataset["within"].item()


@pytest.mark.slow
def test_a_remainder_that_inner_ones_contradict_is_no_accuracy(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = PAIRS["moved box"]
    cutoffs: list[float] = []

    def misjudged(surfaces: Any, signs: Any, cutoff: float, *others: Any, **options: Any) -> Remainder:
        """Return half of what lies beyond all but the first cutoff, without any error."""
        cutoffs.append(cutoff)
        beyond = remainder(surfaces, signs, cutoff, *others, **options)
        (energy,) = beyond.energies
        energy, error = (energy, 0.1 * energy) if cutoff == cutoffs[0] else (energy / 2, 0.0)
        # No more points are drawn.
        return replace(beyond, energies=(energy,), errors=(error,), points=10**9)

    monkeypatch.setattr(octaves, "remainder", misjudged)
    with pytest.raises(AccuracyError, match="out of reach"):
        distance(a.mesh(), b.mesh(), -1.0, rtol=0.01)
