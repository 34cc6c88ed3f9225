"""Processes that are killed while they write: the old value, none, or the new one."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from sobolev_batch import Study
from sobolev_batch.batch.store.create import prepare_store
from sobolev_batch.batch.study.plan import make_plan
from tests.support.commands import finished
from tests.support.processes import PATIENCE_SECONDS
from tests.support.studies import small_table

pytestmark = pytest.mark.process

KILLS = 20


def outcome(script: str, store: Path) -> Any:
    """What a script prints that kills children of its own: they start within milliseconds, without imports."""
    done = finished(sys.executable, "-c", script, store, timeout=PATIENCE_SECONDS)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


# Each child writes one value after the other, and says so before each.
KILLED_WRITERS = """
import json, os, signal, sys
from pathlib import Path
import numpy as np
from sobolev_batch import Study
from sobolev_batch.batch.study.plan import make_plan
from sobolev_batch.batch.store.create import prepare_store
from sobolev_batch.batch.store.records import Record
from tests.support.studies import small_table

path = Path(sys.argv[1])
plan = make_plan(Study.from_table(small_table(lattice={"xi_max": 3.0, "M": 64})))
store = prepare_store(path, plan)
(place,) = store.places()
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
            checksum = store.write_field(0, place, np.full(shape, number, dtype=complex))
            store.write_record(0, Record(str(number), "complete", checksums=(checksum,)))
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
    values = store.read_fields([0], place)[0]
    written = not np.isnan(values).all()
    found["values"] += written
    found["torn"] += written and not (values == values.flat[0]).all()
    found["strays"] += len(list(path.rglob("*.partial")))
    record = store.read_record(0)
    # The field is never older than its record.
    found["unfounded"] += record is not None and not int(record.key) <= values.flat[0].real
    # What every run does first.
    store.location.remove_partial_files()
    found["swept"] &= not list(path.rglob("*.partial"))
print(json.dumps(found, default=int))
"""


def test_a_field_is_the_old_one_or_the_new_one(store_path: Path) -> None:
    found = outcome(KILLED_WRITERS % KILLS, store_path)
    assert (found["torn"], found["unfounded"], found["swept"]) == (0, 0, True)
    # Kills did meet writes, and some came after one.
    assert found["strays"] > 0
    assert found["values"] > KILLS // 2


# Killed before every key that is put in place, until the layout is done without.
KILLED_LAYOUTS = """
import json, os, signal, sys
from pathlib import Path
from sobolev_batch import Study
from sobolev_batch.batch.study.plan import make_plan
from sobolev_batch.batch.store.create import prepare_store
from tests.support.studies import small_table

plan = make_plan(Study.from_table(small_table()))
replace, left = Path.replace, 0

def counted(self, target):
    global left
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    left -= 1
    return replace(self, target)

for deaths in range(100):
    child = os.fork()
    if child == 0:
        Path.replace, left = counted, deaths
        prepare_store(sys.argv[1], plan)
        os._exit(0)
    status = os.waitpid(child, 0)[1]
    if status == 0:
        break
    assert status == signal.SIGKILL
print(json.dumps(deaths))
"""


@pytest.mark.all
def test_a_layout_that_was_interrupted_is_begun_anew(store_path: Path) -> None:
    assert outcome(KILLED_LAYOUTS, store_path) > 5
    store = prepare_store(store_path, make_plan(Study.from_table(small_table())))
    assert store.labels() == ("ico/0", "ico/1", "ico/2", "ico/3", "reference")
    assert store.records() == (None,) * 5
