"""One run at a time has a store to itself."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Barrier
from typing import Any
from uuid import uuid4

import pytest
from distributed import Client

from sobolev_batch import Study, release, run
from sobolev_batch.batch import run as run_module
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import LOCK_KEY, Lock, acquire, locked
from sobolev_batch.batch.storage.timestamps import utc_now
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.study.plan import Plan, make_plan
from sobolev_batch.errors import LockError
from tests.support.commands import call, write_toml

# Stops in the middle of a study until it is told to go on; beats often. Told that its store was released, it
# goes on when its heartbeat has ended.
DRIVER = """
import sys
import threading
import sobolev_batch as sb
from sobolev_batch.batch.store import heartbeat

heartbeat.HEARTBEAT_SECONDS = 0.05

def pause(progress):
    if progress.done == 2:
        print("paused", flush=True)
        if sys.stdin.readline() == "released\\n":
            for thread in threading.enumerate():
                if thread.name == "sobolev-batch-heartbeat":
                    thread.join()

if __name__ == "__main__":
    sb.run(sb.Study.from_toml(sys.argv[1]), sys.argv[2], workers=1, on_progress=pause)
"""


def driving(study: Path, store: Path) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(study), str(store)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "paused\n"
    return process


def test_the_second_run_refuses_and_names_the_first(store_path: Path, tmp_path: Path) -> None:
    study = write_toml(tmp_path)
    first = driving(study, store_path)
    try:
        for second in (call("run", study, "--store", store_path), call("verify", store_path)):
            assert second.returncode == 2
            assert f"another run has this store to itself: process {first.pid} on " in second.stderr
            assert f"sobolev-batch release {store_path}" in second.stderr
        # Not from somebody who is alive.
        refused = call("release", store_path)
        assert refused.returncode == 2
        assert f"process {first.pid} on" in refused.stderr
        assert "is alive" in refused.stderr
    finally:
        _, said = first.communicate("go on\n")
    assert first.returncode == 0, said
    assert not (store_path / LOCK_KEY).exists()
    assert call("run", study, "--store", store_path).returncode == 0


def test_a_run_whose_store_was_released_ends(store_path: Path, tmp_path: Path) -> None:
    first = driving(write_toml(tmp_path), store_path)
    released = call("release", "--force", store_path)
    assert released.returncode == 0
    assert f"released from process {first.pid} on" in released.stdout
    _, said = first.communicate("released\n")
    assert first.returncode != 0
    assert "LockError" in said
    assert "nothing more is written by a run that no longer has the store" in said


@pytest.mark.slow
def test_a_run_that_loses_its_store_while_it_plans_leaves_it_alone(
    study: Study, store_path: Path, monkeypatch: pytest.MonkeyPatch, threads: Client
) -> None:
    run(study, store_path, threads)
    other = Lock("r", "h", "process 12 on far.example", utc_now())
    under_way = store_path / f"zarr.json.{uuid4().hex}.partial"

    def plan_slowly(*arguments: Any) -> Plan:
        planned = make_plan(*arguments)
        release(store_path, force=True)
        acquire(Location.of(store_path), other)
        under_way.write_text("what the other run is writing")
        return planned

    monkeypatch.setattr(run_module, "make_plan", plan_slowly)
    with pytest.raises(LockError, match="the store was released"):
        run(study, store_path, threads)
    assert under_way.exists()
    assert Lock.read(Location.of(store_path)) == other


@pytest.mark.slow
def test_the_lock_of_another_machine_is_released_by_hand(
    study: Study, store_path: Path, caplog: pytest.LogCaptureFixture, threads: Client
) -> None:
    run(study, store_path, threads)
    elsewhere = Lock("r", "h", "process 12 on far.example", "2026-01-01T00:00:00Z", "another boot/pid:[1]/12@34")
    assert Location.of(store_path).create(LOCK_KEY, elsewhere.to_json())
    with pytest.raises(LockError, match=r"process 12 on far\.example, since 2026-01-01"):
        run(study, store_path, threads)
    assert release(store_path) == elsewhere
    assert release(store_path) is None
    assert len(run(study, store_path, threads).reused) == 5


@pytest.mark.process
def test_only_the_dead_of_this_machine_are_taken_over(tmp_path: Path) -> None:
    child = subprocess.Popen(
        [sys.executable, "-c", LOCKING, str(tmp_path / "store")], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    child.stdout.readline()
    location = Location.of(tmp_path / "store")
    with pytest.raises(LockError, match=f"process {child.pid} on"):
        acquire(location, Lock.of_this_process())
    child.send_signal(signal.SIGKILL)
    child.communicate()
    left = Lock.read(location)
    assert left is not None
    assert left.holder_is_gone
    # The same number is another process if it was started at another time.
    here = Lock.of_this_process()
    assert not here.holder_is_gone
    table = json.loads(here.to_json())
    assert Lock(**{**table, "process": here.process + "1"}).holder_is_gone
    with locked(location, here):
        assert here.is_held(location)
    assert not (tmp_path / "store").exists()


LOCKING = """
import sys
import threading
from sobolev_batch.batch.storage.lock import Lock, acquire
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.timestamps import utc_now
from sobolev_batch.batch.store.store import Store
acquire(Location.of(sys.argv[1]), Lock.of_this_process())
print("taken", flush=True)
threading.Event().wait()
"""


@pytest.mark.parametrize("before", [None, "dead"])
@pytest.mark.parametrize("place", ["folder", "memory://locks/a"])
def test_of_many_at_once_one_has_it(place: str, before: str | None, tmp_path: Path) -> None:
    location = Location.of(place if ":" in place else tmp_path / place)
    here = Lock.of_this_process()
    dead = replace(here, run="r", holder="h", process=here.process + "1")
    together = Barrier(8)

    def attempt(number: int) -> bool:
        together.wait()
        try:
            acquire(location, Lock.of_this_process())
        except LockError:
            return False
        return True

    with ThreadPoolExecutor(8) as pool:
        for _ in range(20):
            if before:
                location.create(LOCK_KEY, dead.to_json())
            assert sum(pool.map(attempt, range(8))) == 1
            location.discard(LOCK_KEY)


@pytest.mark.parametrize("text", [b"", b"{", b"[1]", b'{"run": 3}', b'{"nothing": "known"}'])
def test_a_lock_that_cannot_be_read_is_one(text: bytes, tmp_path: Path) -> None:
    location = Location.of(tmp_path / "store")
    location.create(LOCK_KEY, text)
    with pytest.raises(LockError, match="a process that has not written its name"):
        acquire(location, Lock.of_this_process())


@pytest.mark.slow
def test_a_run_elsewhere_that_gave_a_sign_of_life_is_left_alone(
    study: Study, store_path: Path, threads: Client
) -> None:
    run(study, store_path, threads)
    there = Store.open(store_path)
    latest = there.read_run()
    assert latest is not None
    elsewhere = Lock("r", "h", "process 12 on far.example", "2026-01-01T00:00:00Z")
    Location.of(store_path).create(LOCK_KEY, elsewhere.to_json())
    there.write_run(replace(latest, driver="process 12 on far.example, cluster c", state="running", seen=utc_now()))
    with pytest.raises(LockError, match=r"process 12 on far\.example was alive \d+ s ago"):
        release(store_path)
    assert release(store_path, force=True) == elsewhere
    # A lock that was just taken, before any sign of life; a store that cannot be read.
    (store_path / "zarr.json").write_text("")
    Location.of(store_path).create(LOCK_KEY, replace(elsewhere, since=utc_now()).to_json())
    with pytest.raises(LockError, match="was alive"):
        release(store_path)
    assert release(store_path, force=True) is not None


@pytest.mark.process
def test_the_undead_count_as_gone(tmp_path: Path) -> None:
    """A process that has ended and whose parent has not asked how."""
    child = subprocess.Popen(
        [sys.executable, "-c", LOCKING, str(tmp_path / "store")], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    child.stdout.readline()
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    left = Lock.read(Location.of(tmp_path / "store"))
    assert left is not None
    assert left.holder_is_gone
    child.communicate()


@pytest.mark.process
def test_a_full_disk_leaves_no_lock(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", FULL, str(tmp_path / "store")], check=False)
    assert done.returncode == 0
    assert Lock.read(Location.of(tmp_path / "store")) is None


FULL = """
import resource, signal, sys
from sobolev_batch import StoreError
from sobolev_batch.batch.storage.lock import Lock, acquire
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.timestamps import utc_now
from sobolev_batch.batch.store.store import Store
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (10, 10))
try:
    acquire(Location.of(sys.argv[1]), Lock.of_this_process())
except StoreError:
    sys.exit(0)
sys.exit(1)
"""


def test_a_folder_of_the_users_stays(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    with locked(Location.of(tmp_path / "mine"), Lock.of_this_process()):
        pass
    assert (tmp_path / "mine").is_dir()


def test_nothing_is_left_where_nothing_was_begun(tmp_path: Path) -> None:
    bad = '[[family]]\nname = "f"\nsource = "files"\npaths = ["*.ply"]'
    (tmp_path / "bad.toml").write_text(write_toml(tmp_path).read_text() + bad)
    done = call("run", tmp_path / "bad.toml", "--store", tmp_path / "new.zarr")
    assert done.returncode == 2
    assert not (tmp_path / "new.zarr").exists()
