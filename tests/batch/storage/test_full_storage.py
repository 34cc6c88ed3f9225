"""Stores that take no more fields in the middle of a run: it ends, blames no mesh, and is resumed."""

from __future__ import annotations

import resource
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import Client

from sobolev_batch import StoreError, Study, open_store, run
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.batch.cluster.progress import Progress
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.store import Store
from tests.support.commands import STUDY, command
from tests.support.failing_storage import HEALTHY, FailingStorage, Rule, Turn, failing
from tests.support.object_storage import BUCKET, IMPATIENT, serving, taken_for_s3
from tests.support.stores import assert_same
from tests.support.studies import small_table


@pytest.fixture
def storage() -> Iterator[FailingStorage]:
    pytest.importorskip("s3fs", reason="the driver of s3:// URLs comes with the extra 's3'")
    with serving() as server, failing(server) as storage, taken_for_s3({**storage.environment(), **IMPATIENT}):
        yield storage


@pytest.mark.all
def test_object_storage_that_takes_no_more_fields(storage: FailingStorage, tmp_path: Path) -> None:
    location = Location.of(f"s3://{BUCKET}/results.zarr")

    def go() -> subprocess.CompletedProcess[str]:
        return command("run", "study.toml", "--workers", "1", "--store", str(location), folder=tmp_path)

    (tmp_path / "study.toml").write_text(STUDY)
    # Records could still be written: of meshes that failed, too.
    no_fields = Rule(1.0, ("error",), frozenset({"PUT"}), part="/fourier/fourier/c/")
    storage.await_turn(Turn("PUT", "/fourier/fourier/c/", 2, no_fields))
    done = go()
    assert done.returncode == 2, done.stderr
    assert f"error: {location}: the store cannot be written: " in done.stderr.splitlines()[-1]
    storage.rule = HEALTHY
    assert [record and record.status for record in Store(location).records()] == ["complete", None, None]
    again = go()
    assert again.returncode == 0, again.stderr
    assert "2 computed, 1 reused, 0 failed" in again.stdout


def _limit_files(size_bytes: int) -> None:
    """Let this process write no larger files; Python ignores the signal, so that writing fails."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, size_bytes))


def test_a_disk_without_room_for_more_fields(
    study: Study, store_path: Path, finished_store: Path, threads: Client
) -> None:
    with local_client(1) as client:

        def fill(progress: Progress) -> None:
            if progress.stage == "fields" and progress.done == 2:
                client.run(_limit_files, 20_000)

        with pytest.raises(StoreError, match=rf"{store_path}: the store cannot be written: File too large"):
            run(Study.from_table(small_table()), store_path, client, on_progress=fill)
    records = Store(store_path).records()
    assert all(record is None or record.status == "complete" for record in records)
    there = sum(record is not None for record in records)
    assert 2 <= there < 5
    assert not list(store_path.rglob("*.partial"))
    again = run(study, store_path, threads)
    assert (len(again.reused), len(again.computed), again.failed) == (there, 5 - there, {})
    assert_same(open_store(store_path), open_store(finished_store))
