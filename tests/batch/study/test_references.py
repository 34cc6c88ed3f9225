"""Studies whose reference is a smooth surface: rates, resuming, accuracies, blocks, refusals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client

from sobolev_batch import (
    Ellipsoid,
    InputError,
    Interval,
    LatticeError,
    ParametrisedSurface,
    Study,
    Torus,
    fourier_transform,
    open_store,
    run,
)
from sobolev_batch.batch.cluster.clients import thread_client
from sobolev_batch.batch.study.plan import make_plan
from sobolev_batch.spectral.adaptive.solve import DistanceTarget
from sobolev_batch.surfaces.sources.registry import Member, SurfaceMember
from tests.support.smooth_shapes import roof, roof_derivatives, turned_torus
from tests.support.studies import variable

RING = {"R": 2.0, "r": 0.8, "center": [5.0, 0.0, 1.0]}
EGG = {"axes": [2.0, 1.4, 0.8]}


@pytest.fixture(scope="module")
def threads() -> Iterator[Client]:
    """Threads of this process."""
    with thread_client(2) as client:
        yield client


def torus_table(**changes: Any) -> dict[str, Any]:
    """Grids of a torus against the torus, in a few seconds."""
    table: dict[str, Any] = {
        "study": {"name": "torus"},
        "lattice": {"xi_max": 3.0, "M": 20},
        "norm": {"orders": [-3.0, -5.0]},
        "reference": {"source": "torus", **RING},
        "family": [{"name": "grid", "source": "torus-grid", **RING, "levels": [0, 1, 2, 3]}],
    }
    return {**table, **changes}


def egg_table(**changes: Any) -> dict[str, Any]:
    """Stretched icospheres against the ellipsoid."""
    family = {"name": "ico", "source": "ellipsoid-levels", **EGG, "levels": [0, 1, 2, 3, 4]}
    return torus_table(reference={"source": "ellipsoid", **EGG}, family=[family], **changes)


@pytest.mark.slow
@pytest.mark.parametrize(("table", "levels"), [(torus_table(), 4), (egg_table(), 5)], ids=["torus", "ellipsoid"])
def test_refinements_converge_with_second_order(
    threads: Client, store_path: Path, table: dict[str, Any], levels: int
) -> None:
    summary = run(Study.from_table(table), store_path, threads)
    assert len(summary.computed) == levels + 1
    assert not summary.failed
    tree = open_store(store_path)
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
    assert rows["backend"].item() == "finufft"


@pytest.mark.slow
def test_the_stored_reference_is_the_library_s_field(threads: Client, store_path: Path) -> None:
    study = Study.from_table(torus_table())
    run(study, store_path, threads)
    stored = variable(open_store(store_path), "fourier", "fourier").sel(mesh="reference")
    # The reference's bounding sphere becomes the unit sphere at the origin.
    unit = Torus(2.0 / 2.8, 0.8 / 2.8)
    assert study.lattice is not None
    expected = fourier_transform(unit, study.lattice, threads=1, order=study.orders)
    assert np.abs(stored.values - expected.values).max() < 1e-8 * unit.area
    area = open_store(store_path)["meshes"].to_dataset()["area"].sel(mesh="reference").item()
    assert area == pytest.approx(unit.area, rel=1e-12)


@pytest.mark.slow
def test_only_what_changed_is_computed_again(threads: Client, store_path: Path) -> None:
    def go(**changes: Any) -> tuple[str, ...]:
        return run(Study.from_table(torus_table(scaling={"mode": "none"}, **changes)), store_path, threads).computed

    family = [{"name": "f", "source": "ellipsoid", "axes": [1.0, 0.8, 0.5]}]
    here = {"source": "torus", "R": 1.0, "r": 0.4}
    assert go(family=family, reference=here) == ("f/ellipsoid", "reference")
    assert go(family=family, reference=here) == ()
    assert go(family=family, reference={**here, "r": 0.41}) == ("reference",)
    assert go(family=[{**family[0], "axes": [0.8, 1.0, 0.5]}], reference={**here, "r": 0.41}) == ("f/ellipsoid",)


@pytest.mark.slow
def test_a_study_to_an_accuracy(threads: Client, store_path: Path) -> None:
    table = torus_table(accuracy={"rtol": 1e-2}, norm={"orders": [-4.0]})
    del table["lattice"]
    family = [{"name": "grid", "source": "torus-grid", **RING, "levels": [1, 2]}]
    summary = run(Study.from_table({**table, "family": family}), store_path, threads)
    assert not summary.failed
    found = open_store(store_path)["convergence"].to_dataset().isel(order=0)
    assert found["within"].values[:2].all()
    assert (found["error"].values[:2] <= 1e-2 * found["distance"].values[:2]).all()
    assert found["distance"].values[0] / found["distance"].values[1] == pytest.approx(4.0, rel=0.05)


@pytest.mark.slow
def test_blocks_of_a_smooth_surface_make_the_same_store(threads: Client, tmp_path: Path) -> None:
    family = [{"name": "grid", "source": "torus-grid", **RING, "levels": [1]}]
    study = Study.from_table(torus_table(family=family))
    run(study, tmp_path / "whole.zarr", threads)
    study = replace(study, largest_chunk_bytes=20_000)
    assert len(make_plan(study).blocks) > 3
    run(study, tmp_path / "blocks.zarr", threads)
    whole, blocks = (open_store(tmp_path / f"{name}.zarr") for name in ("whole", "blocks"))
    for tree in (whole, blocks):
        assert len(variable(tree, "fourier", "quality").sel(mesh="reference").item()) > 100
    first, second = (variable(tree, "fourier", "fourier").sel(mesh="reference").values for tree in (whole, blocks))
    assert np.abs(first - second).max() < 1e-8 * Torus(2.0, 0.8).area
    errors = [tree["norms"].to_dataset()["discretisation"].sel(mesh="reference").values for tree in (whole, blocks)]
    assert errors[0] == pytest.approx(errors[1], rel=3.0)


# Sources of one's own.


@dataclass(frozen=True)
class Fixed:
    """A source in the place of one from a registry."""

    surface: ParametrisedSurface
    identity: Mapping[str, Any]

    def members(self, folder: Path) -> tuple[Member, ...]:
        return (SurfaceMember("own", -1, self.surface, self.identity),)


def own(surface: ParametrisedSurface, **changes: Any) -> Study:
    """The study of the torus with a surface of one's own as its reference."""
    study = Study.from_table(torus_table(**changes))
    source: Any = Fixed(surface, {"test": 1})
    object.__setattr__(study, "reference", source)
    return study


@pytest.mark.slow
def test_a_reference_of_one_s_own(threads: Client, store_path: Path) -> None:
    family = [{"name": "turned", "source": "torus", "R": 1.0, "r": 0.4}]
    surface = turned_torus(Torus(1.0, 0.4))
    study = own(surface, family=family, lattice={"xi_max": 4.0, "M": 40})
    summary = run(study, store_path, threads)
    assert summary.computed == ("turned/torus", "reference")
    norms = open_store(store_path)["norms"].to_dataset()["norm"]
    # Turning a surface changes no norm but by what the cube cuts off its corners.
    assert norms.sel(mesh="reference").values == pytest.approx(norms.sel(mesh="turned/torus").values, rel=1e-3)


@pytest.mark.slow
def test_a_reference_that_does_not_settle_is_a_failed_row(
    threads: Client, store_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sobolev_batch.spectral.quadrature.smooth.MOST_NODES", 1 << 14)
    side = Interval(-0.9, 1.0)
    rough = ParametrisedSurface(roof, side, side, roof_derivatives)
    family = [{"name": "f", "source": "torus", "R": 1.0, "r": 0.4}]
    summary = run(own(rough, family=family), store_path, threads)
    assert set(summary.failed) == {"reference"}
    assert "not settled to 1e-09 of its area with 16384 nodes" in summary.failed["reference"]


def test_a_reference_beyond_the_period_is_refused_before_anything_is_computed() -> None:
    table = torus_table(scaling={"mode": "none"}, reference={"source": "torus", "R": 5.0, "r": 0.4})
    with pytest.raises(LatticeError, match=r"the surface reaches to \|coordinate\| = 5.4"):
        make_plan(Study.from_table(table))


def test_the_bounding_sphere_of_the_reference_becomes_the_unit_sphere() -> None:
    similarity = make_plan(Study.from_table(torus_table())).similarity
    assert (similarity.scale, similarity.origin) == (1 / 2.8, (5.0, 0.0, 1.0))
    assert make_plan(Study.from_table(egg_table())).similarity.scale == 0.5


@pytest.mark.slow
def test_error_targets_of_smooth_references_are_met_by_settings() -> None:
    table = torus_table(accuracy={"rtol": 1e-2}, norm={"orders": [-4.0]})
    del table["lattice"]
    plan = make_plan(Study.from_table(table))
    target = plan.distance_target(next(row for row in plan.rows if row.label == "reference"))
    assert isinstance(target, DistanceTarget)
    assert plan.sample is not None
    assert np.abs(plan.sample.exact).max() > 0
    error_target = target.error_target(Torus(2.0 / 2.8, 0.8 / 2.8))
    assert all(norm > 0 for norm in error_target.norms)


def test_smooth_surfaces_cannot_be_decimated() -> None:
    family = [{"name": "f", "source": "decimate", "mesh": {"source": "torus", **RING}, "triangles": [100]}]
    plan = make_plan(Study.from_table(torus_table(family=family)))
    with pytest.raises(InputError, match="torus is no mesh; its triangles are needed"):
        plan.rows[0].member.load()


def test_ellipsoids_and_their_levels_are_the_library_s() -> None:
    plan = make_plan(Study.from_table(egg_table()))
    assert [row.label for row in plan.rows] == [f"ico/{level}" for level in range(5)] + ["reference"]
    assert plan.rows[-1].member.load() == Ellipsoid((2.0, 1.4, 0.8))
    assert len({row.key for row in plan.rows}) == 6


def test_the_study_of_a_torus_that_is_ready_to_run() -> None:
    study = Study.from_toml(Path(__file__).parents[3] / "workflows" / "torus.toml")
    plan = make_plan(study)
    assert [row.label for row in plan.rows] == [*(f"grid/{level}" for level in range(6)), "reference"]
    assert plan.rows[-1].member.load() == Torus(1.0, 0.4)
