"""Norms and distances of fields."""

from __future__ import annotations

import dask.array
import numpy as np
import pytest

import sobolev_batch as sb
from tests.support.oracles import full_lattice_norm
from tests.support.shapes import CENTRED_BOX as BOX

LATTICE = sb.Lattice(4.0, 32)


@pytest.mark.slow
@pytest.mark.parametrize("order", [-0.6, -2.0, -10.0])
def test_norm_is_the_trapezoidal_rule_over_the_whole_cube(order: float) -> None:
    a, b = sb.fourier_transform(BOX, LATTICE), sb.fourier_transform(sb.shapes.Sphere(), LATTICE)
    assert sb.norm(a, order)["norm"].item() == pytest.approx(full_lattice_norm(a.values, LATTICE, order), rel=1e-13)
    difference = full_lattice_norm((a - b).values, LATTICE, order)
    assert sb.distance(a, b, order)["distance"].item() == pytest.approx(difference, rel=1e-13)


@pytest.mark.parametrize("order", [-0.5, -0.49, 0, 2, float("nan"), float("-inf"), [-2.0, -0.1], []])
def test_refuses_orders_without_a_norm(order: float | list[float]) -> None:
    with pytest.raises(sb.errors.OrderError):
        sb.norm(sb.shapes.Sphere(), order)


def test_an_order_that_is_named_twice_counts_once() -> None:
    field = sb.fourier_transform(BOX, LATTICE)
    for ask in (sb.norm, lambda one, order: sb.spectrum(one, None, order)):
        assert ask(field, [-2, -3.0, -2.0])["order"].values.tolist() == [-2.0, -3.0]
        assert ask(field, [-2, -2]).sizes["order"] == 1
        assert "order" not in ask(field, np.float64(-2.0)).dims
    assert sb.distance(BOX, sb.shapes.Sphere(), [-5, -5.0, -6], rtol=0.1)["within"].sizes == {"order": 2}


def test_surfaces_take_the_lattice_of_the_field_beside_them() -> None:
    field = sb.fourier_transform(sb.shapes.Sphere(), LATTICE)
    direct = sb.distance(sb.fourier_transform(BOX, LATTICE), field, -2)["distance"].item()
    assert sb.distance(BOX, field, -2)["distance"].item() == pytest.approx(direct, rel=1e-14)


def test_refuses_what_cannot_be_compared() -> None:
    field = sb.fourier_transform(sb.shapes.Sphere(), LATTICE)
    with pytest.raises(sb.errors.LatticeError, match="different lattices"):
        sb.distance(field, sb.fourier_transform(sb.shapes.Sphere(), sb.Lattice(4.0, 30)), -2)
    with pytest.raises(sb.errors.InputError, match="needs a lattice"):
        sb.norm(BOX, -2)
    with pytest.raises(sb.errors.InputError, match=r"a lattice is a Lattice.*found tuple"):
        sb.norm(BOX, -2, lattice=(4.0, 32))  # type: ignore[arg-type]
    with pytest.raises(sb.errors.InputError, match="found dict"):
        sb.norm({}, -2)
    with pytest.raises(sb.errors.LatticeError, match="select one mesh"):
        sb.norm(field.expand_dims(mesh=["a"]), -2)
    with pytest.raises(sb.errors.InputError, match="a Fourier field has complex values, found float64"):
        sb.distance(field.real, sb.shapes.Sphere(), -2)


def test_lazy_and_transposed_fields_give_the_same_numbers() -> None:
    field = sb.fourier_transform(BOX, LATTICE)
    lazy = field.copy(data=dask.array.from_array(field.values, chunks=(10, 33, 5)))
    assert sb.norm(lazy.transpose("xi_z", "xi_x", "xi_y"), -2)["norm"].item() == sb.norm(field, -2)["norm"].item()


def test_single_precision_fields_are_summed_in_double() -> None:
    field = sb.fourier_transform(sb.shapes.icosphere(2), LATTICE, 1e-6)
    single = sb.norm(field.astype(np.complex64), -2)["norm"].item()
    assert single == pytest.approx(sb.norm(field, -2)["norm"].item(), rel=1e-7)
