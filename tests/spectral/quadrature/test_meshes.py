"""From meshes to weighted points."""

from __future__ import annotations

import numpy as np
import pytest

from sobolev_batch import InputError, Mesh, icosphere
from sobolev_batch.spectral.quadrature.meshes import Quadrature
from sobolev_batch.spectral.quadrature.plan import QuadraturePlan
from tests.support.shapes import CENTRED_BOX as BOX


@pytest.mark.parametrize("method", ["auto", "gauss8", 1, 7, 50])
@pytest.mark.parametrize("capacity", [4_000, 20_000, 1 << 22])
def test_batches_hold_the_area_and_the_second_moments(method: str | int, capacity: int) -> None:
    batches = list(QuadraturePlan.of(BOX, 8.0, 1e-10, Quadrature(method)).batches(capacity))
    assert max(len(batch.weights) for batch in batches) <= capacity
    coordinates = np.concatenate([batch.coordinates for batch in batches], axis=1)
    weights = np.concatenate([batch.weights for batch in batches])
    assert (weights > 0).all()
    assert weights.sum() == pytest.approx(BOX.area, rel=1e-13)
    if method != 1:
        # ∫ x² over a box of sides a, b, c: two faces at ±a/2, and four that run through.
        a, b, c = 1.0, 1.2, 1.4
        assert weights @ coordinates[0] ** 2 == pytest.approx(b * c * a**2 / 2 + a**3 / 6 * (b + c), rel=1e-13)


def test_batches_are_nearly_equal() -> None:
    plan = QuadraturePlan.of(icosphere(5), 8.66, 1e-9)
    sizes = [len(batch.weights) for batch in plan.batches(200_000)]
    assert len(sizes) == 3
    assert max(sizes) < 1.4 * min(sizes)


def points_per_triangle(method: str | int, mesh: Mesh, tolerance: float) -> float:
    batches = QuadraturePlan.of(mesh, 8.66, tolerance, Quadrature(method)).batches(1 << 22)
    return sum(len(batch.weights) for batch in batches) / len(mesh.triangles)


def test_small_triangles_get_few_points() -> None:
    fine = icosphere(6)
    assert points_per_triangle("auto", fine, 1e-9) <= 15
    assert points_per_triangle("auto", fine, 1e-4) <= 6
    assert points_per_triangle("auto", fine, 1e-2) == 1.5
    assert points_per_triangle("auto", fine, 0.2) == pytest.approx(0.5, abs=1e-4)
    assert points_per_triangle("gauss8", fine, 1e-9) == 64


@pytest.mark.parametrize("method", ["gauss9", 0, 51, True, 2.5, None])
def test_refuses_other_methods(method: object) -> None:
    with pytest.raises(InputError, match="quadrature must be"):
        Quadrature(method)  # type: ignore[arg-type]
