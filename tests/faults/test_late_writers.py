"""Tasks that outlive their run: what they still write must not replace what is newer."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import pytest
from distributed import Client, wait

from sobolev_batch import LockError, Mesh, Study, run, verify, write_mesh
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import Lock, locked
from sobolev_batch.batch.store.store import Store
from tests.faults.fatal import Moment
from tests.support.commands import TOML, started
from tests.support.processes import PATIENCE_SECONDS, tcp_cluster, wait_until
from tests.support.shapes import TETRAHEDRON_TRIANGLES, TETRAHEDRON_VERTICES
from tests.support.stores import assert_same_results, contents

# Moved by so much, the mesh is another one, of equal size in the store.
SHIFT = 0.125


def write_part(folder: Path, shift: float) -> None:
    write_mesh(Mesh(np.add(TETRAHEDRON_VERTICES, (shift, 0, 0)), TETRAHEDRON_TRIANGLES), folder / "part.ply")


@pytest.mark.all
@pytest.mark.parametrize("what", ["field", "rename", "record"])
def test_a_worker_that_goes_on_after_another_run_writes_nothing(
    what: str, tmp_path: Path, strike: Callable[..., Moment]
) -> None:
    """Its worker is stopped, its driver killed, the mesh changed, another run done, and the worker continued."""
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
        write_part(tmp_path, SHIFT)
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
    store = Store(location.fenced(lock.fence))
    record = store.read_record(0)
    with pytest.raises(LockError, match="the store was released, or its run is over"):
        store.write_record(0, record)
    with locked(location, lock):
        store.write_record(0, record)
        with pytest.raises(LockError, match=r"no longer has the store: process \d+ on .* has it now"):
            Store(location.fenced(Lock.of_this_process().fence)).write_record(0, record)
    assert json.loads(record.to_json(0) if record else "{}")["row"] == 0
