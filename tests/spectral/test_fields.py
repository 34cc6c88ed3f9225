"""Fields as users get them: coordinates, attributes, parameters."""

from __future__ import annotations

import numpy as np
import pytest

from sobolev_batch import Lattice, Sphere, fourier_transform, icosphere
from sobolev_batch.spectral.fields import Quality


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
