"""The time that a plan foretells: what it counts, and how it follows from stored fields."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.batch.cluster.workers import Workers
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.study.plan import Plan, make_plan
from sobolev_batch.results.plan import forecast
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.spectral.transform.transform import expected_points, field_seconds, transform_block
from tests.support.studies import small_table


@pytest.fixture
def plan() -> Plan:
    return make_plan(sb.Study.from_table(small_table()))


def records(plan: Plan, *labels: str, seconds: float) -> dict[str, Record]:
    """Return records of fields that took so long each."""
    keys = {row.label: row.key for row in plan.rows}
    return {label: Record(keys[label], "complete", seconds=seconds) for label in labels}


@pytest.mark.parametrize("mesh", [sb.icosphere(1), sb.icosphere(4), sb.Torus(1.0, 0.4).mesh(96, 48)])
@pytest.mark.parametrize("xi_max", [2.0, 8.0])
def test_points_are_predicted_without_the_mesh(mesh: sb.Mesh, xi_max: float) -> None:
    lattice, settings = sb.Lattice(xi_max, 48), TransformSettings()
    points = transform_block(mesh, lattice, replace(lattice.half, shape=(2, 2, 2)), settings).points
    assert expected_points(len(mesh.triangles), mesh.area, lattice, settings) == pytest.approx(points, rel=0.5)


def test_finer_meshes_and_larger_lattices_take_longer() -> None:
    counts, settings = (0, 10_000, 1_000_000), TransformSettings()
    seconds = np.array([[field_seconds(n, 12.0, sb.Lattice(4.0, M), settings) for n in counts] for M in (32, 128)])
    assert (np.diff(seconds, axis=0) > 0).all()
    assert (np.diff(seconds, axis=1) > 0).all()
    # Spreading costs some hundreds of nanoseconds for each of some points of a triangle.
    assert 0.1 < seconds[0, 2] - seconds[0, 0] < 10


def test_stored_fields_tell_the_speed_of_the_others(plan: Plan) -> None:
    labels = [row.label for row in plan.rows]
    stored = records(plan, *labels[:3], seconds=10.0)
    workers = Workers.of_this_machine(2)
    seconds, processor_seconds, (first, second) = forecast(plan, stored, workers, None, planning_seconds=0.0)
    twice, _, _ = forecast(plan, records(plan, *labels[:3], seconds=20.0), workers, None, planning_seconds=0.0)
    later, _, _ = forecast(plan, stored, workers, None, planning_seconds=7.0)
    # Two surfaces of about the same cost as those that took ten seconds, side by side.
    assert 10 < seconds < 40
    assert processor_seconds > seconds
    assert 1.3 < twice / seconds <= 2
    assert later == pytest.approx(seconds + 7.0)
    assert first.endswith("for 2 missing fields, with 2 tasks at once")
    assert second.endswith("of processor time; the speed is that of the 3 fields that are stored")


def test_nothing_is_foretold_where_nothing_is_missing(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    def measured() -> float:
        raise AssertionError("nothing needs to be measured")

    monkeypatch.setattr("sobolev_batch.results.plan.slowness", measured)
    stored = records(plan, *(row.label for row in plan.rows), seconds=1.0)
    found = forecast(plan, stored, Workers.of_this_machine(2), None, planning_seconds=3.0)
    assert found == (0.0, 0.0, ["nothing is missing"])


def test_meshes_that_take_long_to_make_count(plan: Plan) -> None:
    fit = {"name": "fitted", "source": "fit", "mesh": {"source": "icosphere", "levels": [1]}}
    table = small_table(family=[fit])
    slow = make_plan(sb.Study.from_table(table))
    (fast,) = (row for row in plan.rows if row.label == "ico/1")
    (fitted,) = (row for row in slow.rows if row.label == "fitted/1")
    assert fitted.member.expected_size().seconds > 1 > fast.member.expected_size().seconds


def test_workers_of_a_cluster_are_tried(client: Client, plan: Plan) -> None:
    found = sb.plan(sb.Study.from_table(small_table()), "memory://forecast-cluster.zarr", client)
    assert 0 < found.seconds <= found.processor_seconds < 60
    *_, first, second = str(found).splitlines()
    assert re.fullmatch(r"time: +about \d+(\.\d+)? s for 5 missing fields, with 2 tasks at once", first)
    assert second.endswith("the speed is that of a transform on a worker")
    assert "4.0KB in the driver, for distances of all pairs" in str(found)
