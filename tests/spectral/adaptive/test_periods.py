"""Distances of surfaces that repeat, against the heat traces of rectangles: their errors cover the truth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sobolev_batch import distance
from tests.support.rectangles import Rectangles

Pair = tuple[Rectangles, Rectangles]


def strips(offset: float) -> Rectangles:
    """Long strips at a pitch of 0.04, half as wide."""
    lefts = 0.04 * np.arange(25) + offset
    return Rectangles.from_corners(*(((x, -0.45, 0), (x + 0.02, 0.45, 0)) for x in lefts))


def sheets(count: int, height: float) -> Rectangles:
    """Unit squares at gaps of 0.001."""
    heights = height + 1e-3 * np.arange(count)
    return Rectangles.from_corners(*(((-0.5, -0.5, z), (0.5, 0.5, z)) for z in heights))


# Plates at a pitch of 1/20 show no period below a frequency of 20.
PAIRS: dict[str, Callable[[], Pair]] = {
    "plates": lambda: (Rectangles.tapered(40, 1 / 20, 0.2), Rectangles.tapered(40, 1 / 20, 0.2, 0.5)),
    "fine plates": lambda: (Rectangles.tapered(35, 1 / 35, 0.3), Rectangles.tapered(35, 1 / 35, 0.3, 0.5)),
    "fins": lambda: (Rectangles.fins(30), Rectangles.fins(30).moved(0, 0, 1 / 60)),
    "strips": lambda: (strips(0.0), strips(0.02)),
    "layers": lambda: (sheets(3, 0.0), sheets(1, 5e-3)),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "order", "rtol"),
    [
        ("plates", -4.0, 1e-1),
        ("fine plates", -5.0, 1e-1),
        ("fins", -2.0, 1e-2),
        ("fins", -2.5, 1e-3),
        ("strips", -1.0, 1e-1),
        ("strips", -0.75, 1e-1),
        ("layers", -0.75, 3e-2),
    ],
)
def test_errors_cover_what_lies_beyond_the_measured_frequencies(name: str, order: float, rtol: float) -> None:
    first, second = PAIRS[name]()
    (truth,) = first.distance(second, [order])
    dataset = distance(first.mesh(), second.mesh(), order, rtol=rtol)
    assert dataset["within"].item()
    assert abs(dataset["distance"].item() - truth) <= dataset["error"].item()


@pytest.mark.slow
def test_a_distance_does_not_depend_on_the_other_orders() -> None:
    first, second = (surface.mesh() for surface in PAIRS["plates"]())
    alone, together = (
        distance(first, second, -4.0, rtol=1e-1),
        distance(first, second, [-3.4, -4.0], rtol=1e-1).isel(order=1),
    )
    assert abs(alone["distance"] - together["distance"]) <= alone["error"] + together["error"]
