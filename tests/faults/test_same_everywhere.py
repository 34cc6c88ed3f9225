"""However many workers and threads, and however often a task is done: the same store."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from sobolev_batch import Study, run
from sobolev_batch.batch.cluster.clients import local_client, thread_client
from sobolev_batch.batch.store.store import Store
from tests.support.stores import assert_same_fields, assert_same_tables


def test_workers_and_threads(study: Study, finished_store: Path, tmp_path: Path) -> None:
    for workers in (1, 3):
        with local_client(workers) as client:
            run(study, tmp_path / f"{workers}.zarr", client)
    with thread_client(4) as client:
        run(study, tmp_path / "threads.zarr", client)
    for store in sorted(tmp_path.glob("*.zarr")):
        # Bit for bit; what is summed over tiles of other sizes, to rounding.
        assert_same_fields(store, finished_store)
        assert_same_tables(store, finished_store)


# Two processes that do the same tasks at the same time, again and again.
TWICE = """
import os, sys
from sobolev_batch import Study
from sobolev_batch.batch.study.plan import make_plan
from sobolev_batch.batch.workspace import Workspace
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.fields.tasks import FieldSettings, Job, compute_mesh
from tests.support.studies import small_table

plan = make_plan(Study.from_table(small_table()))
store = Store.open(sys.argv[1])
print("ready", flush=True)
sys.stdin.readline()
for i, row in Workspace.of(store, plan).rows.items():
    if row.label == "reference":
        continue
    job = Job(store, i, row, FieldSettings.of(plan))
    for _ in range(5):
        store.write_record(i, None)
        assert compute_mesh(job, plan.blocks).status == "complete"
"""


def test_the_same_task_twice_at_once(study: Study, finished_store: Path, store_path: Path) -> None:
    run(study, store_path, workers=1)
    twins = [
        subprocess.Popen(
            [sys.executable, "-c", TWICE, str(store_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    for twin in twins:
        assert twin.stdout is not None
        assert twin.stdout.readline() == "ready\n"
    for twin in twins:
        assert twin.stdin is not None
        twin.stdin.write("go\n")
        twin.stdin.flush()
    for twin in twins:
        twin.communicate()
        assert twin.returncode == 0
    assert_same_fields(store_path, finished_store)
    records, clean = Store.open(store_path).records(), Store.open(finished_store).records()
    for record, other in zip(records, clean, strict=True):
        assert record is not None
        assert other is not None
        # As text, since facts of a sphere hold NaN.
        assert str(record.facts) == str(other.facts)
        assert (record.quality, record.checksums) == (other.quality, other.checksums)
    assert run(study, store_path, workers=1).computed == ()
