"""Stores in object storage, against a server that speaks S3, and in memory; storage that fails, or is full."""

from __future__ import annotations

import re
import socket
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import fsspec
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from distributed import Client
from zarr.buffer.cpu import Buffer
from zarr.core.buffer import default_buffer_prototype
from zarr.core.sync import sync

import sobolev_batch as sb
from sobolev_batch import Lattice, Study, open_store, run
from sobolev_batch.batch.cluster.clients import local_client, thread_client
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.errors import StoreError
from sobolev_batch.store import create
from sobolev_batch.store import location as locations
from sobolev_batch.store.create import prepare_store
from sobolev_batch.store.field_arrays import Fields
from sobolev_batch.store.layout import Store, table_attributes, write_table
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import LOCK_KEY
from sobolev_batch.store.records import Record, Records
from sobolev_batch.study.plan import make_plan
from tests.support.commands import STUDY, call, command, finished
from tests.support.object_storage import (
    BUCKET,
    GONE,
    HEALTHY,
    KINDS,
    SECRET,
    TOKEN,
    Kind,
    Rule,
    Server,
    serving,
    taken_for_s3,
)
from tests.support.processes import free_port
from tests.support.stores import differences, full_disk, winners
from tests.support.studies import small_table

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    """A server that this process, and all that it starts, takes for S3."""
    with serving() as server, taken_for_s3(server.environment()):
        yield server


@pytest.fixture
def url(request: pytest.FixtureRequest) -> str:
    """A place that no other test uses."""
    return f"s3://{BUCKET}/{re.sub(r'[^a-z0-9]+', '-', request.node.name.lower())}/results.zarr"


@pytest.fixture
def deaf() -> Iterator[str]:
    """An endpoint that takes connections and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield f"http://127.0.0.1:{listening.getsockname()[1]}"


def key_of(url: str) -> str:
    return url.removeprefix(f"s3://{BUCKET}/")


def test_a_second_run_reuses_and_writes_no_field(server: Server, threads: Client, url: str) -> None:
    study = Study.from_table(small_table())
    first = run(study, url, threads)
    before = len(server.requests())
    steps: list[Progress] = []
    second = run(study, url, threads, on_progress=steps.append)
    assert (second.computed, second.reused) == ((), first.computed)
    assert steps == []
    requests = server.requests()[before:]
    root = url.replace("s3:/", "")
    written = Counter(request.path for request in requests if request.method not in ("GET", "HEAD"))
    assert written.keys() == {f"{root}/zarr.json", f"{root}/records/zarr.json", f"{root}/claim.json"}
    read = Counter(request.path for request in requests if request.method == "GET")
    assert not [path for path in read if "/fourier/fourier/c/" in path]
    # Each write is preceded by a look at the lock, and so are its creation and its end; the worker looks once.
    assert read[f"{root}/claim.json"] <= written.total() + 1


def test_a_second_run_of_many_meshes_takes_few_requests(server: Server, threads: Client, url: str) -> None:
    family = [{"name": f"f{i}", "source": "sphere", "radius": 0.5 + 0.01 * i} for i in range(40)]
    study = Study.from_table(small_table(family=family))
    run(study, url, threads)
    before = len(server.requests())
    assert len(run(study, url, threads).reused) == 41
    assert len(server.requests()) - before <= 45


@pytest.mark.parametrize("key", ["convergence/relative/c/0/0", "meshes/zarr.json", "tags.json"])
def test_what_changed_in_object_storage_is_read_again_and_mended(
    server: Server, threads: Client, url: str, key: str
) -> None:
    study, place = Study.from_table(small_table()), {"Bucket": BUCKET, "Key": f"{key_of(url)}/{key}"}
    run(study, url, threads)
    before, client = sb.table(url), server.client()
    content = client.get_object(**place)["Body"].read()
    # The length stays.
    client.put_object(**place, Body=content[:40] + bytes([content[40] ^ 1]) + content[41:])
    assert sb.verify(url).is_sound is (key == "tags.json")
    assert run(study, url, threads).computed == ()
    pd.testing.assert_frame_equal(sb.table(url), before)
    assert client.get_object(**place)["Body"].read() == content or key == "tags.json"
    assert sb.verify(url).is_sound
    requests = len(server.requests())
    run(study, url, threads)
    assert len(server.requests()) - requests <= 45


def test_what_changes_in_object_storage_during_a_run_is_mended_by_the_next_one(
    server: Server, threads: Client, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(Study.from_table(small_table()), url, threads)
    place, client = {"Bucket": BUCKET, "Key": f"{key_of(url)}/fourier/xi_x/c/0"}, server.client()
    content = client.get_object(**place)["Body"].read()
    remember = Store.remember

    def remember_too_late(store: Store) -> None:
        client.put_object(**place, Body=bytes([content[0] ^ 1]) + content[1:])
        remember(store)

    more = Study.from_table(small_table(family=[{"name": "more", "source": "sphere", "radius": 0.5}]))
    monkeypatch.setattr(Store, "remember", remember_too_late)
    run(more, url, threads)
    monkeypatch.undo()
    run(more, url, threads)
    assert client.get_object(**place)["Body"].read() == content


def test_verify_reads_what_object_storage_lists_unchanged(
    server: Server, threads: Client, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(Study.from_table(small_table()), url, threads)
    place, client = {"Bucket": BUCKET, "Key": f"{key_of(url)}/norms/norm/c/0/0"}, server.client()
    content = client.get_object(**place)["Body"].read()
    tags = Location.tags
    listed = {"norms": tags(Location.parse(url), "norms")}
    client.put_object(**place, Body=bytes([content[0] ^ 1]) + content[1:])
    # As where bytes decay below the storage.
    monkeypatch.setattr(Location, "tags", lambda self, prefix: listed.get(prefix) or tags(self, prefix))
    found = sb.verify(url)
    assert [*found.tables] == ["norms/norm"]
    assert run(Study.from_table(small_table()), url, threads).computed == ()
    assert sb.verify(url).is_sound


def test_requests_grow_by_eight_for_a_mesh(server: Server, threads: Client, url: str) -> None:
    counts = []
    for meshes in (4, 14):
        family = [{"name": f"f{i}", "source": "sphere", "radius": 0.5 + 0.01 * i} for i in range(meshes)]
        study = Study.from_table(small_table(family=family))
        before = len(server.requests())
        run(study, url.replace("results", str(meshes)), threads)
        counts.append(len(server.requests()) - before)
    # The field and its record written, each after a look at the lock; looks for an older record by driver and task;
    # the field read for norms and for pairs.
    assert counts[1] - counts[0] <= 8 * 10 + 4
    # Coordinates of tables are 56 of them, spectra and all pairs 59.
    assert counts[0] < 382


def test_requests_for_records_grow_with_their_pages(server: Server, url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(create, "ROWS_PER_PAGE", 10)
    family = [{"name": f"f{i}", "source": "sphere", "radius": 0.5 + 0.01 * i} for i in range(40)]
    store = prepare_store(url, make_plan(Study.from_table(small_table(family=family))))
    for row in range(41):
        Records(store).write(row, Record(str(row), "complete"))
    records = Records(store).read()

    def requests_of(call: Callable[[], object]) -> int:
        before = len(server.requests())
        call()
        return len(server.requests()) - before

    # The chunks are listed; each page is written, the last one too, and the chunks of its rows are removed at once.
    assert requests_of(lambda: Records(store).collect(records)) == 1 + 2 * 5
    assert not [key for key in server.keys(key_of(url)) if "/record/c/" in key]
    # The folder of chunks is empty, which the driver makes sure of by two more requests.
    assert requests_of(Records(store).read) == 3 + 5
    assert Records(store).read() == records
    assert requests_of(lambda: Records(store).read_one(7)) == 2
    assert requests_of(lambda: Records(store).collect(records)) == 3


def test_another_lattice_leaves_nothing_of_the_first(server: Server, url: str) -> None:
    plan = make_plan(Study.from_table(small_table(accuracy={"rtol": 0.3}, lattice=None, norm={"orders": [-8.0]})))
    store = prepare_store(url, plan)
    prefix = key_of(url)
    empty = server.keys(prefix)
    Fields(store).write(1, plan.blocks[0].place_in(plan.lattice.half), np.zeros(plan.lattice.shape))
    Records(store).write(1, Record("key", "complete"))
    write_table(store, "norms", xr.Dataset({"norm": ("mesh", np.ones(5))}))
    store.consolidate()
    assert len(server.keys(prefix)) == len(empty) + 5
    finer = plan.with_choice(replace(plan.choice, lattice=Lattice(plan.lattice.xi_max, 2 * plan.lattice.M)))
    again = prepare_store(url, finer)
    assert server.keys(prefix) == empty
    assert Records(again).read() == (None,) * 5
    assert table_attributes(again, "norms") is None
    assert np.isnan(Fields(again).read([1], finer.blocks[0].place_in(finer.lattice.half))).all()
    assert Store.open(url).labels() == store.labels()


@pytest.mark.all
def test_credentials_stay_in_the_environment(server: Server, tmp_path: Path, url: str) -> None:
    (tmp_path / "study.toml").write_text(STUDY)
    planned = call("plan", "study.toml", "--store", url, folder=tmp_path).stdout
    assert f"{url}, 0 of 3 already stored" in " ".join(planned.split())
    done = command("--debug", "run", "study.toml", "--store", url, folder=tmp_path, AWS_SESSION_TOKEN=TOKEN)
    assert done.returncode == 0, done.stderr
    assert f"3 computed, 0 reused, 0 failed; store: {url}\n" in done.stdout
    assert "debug " in done.stderr
    keys = server.keys(key_of(url))
    stored = b"".join(server.client().get_object(Bucket=BUCKET, Key=key)["Body"].read() for key in keys)
    for hidden in (SECRET, TOKEN, "Signature=", "tester", server.url):
        assert hidden not in done.stdout
        assert hidden == server.url or hidden not in done.stderr
        assert hidden.encode() not in stored
    status = call("status", url, folder=tmp_path).stdout.splitlines()
    assert status[0] == f"{url}: 3 of 3 complete, 0 failed, 0 to go"
    assert call("table", url, "--format", "csv", folder=tmp_path).stdout.count("\n") == 5
    drawn = call("plot", url, folder=tmp_path).stdout.split()
    assert {path.name for path in tmp_path.iterdir()} == {"study.toml", *drawn}


@pytest.mark.all
@pytest.mark.usefixtures("server")
def test_of_many_drivers_at_once_one_has_the_store(location: Location) -> None:
    for _ in range(5):
        assert winners(location, 6) == 1
        location.discard(LOCK_KEY)


def assert_refused(arguments: Sequence[str], environment: dict[str, str], message: str, folder: Path) -> None:
    """A command ends with one line, which gives the reason and no secret."""
    with taken_for_s3(environment):
        done = call(*arguments, folder=folder)
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
    assert done.stderr.startswith("error: ")
    assert message in done.stderr, done.stderr
    assert done.stderr.count("\n") == 1
    for secret in {SECRET, environment.get("AWS_SECRET_ACCESS_KEY", SECRET)} - {""}:
        assert secret not in done.stderr


@pytest.mark.all
def test_no_store_there_is_not_the_same_as_no_way_there(server: Server, tmp_path: Path, deaf: str) -> None:
    (tmp_path / "study.toml").write_text(STUDY)
    there, nowhere = f"s3://{BUCKET}/nothing.zarr", "s3://no-such-bucket/results.zarr"
    taken = f"s3://{BUCKET}/taken.zarr"
    server.client().put_object(Bucket=BUCKET, Key="taken.zarr/precious.txt", Body=b"text")
    port = free_port()
    unknown = {"AWS_ACCESS_KEY_ID": "", "AWS_SECRET_ACCESS_KEY": ""}
    cases: list[tuple[tuple[str, ...], dict[str, str], str]] = [
        (("status", there), {}, "it holds no store of a study"),
        (("run", "study.toml", "--store", taken), {}, "not empty and holds no store"),
        (("run", "study.toml", "--store", nowhere), {}, "cannot be read: there is no bucket 'no-such-bucket'"),
        (("status", there), {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}, "cannot be read: Could not connect"),
        (("status", there), {"AWS_ENDPOINT_URL": f"http://u:{SECRET}@127.0.0.1:{port}"}, "cannot be read: "),
        (("run", "study.toml", "--store", there), {"AWS_ENDPOINT_URL": deaf}, "nothing answers there within 30 s"),
        (("table", there), unknown, "no credentials (Unable to locate credentials); set those of s3://"),
    ]
    for arguments, environment, message in cases:
        assert_refused(arguments, environment, message, tmp_path)
    assert server.keys("nothing.zarr") == []
    assert server.keys("taken.zarr") == ["taken.zarr/precious.txt"]


@pytest.mark.process
def test_a_missing_driver_is_named(tmp_path: Path) -> None:
    script = "import sys; sys.modules['s3fs'] = None; sys.argv[1:] = ['status', 's3://b/x.zarr']\n"
    script += "from sobolev_batch.cli import main; main()"
    done = finished(sys.executable, "-c", script)
    assert done.returncode == 2
    assert "pip install 'sobolev-batch[s3]'" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.all
def test_permissions_are_checked_before_anything_is_computed(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(STUDY)
    read = '{"Effect": "Allow", "Action": ["s3:Get*", "s3:List*", "s3:Head*"], "Resource": "*"}'
    with serving() as server:
        iam = server.client("iam")
        iam.create_user(UserName="reader")
        iam.put_user_policy(
            UserName="reader", PolicyName="p", PolicyDocument=f'{{"Version": "2012-10-17", "Statement": [{read}]}}'
        )
        made = iam.create_access_key(UserName="reader")["AccessKey"]
        reader = server.environment(made["AccessKeyId"], made["SecretAccessKey"])
        # Another may write, and has done so.
        there, study = f"s3://{BUCKET}/a.zarr", "study.toml"
        done = command("run", study, "--store", there, folder=tmp_path, **server.environment())
        assert done.returncode == 0
        before = server.keys("")
        server.enforce(True)
        with taken_for_s3(reader):
            assert call("status", there, folder=tmp_path).returncode == 0
        for place in (f"s3://{BUCKET}/b.zarr", there):
            assert_refused(("run", study, "--store", place), reader, "cannot be written: access is denied", tmp_path)
        for stranger in (server.environment("AKIANOBODY"), {**reader, "AWS_SECRET_ACCESS_KEY": SECRET}):
            assert_refused(("status", there), stranger, "cannot be read: access is denied", tmp_path)
        server.enforce(False)
        assert server.keys("") == before


@pytest.mark.all
def test_workers_that_do_not_reach_the_store_are_found_at_once(server: Server, url: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{free_port()}")
        with local_client(1) as client:
            patch.undo()
            with pytest.raises(StoreError, match=r"worker tls://\S+ cannot use the store: s3://.*Could not connect"):
                run(Study.from_table(small_table()), url, client)
    assert server.keys(key_of(url)) == []


def test_a_store_in_memory_is_computed_by_threads(study: Study, finished_store: Path) -> None:
    place = "memory://a/results.zarr"
    steps: list[Progress] = []
    summary = run(study, place, workers=2, on_progress=steps.append)
    assert (summary.store, len(summary.computed), summary.failed) == (place, 5, {})
    assert steps[0].label.startswith("http://127.0.0.1:")
    assert len(run(study, place).reused) == 5
    assert list(differences(open_store(place), open_store(finished_store))) == []
    assert list(differences(xr.open_datatree(place, engine="zarr"), open_store(finished_store))) == []
    with thread_client(2) as client:
        assert len(run(study, "memory://b/results.zarr", client).computed) == 5
    with pytest.raises(StoreError, match="it holds no store of a study"):
        open_store("memory://c/results.zarr")


def test_a_store_in_memory_is_refused_where_workers_are_other_processes(client: Client, study: Study) -> None:
    steps: list[Progress] = []
    with pytest.raises(StoreError, match=r"in the memory of one process, and the worker tls://\S+ is another one"):
        run(study, "memory://d/results.zarr", client, on_progress=steps.append)
    assert steps == []
    assert not fsspec.filesystem("memory").exists("/d")


def test_what_other_processes_write_and_delete_is_seen(server: Server, url: str) -> None:
    location, key = Location.parse(url), key_of(url) + "/a/b"
    assert location.names() == set()
    server.client().put_object(Bucket=BUCKET, Key=key, Body=b"1")
    assert location.names() == {"a"}
    assert location.read("a/b") == b"1"
    server.client().put_object(Bucket=BUCKET, Key=key, Body=b"2")
    assert location.read("a/b") == b"2"
    server.client().delete_object(Bucket=BUCKET, Key=key)
    assert location.names() == set()


DOCUMENT = bytes(range(256)) * 400


@pytest.fixture
def storage(server: Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """The server, healthy again after each test, and a driver that gives up sooner than it would."""
    monkeypatch.setattr("s3fs.S3FileSystem.retries", 2)
    yield server
    server.obey(HEALTHY)


@pytest.fixture
def location(url: str) -> Location:
    return Location.parse(url)


@pytest.mark.parametrize("kind", KINDS)
def test_what_fails_once_is_done_again(storage: Server, location: Location, kind: Kind) -> None:
    keys = location.zarr_store()
    location.write({"a/b": b"1", "a/c": b"2", "d": DOCUMENT, "e": b"old"})
    before = storage.failures()[kind]
    steps: list[tuple[Callable[[], object], object]] = [
        (lambda: location.read("d"), DOCUMENT),
        (lambda: location.write({"e": b"new"}), None),
        (location.names, {"a", "d", "e"}),
        (lambda: got(location, "d"), DOCUMENT),
        (lambda: sync(keys.set("f", Buffer.from_bytes(DOCUMENT))), None),
        (lambda: location.remove("a"), None),
    ]
    for step, expected in steps:
        storage.obey(Rule(1.0, (kind,), most=1))
        assert step() == expected
    assert [location.read(key) for key in ("a/b", "a/c", "e", "f")] == [None, None, b"new", DOCUMENT]
    # Four steps read, and only the last removes anything.
    assert storage.failures()[kind] - before == {"truncated": 4, "kept": 1}.get(kind, 6)


def got(location: Location, key: str) -> bytes | None:
    """A key as zarr reads it."""
    found = sync(location.zarr_store().get(key, default_buffer_prototype()))
    return None if found is None else found.to_bytes()


def test_keys_that_a_server_does_not_remove_are_reported(storage: Server, location: Location) -> None:
    location.write({"a/b": b"1", "a/c": b"2"})
    storage.obey(Rule(1.0, ("kept",)))
    with pytest.raises(StoreError, match=r"the store cannot be written: 2 keys are still there, such as \S+/a/b"):
        location.remove("a")
    storage.obey(HEALTHY)
    location.remove("a")
    assert location.read("a/b") is None


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


def test_storage_that_never_answers_is_given_up(location: Location, deaf: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locations, "_ANSWER_SECONDS", 0.1)
    with taken_for_s3({"AWS_ENDPOINT_URL": deaf, "AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b"}):
        for use in (partial(location.read, "a"), partial(location.write, {"a": b"1"})):
            with pytest.raises(StoreError, match="nothing answers there"):
                use()


@pytest.mark.all
def test_a_study_on_storage_that_fails_now_and_then_equals_that_of_a_folder(
    server: Server, url: str, finished_store: Path
) -> None:
    before = server.failures()
    # Often enough that each kind comes with certainty.
    server.obey(Rule(0.2))
    with local_client(2) as client:
        summary = run(Study.from_table(small_table()), url, client)
    server.obey(HEALTHY)
    assert (len(summary.computed), summary.failed) == (5, {})
    # As whoever has no more than xarray opens it.
    assert list(differences(xr.open_datatree(url, engine="zarr"), open_store(finished_store))) == []
    failures = server.failures() - before
    assert all(failures[kind] for kind in KINDS if kind != "kept"), failures
    # What is written is what a folder holds, key for key, but for the records: here few of them share a page.
    written = {key.split("results.zarr/")[1] for key in server.keys(key_of(url))}
    in_folder = {str(path.relative_to(finished_store)) for path in finished_store.rglob("*") if path.is_file()}
    assert written - in_folder == {"tags.json", "records/page/c/0"}
    assert {key.rpartition("/")[0] for key in in_folder - written} == {"records/record/c"}


@pytest.mark.all
@pytest.mark.parametrize(
    ("rule", "verb"),
    # Records of failed meshes could still be written in the second case.
    [(GONE, "(read|written)"), (Rule(1.0, ("error",), "PUT", part="/fourier/fourier/c/"), "written")],
    ids=["gone", "no room for fields"],
)
def test_a_run_whose_store_fails_for_good_ends_and_is_resumed(
    server: Server, location: Location, tmp_path: Path, rule: Rule, verb: str
) -> None:
    arguments = ("run", "study.toml", "--workers", "1", "--store", location)
    (tmp_path / "study.toml").write_text(STUDY)
    # The field of the second mesh, after the record of the first.
    server.await_turn("PUT", "/fourier/fourier/c/", 2, rule)
    done = command(*arguments, folder=tmp_path, AWS_MAX_ATTEMPTS="2")
    server.obey(HEALTHY)
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
    last = done.stderr.splitlines()[-1]
    assert re.match(rf"error: {location}: the store cannot be {verb}: .*InternalError", last), done.stderr
    assert [record and record.status for record in Records(Store(location)).read()] == ["complete", None, None]
    again = command(*arguments, folder=tmp_path, AWS_MAX_ATTEMPTS="2")
    assert again.returncode == 0, again.stderr
    assert "2 computed, 1 reused, 0 failed" in again.stdout


def test_a_disk_without_room_for_more_fields(study: Study, store_path: Path, threads: Client) -> None:
    with full_disk() as fill:

        def fill_up(progress: Progress) -> None:
            if progress.stage == "fields" and progress.done == 2:
                fill(20_000)

        with pytest.raises(StoreError, match=rf"{store_path}: the store cannot be written: File too large"):
            run(study, store_path, threads, on_progress=fill_up)
    records = Records(Store(store_path)).read()
    assert all(record is None or record.status == "complete" for record in records)
    stored = sum(record is not None for record in records)
    assert 2 <= stored < 5
    assert not list(store_path.rglob("*.partial"))
    again = run(study, store_path, threads)
    assert (len(again.reused), len(again.computed), again.failed) == (stored, 5 - stored, {})
