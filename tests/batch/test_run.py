"""Runs of whole studies on a cluster of processes, also without the process that submitted them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w
import trimesh
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.batch import field_tasks, table_stage
from sobolev_batch.batch.cluster.clients import remote_client
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.store import workspace
from sobolev_batch.store.latest_run import RunRecord
from sobolev_batch.store.layout import Store
from sobolev_batch.store.records import Record, Records
from tests.support.commands import call, command, finished
from tests.support.processes import tcp_cluster, wait_until, with_certificates
from tests.support.recipes import write_study
from tests.support.studies import GONE, SMALL_LATTICE, balls, small_table, variable


def test_stored_fields_and_tables_are_those_of_the_library(client: Client, finished_store: Path) -> None:
    tree = sb.open_store(finished_store)
    study = sb.Study.from_table(small_table())
    sphere = sb.fourier_transform(sb.shapes.Sphere(), SMALL_LATTICE)
    for level in range(4):
        field = variable(tree, "fourier", "fourier").sel(mesh=f"ico/{level}").drop_vars(["mesh", "quality"])
        expected = sb.fourier_transform(sb.shapes.icosphere(level), SMALL_LATTICE, threads=1)
        assert np.abs(field.values - expected.values).max() < 1e-13 * 4 * np.pi
        found = variable(tree, "convergence", "distance").sel(mesh=f"ico/{level}").values
        own = sb.distance(expected, sphere, study.orders)
        assert found == pytest.approx(own["distance"].values, rel=1e-12)
        for name, share in (("area_part", own["area_share"]), ("shape_part", 1 - own["area_share"])):
            stored_part = variable(tree, "convergence", name).sel(mesh=f"ico/{level}").values
            assert stored_part == pytest.approx((own["distance"] * share**0.5).values, rel=1e-8)
        # And with the same error.
        area, off, whole = (
            variable(tree, "convergence", name).sel(mesh=f"ico/{level}").values
            for name in ("area_part", "area_part_error", "error")
        )
        with np.errstate(divide="ignore"):
            most = (area + off) / np.maximum(found - whole, 0.0)
        of_area = own["area_share"].values
        farthest = np.maximum(np.minimum(most**2, 1.0) - of_area, of_area)
        assert (own["area_share_error"].values <= farthest + 1e-6).all()
        # A field straight from the store serves as an argument too.
        assert sb.distance(field, sphere, -3.0)["distance"].item() == pytest.approx(found[1], rel=1e-12)
    matrix = variable(tree, "distances", "distance").sel(order=-10.0).values
    assert np.array_equal(matrix, matrix.T)
    assert (matrix.diagonal() == 0).all()
    a, b = (sb.fourier_transform(sb.shapes.icosphere(level), SMALL_LATTICE) for level in (2, 3))
    assert matrix[2, 3] == pytest.approx(sb.distance(a, b, -10.0)["distance"].item(), rel=1e-9)
    convergence = tree["convergence"].to_dataset()
    rates = convergence.sel(order=-3.0)["rate"].values
    assert np.isnan(rates[[0, 4]]).all()
    assert rates[3] == pytest.approx(2.0, abs=0.02)
    # At order -10 the coarse lattice's aliasing exceeds the distances: marked, and without a rate.
    assert not convergence.sel(order=-10.0)["resolved"].any()
    assert np.isnan(convergence.sel(order=-10.0)["rate"]).all()
    assert np.array_equal(convergence["error_part"].sum("part"), convergence["error"])
    # All pairs know their errors too, nearly as well as pair by pair: their images are those of both to the reference.
    pair = sb.distance(a, b, study.orders)
    ours = tree["distances"].to_dataset().sel(mesh="ico/2", other="ico/3")
    assert (ours["error"].values > 0.7 * pair["error"].values).all()
    assert (ours["error"].values < 2.5 * pair["error"].values).all()


def test_mesh_facts_are_recorded(finished_store: Path) -> None:
    meshes = sb.open_store(finished_store)["meshes"].to_dataset()
    row = meshes.sel(mesh="ico/2")
    mesh = sb.shapes.icosphere(2)
    assert (row["triangles"].item(), row["vertices"].item()) == (320, 162)
    assert row["area"].item() == pytest.approx(mesh.area)
    assert row["digest"].item() == mesh.digest
    assert row["edge_length_max"].item() == pytest.approx(mesh.edge_lengths.max())
    assert (row["status"].item(), row["backend"].item()) == ("complete", "finufft")
    assert row["worker"].item().startswith("tls://127.0.0.1:")
    assert meshes["level"].values.tolist() == [0, 1, 2, 3, -1]


def test_a_run_counts_its_steps_and_a_second_one_has_none(client: Client, study: sb.Study, store_path: Path) -> None:
    def stamps() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in (store_path / "fourier" / "fourier" / "c").rglob("*")}

    steps: list[Progress] = []
    first = sb.run(study, store_path, client, on_progress=steps.append)
    assert (len(first.computed), first.reused, steps[0].stage) == (5, (), "cluster")
    fields, tables = ([step for step in steps if step.stage == stage] for stage in ("fields", "tables"))
    assert [step.done for step in fields] == list(range(6))
    assert {step.label for step in fields[1:]} == set(first.computed)
    assert tables[-1].done == tables[-1].total > 0
    before = stamps()
    steps.clear()
    second = sb.run(study, store_path, client, on_progress=steps.append)
    assert (second.computed, second.reused, steps) == ((), first.computed, [])
    with pytest.raises(sb.errors.StoreError, match="another study"):
        sb.run(sb.Study.from_table(small_table(study={"name": "other"})), store_path, client)
    assert stamps() == before


def test_a_run_looks_through_its_records_as_often_with_more_meshes(
    client: Client, store_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    passes: list[int] = []
    complete = workspace.complete_records

    def counted(records: Sequence[Record | None]) -> dict[int, Record]:
        passes.append(len(records))
        return complete(records)

    monkeypatch.setattr(workspace, "complete_records", counted)
    counts = []
    for levels in ([0, 1], [0, 1, 2, 3]):
        family = [{"name": "ico", "source": "icosphere", "levels": levels}]
        for _ in range(2):
            passes.clear()
            sb.run(sb.Study.from_table(small_table(family=family)), store_path, client)
        counts.append(len(passes))
    assert counts[0] == counts[1] > 0


def test_tables_of_an_older_version_are_made_anew(
    client: Client, study: sb.Study, store_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(table_stage, "TABLES_VERSION", table_stage.TABLES_VERSION - 1)
        sb.run(study, store_path, client)
    for tabulated in (True, False):
        steps: list[Progress] = []
        assert sb.run(study, store_path, client, on_progress=steps.append).computed == ()
        assert bool(steps) == ("tables" in {step.stage for step in steps}) == tabulated


def test_what_another_version_computed_is_never_taken_for_ours_and_is_named(
    copy: Path, store_path: Path, threads: Client, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    study, other = sb.Study.from_table(small_table()), store_path.with_name("other.zarr")
    with monkeypatch.context() as patch:
        # As on a worker of a later version.
        patch.setattr(field_tasks, "NUMERICS_VERSION", -1)
        failed = sb.run(study, other, threads).failed
    assert len(failed) == 5
    assert "computed it by numerics of version -1, not" in failed["ico/2"]
    assert len(sb.run(study, other, threads).computed) == 5
    # In a store where it was taken all the same:
    row, records = Store.open(copy).labels().index("ico/2"), Records(Store.open(copy))
    record = records.read()[row]
    assert record is not None
    records.write(row, replace(record, numerics=-1))
    monkeypatch.setattr(table_stage, "TABLES_VERSION", -1)
    assert sb.run(study, copy, threads).computed == ()
    versions = variable(sb.open_store(copy), "meshes", "numerics")
    assert versions["mesh"].values[versions == -1].tolist() == ["ico/2"]
    assert "were computed by numerics of versions -1 and" in caplog.text
    assert sb.verify(copy).fields.keys() == {"ico/2"}
    assert sb.run(study, copy, threads).computed == ("ico/2",)
    assert sb.verify(copy).is_sound


def test_a_bad_mesh_is_recorded_and_stops_nothing(client: Client, tmp_path: Path, store_path: Path) -> None:
    trimesh.creation.box().export(tmp_path / "good.off")
    (tmp_path / "bad.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 nan 0\n3 0 1 2\n")
    trimesh.creation.box((9.0, 1.0, 1.0)).export(tmp_path / "large.off")
    family = [{"name": "f", "source": "files", "paths": ["*.off", "missing.ply"]}]
    study = sb.Study.from_table(small_table(family=family), folder=tmp_path)
    summary = sb.run(study, store_path, client)
    assert summary.computed == ("f/good", "reference")
    assert set(summary.failed) == {"f/bad", "f/large", "f/missing"}
    assert "1 of 3 vertices have NaN" in summary.failed["f/bad"]
    assert "holds only |coordinate| <" in summary.failed["f/large"]
    assert "cannot be read" in summary.failed["f/missing"]
    tree = sb.open_store(store_path)
    distances = variable(tree, "convergence", "distance").isel(order=0)
    assert distances["mesh"][np.isfinite(distances)].values.tolist() == ["f/good", "reference"]
    assert np.isnan(variable(tree, "distances", "distance").sel(mesh="f/good", other="f/bad").values).all()
    assert variable(tree, "meshes", "status").sel(mesh="f/bad").item() == "failed"
    # Mended, it is computed, and nothing else is.
    trimesh.creation.box().export(tmp_path / "bad.off")
    assert sb.run(study, store_path, client).computed == ("f/bad",)


# Dies without any farewell as soon as the study is handed over.
CLIENT = """
import os, signal, sys
import sobolev_batch as sb
from distributed import Client

client = Client(sys.argv[1])
sb.submit(sb.Study.from_toml(sys.argv[2]), sys.argv[3], client)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture
def study_path(tmp_path: Path) -> Path:
    write_study(tmp_path)
    return tmp_path / "study.toml"


@pytest.mark.all
def test_the_client_is_killed_and_the_tables_come(study_path: Path, store_path: Path) -> None:
    with tcp_cluster([], []) as (address, _):
        client = finished(sys.executable, "-c", CLIENT, address, study_path, store_path)
        assert client.returncode == -9, client.stderr
        followed = call("status", store_path, "--follow")
    assert followed.returncode == 0, followed.stdout + followed.stderr
    assert f"{store_path}: 6 of 6 complete, 0 failed, 0 to go" in followed.stdout
    assert "\ndone; by process" in followed.stdout
    table = call("table", store_path).stdout
    assert ("ico/3" in table, "nan" in table.lower()) == (True, False)


def test_the_command_returns_and_says_how_to_follow(study_path: Path, tmp_path: Path, client: Client) -> None:
    store, address = tmp_path / "with space.zarr", client.scheduler.address
    for missing, status, options in ((2, 3, ["--only", "ico/[0]"]), (4, 0, []), (0, 0, [])):
        with with_certificates(client):
            submitted = call("submit", study_path, "--scheduler", address, "--store", store, *options)
        assert submitted.returncode == 0, submitted.stderr
        assert submitted.stdout.splitlines() == [
            f"{missing} of 6 surfaces to be computed by the cluster at {address}",
            f"follow it by: sobolev-batch status --follow '{store}'",
        ]
        assert call("status", store, "--follow").returncode == status


@pytest.mark.process
def test_a_study_of_several_objects_is_handed_over_as_a_whole(tmp_path: Path, client: Client) -> None:
    study = sb.Study.from_table(small_table(object=[*balls(ball=1.0), GONE]), folder=tmp_path)
    store, address = tmp_path / "all.zarr", client.scheduler.address
    submission = sb.submit(study, store, client)
    assert (submission.store, submission.surfaces, submission.missing, submission.refused) == (str(store), 10, 10, {})
    followed = call("status", store, "--follow")
    assert followed.returncode == 3
    assert "gone: the reference cannot be made" in followed.stdout
    assert sb.status(store).complete == 5
    (tmp_path / "study.toml").write_text(tomli_w.dumps(study.table))
    with with_certificates(client):
        submitted = call("submit", tmp_path / "study.toml", "--scheduler", address, "--store", store)
    assert submitted.returncode == 0, submitted.stderr
    assert submitted.stdout.splitlines() == [
        f"5 of 10 surfaces to be computed by the cluster at {address}",
        f"follow it by: sobolev-batch status --follow {store}",
    ]
    call("status", store, "--follow")


def test_what_is_wrong_is_said_before_anything_is_handed_over(
    tmp_path: Path, store_path: Path, threads: Client
) -> None:
    table = small_table(family=[{"name": "a", "source": "files", "paths": ["no/*.ply"]}])
    with pytest.raises(sb.errors.StudyError, match="matches no file"):
        sb.submit(sb.Study.from_table(table, folder=tmp_path), store_path, threads)
    with pytest.raises(sb.errors.ClusterError, match="requests backend 'gpu'"):
        sb.submit(sb.Study.from_table(small_table(transform={"backend": "gpu"})), store_path, threads)
    assert not store_path.exists()


def test_a_study_that_no_cluster_has_taken_is_waited_for_by_nobody(
    store_path: Path, threads: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(*arguments: object, **settings: object) -> None:
        raise sb.errors.ClusterError("the scheduler was lost")

    monkeypatch.setattr(threads, "submit", lost)
    with pytest.raises(sb.errors.ClusterError, match="was lost"):
        sb.submit(sb.Study.from_table(small_table()), store_path, threads)
    found = sb.status(store_path)
    assert not found.going_on
    assert "the latest run failed: it was not handed over: the scheduler was lost" in str(found)


@pytest.mark.all
def test_the_worker_that_drives_is_lost_and_another_takes_over(study_path: Path, store_path: Path) -> None:
    with tcp_cluster([], []) as (address, workers):
        assert command("submit", study_path, "--scheduler", address, "--store", store_path).returncode == 0
        store = Store.open(store_path)
        begun = wait_until(lambda: (record := RunRecord.read(store)) and record.state != "submitted" and record)
        assert begun
        driver = next(worker for worker in workers if f"process {worker.pid} " in begun.driver)
        driver.kill()
        done = wait_until(lambda: (record := RunRecord.read(store)) and record.state in ("done", "failed") and record)
        assert done
        assert done.state == "done"
    status = sb.status(store_path)
    assert (status.complete, status.total) == (6, 6)


@pytest.mark.all
def test_a_study_that_cannot_be_driven_says_so_in_its_store(study_path: Path, store_path: Path) -> None:
    """A file that the client sees and the workers do not: here, one that goes away."""
    mesh = study_path.with_name("tetrahedron.off")
    table = small_table(reference={"source": "files", "paths": [mesh.name]})
    with tcp_cluster([]) as (address, _), remote_client(address) as client:
        study = sb.Study.from_table(table, folder=mesh.parent)
        # Holds the only thread until the file is gone.
        blocked = client.submit(_remove, str(mesh), pure=False, priority=10)
        sb.submit(study, store_path, client)
        blocked.result()
        followed = call("status", store_path, "--follow")
    assert followed.returncode == 1
    assert "the latest run failed: the reference cannot be made" in followed.stdout


def _remove(path: str) -> None:
    # The study must have been planned by the client: its store says so.
    store = Path(path).parent / "results.zarr" / "records" / "zarr.json"
    wait_until(store.exists)
    Path(path).unlink()
