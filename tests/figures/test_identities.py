"""Identities on a real surface: the cortex of workflows/cortex.toml, decimated, against itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import sobolev_batch as sb
from sobolev_batch.batch.study.plan import members_of
from sobolev_batch.spectral.backends import NufftSpec
from sobolev_batch.spectral.lattice import AXES
from sobolev_batch.spectral.quadrature.kinds import kind_of
from sobolev_batch.spectral.quadrature.meshes import WeightedPoints
from sobolev_batch.spectral.transform.nufft import transform_points

WORKFLOW = Path(__file__).parents[2] / "workflows/cortex.toml"
LATTICE = sb.Lattice(5.0, 32)
ORDERS = [-0.8, -2.0, -6.0]


@pytest.fixture(scope="module")
def points() -> tuple[list[WeightedPoints], list[WeightedPoints]]:
    """Points of the midpoint rule on the cortex with 1,280 triangles, and on the whole one."""
    study = sb.Study.from_toml(WORKFLOW)
    members = members_of(study)
    whole, coarse = (members[label][1].load() for label in ("reference", "decimated/1280"))
    assert isinstance(whole, sb.Mesh)
    assert isinstance(coarse, sb.Mesh)
    similarity = sb.Similarity.to_unit_ball(whole)
    plans = (kind_of(similarity.apply(surface)).plan(1.0, 1e-9, 2) for surface in (coarse, whole))
    first, second = (list(plan.batches(1 << 20)) for plan in plans)
    return first, second


@pytest.fixture(scope="module")
def fields(points: tuple[list[WeightedPoints], list[WeightedPoints]]) -> tuple[xr.DataArray, xr.DataArray]:
    def field(batches: list[WeightedPoints]) -> xr.DataArray:
        values, _ = transform_points(batches, LATTICE, LATTICE.half, NufftSpec(LATTICE.shape, 1e-14))
        return xr.DataArray(np.asarray(values), dims=AXES, coords=dict(zip(AXES, LATTICE.axes, strict=True)))

    return field(points[0]), field(points[1])


@pytest.mark.slow
def test_bands_add_up(fields: tuple[xr.DataArray, xr.DataArray]) -> None:
    squared = sb.distance(*fields, ORDERS)["distance"] ** 2
    bands = sb.spectrum(*fields, ORDERS)["squared"]
    assert bands.sizes["band"] > 3
    xr.testing.assert_allclose(bands.sum("band"), squared, rtol=1e-12)


def test_the_witness_integrates_to_the_squared_distance(
    points: tuple[list[WeightedPoints], list[WeightedPoints]], fields: tuple[xr.DataArray, xr.DataArray]
) -> None:
    integral = np.zeros(len(ORDERS))
    for sign, batches in zip((1, -1), points, strict=True):
        for batch in batches:
            values = sb.witness(*fields, ORDERS, np.asarray(batch.coordinates).T, eps=1e-14).to_numpy()
            integral += sign * (values @ np.asarray(batch.weights))
    squared = sb.distance(*fields, ORDERS)["distance"].to_numpy() ** 2
    np.testing.assert_allclose(integral, squared, rtol=1e-10)
