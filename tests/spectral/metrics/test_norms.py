"""Norms and distances of fields."""

from __future__ import annotations

import dask.array
import numpy as np
import pytest

from sobolev_batch import (
    InputError,
    Lattice,
    LatticeError,
    OrderError,
    Sphere,
    distance,
    fourier_transform,
    icosphere,
    norm,
)
from tests.support.oracles import full_lattice_norm
from tests.support.shapes import CENTRED_BOX as BOX

LATTICE = Lattice(4.0, 32)


@pytest.mark.slow
@pytest.mark.parametrize("order", [-0.6, -2.0, -10.0])
def test_norm_is_the_trapezoidal_rule_over_the_whole_cube(order: float) -> None:
    a, b = fourier_transform(BOX, LATTICE), fourier_transform(Sphere(), LATTICE)
    assert norm(a, order)["norm"].item() == pytest.approx(full_lattice_norm(a.values, LATTICE, order), rel=1e-13)
    difference = full_lattice_norm((a - b).values, LATTICE, order)
    assert distance(a, b, order)["distance"].item() == pytest.approx(difference, rel=1e-13)


@pytest.mark.parametrize("order", [-0.5, -0.49, 0, 2, float("nan"), float("-inf"), [-2.0, -0.1], []])
def test_refuses_orders_without_a_norm(order: float | list[float]) -> None:
    with pytest.raises(OrderError):
        norm(Sphere(), order)


def test_surfaces_take_the_lattice_of_the_field_beside_them() -> None:
    field = fourier_transform(Sphere(), LATTICE)
    direct = distance(fourier_transform(BOX, LATTICE), field, -2)["distance"].item()
    assert distance(BOX, field, -2)["distance"].item() == pytest.approx(direct, rel=1e-14)


def test_refuses_what_cannot_be_compared() -> None:
    field = fourier_transform(Sphere(), LATTICE)
    with pytest.raises(LatticeError, match="different lattices"):
        distance(field, fourier_transform(Sphere(), Lattice(4.0, 30)), -2)
    with pytest.raises(InputError, match="needs a lattice"):
        norm(BOX, -2)
    with pytest.raises(InputError, match="found dict"):
        norm({}, -2)
    with pytest.raises(LatticeError, match="select one mesh"):
        norm(field.expand_dims(mesh=["a"]), -2)
    with pytest.raises(InputError, match="a Fourier field has complex values, found float64"):
        distance(field.real, Sphere(), -2)


def test_lazy_and_transposed_fields_give_the_same_numbers() -> None:
    field = fourier_transform(BOX, LATTICE)
    lazy = field.copy(data=dask.array.from_array(field.values, chunks=(10, 33, 5)))
    assert norm(lazy.transpose("xi_z", "xi_x", "xi_y"), -2)["norm"].item() == norm(field, -2)["norm"].item()


def test_single_precision_fields_are_summed_in_double() -> None:
    field = fourier_transform(icosphere(2), LATTICE, 1e-6)
    single = norm(field.astype(np.complex64), -2)["norm"].item()
    assert single == pytest.approx(norm(field, -2)["norm"].item(), rel=1e-7)
