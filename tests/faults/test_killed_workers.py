"""Workers that are killed in the middle of a mesh."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from distributed import Client

from sobolev_batch import Study, open_store, run
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.batch.store.store import Store
from tests.faults.conftest import LABELS
from tests.faults.fatal import Moment
from tests.support.commands import command, write_toml
from tests.support.stores import assert_same_results
from tests.support.studies import variable


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
    assert "ico/2 is failed: its tasks ended the worker that they ran on again and again" in done.stdout
    assert "Traceback" not in done.stderr
    records = Store.open(store_path).records()
    assert [record.status for record in records if record] == ["complete", "complete", "failed", "complete", "complete"]
    assert variable(open_store(store_path), "convergence", "distance").sel(mesh="ico/2").isnull().all()
    # Without what kills its workers, it is computed and nothing else is.
    assert run(study, store_path, threads).computed == ("ico/2",)
    assert_same_results(store_path, finished_store)
