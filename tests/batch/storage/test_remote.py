"""Storage that fails for a moment, or for good, or is full: a run ends, blames no mesh, and is resumed."""

from __future__ import annotations

import re
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import Client
from zarr.buffer.cpu import Buffer
from zarr.core.buffer import default_buffer_prototype
from zarr.core.sync import sync

from sobolev_batch import StoreError, Study, open_store, run
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.batch.storage import location as locations
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.store import Store
from tests.support.commands import STUDY, command
from tests.support.object_storage import (
    BUCKET,
    GONE,
    HEALTHY,
    KINDS,
    Kind,
    Rule,
    Server,
    serving,
    taken_for_s3,
)
from tests.support.stores import differences, full_disk
from tests.support.studies import small_table

DOCUMENT = bytes(range(256)) * 400


@pytest.fixture(scope="module")
def served() -> Iterator[Server]:
    """A server that fails on demand, which this process and all that it starts take for S3."""
    with serving() as server, taken_for_s3(server.environment()):
        yield server


@pytest.fixture
def storage(served: Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """The server, healthy again after each test, and a driver that gives up sooner than it would."""
    monkeypatch.setattr("s3fs.S3FileSystem.retries", 2)
    yield served
    served.obey(HEALTHY)


@pytest.fixture
def location(request: pytest.FixtureRequest) -> Location:
    """A place that no other test uses."""
    return Location.parse(f"s3://{BUCKET}/{re.sub(r'[^a-z0-9]+', '-', request.node.name.lower())}/results.zarr")


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_what_fails_once_is_done_again(storage: Server, location: Location, kind: Kind) -> None:
    keys = location.zarr_store()
    location.write({"a/b": b"old", "a/c": b"2", "d": DOCUMENT})
    before = storage.failures()[kind]

    def fail_once() -> None:
        storage.obey(Rule(1.0, (kind,), most=1))

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


def got(location: Location, key: str) -> bytes | None:
    """A key as zarr reads it."""
    found = sync(location.zarr_store().get(key, default_buffer_prototype()))
    return None if found is None else found.to_bytes()


@pytest.mark.slow
def test_keys_that_a_server_does_not_remove_are_reported(storage: Server, location: Location) -> None:
    location.write({"a/b": b"1", "a/c": b"2"})
    storage.obey(Rule(1.0, ("kept",)))
    with pytest.raises(StoreError, match=r"the store cannot be written: 2 keys are still there, such as \S+/a/b"):
        location.remove("a")
    storage.obey(HEALTHY)
    location.remove("a")
    assert location.read("a/b") is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "reason"),
    [("error", "InternalError"), ("reset before", "Could not connect"), ("truncated", "not completed")],
)
def test_an_outage_ends_in_one_line(storage: Server, location: Location, kind: Kind, reason: str) -> None:
    location.write({"a": DOCUMENT})
    storage.obey(Rule(1.0, (kind,)))
    with pytest.raises(StoreError, match=rf"^{location}: the store cannot be read: .*{reason}"):
        location.read("a")
    with pytest.raises(StoreError, match=rf"the store cannot be read: .*{reason}"), location.access("read"):
        got(location, "a")
    if kind != "truncated":
        with pytest.raises(StoreError, match=rf"^{location}: the store cannot be written: .*{reason}"):
            location.write({"a": b"2"})
    storage.obey(HEALTHY)
    assert location.read("a") == DOCUMENT


def test_storage_that_never_answers_is_given_up(location: Location, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locations, "_ANSWER_SECONDS", 0.1)
    credentials = {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b"}
    with (
        socket.create_server(("127.0.0.1", 0)) as deaf,
        taken_for_s3({"AWS_ENDPOINT_URL": f"http://127.0.0.1:{deaf.getsockname()[1]}", **credentials}),
    ):
        with pytest.raises(StoreError, match="nothing answers there"):
            location.read("a")
        with pytest.raises(StoreError, match="nothing answers there"):
            location.write({"a": b"1"})


@pytest.mark.all
def test_a_study_on_storage_that_fails_now_and_then(served: Server, location: Location, finished_store: Path) -> None:
    before = served.failures()
    # Often enough that each kind comes with certainty.
    served.obey(Rule(0.2))
    with local_client(2) as client:
        summary = run(Study.from_table(small_table()), location, client)
    served.obey(HEALTHY)
    assert (len(summary.computed), summary.failed) == (5, {})
    assert list(differences(open_store(location.name), open_store(finished_store))) == []
    failures = served.failures() - before
    assert all(failures[kind] for kind in KINDS if kind != "kept"), failures


@pytest.mark.all
@pytest.mark.parametrize(
    ("rule", "verb"),
    # Records of failed meshes could still be written in the second case.
    [(GONE, "(read|written)"), (Rule(1.0, ("error",), "PUT", part="/fourier/fourier/c/"), "written")],
    ids=["gone", "no room for fields"],
)
def test_a_run_whose_store_fails_for_good_ends_and_is_resumed(
    served: Server, location: Location, tmp_path: Path, rule: Rule, verb: str
) -> None:
    def go() -> subprocess.CompletedProcess[str]:
        return command(
            "run", "study.toml", "--workers", "1", "--store", location, folder=tmp_path, AWS_MAX_ATTEMPTS="2"
        )

    (tmp_path / "study.toml").write_text(STUDY)
    # The field of the second mesh, after the record of the first.
    served.await_turn("PUT", "/fourier/fourier/c/", 2, rule)
    done = go()
    served.obey(HEALTHY)
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
    last = done.stderr.splitlines()[-1]
    assert re.match(rf"error: {location}: the store cannot be {verb}: .*InternalError", last), done.stderr
    assert [record and record.status for record in Store(location).records()] == ["complete", None, None]
    again = go()
    assert again.returncode == 0, again.stderr
    assert "2 computed, 1 reused, 0 failed" in again.stdout


@pytest.mark.slow
def test_a_disk_without_room_for_more_fields(study: Study, store_path: Path, threads: Client) -> None:
    with full_disk(None) as fill:

        def fill_up(progress: Progress) -> None:
            if progress.stage == "fields" and progress.done == 2:
                fill(20_000)

        with pytest.raises(StoreError, match=rf"{store_path}: the store cannot be written: File too large"):
            run(study, store_path, threads, on_progress=fill_up)
    records = Store(store_path).records()
    assert all(record is None or record.status == "complete" for record in records)
    stored = sum(record is not None for record in records)
    assert 2 <= stored < 5
    assert not list(store_path.rglob("*.partial"))
    again = run(study, store_path, threads)
    assert (len(again.reused), len(again.computed), again.failed) == (stored, 5 - stored, {})
