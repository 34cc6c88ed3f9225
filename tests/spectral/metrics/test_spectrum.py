"""Spectra: sums of bands, their positions, and the wavelengths that they show."""

from __future__ import annotations

import numpy as np
import pytest

from sobolev_batch import (
    InputError,
    Lattice,
    Mesh,
    OrderError,
    Similarity,
    Sphere,
    distance,
    fourier_transform,
    icosphere,
    norm,
    spectrum,
)
from tests.support.shapes import CENTRED_BOX as BOX

LATTICE = Lattice(4.0, 32)
ORDERS = [-0.7, -2.0, -10.0]


@pytest.mark.parametrize("bands", [None, 1, 7, 40])
def test_bands_add_up_to_the_squared_distance(bands: int | None) -> None:
    a, b = fourier_transform(BOX, LATTICE), fourier_transform(Sphere(), LATTICE)
    dataset = spectrum(a, b, ORDERS, bands=bands)
    squares = distance(a, b, ORDERS)["distance"].values ** 2
    assert dataset["squared"].sum("band").values == pytest.approx(squares, rel=1e-12)
    assert dataset["share"].sum("band").values == pytest.approx(1, rel=1e-12)
    assert dataset["total"].values == pytest.approx(squares, rel=1e-12)
    assert spectrum(a, None, -2.0, bands=bands)["squared"].sum().item() == pytest.approx(
        norm(a, -2.0)["norm"].item() ** 2, rel=1e-12
    )


def test_bands_are_sums_over_the_whole_lattice() -> None:
    rng = np.random.default_rng(0)
    lattice = Lattice(1.5, 6)
    values = rng.standard_normal(lattice.shape) + 1j * rng.standard_normal(lattice.shape)
    field = fourier_transform(Sphere(0.1), lattice).copy(data=values)
    edges = [0.0, 0.5, 0.8, 1.5, 2.1]  # the shells |k|² = 1 and 9 lie on edges, those beyond 17 in no band
    dataset = spectrum(field, None, -2.0, bands=edges)
    x, y, z = np.meshgrid(*lattice.axes, indexing="ij")
    ends = [np.where(np.abs(axis) == 1.5, 0.5, 1.0) for axis in (x, y, z)]
    weights = 0.5**3 * ends[0] * ends[1] * ends[2] * np.where(z > 0, 2, 1)
    radii = np.round(np.sqrt(x**2 + y**2 + z**2), 12)
    for i in range(4):
        inside = (radii >= edges[i]) & (radii < edges[i + 1])
        expected = np.sum((weights * (1 + radii**2) ** -2.0 * np.abs(values) ** 2)[inside])
        assert dataset["squared"].values[i] == pytest.approx(expected, rel=1e-12)
        mean = np.average(np.abs(values[inside]) ** 2, weights=weights[inside])
        assert dataset["mean_square"].values[i] == pytest.approx(mean, rel=1e-12)
    assert dataset["squared"].sum().item() < dataset["total"].item()


def test_energy_of_a_sphere_is_its_closed_form() -> None:
    # ∫_{|ξ|=r} |σ^|² dS = 16π sin²(2πr): twice the area in the mean over whole periods, zero at multiples of 1/2.
    lattice = Lattice(5.0, 160)
    edges = np.arange(1.0, 5.01, 0.125)
    dataset = spectrum(Sphere(), None, -2.0, bands=edges.tolist(), lattice=lattice)
    middles = (edges[1:] + edges[:-1]) / 2
    averages = 8 * np.pi * (1 - np.sinc(2 * 0.125) * np.cos(4 * np.pi * middles))
    assert dataset["energy"].values == pytest.approx(averages, rel=0.1, abs=1.5)
    whole = spectrum(Sphere(), None, -2.0, bands=[1.0, 5.0], lattice=lattice)
    assert whole["energy"].item() == pytest.approx(2 * Sphere().area, rel=0.02)


@pytest.mark.parametrize("frequency", [1.0, 2.0])
def test_ripples_show_from_their_frequency_on(frequency: float) -> None:
    # A rippled sheet of side 2 against the flat one: ξ_x is the ripples' frequency up to 1/2, ξ_z is any.
    n = 64
    x, y = np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1), indexing="ij")
    first = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    lower, upper = [first, first + n + 1, first + 1], [first + 1, first + n + 1, first + n + 2]
    triangles = np.concatenate([np.stack(lower, axis=1), np.stack(upper, axis=1)])
    flat, rippled = (
        Mesh(np.stack([x, y, height * np.sin(2 * np.pi * frequency * x)], -1).reshape(-1, 3), triangles)
        for height in (0.0, 1e-3)
    )
    bands = [0.0, 0.6 * frequency, frequency, 1.5 * frequency]
    dataset = spectrum(rippled, flat, -1.0, bands=bands, lattice=Lattice(4.0, 32))
    below, _, above = dataset["energy"].values.tolist()
    assert above > 20 * below
    assert dataset["share"].values[0] < 0.02


def test_default_bands_and_wavelengths() -> None:
    similarity = Similarity(0.02)
    dataset = spectrum(icosphere(2), Sphere(), -3.0, lattice=LATTICE, similarity=similarity)
    assert dataset["upper"].values == pytest.approx([0.5, 1, 2, 4, 4 * 3**0.5])
    assert dataset["lower"].values[0] == 0
    assert dataset["longest_wavelength"].values == pytest.approx([np.inf, 2, 1, 0.5, 0.25])
    assert dataset["own_shortest_wavelength"].values[:4] == pytest.approx([100, 50, 25, 12.5])
    assert dataset["squared"].dims == ("band",)
    assert "own_longest_wavelength" not in spectrum(Sphere(), None, -3.0, lattice=LATTICE).coords


def test_equal_fields_have_no_shares_and_missing_samples_no_spectrum() -> None:
    a = fourier_transform(Sphere(), LATTICE)
    assert np.isnan(spectrum(a, a, -2.0)["share"].values).all()
    damaged = a.copy()
    damaged[16, 16, 0] = np.nan
    dataset = spectrum(damaged, a, -2.0)
    assert np.isnan(dataset["total"].item())
    assert np.isnan(dataset["squared"].values[0])


@pytest.mark.parametrize(
    "bands", [0, -3, [1.0], [1.0, 1.0], [2.0, 1.0], [-1.0, 1.0], [0.0, np.inf], "octaves", [[0, 1]]]
)
def test_refuses_bands(bands: object) -> None:
    with pytest.raises(InputError, match="band"):
        spectrum(Sphere(), None, -2.0, lattice=LATTICE, bands=bands)  # type: ignore[arg-type]


def test_refuses_what_norms_refuse() -> None:
    with pytest.raises(OrderError):
        spectrum(Sphere(), None, -0.5, lattice=LATTICE)
    with pytest.raises(InputError, match="needs a lattice"):
        spectrum(BOX, None, -2.0)
