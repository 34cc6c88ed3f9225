"""However many workers and threads, and however often a task is done: the same store."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

import pytest
from distributed import Client

from sobolev_batch import Study, run
from sobolev_batch.batch.cluster.clients import local_client, thread_client
from sobolev_batch.batch.store.store import Store
from tests.support.stores import assert_same_results


@pytest.mark.parametrize(
    "cluster",
    [partial(thread_client, 4), *(pytest.param(partial(local_client, n), marks=pytest.mark.all) for n in (1, 3))],
)
def test_workers_and_threads(
    cluster: Callable[[], AbstractContextManager[Client]], study: Study, finished_store: Path, store_path: Path
) -> None:
    with cluster() as client:
        run(study, store_path, client)
    # Bit for bit; what is summed over tiles of other sizes, to rounding.
    assert_same_results(store_path, finished_store)


# Two processes that do the same tasks at the same time, again and again.
TWICE = """
import os, sys
from sobolev_batch import Study
from sobolev_batch.batch.study.plan import make_plan
from sobolev_batch.batch.workspace import Workspace
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.fields.tasks import Job, compute_mesh
from tests.support.studies import small_table

plan = make_plan(Study.from_table(small_table()))
store = Store.open(sys.argv[1])
print("ready", flush=True)
sys.stdin.readline()
for i, row in Workspace.for_plan(store, plan).rows.items():
    if row.label == "reference":
        continue
    job = Job.for_row(plan, row, store, i)
    for _ in range(5):
        store.write_record(i, None)
        assert compute_mesh(job, plan.blocks).status == "complete"
"""


@pytest.mark.process
def test_the_same_task_twice_at_once(study: Study, finished_store: Path, store_path: Path, threads: Client) -> None:
    run(study, store_path, threads)
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
    assert_same_results(store_path, finished_store)
    # Facts as text, since those of a sphere hold NaN.
    ours, clean = (
        [(str(record.facts), record.quality, record.checksums) for record in Store.open(path).records() if record]
        for path in (store_path, finished_store)
    )
    assert ours == clean
    assert run(study, store_path, threads).computed == ()
