"""Witness functions and Hausdorff and Chamfer distances that a study asks for, in its store."""

from __future__ import annotations

import os
import shutil
import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import trimesh
import xarray as xr
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.batch.analysis.compare import Comparer
from sobolev_batch.batch.analysis.compare_tasks import (
    Comparison,
    StoredMesh,
    WitnessSettings,
    compare_by_proximity,
    compare_by_witness,
)
from sobolev_batch.batch.analysis.kinds import ProximityKind, WitnessKind
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.batch.cluster.execution import Cluster
from sobolev_batch.batch.cluster.progress import Progress
from sobolev_batch.batch.cluster.workers import WorkerInfo, Workers
from sobolev_batch.batch.run import Summary
from sobolev_batch.batch.store.comparison_records import ComparisonRecord, ComparisonRecords
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.study.plan import make_plan
from sobolev_batch.batch.workspace import Workspace
from sobolev_batch.results.status import Status
from tests.support.stores import assert_same_fields, assert_same_tables
from tests.support.studies import small_table, variable

pytest.importorskip("pyvista", reason="VTK comes with the extra 'vtk'")

ORDERS = (-2.0, -3.5)
ASKED: dict[str, Any] = {"witness": {"orders": list(ORDERS)}, "proximity": {"points": 300}}
TO_A_MESH: dict[str, Any] = {"reference": {"source": "icosphere", "levels": [5]}}


class Killed(Exception):  # noqa: N818  # it stands for an end without a word, not for an error
    """The end of a run, at any of its steps."""


def asking(**changes: Any) -> sb.Study:
    return sb.Study.from_table(small_table(**{**TO_A_MESH, **ASKED, **changes}))


def run_and_count(study: sb.Study, path: Path, client: Client | None) -> tuple[Summary, list[str]]:
    """A run, and the labels of the comparisons that it made."""
    made: list[str] = []

    def count_step(progress: Progress) -> None:
        if progress.stage == "comparisons" and progress.label:
            made.append(progress.label)

    return sb.run(study, path, client, on_progress=count_step), made


def assert_right(path: Path, study: sb.Study) -> None:
    """Every mesh's witness function is what the library finds at its vertices, and NaN beyond them."""
    tree = sb.open_store(path)
    fields, witnesses = variable(tree, "fourier", "fourier"), variable(tree, "witness", "witness").load()
    plan = make_plan(study)
    for row in plan.rows:
        found = witnesses.sel(mesh=row.label).to_numpy()
        if row.label == plan.reference:
            assert np.isnan(found).all()
            continue
        mesh = plan.similarity.apply(row.member.load())
        assert isinstance(mesh, sb.Mesh)
        expected = sb.witness(
            fields.sel(mesh=row.label), fields.sel(mesh=plan.reference), study.witness, mesh.vertices, eps=1e-12
        ).to_numpy()
        count = len(mesh.vertices)
        assert np.abs(found[:, :count] - expected).max() < 1e-7 * np.abs(expected).max()
        assert np.isnan(found[:, count:]).all()
    assert witnesses["order"].values.tolist() == list(study.witness)


@pytest.fixture(scope="module")
def compared(client: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with comparisons; not to be changed."""
    path = tmp_path_factory.mktemp("compared") / "results.zarr"
    sb.run(asking(), path, client)
    return path


@pytest.fixture
def store(compared: Path, store_path: Path) -> Path:
    shutil.copytree(compared, store_path)
    return store_path


def test_witness_functions_are_those_of_the_library(compared: Path) -> None:
    assert_right(compared, asking())
    tree = xr.open_datatree(compared, engine="zarr")
    assert tree["witness"].attrs["reference"] == "reference"
    assert variable(tree, "witness", "witness").attrs["units"] == "1 / unit length"


def test_where_a_mesh_has_less_area_they_are_negative(compared: Path) -> None:
    """An icosahedron within the sphere."""
    tree = sb.open_store(compared)
    values = variable(tree, "witness", "witness").sel(mesh="ico/0").isel(order=0).dropna("vertex")
    assert (values < 0).all()


def test_proximities_are_those_of_the_library(compared: Path) -> None:
    tree = sb.open_store(compared)
    plan = make_plan(asking())
    reference = plan.similarity.apply(plan.rows[-1].member.load())
    assert isinstance(reference, sb.Mesh)
    for row in plan.rows[:-1]:
        mesh = plan.similarity.apply(row.member.load())
        assert isinstance(mesh, sb.Mesh)
        expected = sb.proximity(mesh, reference, points=300)
        for name in ("hausdorff", "chamfer", "chamfer_error"):
            found = variable(tree, "proximity", name).sel(mesh=row.label).item()
            assert found == pytest.approx(getattr(expected, name), rel=1e-12)
    assert np.isnan(variable(tree, "proximity", "hausdorff").sel(mesh="reference").item())


def test_a_second_run_has_nothing_to_do(store: Path) -> None:
    # Without a client: a cluster would be started, and say so.
    stages: list[str] = []
    sb.run(asking(), store, on_progress=lambda progress: stages.append(progress.stage))
    assert stages == []


def test_only_what_is_new_is_compared(store: Path, client: Client) -> None:
    grown = asking(family=[{"name": "ico", "source": "icosphere", "levels": [0, 1, 2, 3, 4]}])
    _, made = run_and_count(grown, store, client)
    assert sorted(made) == ["ico/4", "ico/4"]
    assert_right(store, grown)
    finer = asking(
        family=[
            {"name": "ico", "source": "icosphere", "levels": [0, 1, 2, 3, 4]},
            # More vertices than a chunk holds.
            {"name": "fine", "source": "icosphere", "levels": [6]},
        ]
    )
    _, made = run_and_count(finer, store, client)
    assert sorted(made) == ["fine/6", "fine/6"]
    assert_right(store, finer)


def test_other_orders_are_other_witness_functions(store: Path, client: Client) -> None:
    other = asking(witness={})
    _, made = run_and_count(other, store, client)
    assert sorted(made) == ["ico/0", "ico/1", "ico/2", "ico/3"]
    assert other.witness == other.orders
    assert_right(store, other)


def test_other_points_are_other_proximities(store: Path, client: Client) -> None:
    before = variable(sb.open_store(store), "proximity", "chamfer").load()
    _, made = run_and_count(asking(proximity={"points": 200}), store, client)
    assert sorted(made) == ["ico/0", "ico/1", "ico/2", "ico/3"]
    after = variable(sb.open_store(store), "proximity", "chamfer").load()
    assert (after != before).any()


def test_another_reference_makes_all_anew(store: Path, client: Client) -> None:
    # The study's unit stays, and so do the fields of the meshes.
    other = asking(reference={"source": "icosphere", "levels": [4]}, scaling={"mode": "none"})
    summary, made = run_and_count(other, store, client)
    assert len(made) == 8
    assert_right(store, other)
    assert not summary.not_compared


def test_what_is_not_asked_for_any_more_goes(store: Path, client: Client) -> None:
    fields = Store(store).rows_with_complete_fields()
    sb.run(sb.Study.from_table(small_table(**TO_A_MESH)), store, client)
    assert not {"witness", "proximity"} & set(sb.open_store(store).children)
    assert not (store / "witness").exists()
    assert Store(store).rows_with_complete_fields() == fields
    _, made = run_and_count(asking(), store, client)
    assert len(made) == 8
    assert_right(store, asking())


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 5] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("key", "flipped", "words"),
    [
        ("witness/witness/c/1/0/0", True, "its witness function is damaged"),
        ("records/witness/c/2", True, "the record of its witness is damaged"),
        ("records/proximity/c/2", True, "the record of its proximity is damaged"),
    ],
)
def test_damage_is_named_and_repaired(
    key: str, flipped: bool, words: str, store: Path, compared: Path, client: Client
) -> None:
    flip(store / key)
    found = sb.verify(store)
    label = f"ico/{key.split('/c/')[1][0]}"
    assert [*found.comparisons] == [label]
    assert found.comparisons[label].startswith(words)
    assert not found.is_sound
    _, made = run_and_count(asking(), store, client)
    assert made == [label]
    assert_right(store, asking())
    assert sb.verify(store).is_sound
    assert_same_fields(store, compared)


@pytest.mark.parametrize("axis", ["mesh", "order"])
def test_a_lost_coordinate_of_witness_functions(axis: str, store: Path, client: Client) -> None:
    (store / f"witness/{axis}/c/0").unlink()
    with pytest.raises(sb.DamageError, match=f"witness/{axis} is missing"):
        sb.open_store(store)
    sb.run(asking(), store, client)
    assert_right(store, asking())


@pytest.mark.parametrize("gone", ["mesh", "order"])
def test_a_removal_that_was_cut_short(gone: str, store: Path, client: Client) -> None:
    """Of the group, in whatever order its keys go."""
    here = Store.open(store)
    for name in [name for name in here.documents if name.startswith("witness")]:
        del here.documents[name]
    here.consolidate()
    shutil.rmtree(store / "witness" / gone)
    sb.run(asking(), store, client)
    assert_right(store, asking())


def forbid_the_first(patched: pytest.MonkeyPatch) -> None:
    """Make comparisons of the first mesh too large for any worker."""
    for kind in (WitnessKind, ProximityKind):
        patched.setattr(kind, "projected_bytes", lambda self, i: 1e15 if i == 0 else 1.0)


@pytest.mark.all
def test_another_member_becomes_the_reference(store_path: Path, client: Client) -> None:
    """Whose own record, of a failure even, speaks for nothing any more."""

    def study(member: str) -> sb.Study:
        return asking(reference={"source": "family", "family": "ico", "member": member}, scaling={"mode": "none"})

    with pytest.MonkeyPatch.context() as patched:
        forbid_the_first(patched)
        assert [*sb.run(study("3"), store_path, client).not_compared] == ["ico/0"]
    for member in ("2", "0", "3"):
        sb.run(study(member), store_path, client)
        assert sb.verify(store_path).is_sound
        assert not Status.of(store_path).not_compared
        assert_right(store_path, study(member))


def test_notes_of_what_is_not_asked_for_any_more_go(store_path: Path, client: Client) -> None:
    def end(progress: Progress) -> None:
        if progress.stage == "comparisons" and progress.done == 1:
            raise Killed

    with pytest.raises(Killed):
        sb.run(asking(witness=None), store_path, client, on_progress=end)
    assert (store_path / "records/proximity").exists()
    sb.run(sb.Study.from_table(small_table(**TO_A_MESH)), store_path, client)
    assert not (store_path / "records/proximity").exists()
    assert not (store_path / "proximity").exists()


def test_a_task_that_outlives_its_run_is_not_believed(store: Path, client: Client) -> None:
    """It writes values of other orders into the array of the next run, and a record of its own."""
    other, straggler = (
        asking(witness={"orders": [-3.0, -5.0]}),
        ComparisonRecord("of another run", "complete", checksum=1),
    )

    def spoil(progress: Progress) -> None:
        if progress.stage == "comparisons" and progress.done == progress.total:
            ComparisonRecords(Store.open(store), "witness").write(1, straggler)

    sb.run(other, store, client, on_progress=spoil)
    assert np.isnan(variable(sb.open_store(store), "witness", "witness").sel(mesh="ico/1")).all()
    sb.run(other, store, client)
    assert_right(store, other)


def test_a_refused_run_in_another_unit_leaves_no_table_of_the_old_one(store: Path, client: Client) -> None:
    with pytest.raises(sb.ClusterError):
        sb.run(asking(scaling={"mode": "fixed", "scale": 0.9}, transform={"backend": "gpu"}), store, client)
    assert not {"convergence", "witness", "proximity"} & set(sb.open_store(store).children)
    sb.run(asking(), store, client)
    assert_right(store, asking())


@pytest.mark.parametrize("axis", ["mesh", "order"])
def test_a_damaged_coordinate_of_witness_functions(axis: str, store: Path, client: Client) -> None:
    flip(store / f"witness/{axis}/c/0")
    assert [*sb.verify(store).tables] == [f"witness/{axis}"]
    sb.run(asking(), store, client)
    assert sb.verify(store).is_sound
    assert_right(store, asking())


def test_a_lost_chunk_is_seen_by_the_next_run(store: Path, client: Client) -> None:
    (store / "witness/witness/c/3/0/0").unlink()
    _, made = run_and_count(asking(), store, client)
    assert made == ["ico/3"]
    assert_right(store, asking())


def test_a_damaged_field_is_found_by_a_comparison(store_path: Path, client: Client) -> None:
    plain = sb.Study.from_table(small_table(**TO_A_MESH))
    sb.run(plain, store_path, client)
    flip(store_path / "fourier/fourier/c/1/0/0/0")
    summary, _ = run_and_count(asking(), store_path, client)
    assert summary.computed == ("ico/1",)
    assert_right(store_path, asking())


def test_a_smaller_mesh_leaves_nothing_of_a_larger_one(store_path: Path, tmp_path: Path, client: Client) -> None:
    def write(level: int) -> sb.Study:
        mesh = sb.icosphere(level)
        trimesh.Trimesh(0.9 * mesh.vertices, mesh.triangles, process=False).export(tmp_path / "a.ply")
        table = small_table(
            **TO_A_MESH, witness=ASKED["witness"], family=[{"name": "f", "source": "files", "paths": ["a.ply"]}]
        )
        return sb.Study.from_table(table, folder=tmp_path)

    for level in (6, 2):
        study = write(level)
        sb.run(study, store_path, client)
        assert_right(store_path, study)


def test_vertices_that_no_triangle_uses(store_path: Path, tmp_path: Path, client: Client) -> None:
    """They may lie beyond the lattice's period."""
    mesh = sb.icosphere(1)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in [[900.0, 0.0, 0.0], *mesh.vertices.tolist()]]
    lines += [f"f {i + 2} {j + 2} {k + 2}" for i, j, k in mesh.triangles.tolist()]
    (tmp_path / "stray.obj").write_text("\n".join(lines))
    table = small_table(**TO_A_MESH, **ASKED, family=[{"name": "f", "source": "files", "paths": ["*.obj"]}])
    summary = sb.run(sb.Study.from_table(table, folder=tmp_path), store_path, client)
    assert not summary.not_compared
    values = variable(sb.open_store(store_path), "witness", "witness").sel(mesh="f/stray").to_numpy()
    assert np.isnan(values[:, 0]).all()
    assert not np.isnan(values[:, 1:43]).any()
    assert variable(sb.open_store(store_path), "proximity", "hausdorff").sel(mesh="f/stray").item() < 1


def test_blocks_and_parts_of_the_lattice_add_up(
    store_path: Path, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Fields of 40 kB in chunks of a few.
    study = replace(asking(proximity=None), largest_chunk_bytes=16 << 10)
    sb.run(study, store_path, client)
    here, plan = Store.open(store_path), make_plan(study)
    assert len(plan.blocks) > 2
    assert_right(store_path, study)
    stored = [
        StoredMesh(i, row.label, row.member, record.facts.digest, record.checksums)
        for i, (row, record) in enumerate(zip(plan.rows, here.records(), strict=True))
        if record is not None
    ]
    comparison = Comparison(here, "key", stored[3], stored[-1], plan.similarity)
    # Here and not on a worker, so that each block is evaluated in parts.
    monkeypatch.setattr("sobolev_batch.spectral.metrics.witness.BLOCK_SAMPLES", 300)
    record = compare_by_witness(comparison, WitnessSettings(plan.lattice, plan.blocks, ORDERS, 1e8))
    assert record.status == "complete", record.reason
    assert_right(store_path, study)


def write_sphere(path: Path, level: int, radius: float = 0.9) -> None:
    mesh = sb.icosphere(level)
    trimesh.Trimesh(radius * mesh.vertices, mesh.triangles, process=False).export(path)


def of_files(folder: Path, names: tuple[str, ...] = ("a.ply", "b.ply"), **changes: Any) -> sb.Study:
    """A study of files in a unit that is given, so that their fields stay whatever the others do."""
    family = [{"name": "f", "source": "files", "paths": list(names)}]
    table = small_table(**{**TO_A_MESH, **ASKED, "family": family, "scaling": {"mode": "none"}, **changes})
    return sb.Study.from_table(table, folder=folder)


@pytest.fixture
def files(tmp_path: Path) -> Path:
    for name, level in (("a.ply", 2), ("b.ply", 1), ("c.ply", 3)):
        write_sphere(tmp_path / name, level)
    return tmp_path


CHANGES: dict[str, Any] = {
    "one more mesh": {"names": ("a.ply", "b.ply", "c.ply")},
    "fewer orders": {"witness": {"orders": [-3.0]}},
    "other orders": {"witness": {"orders": [-2.5, -3.0]}},
    "other points": {"proximity": {"points": 100}},
    "another reference": {"reference": {"source": "icosphere", "levels": [4]}},
    "no witness": {"witness": None},
    "nothing besides": {"witness": None, "proximity": None},
    "other fields": {"transform": {"eps": 1e-5}},
}


@pytest.mark.parametrize(
    "change", [pytest.param(change, marks=[] if change == "other orders" else pytest.mark.all) for change in CHANGES]
)
def test_a_store_can_be_read_at_every_step_and_after_an_end_at_any(
    change: str, files: Path, tmp_path: Path, client: Client
) -> None:
    """Whatever is there then is right, and the next run makes it whole."""
    place = tmp_path / "s.zarr"
    sb.run(of_files(files), place, client)
    changed = of_files(files, **CHANGES[change])
    steps = 0

    def look(progress: Progress) -> None:
        nonlocal steps
        steps += 1
        tree = xr.open_datatree(place, engine="zarr").load()
        assert sb.open_store(place).children.keys() == tree.children.keys()
        if "witness" in tree.children and "convergence" in tree.children:
            assert np.isfinite(variable(tree, "witness", "witness").sel(mesh="f/b")[:, :42]).all()
        if steps == last:
            raise Killed

    last = 0
    copy = tmp_path / "before.zarr"
    shutil.copytree(place, copy)
    sb.run(changed, place, client, on_progress=look)
    total = steps
    for last in sorted({1, max(1, 2 * total // 3)}):  # noqa: B007  # `look` reads it
        shutil.rmtree(place)
        shutil.copytree(copy, place)
        steps = 0
        with pytest.raises(Killed):
            sb.run(changed, place, client, on_progress=look)
        assert not sb.verify(place).comparisons
        steps = total + 1
        sb.run(changed, place, client)
        tree = sb.open_store(place)
        assert ("witness" in tree.children) == bool(changed.witness)
        assert ("proximity" in tree.children) == (changed.proximity is not None)
        assert (place / "witness").exists() == (place / "records/witness").exists() == bool(changed.witness)
        if changed.witness:
            assert_right(place, changed)


def test_nothing_is_left_of_a_mesh_that_fails_later(files: Path, tmp_path: Path, client: Client) -> None:
    place = tmp_path / "s.zarr"
    sb.run(of_files(files), place, client)
    (files / "a.ply").write_text("garbage")
    summary = sb.run(of_files(files), place, client)
    assert [*summary.failed] == ["f/a"]
    tree = sb.open_store(place)
    assert np.isnan(variable(tree, "witness", "witness").sel(mesh="f/a")).all()
    assert np.isnan(variable(tree, "proximity", "chamfer").sel(mesh="f/a"))
    assert np.isfinite(variable(tree, "witness", "witness").sel(mesh="f/b")[:, :42]).all()


def test_nothing_is_left_of_a_mesh_whose_comparison_fails_later(
    files: Path, tmp_path: Path, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "s.zarr"
    sb.run(of_files(files), place, client)
    # Another mesh, of as many vertices.
    write_sphere(files / "a.ply", 2, radius=0.7)
    with monkeypatch.context() as patched:
        forbid_the_first(patched)
        summary = sb.run(of_files(files), place, client)
    assert [*summary.not_compared] == ["f/a"]
    assert summary.not_compared["f/a"].startswith("no witness: it takes about 1.0PB")
    assert "; no proximity: it takes" in summary.not_compared["f/a"]
    tree = sb.open_store(place)
    assert np.isnan(variable(tree, "witness", "witness").sel(mesh="f/a")).all()
    assert "takes about" in variable(tree, "proximity", "reason").sel(mesh="f/a").item()
    sb.run(of_files(files), place, client)
    assert_right(place, of_files(files))


def test_no_note_speaks_for_values_that_are_being_replaced(files: Path, tmp_path: Path, client: Client) -> None:
    """The old mesh may come back after a run for another one that ended between its values and their record."""
    place = tmp_path / "s.zarr"
    sb.run(of_files(files), place, client)
    old = {record.key for record in ComparisonRecords(Store.open(place), "witness").read() if record is not None}
    assert len(old) == 2
    for name, level in (("a.ply", 2), ("b.ply", 1)):
        write_sphere(files / name, level, radius=0.7)

    def end(progress: Progress) -> None:
        if progress.stage == "comparisons" and progress.done == 1:
            raise Killed

    with pytest.raises(Killed):
        sb.run(of_files(files), place, client, on_progress=end)
    assert not old & {
        record.key for record in ComparisonRecords(Store.open(place), "witness").read() if record is not None
    }


@pytest.mark.all
def test_values_without_a_note_are_those_of_nobody(files: Path, tmp_path: Path, client: Client) -> None:
    """As an end between both leaves them; and then the mesh becomes smaller."""
    place = tmp_path / "s.zarr"
    write_sphere(files / "a.ply", 6)
    sb.run(of_files(files), place, client)
    ComparisonRecords(Store.open(place), "witness").write(0, None)
    write_sphere(files / "a.ply", 2)
    sb.run(of_files(files), place, client)
    assert_right(place, of_files(files))


def test_a_mesh_that_has_changed_is_not_compared(store: Path) -> None:
    study = asking()
    plan, records = make_plan(study), Store(store).records()
    here = Store.open(store)
    stored = [
        StoredMesh(i, row.label, row.member, record.facts.digest, record.checksums)
        for i, (row, record) in enumerate(zip(plan.rows, records, strict=True))
        if record is not None
    ]
    changed = StoredMesh(1, "ico/1", plan.rows[2].member, stored[1].digest, stored[1].checksums)
    record = compare_by_proximity(Comparison(here, "key", changed, stored[-1], plan.similarity), 100)
    assert record.status == "failed"
    assert "is not the mesh whose field is stored" in record.reason
    assert ComparisonRecords(here, "proximity").read()[1] == record


def test_a_mesh_that_failed_is_left_out(store_path: Path, tmp_path: Path, client: Client) -> None:
    (tmp_path / "bad.off").write_text("OFF\n1 1 0\n0 0 0\n3 0 1 2\n")
    family = [
        {"name": "ico", "source": "icosphere", "levels": [1]},
        {"name": "bad", "source": "files", "paths": ["bad.off"]},
        {"name": "closed", "source": "sphere"},
    ]
    study = sb.Study.from_table(small_table(**TO_A_MESH, **ASKED, family=family), folder=tmp_path)
    summary, made = run_and_count(study, store_path, client)
    assert [*summary.failed] == ["bad/bad"]
    assert made == ["ico/1", "ico/1"]
    assert not summary.not_compared
    witnesses = variable(sb.open_store(store_path), "witness", "witness")
    assert np.isnan(witnesses.sel(mesh=["bad/bad", "closed/sphere", "reference"])).all()


def test_too_little_memory_is_foreseen(store: Path, client: Client) -> None:
    study = asking(witness={"orders": [-2.0]})
    here, plan = Store.open(store), make_plan(study)
    small = Workers((WorkerInfo("tcp://small", 1, 2e8, "cpu", ""),))
    reasons = Comparer.of(Workspace.of(here, plan)).run(Cluster(client, small))
    assert sorted(reasons) == ["ico/0", "ico/1", "ico/2", "ico/3"]
    assert reasons["ico/0"].startswith("no witness: it takes about")
    assert "start workers with more memory" in reasons["ico/0"]
    status = Status.of(store)
    assert sorted(status.not_compared) == sorted(reasons)
    assert f"ico/0: {reasons['ico/0']}" in list(status.lines())
    # Another run, with the workers that there are, makes up for it.
    _, made = run_and_count(study, store, client)
    assert sorted(made) == sorted(reasons)
    assert not Status.of(store).not_compared
    assert_right(store, study)


@pytest.mark.all
def test_a_worker_killed_in_the_middle(store_path: Path, compared: Path) -> None:
    killed = threading.Event()
    with local_client(2) as client:
        workers = sorted(client.run(os.getpid).values())

        def kill(progress: Progress) -> None:
            if progress.stage == "comparisons" and not killed.is_set():
                killed.set()
                psutil.Process(workers[0]).send_signal(signal.SIGKILL)

        summary = sb.run(asking(), store_path, client, on_progress=kill)
    assert killed.is_set()
    assert not summary.not_compared
    assert_same_fields(store_path, compared)
    assert_same_tables(store_path, compared)
    assert_right(store_path, asking())


def test_fields_that_are_replaced_hide_the_witness_functions(store: Path, client: Client) -> None:
    """A reader never finds those of other fields."""
    seen: list[bool] = []

    def look(progress: Progress) -> None:
        if progress.stage == "fields" and progress.label:
            seen.append("witness" in sb.open_store(store).children)

    changed = asking(transform={"eps": 1e-5})
    sb.run(changed, store, client, on_progress=look)
    assert seen == [False] * 5
    assert_right(store, changed)


def test_a_store_in_memory(compared: Path) -> None:
    sb.run(asking(), "memory://compared.zarr")
    there, here = (
        variable(sb.open_store(place), "witness", "witness") for place in ("memory://compared.zarr", compared)
    )
    xr.testing.assert_allclose(there.load(), here.load(), rtol=1e-9)


def test_a_closed_form_has_no_proximity() -> None:
    study = sb.Study.from_table(small_table(proximity={}))
    with pytest.raises(sb.StudyError, match=r"the reference is not one but a Sphere; take a fine mesh"):
        make_plan(study)


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ({"witness": {"orders": [0.0]}}, "-1/2"),
        ({"witness": {"order": -2.0}}, r"\[witness\]: unknown key order"),
        ({"witness": True}, "witness"),
        ({"proximity": {"points": 1}}, r"\[proximity\]: points must be 2 or more"),
        ({"proximity": {"points": 10**9}}, r"\[proximity\]: points must be at most 10000000"),
        ({"proximity": {"points": "many"}}, r"\[proximity\]: points must be a whole number"),
    ],
)
def test_sections_that_make_no_sense(section: dict[str, Any], words: str) -> None:
    with pytest.raises(sb.StudyError, match=words):
        sb.Study.from_table(small_table(**section))


def test_notes_survive_as_text() -> None:
    record = ComparisonRecord("key", "complete", "", {"chamfer": 0.1}, 7, 0.5)
    assert ComparisonRecord.from_json(record.to_json(3), 3) == record
    assert ComparisonRecord.from_json("", 3) is None
    with pytest.raises(sb.DamageError):
        ComparisonRecord.from_json('{"key": 1', 3)
