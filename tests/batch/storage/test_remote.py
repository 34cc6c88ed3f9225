"""Object storage that fails for a moment, or for good, and disks that are full."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from distributed import Client
from zarr.buffer.cpu import Buffer
from zarr.core.buffer import default_buffer_prototype
from zarr.core.sync import sync

from sobolev_batch import StoreError, Study, open_store, run
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.batch.storage import retry
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.create import prepare_store
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.study.plan import make_plan
from tests.support.commands import STUDY, command
from tests.support.failing_storage import GONE, HEALTHY, KINDS, FailingStorage, Kind, Rule, Turn, failing
from tests.support.object_storage import BUCKET, IMPATIENT, serving, taken_for_s3
from tests.support.stores import assert_same
from tests.support.studies import small_table

pytest.importorskip("s3fs", reason="the driver of s3:// URLs comes with the extra 's3'")

DOCUMENT = bytes(range(256)) * 400


@pytest.fixture(scope="module")
def served() -> Iterator[FailingStorage]:
    """A server that fails on demand, which this process and all that it starts take for S3."""
    with serving() as server, failing(server) as storage, taken_for_s3(storage.environment()):
        yield storage


@pytest.fixture
def storage(served: FailingStorage) -> Iterator[FailingStorage]:
    """The server, healthy again after each test."""
    yield served
    served.rule = HEALTHY


@pytest.fixture(scope="module")
def s3_client(served: FailingStorage) -> Iterator[Client]:
    """Two worker processes that know the server."""
    with local_client(2) as client:
        yield client


@pytest.fixture
def location(request: pytest.FixtureRequest) -> Location:
    """A place that no other test uses."""
    return Location.of(f"s3://{BUCKET}/{re.sub(r'[^a-z0-9]+', '-', request.node.name.lower())}/results.zarr")


@pytest.mark.parametrize("kind", KINDS)
def test_what_fails_once_is_done_again(storage: FailingStorage, location: Location, kind: Kind) -> None:
    keys = location.zarr_store()
    location.write({"a/b": b"old", "a/c": b"2", "d": DOCUMENT})
    before = storage.failures()[kind]

    def fail_once() -> None:
        storage.rule = Rule(1.0, (kind,), most=1)

    fail_once()
    assert location.read("d") == DOCUMENT
    fail_once()
    location.write({"a/b": b"new"})
    assert location.read("a/b") == b"new"
    fail_once()
    assert location.names()
    fail_once()
    assert got(location, "d") == DOCUMENT
    fail_once()
    sync(keys.set("e", Buffer.from_bytes(DOCUMENT)))
    assert location.read("e") == DOCUMENT
    fail_once()
    location.remove("a")
    assert location.read("a/c") is None
    # Only the last step removes anything.
    assert storage.failures()[kind] - before == (1 if kind == "kept" else 6)


def got(location: Location, key: str, largest_bytes: int = 0) -> bytes | None:
    """A key as zarr reads it."""
    found = sync(location.zarr_store(largest_bytes).get(key, default_buffer_prototype()))
    return None if found is None else found.to_bytes()


def test_a_part_of_a_large_key_that_breaks_off_is_read_again(
    storage: FailingStorage, location: Location, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("s3fs.S3FileSystem.default_block_size", len(DOCUMENT) // 4)
    location.write({"a": DOCUMENT})
    storage.rule = Rule(1.0, ("truncated",), most=1)
    before = storage.requests()
    assert got(location, "a", largest_bytes=100 << 20) == DOCUMENT
    made = storage.requests()[len(before) :]
    assert sum(request.failure == "truncated" for request in made) == 1
    # Each time a look at its size, and four parts.
    assert 6 <= len(made) <= 10


@pytest.mark.all
def test_what_is_cut_short_each_time_is_no_answer(storage: FailingStorage, location: Location) -> None:
    location.write({"a": DOCUMENT})
    storage.rule = Rule(1.0, ("truncated",))
    with pytest.raises(StoreError, match=r"the store cannot be read: .*not completed"):
        location.read("a")
    with pytest.raises(StoreError, match=r"the store cannot be read: .*not completed"), location.access("read"):
        got(location, "a")


def test_keys_that_a_server_does_not_remove_are_told_of(storage: FailingStorage, location: Location) -> None:
    location.write({"a/b": b"1", "a/c": b"2"})
    storage.rule = Rule(1.0, ("kept",))
    with pytest.raises(StoreError, match=r"the store cannot be written: 2 keys are still there, such as \S+/a/b"):
        location.remove("a")
    storage.rule = HEALTHY
    location.remove("a")
    assert location.read("a/b") is None


@pytest.mark.parametrize(
    ("kind", "reason"),
    [("error", "InternalError"), pytest.param("reset before", "Could not connect", marks=pytest.mark.all)],
)
def test_a_store_that_fails_for_good_is_given_up(
    storage: FailingStorage, location: Location, kind: Kind, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The driver's own attempts take some eight seconds.
    monkeypatch.setattr(retry, "LONGEST_SECONDS", 5.0)
    location.write({"a": b"1"})
    storage.rule = Rule(1.0, (kind,))
    started = time.monotonic()
    with pytest.raises(
        StoreError, match=rf"^{location}: the store cannot be written: .*({reason}|no success within 5 s)"
    ):
        location.write({"a": b"2"})
    assert time.monotonic() - started < 10
    storage.rule = HEALTHY
    assert location.read("a") == b"1"


@pytest.mark.all
def test_a_study_on_storage_that_fails_now_and_then(
    storage: FailingStorage, s3_client: Client, location: Location, finished_store: Path
) -> None:
    before = storage.failures()
    # Often enough that each kind comes with certainty.
    storage.rule = Rule(0.2)
    summary = run(Study.from_table(small_table()), location, s3_client)
    storage.rule = HEALTHY
    assert (len(summary.computed), summary.failed) == (5, {})
    assert_same(open_store(location.name), open_store(finished_store))
    failures = storage.failures() - before
    assert all(failures[kind] for kind in KINDS if kind != "kept"), failures


@pytest.mark.all
def test_a_run_whose_store_fails_for_good_ends_and_is_resumed(
    storage: FailingStorage, location: Location, tmp_path: Path
) -> None:
    def go() -> subprocess.CompletedProcess[str]:
        return command("run", "study.toml", "--workers", "1", "--store", str(location), folder=tmp_path, **IMPATIENT)

    (tmp_path / "study.toml").write_text(STUDY)
    # The field of the second mesh, after the record of the first.
    storage.await_turn(Turn("PUT", "/fourier/fourier/c/", 2, GONE))
    started = time.monotonic()
    done = go()
    assert time.monotonic() - started < 60
    assert done.returncode == 2, done.stderr
    last = done.stderr.splitlines()[-1]
    assert re.match(rf"error: {location}: the store cannot be (read|written): ", last), done.stderr
    assert "InternalError" in last
    assert done.stdout == ""
    storage.rule = HEALTHY
    assert [record and record.status for record in Store(location).records()] == ["complete", None, None]
    again = go()
    assert again.returncode == 0, again.stderr
    assert "2 computed, 1 reused, 0 failed" in again.stdout


FULL = """
import resource, sys
from sobolev_batch.batch.store.create import prepare_store
from sobolev_batch.batch.store.store import Store
import numpy as np

store = Store(sys.argv[1])
shape = tuple(map(int, sys.argv[2:]))
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    store.write_field(1, tuple(slice(0, size) for size in shape), np.ones(shape, dtype=complex))
except Exception as error:
    print(f"{type(error).__name__}: {error}")
"""


@pytest.mark.process
def test_a_field_that_finds_no_room_leaves_nothing(store_path: Path) -> None:
    plan = make_plan(Study.from_table(small_table()))
    store = prepare_store(store_path, plan)
    before = sorted(path for path in store_path.rglob("*") if path.is_file())
    arguments = [str(store_path), *map(str, plan.lattice.shape)]
    done = subprocess.run([sys.executable, "-c", FULL, *arguments], capture_output=True, text=True, check=True)
    assert done.stdout == f"StoreError: {store_path}: the store cannot be written: File too large\n"
    assert sorted(path for path in store_path.rglob("*") if path.is_file()) == before
    assert np.isnan(store.read_fields([1], plan.lattice.place(plan.blocks[0]))).all()
    assert store.records() == (None,) * 5
