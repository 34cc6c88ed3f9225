"""What distances are relative to the reference, against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sobolev_batch import Lattice, Mesh, Sphere, distance, icosphere
from sobolev_batch.spectral.errors.budget import NormEstimate
from sobolev_batch.spectral.exact.spheres import sphere_distance, sphere_inner_product


@pytest.mark.parametrize("settings", [{"lattice": Lattice(5.0, 64)}, {"rtol": 1e-2}])
@pytest.mark.parametrize("radius", [0.9, 1.2])
def test_relative_distances_and_shares_of_area(settings: dict[str, Any], radius: float) -> None:
    orders = [-1.0, -1.5, -2.0, -4.0]
    found = distance(Sphere(radius, (0.1, 0.0, 0.0)), Sphere(), orders, **settings)
    for order in orders:
        one = found.sel(order=order)
        squared = sphere_inner_product(Sphere(), Sphere(), order)
        product = sphere_inner_product(Sphere(radius, (0.1, 0.0, 0.0)), Sphere(), order) - squared
        relative = sphere_distance(Sphere(radius, (0.1, 0.0, 0.0)), Sphere(), order) / squared**0.5
        assert abs(one["relative"] - relative) <= one["relative_error"]
        assert abs(one["area_share"] - (product / squared / relative) ** 2) <= one["area_share_error"]
        if "rtol" in settings:
            assert one["relative_error"] <= 1.1e-2 * relative
            assert one["area_share_error"] <= 0.02
            assert one["excess"].item() == pytest.approx(product / squared, rel=0.02)


def test_equal_surfaces_differ_by_nothing() -> None:
    ball = icosphere(1)
    shuffled = Mesh(ball.vertices, ball.triangles[::-1])
    for settings in ({"lattice": Lattice(2.0, 16)}, {"rtol": 1e-2}):
        found = distance(shuffled, ball, -2.0, **settings)
        assert [found[name].item() for name in ("distance", "error", "relative", "relative_error")] == [0.0] * 4
        assert np.isnan(found["area_share"].item())


def test_norms_below_their_errors_give_no_relative_error() -> None:
    values, errors = NormEstimate(*np.full((4, 1), 0.1)).relative_to(NormEstimate(*np.full((4, 1), 0.2)))
    assert (values.item(), np.isnan(errors.item())) == (0.5, True)
    distances, norms = (
        NormEstimate(np.array([value]), *np.full((3, 1), error)) for value, error in ((0.5, 0.01), (2, 0.1))
    )
    close = distances.relative_to(norms)
    # The largest quotient that both errors permit.
    assert close[0].item() + close[1].item() == pytest.approx((0.5 + 0.03) / (2.0 - 0.3))
