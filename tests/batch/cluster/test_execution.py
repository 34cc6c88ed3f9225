"""The scheduler dies in the middle of a run: the run ends with an error, and nothing is recorded as failed."""

from __future__ import annotations

from pathlib import Path

import pytest
from distributed import Client

from sobolev_batch import ClusterError, Study, run
from sobolev_batch.batch.cluster.progress import Progress
from sobolev_batch.batch.store.store import Store
from sobolev_batch.results.status import Status
from tests.support.processes import SCHEDULER, WORKER, dask, scheduler_address, stop
from tests.support.studies import small_table


def test_a_lost_scheduler_ends_the_run_and_blames_no_mesh(store_path: Path) -> None:
    family = [{"name": f"ball{i}", "source": "sphere", "radius": 0.5 + 0.001 * i} for i in range(200)]
    study = Study.from_table(small_table(family=family, norm={"orders": [-3.0], "pairs": "reference"}))
    scheduler = dask(*SCHEDULER)
    processes = [scheduler]

    def end(progress: Progress) -> None:
        if progress.stage == "fields" and progress.done == 3:
            scheduler.kill()
            scheduler.wait()

    try:
        address = scheduler_address(scheduler)
        processes.append(dask("worker", address, *WORKER))
        # It gives up looking for the scheduler after a second instead of half a minute.
        client = Client(address, timeout=1)
        client.wait_for_workers(1, timeout=60)
        with pytest.raises(ClusterError, match=r"the scheduler at .* was lost; the same command goes on"):
            run(study, store_path, client, on_progress=end)
    finally:
        for process in reversed(processes):
            stop(process)
    records = Store(store_path).records()
    assert all(record is None or record.status == "complete" for record in records)
    assert sum(record is not None for record in records) >= 3
    status = Status.of(store_path)
    assert status.run is not None
    assert (status.run.state, status.failed) == ("failed", {})
    again = run(study, store_path, workers=1)
    assert (len(again.reused) >= 3, again.failed) == (True, {})
