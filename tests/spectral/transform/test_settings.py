"""Settings of transforms: defaults, what is out of range, and those that follow from the error a field may have."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sobolev_batch import InputError, Lattice, Mesh, Sphere, fourier_transform, icosphere, norm
from sobolev_batch.spectral.backends import ComplexDtype
from sobolev_batch.spectral.fields import field_for
from sobolev_batch.spectral.lattice import SobolevWeights
from sobolev_batch.spectral.transform.transform import (
    ErrorTarget,
    TransformSettings,
    choose_settings,
    permits_single,
    transform_block,
)
from tests.support.shapes import CENTRED_BOX as BOX

LATTICE = Lattice(3.0, 32)

# One corner drawn out: triangles of very different sizes in one mesh.
DRAWN = icosphere(3).vertices.copy()
DRAWN[0] *= 1.9
MESHES = {
    "box": BOX,
    "icosphere": icosphere(4),
    "drawn": Mesh(0.6 * DRAWN, icosphere(3).triangles),
}


@pytest.mark.slow
@pytest.mark.parametrize("order", [-2.0, -5.0, -10.0])
@pytest.mark.parametrize("name", MESHES)
def test_chosen_fields_keep_their_goal_and_are_not_wasteful(name: str, order: float) -> None:
    mesh = MESHES[name]
    exact = fourier_transform(mesh, LATTICE, 1e-13)
    scale = norm(exact, order)["norm"].item()
    points = []
    for relative in (1e-2, 1e-4, 1e-6, 1e-8):
        target = ErrorTarget((order,), (relative * scale,))
        settings = choose_settings(mesh, LATTICE, target, TransformSettings())
        transformed = transform_block(mesh, LATTICE, LATTICE.half, settings)
        error = norm(exact.copy(data=transformed.values - exact.values), order)["norm"].item()
        # The forecast is no bound: the probe says what came of it, and whoever needs it tightens.
        assert error < 4 * target.norms[0]
        points.append(transformed.points)
    assert points == sorted(points)
    careful = transform_block(mesh, LATTICE, LATTICE.half, TransformSettings(1e-8)).points
    assert points[-1] <= careful


@pytest.mark.parametrize("name", MESHES)
def test_probed_fields_keep_their_goal(name: str) -> None:
    mesh, orders = MESHES[name], (-2.0, -8.0)
    exact = fourier_transform(mesh, LATTICE, 1e-13)
    target = ErrorTarget(orders, tuple((1e-5 * norm(exact, orders)["norm"].values).tolist()))
    field = field_for(mesh, LATTICE, target, TransformSettings())
    errors = norm(exact.copy(data=field.values - exact.values), orders)["norm"].values
    assert (errors <= target.norms).all()
    assert (field.quality.probe.norms(SobolevWeights(LATTICE, orders)) <= target.norms).all()


def test_single_precision_is_for_goals_above_its_rounding() -> None:
    area = Sphere().area
    assert permits_single(Sphere(), LATTICE, ErrorTarget((-2.0,), (1e-4 * area,)))
    assert not permits_single(Sphere(), LATTICE, ErrorTarget((-2.0,), (1e-8 * area,)))
    field = field_for(Sphere(), LATTICE, ErrorTarget((-2.0,), (1e-4 * area,)), TransformSettings(dtype="complex64"))
    # The rounding of a closed form to single precision is an error like any other.
    exact = fourier_transform(Sphere(), LATTICE)
    true = norm(exact.copy(data=field.values - exact.values), -2.0)["norm"].item()
    assert 0 < true < field.quality.probe.norms(SobolevWeights(LATTICE, (-2.0,)))[0] < 1e-6 * area


def test_settings_keep_precision_and_quadrature() -> None:
    given = TransformSettings(dtype="complex64")
    chosen = choose_settings(BOX, LATTICE, ErrorTarget((-2.0,), (1e-9,)), given)
    assert replace(chosen, eps=given.eps, tolerance=given.tolerance) == given
    assert chosen.eps == 2e-7


@pytest.mark.parametrize(("dtype", "eps"), [("complex128", 1e-9), ("complex64", 1e-6)])
def test_eps_and_tolerance_follow_from_the_dtype(dtype: ComplexDtype, eps: float) -> None:
    settings = TransformSettings(dtype=dtype)
    assert (settings.eps, settings.tolerance) == (eps, eps)
    assert pickle.loads(pickle.dumps(settings)) == settings
    settings = TransformSettings(1e-5, tolerance=1e-3)
    assert replace(settings, eps=1e-7) == TransformSettings(1e-7, tolerance=1e-3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        *(({"eps": eps}, "eps must lie between") for eps in (1e-15, 0.5, np.nan)),
        ({"eps": 1e-9, "dtype": "complex64"}, "eps must lie between"),
        ({"dtype": "float64"}, "dtype must be"),
        *(({"quadrature": method}, "quadrature must be") for method in ("gauss9", 0, 51, True, 2.5, None)),
    ],
)
def test_refuses_what_is_out_of_reach(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        TransformSettings(**settings)
