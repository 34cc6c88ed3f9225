"""Fields as users get them, and the exact values that they are checked against."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import beta

from sobolev_batch import Lattice, Mesh, distance, fourier_transform, norm
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.norms.fields import PROBED_ORDERS, Quality
from sobolev_batch.shapes import Ellipsoid, Sphere, Torus, icosphere
from sobolev_batch.transform.fourier import TransformSettings, transform_block
from sobolev_batch.transform.lattice import SobolevWeights, shell_sums
from sobolev_batch.transform.probe import Sample, draw, estimate, join, measure, with_own
from tests.support.shapes import CENTRED_BOX

LATTICE = Lattice(3.0, 24)
ORDERS = (-2.0, -5.0)


@pytest.mark.slow
@pytest.mark.parametrize("surface", [icosphere(3), Sphere(0.9), Ellipsoid((0.9, 0.7, 0.5))])
def test_norms_are_estimated_from_a_few_frequencies(surface: Surface) -> None:
    samples = [Sample.from_surface(surface, draw(LATTICE, ORDERS, 2, 32, seed)) for seed in range(20)]
    squares = np.mean([estimate([sample], ORDERS) ** 2 for sample in samples], axis=0)
    expected = norm(surface, ORDERS, lattice=LATTICE)["norm"].values
    assert np.sqrt(squares) == pytest.approx(expected, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("eps", [1e-3, 1e-6])
@pytest.mark.parametrize("surface", [icosphere(3), Torus(0.9, 0.3)])
def test_whichever_frequencies_are_drawn_their_probe_covers_the_error(surface: Surface, eps: float) -> None:
    field, exact = (fourier_transform(surface, LATTICE, accuracy, threads=1) for accuracy in (eps, 1e-14))
    true_errors = distance(field, exact, ORDERS)["distance"].values
    degree = 2 if isinstance(surface, Mesh) else 16
    covered, ratios = [], []
    for seed in range(100):
        draws = draw(LATTICE, PROBED_ORDERS, degree, 32, seed)
        places = tuple((draws.indices - LATTICE.half.start).T)
        probe = measure(draws, field.values[places], exact.values[places].astype(np.complex128))
        reported = probe.norms(SobolevWeights(LATTICE, ORDERS))
        covered.append(reported >= true_errors)
        ratios.append(reported / true_errors)
    assert np.mean(covered) >= 0.98
    assert np.median(ratios) < 3


@pytest.mark.parametrize("probed", [-0.6, -2.0, -20.0, -100.0])
def test_an_error_that_is_probed_at_one_order_serves_others(probed: float) -> None:
    orders, ratios = (-0.6, -2.0, -5.0, -20.0, -100.0), []
    for size in np.linspace(0.5, 1.0, 8):
        mesh = Mesh(size * CENTRED_BOX.vertices, CENTRED_BOX.triangles)
        coarse = fourier_transform(mesh, LATTICE, quadrature=2, order=probed, threads=1)
        true_errors = distance(coarse, fourier_transform(mesh, LATTICE, 1e-14, threads=1), orders)["distance"].values
        probe = Quality.from_json(coarse.attrs["quality"]).probe
        ratios.append(probe.norms(SobolevWeights(LATTICE, orders)) / true_errors)
    assert np.min(ratios) > 1
    assert np.median(ratios) < 3


@pytest.mark.slow
def test_tiny_surfaces_have_distances_at_orders_whose_weights_underflow() -> None:
    size, offset, order = 1e-6, 1e-8, -30.0
    a = Mesh(size * CENTRED_BOX.vertices, CENTRED_BOX.triangles)
    found = distance(Mesh(a.vertices + np.array([offset, 0, 0]), a.triangles), a, order, rtol=0.1)
    # So near to zero, the kernel is a parabola: half of its slope is the mean of (2πξ)² along an axis.
    slope = (2 * np.pi) ** 2 / 3 * 2 * np.pi * beta(2.5, -order - 2.5)
    assert abs(found["distance"] - np.sqrt(slope) * offset * a.area) < found["error"] + 1e-9 * found["distance"]
    assert found["within"]


def test_draws_among_a_fields_own_values_meet_its_peaks_without_bias() -> None:
    # Pieces whose pitch is that of the lattice: of 18,000 frequencies some fifty are peaks.
    lattice, orders, piece = Lattice(2.5, 32), (-2.0,), icosphere(0)
    places = 0.4 * np.stack(np.meshgrid(*[np.arange(6)] * 3), axis=-1).reshape(-1, 1, 3) - 1
    triangles = piece.triangles + len(piece.vertices) * np.arange(len(places))[:, None, None]
    mesh = Mesh((0.1 * piece.vertices + places).reshape(-1, 3), triangles.reshape(-1, 3))
    values, exact = (
        transform_block(mesh, lattice, lattice.half, settings).values
        for settings in (TransformSettings(1e-9, tolerance=1e-2), TransformSettings(1e-13))
    )
    weights = SobolevWeights(lattice, orders)
    true = weights.per_shell @ shell_sums(values - exact, None, lattice, lattice.half)
    covered, squares = [], []
    for seed in range(200):
        draws, probes = draw(lattice, orders, 2, 8, seed), []
        for block in lattice.half.split(6_000) if seed % 2 else (lattice.half,):
            pooled = with_own(draws, draws.count, lattice, block, values[block.place_in(lattice.half)])
            places_of_all = tuple((pooled.indices - lattice.half.start).T)
            probes.append(measure(pooled, values[places_of_all], exact[places_of_all].astype(np.complex128)))
        probe = join(probes)
        covered.append(probe.norms(weights)[0] ** 2 >= true[0])
        squares.append((weights.per_shell[:, list(probe.shells)] @ np.array(probe.sums))[0])
    assert np.mean(squares) == pytest.approx(true[0], rel=0.15)
    assert np.mean(covered) > 0.9


def test_field_coordinates_and_attributes() -> None:
    field = fourier_transform(Sphere(1.5), Lattice(1.0, 8))
    assert field.dims == ("xi_x", "xi_y", "xi_z")
    assert field.sel(xi_x=0, xi_y=0, xi_z=0).item() == pytest.approx(9 * np.pi)
    assert field["xi_z"].attrs["units"] == "cycles per unit length"
    assert Quality.from_json(field.attrs["quality"]).area == pytest.approx(9 * np.pi)
    assert (field.attrs["xi_max"], field.attrs["M"], field.attrs["eps"]) == (1.0, 8, 1e-9)
    assert field.attrs["units"] == "squared units of length"
    assert {"long_name", "convention", "quadrature", "backend"} <= field.attrs.keys()


def test_one_order_or_several_are_probed() -> None:
    mesh, lattice = icosphere(1), Lattice(1.0, 8)
    one, several = (fourier_transform(mesh, lattice, order=order, threads=1) for order in (-2.0, [-2.0]))
    assert one.attrs == several.attrs
