"""Surfaces far apart: their distance follows from both norms, at once, with an error that covers it."""

from __future__ import annotations

import numpy as np
import pytest

import sobolev_batch as sb
from sobolev_batch.norms.bounds import product_apart
from sobolev_batch.transform.spheres import sphere_inner_product
from tests.support.shapes import BOX_TRIANGLES, BOX_VERTICES

ORDERS = [-0.75, -1.0, -2.0, -5.0]


def box(sides: tuple[float, float, float], center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> sb.Mesh:
    return sb.Mesh((BOX_VERTICES / [1, 2, 4] - 0.5) * sides + center, BOX_TRIANGLES)


@pytest.mark.parametrize("order", [-0.6, -1.0, -1.5, -2.0, -4.0, -10.0])
def test_the_bound_on_a_product_holds_and_is_small_wherever_it_counts(order: float) -> None:
    rng, count = np.random.default_rng(0), 0
    for _ in range(60):
        radii, gap, rtol = 10 ** rng.uniform(-1, 1.5, 2), rng.uniform(0.0, 12.0), 10 ** rng.uniform(-6, -1)
        a, b = sb.shapes.Sphere(radii[0]), sb.shapes.Sphere(radii[1], (0.0, radii.sum() + gap, 0.0))
        bound = product_apart([a, b], [order], rtol)
        if bound is None:
            continue
        count += 1
        square = sphere_inner_product(a, a, order) + sphere_inner_product(b, b, order)
        # The closed form is exact to rounding.
        assert sphere_inner_product(a, b, order) <= bound[0] + 1e-15 * square
        assert bound[0] <= 0.01 * rtol * square
    assert count > 15


@pytest.mark.parametrize("place", [(9.0, 0.0, 0.0), (1e6, -2e6, 3e5)])
def test_the_distance_of_spheres_far_apart_is_that_of_the_closed_form(place: tuple[float, float, float]) -> None:
    a, b = sb.shapes.Sphere(0.8, place), sb.shapes.Sphere(1.1)
    truth, found = sb.distance(a, b, ORDERS), sb.distance(a, b, ORDERS, rtol=1e-3)
    assert found["within"].all()
    for name, error in (("distance", "error"), ("relative", "relative_error"), ("area_share", "area_share_error")):
        assert (np.abs(found[name] - truth[name]) <= found[error]).all()
        assert (found[error] <= 0.02 * found[name]).all()
    assert found["error_part"].sum("part").values == pytest.approx(found["error"].values)
    assert found["excess"].values == pytest.approx(-1, abs=1e-3)


@pytest.mark.slow
def test_no_lattice_holds_both() -> None:
    mesh = sb.shapes.icosphere(3)
    far = sb.Mesh(mesh.vertices + np.array([1e6, -2e6, 3e5]), mesh.triangles)
    alone, found = sb.norm(mesh, -2.0, rtol=1e-2), sb.distance(far, mesh, -2.0, rtol=1e-2)
    assert abs(found["relative"] - 2**0.5) <= found["relative_error"]
    assert found.attrs["M"] <= 2 * alone.attrs["M"]
    assert found.attrs["xi_max"] >= 0.5 * alone.attrs["xi_max"]
    assert [len(found.attrs[name]) for name in ("eps", "points")] == [2, 2]
    # The change of the reference is one of its own, in its own place.
    small = sb.Mesh(far.vertices[0] + 0.2 * mesh.vertices, mesh.triangles)
    moved = sb.yardsticks(small, mesh, -4.0, rtol=1e-2)
    beside = sb.Mesh(mesh.vertices + np.array([moved["moved"].item(), 0.0, 0.0]), mesh.triangles)
    assert sb.distance(beside, mesh, -4.0, rtol=1e-2)["distance"] == pytest.approx(moved["distance"].item(), rel=0.05)


@pytest.mark.slow
def test_differences_far_apart_on_a_common_part() -> None:
    plate = box((10.0, 1.0, 0.2))
    lumps = [box((0.5, 0.5, 0.5), (-4.6, 0.0, 0.35)), box((0.4, 0.6, 0.5), (4.6, 0.0, 0.35))]
    count = len(plate.vertices)
    a, b = (
        sb.Mesh(np.vstack([plate.vertices, lump.vertices]), np.vstack([plate.triangles, lump.triangles + count]))
        for lump in lumps
    )
    found = sb.distance(a, b, -4.0, rtol=1e-2)
    truth = np.hypot(*(sb.norm(lump, -4.0, rtol=1e-3)["norm"].item() for lump in lumps))
    whole = sb.norm(b, -4.0, rtol=1e-2)
    assert abs(found["distance"] - truth) <= found["error"] + 2e-3 * truth
    off = abs(found["relative"] - truth / whole["norm"]) / found["relative"]
    assert off <= found["relative_error"] / found["relative"] + whole["error"] / whole["norm"] + 2e-3
