"""Processes that are killed or stopped: workers, schedulers, drivers and writers, and tasks that outlive their run."""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from pathlib import Path

import dask
import numpy as np
import psutil
import pytest
import tomli_w
from distributed import Client, wait

from sobolev_batch import Mesh, Study, open_store, run, status, table, verify, write_mesh
from sobolev_batch.batch.cluster import watch
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.batch.cluster.watch import Silence, Watch
from sobolev_batch.errors import ClusterError, LockError, StoreError
from sobolev_batch.store.create import prepare_store
from sobolev_batch.store.layout import Store
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import Lock, locked
from sobolev_batch.store.records import Records
from sobolev_batch.study.plan import make_plan
from tests.faults.conftest import LABELS
from tests.faults.fatal import Moment
from tests.support.commands import TOML, call, command, finished, read_until, started, write_toml
from tests.support.processes import PATIENCE_SECONDS, tcp_cluster, wait_until
from tests.support.shapes import TETRAHEDRON_TRIANGLES, TETRAHEDRON_VERTICES
from tests.support.stores import assert_same_results, contents, flip
from tests.support.studies import small_table, variable


@pytest.mark.parametrize(
    "what", ["record", *(pytest.param(what, marks=pytest.mark.all) for what in ("field", "rename", "recorded"))]
)
def test_the_result_is_that_of_a_clean_run(
    what: str, study: Study, store_path: Path, finished_store: Path, strike: Callable[..., Moment], threads: Client
) -> None:
    moment = strike(what, 2)
    with local_client(2) as client:
        summary = run(study, store_path, client)
    assert len(moment.pids) == 1
    assert (summary.computed, summary.failed) == (LABELS, {})
    assert_same_results(store_path, finished_store)
    strays = list(store_path.rglob("*.partial"))
    assert len(strays) == (what == "rename")
    # The next run sweeps them.
    run(study, store_path, threads)
    assert list(store_path.rglob("*.partial")) == []


@pytest.mark.all
def test_a_mesh_that_kills_every_worker_is_blamed_and_no_other(
    study: Study, store_path: Path, finished_store: Path, tmp_path: Path, strike: Callable[..., Moment], threads: Client
) -> None:
    moment = strike("field", 2, times=99)
    done = command("run", write_toml(tmp_path), "--store", store_path, "--workers", "2")
    assert done.returncode == 3, done.stderr
    # Twice beside others, twice alone.
    assert len(moment.pids) == 4
    assert "ico/2 failed: its tasks ended the worker that they ran on again and again" in done.stdout
    assert "Traceback" not in done.stderr
    assert variable(open_store(store_path), "convergence", "distance").sel(mesh="ico/2").isnull().all()
    # Without what kills its workers, it is computed and nothing else is.
    assert run(study, store_path, threads).computed == ("ico/2",)
    assert_same_results(store_path, finished_store)


@pytest.mark.parametrize(
    "line", ["[2/5]", *(pytest.param(line, marks=pytest.mark.all) for line in ("dashboard:", "parts of tables"))]
)
def test_the_next_run_computes_what_has_no_record(
    line: str, store_path: Path, finished_store: Path, tmp_path: Path
) -> None:
    study = write_toml(tmp_path)
    with started("run", study, "--store", store_path, "--workers", "1") as driver:
        read_until(driver, line)
        os.kill(driver.pid, signal.SIGKILL)
        driver.wait()
        # Its workers end with it: what they were writing is then written or never will be.
        assert driver.stdout is not None
        driver.stdout.read()
    complete = [record is not None for record in Records(Store.open(store_path)).read()].count(True)
    assert complete >= {"dashboard:": 0, "[2/5]": 2, "parts of tables": 5}[line]
    # The process is known to be gone, so that its claim keeps nobody out.
    again = call("run", study, "--store", store_path, "--workers", "1")
    assert again.returncode == 0, again.stderr
    assert "taken over from process" in again.stderr
    assert again.stderr.count("complete, ") == 5 - complete
    assert f"{5 - complete} computed, {complete} reused" in again.stdout
    assert_same_results(store_path, finished_store)


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A study of two objects that goes through all stages, and its store after an undisturbed run."""
    folder = tmp_path_factory.mktemp("several")
    eggs = [
        {"name": name, "reference": {"source": "ellipsoid", "axes": [1.0, axis, 0.8], "levels": [3]}}
        for name, axis in (("a", 0.9), ("b", 0.7))
    ]
    table = small_table(
        lattice=None,
        accuracy={"rtol": 0.3},
        norm={"orders": [-2.0]},
        proximity={"points": 500},
        object=eggs,
        family=[{"name": "ico", "source": "icosphere", "levels": [1, 2]}],
        reference=None,
    )
    (folder / "study.toml").write_text(
        tomli_w.dumps({key: value for key, value in table.items() if key != "reference"})
    )
    run(Study.from_toml(folder / "study.toml"), folder / "undisturbed.zarr", workers=1)
    return folder / "study.toml", folder / "undisturbed.zarr"


@pytest.mark.parametrize(
    "line",
    [
        "lattices chosen",
        *(pytest.param(line, marks=pytest.mark.all) for line in ("b, 2 of 2: [1/3]", "parts of tables", "measured")),
    ],
)
def test_objects_go_on_wherever_their_driver_was_killed(
    line: str, several: tuple[Path, Path], store_path: Path, threads: Client
) -> None:
    study, undisturbed = several
    with started("run", study, "--store", store_path, "--workers", "1") as driver:
        read_until(driver, line)
        os.kill(driver.pid, signal.SIGKILL)
        driver.wait()
        assert driver.stdout is not None
        driver.stdout.read()
    assert status(store_path).run is not None
    again = run(Study.from_toml(study), store_path, threads)
    assert (len(again.computed) + len(again.reused), again.failed) == (6, {})
    for name in "ab":
        assert_same_results(store_path / name, undisturbed / name)
    assert verify(store_path).is_sound
    assert table(store_path)["object"].unique().tolist() == ["a", "b"]


# Pilots find a lattice that is too small; what is computed on it is laid out again, and computed on a larger one.
GROWING = """
import sys
from distributed import Client
import sobolev_batch as sb
from sobolev_batch.batch import object_run
from sobolev_batch.study import pilots
from tests.support.studies import small_table

run_pilot, object_run._SMALL_SECONDS = pilots.run_pilot, 0.0


def on_small_lattice(problem):
    distances, lattice, dtype = run_pilot(problem)
    return distances, sb.Lattice(0.6 * lattice.xi_max, lattice.M), dtype


pilots.run_pilot = on_small_lattice
study = small_table(lattice=None, accuracy={"rtol": 5e-4}, norm={"orders": [-10.0, -4.0]})
with Client(processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None) as client:
    sb.run(sb.Study.from_table(study), sys.argv[1], client, on_progress=lambda one: print(one, file=sys.stderr))
"""


@pytest.mark.all
@pytest.mark.parametrize("moment", ["[1/5]", "[3/5]", "parts of tables"])
def test_a_larger_lattice_goes_on_where_its_driver_was_killed(moment: str, tmp_path: Path) -> None:
    undisturbed, store_path = tmp_path / "undisturbed.zarr", tmp_path / "store.zarr"
    done = finished(sys.executable, "-c", GROWING.replace("sys.argv[1]", repr(str(undisturbed))))
    assert done.returncode == 0, done.stderr
    assert "grown" in done.stderr or done.stderr.count("[5/5]") == 2
    with started(script=GROWING.replace("sys.argv[1]", repr(str(store_path)))) as driver:
        for _ in range(2):
            read_until(driver, moment)
        os.kill(driver.pid, signal.SIGKILL)
        driver.wait()
    again = finished(sys.executable, "-c", GROWING.replace("sys.argv[1]", repr(str(store_path))))
    assert again.returncode == 0, again.stderr
    assert_same_results(store_path, undisturbed)
    assert verify(store_path).is_sound


@pytest.mark.all
@pytest.mark.parametrize("line", ["is damaged", "[1/1]"])
def test_a_repair_goes_on_where_its_driver_was_killed(
    line: str, finished_store: Path, store_path: Path, tmp_path: Path
) -> None:
    # New orders need all fields and no transform.
    (tmp_path / "study.toml").write_text(tomli_w.dumps(small_table(norm={"orders": [-4.0]})))
    undisturbed = tmp_path / "undisturbed.zarr"
    for place in (undisturbed, store_path):
        shutil.copytree(finished_store, place)
        flip(place / "fourier/fourier/c/2/0/0/0")
    assert call("run", tmp_path / "study.toml", "--store", undisturbed, "--workers", "1").returncode == 0
    with started("run", tmp_path / "study.toml", "--store", store_path, "--workers", "1") as driver:
        read_until(driver, line)
        os.kill(driver.pid, signal.SIGKILL)
        driver.wait()
    again = call("run", tmp_path / "study.toml", "--store", store_path, "--workers", "1")
    assert again.returncode == 0, again.stderr
    assert_same_results(store_path, undisturbed)
    assert verify(store_path).is_sound


KILLS = 20
# Its children start within milliseconds, without imports. Each writes one value after the other, and says so before.
KILLED_WRITERS = """
import json, os, signal, sys
from pathlib import Path
import numpy as np
from sobolev_batch import Study
from sobolev_batch.study.plan import make_plan
from sobolev_batch.store.create import prepare_store
from sobolev_batch.store.field_arrays import Fields
from sobolev_batch.store.records import Record, Records
from tests.support.studies import small_table

path = Path(sys.argv[1])
plan = make_plan(Study.from_table(small_table(lattice={"xi_max": 3.0, "M": 64})))
store = prepare_store(path, plan)
(place,) = Fields(store).places()
shape = [part.stop for part in place]
chunk = path / "fourier/fourier/c/0/0/0/0"
chunk.parent.mkdir(parents=True)
rng = np.random.default_rng(7)
found = {"torn": 0, "strays": 0, "unfounded": 0, "values": 0, "swept": True}
for kill in range(%d):
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        for number in range(1000 * kill + 1, 1000 * (kill + 1)):
            os.write(writer, b"x")
            checksum = Fields(store).write(0, place, np.full(shape, number, dtype=complex))
            Records(store).write(0, Record(str(number), "complete", checksums=(checksum,)))
        os._exit(1)
    for _ in range(int(rng.integers(1, 12))):
        os.read(reader, 1)
    # Where in the write it is by now is up to chance; every other time, there is a file without its name yet.
    while kill %% 2 and not any(name.endswith(".partial") for name in os.listdir(chunk.parent)):
        pass
    os.kill(child, signal.SIGKILL)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL
    os.close(reader)
    os.close(writer)
    values = Fields(store).read([0], place)[0]
    written = not np.isnan(values).all()
    found["values"] += written
    found["torn"] += written and not (values == values.flat[0]).all()
    found["strays"] += len(list(path.rglob("*.partial")))
    record = Records(store).read_one(0)
    # The field is never older than its record.
    found["unfounded"] += record is not None and not int(record.key) <= values.flat[0].real
    # What every run does first.
    store.location.remove_partial_files()
    found["swept"] &= not list(path.rglob("*.partial"))
print(json.dumps(found, default=int))
"""


@pytest.mark.process
def test_a_field_is_the_old_one_or_the_new_one(store_path: Path) -> None:
    done = finished(sys.executable, "-c", KILLED_WRITERS % KILLS, store_path, timeout=PATIENCE_SECONDS)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["torn"], found["unfounded"], found["swept"]) == (0, 0, True)
    # Kills did meet writes, and some came after one.
    assert found["strays"] > 0
    assert found["values"] > KILLS // 2


def test_a_layout_that_was_interrupted_is_begun_anew(
    study: Study, store_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, replace, left = make_plan(study), Path.replace, 0

    def counted(path: Path, target: Path) -> Path:
        nonlocal left
        left -= 1
        if left < 0:
            raise OSError("the disk is gone")
        return replace(path, target)

    # It ends before every key that is put in place, until it is done with all.
    monkeypatch.setattr(Path, "replace", counted)
    for whole in range(100):
        left = whole
        with suppress(StoreError):
            store = prepare_store(store_path, plan)
            break
    assert whole > 5
    assert (store.labels(), Records(store).read()) == (LABELS, (None,) * 5)


def write_part(folder: Path, shift: float) -> None:
    write_mesh(Mesh(np.add(TETRAHEDRON_VERTICES, (shift, 0, 0)), TETRAHEDRON_TRIANGLES), folder / "part.ply")


@pytest.mark.all
@pytest.mark.parametrize("what", ["field", "rename", "record"])
def test_a_worker_that_goes_on_after_another_run_writes_nothing(
    what: str, tmp_path: Path, strike: Callable[..., Moment]
) -> None:
    study, store, undisturbed = tmp_path / "study.toml", tmp_path / "store.zarr", tmp_path / "undisturbed.zarr"
    family = '[[family]]\nname = "file"\nsource = "files"\npaths = ["part.ply"]\n'
    study.write_text(TOML.partition("[[family]]")[0] + family)
    write_part(tmp_path, 0.0)
    moment = strike(what, 0, number=signal.SIGSTOP)
    with tcp_cluster([]) as (address, (_, worker)):
        with started("run", study, "--store", store, "--scheduler", address) as driver:
            wait_until(lambda: moment.pids and psutil.Process(worker.pid).status() == psutil.STATUS_STOPPED)
            assert driver.poll() is None
        # The driver was killed.
        # Another mesh, of equal size in the store.
        write_part(tmp_path, 0.125)
        assert run(Study.from_toml(study), store, workers=1).failed == {}
        before = contents(store)
        os.kill(worker.pid, signal.SIGCONT)
        with Client(address) as client:
            # The worker has one thread: it has ended its task when it does another.
            wait(client.submit(os.getpid), timeout=PATIENCE_SECONDS)
    assert contents(store) == before
    assert verify(store).is_sound
    run(Study.from_toml(study), undisturbed, workers=1)
    assert_same_results(store, undisturbed)


def test_only_the_run_that_has_the_store_writes(store_path: Path, finished_store: Path) -> None:
    location, lock = Location(str(finished_store)), Lock.of_this_process()
    store = Store(lock.fenced(location))
    record = Records(store).read_one(0)
    with pytest.raises(LockError, match="the store was unlocked, or its run is over"):
        Records(store).write(0, record)
    with locked(location, lock):
        Records(store).write(0, record)
        with pytest.raises(LockError, match=r"no longer has the store: process \d+ on .* has it now"):
            Records(Store(Lock.of_this_process().fenced(location))).write(0, record)
    assert json.loads(record.to_json(0) if record else "{}")["row"] == 0


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(watch, "_POLL_SECONDS", 1.0)
    monkeypatch.setattr(watch, "_TELL_AFTER_SECONDS", 3.0)
    # Of schedulers that are other processes, and of those in this one.
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL", "10s")
    with dask.config.set({"distributed.scheduler.worker-ttl": "10s"}):
        yield


@pytest.fixture
def stopped(impatient: None, strike: Callable[..., Moment]) -> Iterator[Moment]:
    """A worker of any cluster that is started meanwhile is stopped before it writes the field of ico/2."""
    moment = strike("field", 2, number=signal.SIGSTOP)
    yield moment
    for pid in moment.pids:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


@contextmanager
def two_workers(nanny: str) -> Iterator[Client]:
    with tcp_cluster([nanny], [nanny]) as (address, _), Client(address) as client:
        yield client


@pytest.mark.all
@pytest.mark.parametrize(
    "cluster",
    # The worker of a cluster of one's own is started again.
    [partial(two_workers, "--nanny"), partial(two_workers, "--no-nanny"), partial(local_client, 1)],
    ids=["nannies", "no nannies", "own"],
)
def test_what_a_silent_worker_has_is_told_and_done_by_others(
    cluster: Callable[[], AbstractContextManager[Client]], stopped: Moment, study: Study,
    store_path: Path, finished_store: Path, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    with cluster() as client, caplog.at_level(logging.WARNING):
        summary = run(study, store_path, client)
    assert len(stopped.pids) == 1
    assert (summary.computed, summary.failed) == (LABELS, {})
    assert_same_results(store_path, finished_store)
    told = re.search(r"the worker (\S+) has said nothing since \d\d:\d\d:\d\d UTC, and has (.*?)\. Dask", caplog.text)
    assert told is not None, caplog.text
    assert "ico/2" in told[2]


@pytest.mark.all
@pytest.mark.usefixtures("impatient")
def test_a_worker_that_was_stopped_before_the_run_is_given_up(study: Study, store_path: Path) -> None:
    with tcp_cluster([], []) as (address, (_, worker, _)), Client(address) as client:
        os.kill(worker.pid, signal.SIGSTOP)
        assert run(study, store_path, client).computed == LABELS


@pytest.mark.all
@pytest.mark.usefixtures("impatient")
def test_a_scheduler_that_is_silent_ends_the_run(study: Study, store_path: Path, finished_store: Path) -> None:
    with tcp_cluster([]) as (address, (scheduler, _)):

        def stop_scheduler(progress: object) -> None:
            if getattr(progress, "label", "") == "ico/1":
                os.kill(scheduler.pid, signal.SIGSTOP)

        try:
            with (
                Client(address, timeout=5) as client,
                pytest.raises(ClusterError, match="the same command goes on from what is stored"),
            ):
                run(study, store_path, client, on_progress=stop_scheduler)
        finally:
            os.kill(scheduler.pid, signal.SIGCONT)
    assert "ico/0" in run(study, store_path, workers=1).reused
    assert_same_results(store_path, finished_store)


@pytest.mark.all
@pytest.mark.usefixtures("impatient")
def test_a_cluster_without_workers_is_told() -> None:
    def told(address: str, needs_gpu: bool) -> str:
        with Client(address) as client, Watch(client, needs_gpu).kept() as kept:
            return wait_until(lambda: kept.obstacle)

    with tcp_cluster() as (address, _):
        assert told(address, False) == "no worker is left; waiting for one to start"
    with tcp_cluster([]) as (address, _):
        assert told(address, True).startswith("no worker with a GPU is left, and the study requests one")


def test_a_silence_counts_only_what_was_heard_missing() -> None:
    silence = Silence(heard=1.0).after(5.0, heard=1.0).after(2.5, heard=1.0)
    assert silence.seconds == 7.5
    assert silence.after(100.0, heard=2.0).seconds == 0.0
