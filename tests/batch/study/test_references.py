"""Studies whose reference is a smooth surface: rates, resuming, accuracies, blocks, refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.batch.study.plan import make_plan
from sobolev_batch.surfaces.sources.registry import SurfaceMember
from tests.support.shapes import Roof
from tests.support.studies import small_table, variable

RING = {"R": 2.0, "r": 0.8, "center": [5.0, 0.0, 1.0]}
EGG = {"axes": [2.0, 1.4, 0.8]}


def torus_table(**changes: Any) -> dict[str, Any]:
    """Grids of a torus against the torus, in a few seconds."""
    ring = {"source": "torus", **RING}
    family = [{"name": "grid", **ring, "levels": [0, 1, 2, 3]}]
    own = {"lattice": {"xi_max": 3.0, "M": 20}, "norm": {"orders": [-3.0, -5.0]}, "reference": ring, "family": family}
    return small_table(**{**own, **changes})


def egg_table(**changes: Any) -> dict[str, Any]:
    """Stretched icospheres against the ellipsoid."""
    family = {"name": "ico", "source": "ellipsoid", **EGG, "levels": [0, 1, 2, 3, 4]}
    return torus_table(reference={"source": "ellipsoid", **EGG}, family=[family], **changes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("table", "levels", "unit"),
    # The reference's bounding sphere becomes the unit sphere at the origin.
    [(torus_table(), 4, sb.Torus(2.0 / 2.8, 0.8 / 2.8)), (egg_table(), 5, sb.Ellipsoid((1.0, 0.7, 0.4)))],
    ids=["torus", "ellipsoid"],
)
def test_refinements_converge_with_second_order(
    threads: Client, store_path: Path, table: dict[str, Any], levels: int, unit: sb.Torus | sb.Ellipsoid
) -> None:
    study = sb.Study.from_table(table)
    summary = sb.run(study, store_path, threads)
    assert len(summary.computed) == levels + 1
    assert not summary.failed
    tree = sb.open_store(store_path)
    stored = variable(tree, "fourier", "fourier").sel(mesh="reference")
    assert study.lattice is not None
    expected = sb.fourier_transform(unit, study.lattice, threads=1, order=study.orders)
    assert np.abs(stored.values - expected.values).max() < 1e-8 * unit.area
    convergence = tree["convergence"].to_dataset()
    for order in (-3.0, -5.0):
        found = convergence.sel(order=order)
        distances, rates = found["distance"].values, found["rate"].values
        assert (distances[:-2] > 3 * distances[1:-1]).all()
        assert distances[levels - 2] / distances[levels - 1] == pytest.approx(4.0, rel=0.02)
        assert rates[levels - 1] == pytest.approx(2.0, abs=0.02)
        assert distances[levels] == 0
    rows = tree["meshes"].to_dataset().sel(mesh="reference")
    assert rows["status"].item() == "complete"
    assert rows["triangles"].item() == 0
    assert rows["points"].item() > 500
    assert rows["area"].item() == pytest.approx(unit.area, rel=1e-12)


@pytest.mark.slow
def test_blocks_of_a_smooth_surface_make_the_same_store(threads: Client, tmp_path: Path) -> None:
    family = [{"name": "grid", "source": "torus", **RING, "levels": [1]}]
    study = sb.Study.from_table(torus_table(family=family))
    sb.run(study, tmp_path / "whole.zarr", threads)
    study = replace(study, largest_chunk_bytes=20_000)
    assert len(make_plan(study).blocks) > 3
    sb.run(study, tmp_path / "blocks.zarr", threads)
    whole, blocks = (sb.open_store(tmp_path / f"{name}.zarr") for name in ("whole", "blocks"))
    first, second = (variable(tree, "fourier", "fourier").sel(mesh="reference").values for tree in (whole, blocks))
    assert np.abs(first - second).max() < 1e-8 * sb.Torus(2.0, 0.8).area
    errors = [tree["norms"].to_dataset()["discretisation"].sel(mesh="reference").values for tree in (whole, blocks)]
    assert errors[0] == pytest.approx(errors[1], rel=3.0)


@pytest.mark.slow
def test_a_reference_that_does_not_settle_is_a_failed_row(
    threads: Client, store_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sobolev_batch.spectral.quadrature.kinds.MOST_NODES", 1 << 14)
    family = [{"name": "f", "source": "torus", "R": 1.0, "r": 0.4}]
    study = sb.Study.from_table(torus_table(family=family))
    member = SurfaceMember("own", -1, Roof(), {"test": 1})
    object.__setattr__(study, "reference", SimpleNamespace(members=lambda folder: (member,)))
    summary = sb.run(study, store_path, threads)
    assert set(summary.failed) == {"reference"}
    assert "not settled to 1e-09 of its area with 16384 nodes" in summary.failed["reference"]


def test_the_bounding_sphere_of_the_reference_becomes_the_unit_sphere() -> None:
    similarity = make_plan(sb.Study.from_table(torus_table())).similarity
    assert (similarity.scale, similarity.origin) == (1 / 2.8, (5.0, 0.0, 1.0))
    assert make_plan(sb.Study.from_table(egg_table())).similarity.scale == 0.5
