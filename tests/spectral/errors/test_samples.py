"""Exact values that fields are checked against."""

from __future__ import annotations

import numpy as np
import pytest

from sobolev_batch import Ellipsoid, InputError, Lattice, Sphere, icosphere, norm
from sobolev_batch.spectral.errors.a_priori import ErrorTarget, choose_settings
from sobolev_batch.spectral.errors.probe import draw
from sobolev_batch.spectral.errors.samples import Sample, draws_for, estimate, needs_probe
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.surfaces.shapes.surface import Surface
from tests.support.shapes import CENTRED_BOX as BOX

LATTICE = Lattice(3.0, 24)
ORDERS = (-2.0, -5.0)


@pytest.mark.parametrize("surface", [icosphere(3), Sphere(0.9), Ellipsoid((0.9, 0.7, 0.5))])
def test_norms_are_estimated_from_a_few_frequencies(surface: Surface) -> None:
    samples = [Sample.of(surface, draw(LATTICE, ORDERS, 2, 32, seed)) for seed in range(20)]
    squares = np.mean([estimate([sample], ORDERS) ** 2 for sample in samples], axis=0)
    expected = norm(surface, ORDERS, lattice=LATTICE)["norm"].values
    assert np.sqrt(squares) == pytest.approx(expected, rel=0.15)


def test_closed_forms_need_a_probe_in_single_precision_alone() -> None:
    single, double = TransformSettings(dtype="complex64"), TransformSettings()
    assert needs_probe(Sphere(), single)
    assert not needs_probe(Sphere(), double)
    assert needs_probe(BOX, double)
    assert needs_probe(Ellipsoid((1.0, 0.8, 0.6)), double)


def test_unknown_kinds_of_surfaces_are_refused_with_the_known_ones() -> None:
    draws = draws_for([Sphere()], LATTICE, ORDERS, 2)
    with pytest.raises(InputError, match=r"exact transform are Mesh, Smooth, Sphere; found Lattice"):
        Sample.of(LATTICE, draws)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"for meshes and parametrised surfaces, found Sphere"):
        choose_settings(Sphere(), LATTICE, ErrorTarget((-2.0,), (1e-3,)), TransformSettings())
