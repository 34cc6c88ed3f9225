"""One run at a time has a store to itself."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Event
from threading import enumerate as enumerate_threads
from typing import Any
from uuid import uuid4

import pytest
from distributed import Client

from sobolev_batch import Study, run, status, unlock
from sobolev_batch.batch.cluster import watch
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.errors import LockError, StoreError
from sobolev_batch.result_types import Summary
from sobolev_batch.store import workspace
from sobolev_batch.store.latest_run import RunRecord
from sobolev_batch.store.layout import Store
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import LOCK_KEY, Lock, acquire, locked, utc_now
from sobolev_batch.study.plan import Plan, make_plan
from tests.support.commands import call, write_toml
from tests.support.processes import PATIENCE_SECONDS
from tests.support.stores import full_disk, winners
from tests.support.studies import small_table

ELSEWHERE = Lock("r", "h", "process 12 on far.example", "2026-01-01T00:00:00Z", "another boot/pid:[1]/12@34")


@pytest.fixture
def location(store_path: Path) -> Location:
    return Location.parse(store_path)


@contextmanager
def driving(store: Path, client: Client, go_on: Callable[[], object] = lambda: None) -> Iterator[Future[Summary]]:
    """A run in a thread, which stops in the middle of the study, and goes on after the block."""
    paused, released = Event(), Event()

    def pause(progress: Progress) -> None:
        if progress.done == 2 and not paused.is_set():
            paused.set()
            assert released.wait(PATIENCE_SECONDS)
            go_on()

    with ThreadPoolExecutor(1) as pool:
        driver = pool.submit(run, Study.from_table(small_table()), store, client, on_progress=pause)
        assert paused.wait(PATIENCE_SECONDS), driver.result()
        try:
            yield driver
        finally:
            released.set()


@pytest.mark.slow
def test_the_second_run_refuses_and_names_the_first(store_path: Path, tmp_path: Path, threads: Client) -> None:
    study = write_toml(tmp_path)
    with driving(store_path, threads) as first:
        for second in (call("run", study, "--store", store_path), call("verify", store_path)):
            assert second.returncode == 2
            assert f"another run has this store to itself: process {os.getpid()} on " in second.stderr
            assert f"sobolev-batch unlock {store_path}" in second.stderr
        # Not from somebody who is alive.
        refused = call("unlock", store_path)
        assert refused.returncode == 2
        assert f"process {os.getpid()} on" in refused.stderr
        assert "is alive" in refused.stderr
    assert len(first.result().computed) == 5
    assert not (store_path / LOCK_KEY).exists()
    assert len(run(Study.from_toml(study), store_path, threads).reused) == 5


@pytest.mark.slow
def test_a_run_whose_store_was_unlocked_ends(
    store_path: Path, monkeypatch: pytest.MonkeyPatch, threads: Client
) -> None:
    monkeypatch.setattr(watch, "HEARTBEAT_SECONDS", 0.02)

    def wait_for_the_end_of_the_heartbeat() -> None:
        for thread in enumerate_threads():
            if thread.name == "sobolev-batch-heartbeat":
                thread.join(PATIENCE_SECONDS)

    with driving(store_path, threads, wait_for_the_end_of_the_heartbeat) as first:
        unlocked = call("unlock", "--force", store_path)
        assert unlocked.returncode == 0
        assert f"unlocked; process {os.getpid()} on" in unlocked.stdout
    # Its heartbeat or a task notices first.
    with pytest.raises(LockError, match="a run that no longer has the store: the store was unlocked"):
        first.result()


@pytest.mark.slow
def test_a_run_that_loses_its_store_while_it_plans_leaves_it_alone(
    study: Study, location: Location, store_path: Path, monkeypatch: pytest.MonkeyPatch, threads: Client
) -> None:
    run(study, store_path, threads)
    other = replace(ELSEWHERE, since=utc_now())
    under_way = store_path / f"zarr.json.{uuid4().hex}.partial"

    def plan_slowly(*arguments: Any) -> Plan:
        planned = make_plan(*arguments)
        unlock(store_path, force=True)
        acquire(location, other)
        under_way.write_text("what the other run is writing")
        return planned

    monkeypatch.setattr(workspace, "make_plan", plan_slowly)
    with pytest.raises(LockError, match=r"no longer has the store: process 12 on far\.example has it now"):
        run(study, store_path, threads)
    assert under_way.exists()
    assert Lock.read(location) == other


@pytest.mark.slow
def test_the_lock_of_another_machine_is_unlocked_by_hand_unless_its_run_gave_a_sign_of_life(
    study: Study, location: Location, store_path: Path, threads: Client
) -> None:
    run(study, store_path, threads)
    location.create(LOCK_KEY, ELSEWHERE.to_json())
    with pytest.raises(LockError, match=r"process 12 on far\.example, since 2026-01-01"):
        run(study, store_path, threads)
    assert (unlock(store_path), unlock(store_path)) == (ELSEWHERE, None)
    assert len(run(study, store_path, threads).reused) == 5
    there = Store.open(store_path)
    latest = RunRecord.read(there)
    assert latest is not None
    location.create(LOCK_KEY, ELSEWHERE.to_json())
    far = "process 12 on far.example, cluster c"
    replace(latest, driver=far, state="running", seen=utc_now()).write(there)
    with pytest.raises(LockError, match=r"process 12 on far\.example was alive \d+ s ago"):
        unlock(store_path)
    replace(latest, state="running", started="2999-01-01T00:00:00Z", seen="2999-01-01T00:00:00Z").write(there)
    assert "ahead of the clock here" in str(status(store_path))
    assert "whether it goes on is unknown" in str(status(store_path))
    assert unlock(store_path, force=True) == ELSEWHERE
    location.create(LOCK_KEY, replace(ELSEWHERE, since="2999-01-01T00:00:00Z").to_json())
    with pytest.raises(LockError, match=r"process 12 on far\.example is \d+ s ahead of the clock here"):
        unlock(store_path)
    assert unlock(store_path, force=True) is not None
    # A lock that was just taken, before any sign of life; a store that cannot be read.
    (store_path / "zarr.json").write_text("")
    location.create(LOCK_KEY, replace(ELSEWHERE, since=utc_now()).to_json())
    with pytest.raises(LockError, match="was alive"):
        unlock(store_path)
    assert unlock(store_path, force=True) is not None


LOCKING = """
import sys
from sobolev_batch.store.lock import Lock, acquire
from sobolev_batch.store.location import Location
acquire(Location.parse(sys.argv[1]), Lock.of_this_process())
print("taken", flush=True)
sys.stdin.read()
"""


@pytest.mark.process
def test_only_the_dead_of_this_machine_are_taken_over(location: Location, store_path: Path) -> None:
    command = [sys.executable, "-c", LOCKING, str(store_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "taken\n"
        with pytest.raises(LockError, match=f"process {child.pid} on"):
            acquire(location, Lock.of_this_process())
        child.kill()
        # It has ended, and its parent has not asked how; then it is no more.
        os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
        left = Lock.read(location)
        assert left is not None
        assert left.holder_is_gone
    assert left.holder_is_gone
    # The same number is another process if it was started at another time.
    here = Lock.of_this_process()
    assert not here.holder_is_gone
    assert replace(here, process=here.process + "1").holder_is_gone
    with locked(location, here):
        assert here.is_held(location)
    assert not store_path.exists()


@pytest.mark.parametrize("before", [None, "dead"])
@pytest.mark.parametrize("place", ["folder", "memory://locks/a"])
def test_of_many_at_once_one_has_it(place: str, before: str | None, tmp_path: Path) -> None:
    location = Location.parse(place if ":" in place else tmp_path / place)
    here = Lock.of_this_process()
    dead = replace(here, run="r", holder="h", process=here.process + "1")
    for _ in range(20):
        if before:
            location.create(LOCK_KEY, dead.to_json())
        assert winners(location, 8) == 1
        location.discard(LOCK_KEY)


NONSENSE = b'{"run": "r", "holder": "h", "driver": "d", "since": "noon"}'


@pytest.mark.parametrize("text", [b"", b"{", b"[1]", b'{"run": 3}', b'{"nothing": "known"}', NONSENSE])
def test_a_lock_that_cannot_be_read_is_one(text: bytes, location: Location) -> None:
    location.create(LOCK_KEY, text)
    with pytest.raises(LockError, match="a process that has not written its name"):
        acquire(location, Lock.of_this_process())


def test_a_full_disk_leaves_no_lock_and_a_folder_of_the_users_stays(location: Location, store_path: Path) -> None:
    with full_disk(10), pytest.raises(StoreError, match="File too large"):
        acquire(location, Lock.of_this_process())
    assert Lock.read(location) is None
    store_path.mkdir(exist_ok=True)
    with locked(location, Lock.of_this_process()):
        pass
    assert store_path.is_dir()
