"""Fields between the frequencies of their lattice, against the exact transform; and on the whole lattice."""

from __future__ import annotations

import dask.array
import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch import InputError, Lattice, LatticeError, Mesh, Sphere, fourier_transform, icosphere
from sobolev_batch.spectral.exact.spheres import sphere_transform
from sobolev_batch.spectral.exact.triangles import exact_transform
from sobolev_batch.spectral.metrics.interpolation import full_lattice, interpolate

Reals = NDArray[np.float64]

EPS = 1e-13


def away(shift: tuple[float, float, float]) -> Mesh:
    sphere = icosphere(2)
    return Mesh(0.4 * sphere.vertices + np.asarray(shift), sphere.triangles)


@pytest.mark.parametrize(
    ("mesh", "M", "inside", "beside"),
    [
        # A box of a third of the period, of half of it, and a small one at the period's end.
        (icosphere(3), 64, 1e-11, 2e-9),
        (icosphere(3), 40, 1e-6, 1e-6),
        (away((2.5, -2.7, 0.1)), 64, 1e-11, 1e-9),
    ],
)
def test_against_the_exact_transform(mesh: Mesh, M: int, inside: float, beside: float) -> None:
    rng = np.random.default_rng(0)
    lattice = Lattice(5.0, M)
    field = fourier_transform(mesh, lattice, EPS)
    # Within twelve samples of no face of the cube, and in the last cell before one.
    inner = rng.uniform(-1, 1, (150, 3)) * max(5.0 - 12 * lattice.spacing, 1.0)
    outer = rng.uniform(-5, 5, (150, 3))
    outer[np.arange(150), rng.integers(0, 3, 150)] = rng.choice([-1, 1], 150) * rng.uniform(5 - lattice.spacing, 5, 150)
    for frequencies, tolerance in ((inner, inside), (outer, beside)):
        interpolated = interpolate(field, frequencies)
        errors = np.abs(interpolated.values - exact_transform(mesh, frequencies))
        assert errors.max() < tolerance * mesh.area
        # The bound holds, and is not idle.
        bounds, amplification = interpolated["error"].values, interpolated["amplification"].values
        assert (errors <= bounds + 3 * EPS * mesh.area * amplification).all()
        assert bounds.max() < 1e-4 * mesh.area


def test_known_bounds() -> None:
    # As documented: a box of a third of the period.
    field = fourier_transform(Sphere(), Lattice(5.0, 64))
    area = Sphere().area
    inner = interpolate(field, np.random.default_rng(1).uniform(-3, 3, (50, 3)))
    assert inner["error"].values.max() < 3e-10 * area
    assert inner["amplification"].values.max() < 10
    faces = interpolate(field, [[4.95, 0.3, 0.2], [0.1, -4.93, 4.97]])
    assert faces["error"].values.max() < 1e-7 * area


def test_samples_and_their_conjugates_come_back() -> None:
    lattice = Lattice(3.0, 48)
    field = fourier_transform(away((0.3, 0.2, -0.1)), lattice, EPS)
    frequencies = np.array([[0, 0, 0], [1.5, -0.75, 2.0], [-3, 3, -3], [-1.5, 0.75, -2.0]])
    interpolated = interpolate(field, frequencies).values
    expected = field.sel(xi_x=1.5, xi_y=-0.75, xi_z=2.0).item()
    assert interpolated[0] == pytest.approx(field.sel(xi_x=0, xi_y=0, xi_z=0).item(), rel=1e-9)
    assert interpolated[1] == pytest.approx(expected, rel=0, abs=1e-9)
    assert interpolated[3] == np.conj(interpolated[1])
    assert interpolated[2] == pytest.approx(np.conj(field.sel(xi_x=3, xi_y=-3, xi_z=3).item()), rel=0, abs=1e-7)


def test_fields_that_do_not_know_their_box() -> None:
    sphere = Sphere(0.5, (0.1, 0.0, -0.2))
    field = fourier_transform(sphere, Lattice(5.0, 64)).drop_attrs()
    frequencies = np.random.default_rng(2).uniform(-3, 3, (20, 3))
    with pytest.raises(InputError, match="pass reach"):
        interpolate(field, frequencies)
    interpolated = interpolate(field, frequencies, reach=0.8)
    assert interpolated.values == pytest.approx(sphere_transform(sphere, frequencies), rel=0, abs=1e-9)
    with pytest.raises(LatticeError, match="reach must lie between"):
        interpolate(field, frequencies, reach=3.3)


def test_refuses_to_extrapolate_and_malformed_frequencies() -> None:
    field = fourier_transform(Sphere(), Lattice(3.0, 24))
    with pytest.raises(LatticeError, match="cannot be extrapolated"):
        interpolate(field, [[0, 0, 3.01]])
    for frequencies in ([1.0, 2.0, 3.0], [[np.nan, 0, 0]], "abc"):
        with pytest.raises(InputError, match="frequencies must"):
            interpolate(field, frequencies)
    with pytest.raises(LatticeError, match="select one mesh"):
        interpolate(field.expand_dims(mesh=["a"]), [[0, 0, 0]])


def test_the_whole_lattice() -> None:
    lattice, mesh = Lattice(2.0, 8), away((0.3, 0.2, -0.1))
    field = fourier_transform(mesh, lattice, EPS)
    full = full_lattice(field)
    assert full.shape == (9, 9, 9)
    assert full.dims == field.dims
    for name in ("xi_x", "xi_y", "xi_z"):
        assert np.array_equal(full[name], lattice.axes[0])
    frequencies: Reals = np.random.default_rng(3).integers(-4, 5, (40, 3)) * lattice.axes[2][1]
    interpolated = [full.sel(xi_x=x, xi_y=y, xi_z=z).item() for x, y, z in frequencies]
    assert np.asarray(interpolated) == pytest.approx(exact_transform(mesh, frequencies), rel=0, abs=1e-11)
    stacked = xr.concat([field, 2 * field], dim="mesh").assign_coords(mesh=["a", "b"])
    lazy = full_lattice(stacked.chunk({"mesh": 1}).transpose("xi_z", "mesh", "xi_x", "xi_y"))
    assert isinstance(lazy.data, dask.array.Array)
    assert lazy.sel(mesh="b").transpose(*full.dims).values == pytest.approx(2 * full.values)
    with pytest.raises(LatticeError):
        full_lattice(full)
