"""Bounds on relative distances hold, and tell on which side of a threshold a distance lies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import sobolev_batch as sb
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.norms.accuracy import threshold
from sobolev_batch.norms.accuracy.threshold import Interval, Method, relative_distance
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.transform.fourier import transform_block
from tests.support.rectangles import Rectangles

NOTHING = Rectangles(np.zeros((0, 3)), np.zeros((0, 3)))


def bounded(surface: Surface, reference: Surface, order: float, threshold: float) -> tuple[Interval, Method]:
    return relative_distance(surface, reference, order, threshold, Accuracy(threshold), 2, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "method", "gap"), [(-4.0, "lattice", 0.01), (-2.5, "lattice", 0.01), (-1.2, "octaves", 0.05)]
)
@pytest.mark.parametrize("sign", [-1, 1])
def test_spheres_against_their_closed_form(order: float, method: str, gap: float, sign: int) -> None:
    side = 1 + sign * gap
    surface, reference = sb.shapes.Sphere(0.97, (0.01, 0.02, 0.0)), sb.shapes.Sphere()
    truth = float(sb.distance(surface, reference, order)["distance"] / sb.norm(reference, order)["norm"])
    found, used = bounded(surface, reference, order, side * truth)
    assert found.lower <= truth <= found.upper
    assert (found.upper <= side * truth, found.lower > side * truth) == (side > 1, side < 1)
    assert side < 1 or used == method


@pytest.mark.slow
@pytest.mark.parametrize("order", [-4.0, -2.0])
@pytest.mark.parametrize("threshold", [3e-3, 0.1])
def test_surfaces_that_repeat_beyond_the_lattice(order: float, threshold: float) -> None:
    # Between the fins of the other one: below a frequency of 12 there is next to nothing of the difference.
    fins = Rectangles.fins(12)
    between = fins.moved(0.0, 0.0, 1 / 24)
    (distance,), (norm,) = fins.distance(between, [order]), fins.distance(NOTHING, [order])
    found, _ = bounded(between.mesh(), fins.mesh(), order, threshold)
    assert found.lower <= distance / norm <= found.upper
    assert (found.upper <= threshold) == (distance / norm <= threshold)


@pytest.mark.parametrize("layers", [2, 16])
def test_layers_in_one_place_weigh_more_beyond_the_lattice(layers: int) -> None:
    """As of a sheet that is stored with both of its sides, or of scans that overlap."""
    moved, stack = (Rectangles.from_corners(*(((0, 0, z), (1.4, 1.4, z)) for _ in range(layers))) for z in (0.05, 0.0))
    # Coincident layers are so many times as far as one.
    one, other = (Rectangles.from_corners(((0, 0, z), (1.4, 1.4, z))) for z in (0.05, 0.0))
    (distance,), (norm,) = one.distance(other, [-0.8]), other.distance(NOTHING, [-0.8])
    (bounds, _) = bounded(moved.mesh(), stack.mesh(), -0.8, 0.98 * distance / norm)
    assert bounds.lower <= distance / norm <= bounds.upper


def test_a_distance_at_the_threshold_is_left_undecided() -> None:
    surface, reference = sb.shapes.Sphere(0.97), sb.shapes.Sphere()
    truth = float(sb.distance(surface, reference, -4.0)["distance"] / sb.norm(reference, -4.0)["norm"])
    found, _ = bounded(surface, reference, -4.0, truth)
    assert found.lower <= truth <= found.upper
    # Not for lack of effort.
    assert found.upper - found.lower < 0.01 * truth


def test_surfaces_that_do_not_feel_each_other_are_as_far_apart_as_their_norms_say() -> None:
    found, _ = bounded(sb.shapes.Sphere(1.0, (1e6, -2e6, 0.0)), sb.shapes.Sphere(), -4.0, 1e-3)
    assert found.lower == pytest.approx(2**0.5, rel=0.05)
    assert found.lower <= 2**0.5 <= found.upper


def test_the_norm_of_a_reference_is_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    transformed: list[float] = []

    def counted(surface: sb.Mesh, *settings: Any) -> Any:
        transformed.append(surface.area)
        return transform_block(surface, *settings)

    monkeypatch.setattr(threshold, "transform_block", counted)
    ball = sb.shapes.icosphere(2)
    for scale, radius in ((0.97, 1.25), (0.96, 1.25), (0.97, 1.5)):
        # Each time as if it were read anew.
        reference = sb.Mesh(radius * ball.vertices, ball.triangles)
        bounded(sb.Mesh(scale * reference.vertices, ball.triangles), reference, -4.0, 0.1)
    assert transformed == pytest.approx([1.25**2 * ball.area, 1.5**2 * ball.area])
