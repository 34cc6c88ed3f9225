"""Studies that go on without the process that submitted them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import tomli_w
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.batch.cluster.clients import remote_client
from sobolev_batch.batch.store.store import Store
from sobolev_batch.results.status import Status
from tests.support.commands import call, command
from tests.support.processes import tcp_cluster, wait_until
from tests.support.recipes import write_study
from tests.support.studies import GONE, balls, small_table

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
        client = subprocess.run(
            [sys.executable, "-c", CLIENT, address, str(study_path), str(store_path)],
            capture_output=True,
            text=True,
            check=False,
        )
        assert client.returncode == -9, client.stderr
        followed = call("status", store_path, "--follow")
    assert followed.returncode == 0, followed.stdout + followed.stderr
    assert f"{store_path}: 6 of 6 complete, 0 failed, 0 to go" in followed.stdout
    assert "\ndone; by process" in followed.stdout
    table = call("table", store_path)
    assert "ico/3" in table.stdout
    assert "nan" not in table.stdout.lower()


def test_the_command_returns_and_says_how_to_follow(study_path: Path, tmp_path: Path, client: Client) -> None:
    store, address = tmp_path / "with space.zarr", client.scheduler.address
    for missing in (6, 0):
        submitted = call("submit", study_path, "--scheduler", address, "--store", store)
        assert submitted.returncode == 0, submitted.stderr
        assert submitted.stdout.splitlines() == [
            f"{missing} of 6 surfaces to be computed by the cluster at {address}",
            f"follow it by: sobolev-batch status --follow '{store}'",
        ]
        assert call("status", store, "--follow").returncode == 0


@pytest.mark.process
def test_a_collection_is_handed_over_by_object(tmp_path: Path, client: Client) -> None:
    collection = sb.StudyCollection.from_table(small_table(object=[*balls(ball=1.0), GONE]), folder=tmp_path)
    store, address = tmp_path / "all.zarr", client.scheduler.address
    submission = sb.submit(collection, store, client)
    assert (submission.surfaces, submission.missing) == (5, 5)
    assert submission.objects["ball"].store == str(store / "ball")
    assert list(submission.refused) == ["gone"]
    assert call("status", store, "--follow").returncode == 3
    (tmp_path / "study.toml").write_text(tomli_w.dumps(collection.table))
    submitted = call("submit", tmp_path / "study.toml", "--scheduler", address, "--store", store)
    assert submitted.returncode == 3, submitted.stderr
    assert submitted.stdout.splitlines() == [
        "ball:",
        f"0 of 5 surfaces to be computed by the cluster at {address}",
        "gone:",
        f"follow it by: sobolev-batch status --follow {store}",
    ]
    assert "not submitted: the reference cannot be made" in submitted.stderr
    assert "gone: it has no results; run the study again to see why" in call("status", store, "--follow").stdout


def test_what_is_wrong_is_said_before_anything_is_handed_over(
    tmp_path: Path, store_path: Path, threads: Client
) -> None:
    table = small_table(family=[{"name": "a", "source": "files", "paths": ["no/*.ply"]}])
    with pytest.raises(sb.StudyError, match="matches no file"):
        sb.submit(sb.Study.from_table(table, folder=tmp_path), store_path, threads)
    with pytest.raises(sb.ClusterError, match="requests backend 'gpu'"):
        sb.submit(sb.Study.from_table(small_table(transform={"backend": "gpu"})), store_path, threads)
    assert not store_path.exists()


@pytest.mark.all
def test_the_worker_that_drives_is_lost_and_another_takes_over(study_path: Path, store_path: Path) -> None:
    with tcp_cluster([], []) as (address, workers):
        assert command("submit", study_path, "--scheduler", address, "--store", store_path).returncode == 0
        store = Store.open(store_path)
        begun = wait_until(lambda: (record := store.read_run()) and record.state != "submitted" and record)
        assert begun
        driver = next(worker for worker in workers if f"process {worker.pid} " in begun.driver)
        driver.kill()
        done = wait_until(lambda: (record := store.read_run()) and record.state in ("done", "failed") and record)
        assert done
        assert done.state == "done"
    status = Status.from_store(store_path)
    assert (status.complete, status.total, status.failed) == (6, 6, {})


@pytest.mark.all
def test_a_study_that_cannot_be_driven_says_so_in_its_store(study_path: Path, store_path: Path) -> None:
    """A file that the client sees and the workers do not: here, one that goes away."""
    mesh = study_path.with_name("mesh.off")
    mesh.write_text("OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 3\n3 0 2 3\n3 1 2 3\n")
    table = small_table(reference={"source": "files", "paths": ["mesh.off"]})
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
