"""The time that a plan foretells: what it counts, and how it follows from stored fields."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.batch.cluster.workers import Workers
from sobolev_batch.batch.dry_run import seconds_of_missing
from sobolev_batch.batch.field_costs import row_seconds
from sobolev_batch.store.layout import Store, hide_tables
from sobolev_batch.store.records import Record, Records
from sobolev_batch.study.plan import Plan, make_plan
from sobolev_batch.transform.fourier import TransformSettings, expected_points, field_seconds, transform_block
from tests.support.studies import balls, methods_of, small_table


@pytest.fixture
def plan() -> Plan:
    return make_plan(sb.Study.from_table(small_table()))


def records(plan: Plan, *labels: str, seconds: float) -> dict[str, Record]:
    """Return records of fields that took so long each."""
    keys = {row.label: row.key for row in plan.rows}
    return {label: Record(keys[label], "complete", seconds=seconds) for label in labels}


def test_a_store_that_no_folder_can_hold_is_told(tmp_path: Path) -> None:
    found = sb.plan(sb.Study.from_table(small_table()), tmp_path / "typo" / "s.zarr")
    assert "there is no folder" in found.warnings[0]
    assert sb.plan(sb.Study.from_table(small_table()), tmp_path / "s.zarr").warnings == ()


def test_objects_that_cannot_be_planned_lack_something() -> None:
    command = {"source": "command", "command": ["remesh", "{input}", "{output}", "{triangles}"], "triangles": [20]}
    family = {"name": "ours", "mesh": {"source": "icosphere", "levels": [1]}, **command}
    table = small_table(lattice=None, accuracy={"rtol": 0.05}, object=[*balls(a=1.0), *balls(b=1.1)], family=[family])
    found = sb.plan(sb.Study.from_table(table), "memory://not-permitted.zarr")
    assert [*found.refused] == ["a", "b"]
    assert "2 of 2 objects cannot be planned" in str(found)
    assert str(found).count("--allow-commands") == 1
    assert "nothing is missing" not in str(found)


@pytest.mark.parametrize(
    "mesh", [sb.shapes.icosphere(1), sb.shapes.icosphere(4), sb.shapes.Torus(1.0, 0.4).mesh(96, 48)]
)
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
    workers = Workers.of_this_machine(2)
    found, basis = seconds_of_missing(plan, records(plan, *labels[:3], seconds=10.0), workers, None)
    twice, _ = seconds_of_missing(plan, records(plan, *labels[:3], seconds=20.0), workers, None)
    # Two surfaces of about the same cost as those that took ten seconds.
    assert list(found) == labels[3:]
    assert all(2 < seconds < 40 for seconds in found.values())
    assert {label: seconds / 2 for label, seconds in twice.items()} == pytest.approx(found)
    assert basis == "the 3 fields that are stored"


def test_what_programs_took_tells_no_speed(plan: Plan) -> None:
    made = {"name": "made", "source": "command", "mesh": {"source": "icosphere", "levels": [1]}, "n": [1, 2, 3]}
    families = [made | {"command": ["cp", "{input}", "{output}", "{n}"]}, *small_table()["family"]]
    both, own = make_plan(sb.Study.from_table(small_table(family=families))), [row.label for row in plan.rows][:3]
    slow, workers = [row.label for row in both.rows][:3], Workers.of_this_machine(2)
    stored = records(both, *own, seconds=1.0)
    found, basis = seconds_of_missing(both, stored | records(both, *slow, seconds=1e4), workers, None)
    assert basis == "the 3 fields that are stored"
    assert found == seconds_of_missing(plan, stored, workers, None)[0]


def test_nothing_is_foretold_where_nothing_is_missing(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    def measured() -> float:
        raise AssertionError("nothing needs to be measured")

    monkeypatch.setattr("sobolev_batch.batch.dry_run.slowness", measured)
    stored = records(plan, *(row.label for row in plan.rows), seconds=1.0)
    assert seconds_of_missing(plan, stored, Workers.of_this_machine(2), None) == ({}, "")


def test_objects_are_foretold_beside_each_other(client: Client, tmp_path: Path) -> None:
    one, three = (
        sb.plan(
            sb.Study.from_table(small_table(object=balls(**dict.fromkeys(names, 1.0)), family=methods_of())),
            tmp_path / f"{names}.zarr",
            client,
        )
        for names in ("a", "abc")
    )
    assert len(three.missing) == 3 * len(one.missing)
    assert list(three.objects) == ["a", "b", "c"]
    # On two workers, what three take together takes longer than one, and less than one after the other.
    work = sum(each.planning_seconds + sum(each.task_seconds.values()) for each in three.objects.values())
    assert three.seconds == pytest.approx(work / 2)
    alone = one.object
    assert one.seconds == pytest.approx(alone.planning_seconds + sum(alone.task_seconds.values()) / 2)


@pytest.mark.extras
def test_meshes_that_take_long_to_make_count(plan: Plan) -> None:
    fit = {"name": "fitted", "source": "fit", "mesh": {"source": "icosphere", "levels": [1]}}
    fitted, *_ = make_plan(sb.Study.from_table(small_table(family=[fit]))).rows
    fast, *_ = plan.rows
    assert fitted.member.expected_size().seconds > 1 > fast.member.expected_size().seconds


def test_remeshing_and_comparing_beyond_octaves_count(plan: Plan) -> None:
    family = {"name": "even", "source": "remesh", "mesh": {"source": "icosphere", "levels": [5]}, "triangles": [4000]}
    even, *_ = make_plan(sb.Study.from_table(small_table(family=[family]))).rows
    assert row_seconds(plan, even) > 1 > row_seconds(plan, replace(even, member=plan.rows[0].member))
    with_octaves = make_plan(sb.Study.from_table(small_table(lattice={"xi_max": 2.0, "M": 16, "octaves": 1})))
    mesh = with_octaves.rows[0]
    as_reference = row_seconds(replace(with_octaves, reference=mesh.label), mesh)
    assert row_seconds(with_octaves, mesh) - as_reference > 0.1


def test_workers_of_a_cluster_are_tried(client: Client, plan: Plan) -> None:
    found = sb.plan(sb.Study.from_table(small_table()), "memory://forecast-cluster.zarr", client)
    assert 0 < found.seconds <= found.processor_seconds < 60
    first, second, *_ = str(found).splitlines()
    assert re.fullmatch(r"time: +about \d+(\.\d+)? s for 5 missing fields, with 2 tasks at once", first)
    assert second.endswith("the speed is that of a transform on a worker")
    assert "2.4KB on disk; tiles: 1" in str(found)


def test_of_many_objects_some_are_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[str] = []

    def planned(study: sb.Study, *arguments: Any) -> Plan:
        looked.append(study.object.name)
        return make_plan(study, *arguments)

    monkeypatch.setattr("sobolev_batch.batch.dry_run.make_plan", planned)
    names = [f"ball{k:02}" for k in range(40)]
    study = sb.Study.from_table(small_table(object=balls(**dict.fromkeys(names, 1.0)), family=methods_of()))
    named: list[str] = []
    found = sb.plan(study, tmp_path / "many.zarr", on_progress=named.append)
    assert looked == list(found.objects)
    assert named == [f"{name} ({k} of 6)" for k, name in enumerate(looked, 1)]
    places = [names.index(name) for name in looked]
    assert (len(places), places[0], places[-1], {*np.diff(places)}) == (6, 0, 39, {7, 8})
    assert found.count == 40
    assert found.weight == pytest.approx(40 / 6)
    assert found.total_bytes == 40 * found.objects["ball00"].total_bytes
    assert "for 200 missing fields" in str(found)
    assert re.search("^objects: +40, of which 6 were looked at; ", str(found), re.M)


def made_of(**families: Mapping[str, Any] | list[int]) -> list[dict[str, Any]]:
    """Return families by name: icospheres of some levels, or sources."""
    return [
        {"name": name, **(source if isinstance(source, Mapping) else {"source": "icosphere", "levels": source})}
        for name, source in families.items()
    ]


COMMAND = {
    "source": "command",
    "mesh": {"source": "icosphere", "levels": [0]},
    "command": ["cp", "{input}", "{output}"],
}


def test_a_plan_says_what_nobody_can_predict(tmp_path: Path) -> None:
    found = sb.plan(sb.Study.from_table(small_table(family=made_of(coarse=COMMAND, fine=[3]))), tmp_path / "s.zarr")
    assert found.object.unknown == tuple(label for label in found.missing if label.startswith("coarse"))
    assert "programs and searches make 1 of the meshes, and their time is not known" in " ".join(str(found).split())
    assert "not known" not in str(sb.plan(sb.Study.from_table(small_table()), tmp_path / "s.zarr"))


def test_a_plan_and_a_status_and_a_run_agree_on_what_is_missing() -> None:
    place, study = "memory://agreed.zarr", sb.Study.from_table(small_table())
    levels = [0, 1, 2, 3, 4]
    more = sb.Study.from_table(small_table(family=[{"name": "ico", "source": "icosphere", "levels": levels}]))
    sb.run(study, place)
    # First nothing is missing, then tables, then a field.
    assert "nothing is missing" in str(sb.plan(study, place))
    hide_tables(Store.open(place))
    assert not sb.status(place).has_tables
    assert "no field is missing, and tables follow" in str(sb.plan(study, place))
    assert sb.run(study, place).computed == ()
    assert "nothing is missing" in str(sb.plan(study, place))
    Records(Store.open(place)).write(0, None)
    (missing,) = sb.status(place).lost_records
    assert (sb.verify(place).complete, sb.status(place).complete) == (4, 4)
    assert sb.plan(study, place).missing == (missing,)
    # Surfaces that the store does not know yet are missing too.
    assert set(sb.plan(more, place).missing) == {missing, "ico/4"}
    assert set(sb.run(more, place).computed) == {missing, "ico/4"}
    assert (sb.status(place).complete, sb.status(place).lost_records) == (6, ())
    # Those that have another name by now are not.
    renamed = sb.Study.from_table(small_table(family=[{"name": "new", "source": "icosphere", "levels": levels}]))
    assert sb.plan(renamed, place).missing == ()
    assert sb.run(renamed, place).computed == ()


def test_a_plan_fits_the_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    title = " ".join(["several words"] * 9)
    found = sb.plan(sb.Study.from_table(small_table(study={"name": "small", "title": title})), tmp_path / ("x" * 60))
    lines = str(found).splitlines()
    assert {len(line) > 60 for line in lines if "x" * 60 not in line} == {False}
    assert f" study: {title} " in " ".join(str(found).split())
    assert lines[1].startswith(" " * 15)
