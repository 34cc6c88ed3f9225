"""Stores in object storage, against a server that speaks S3, and in memory."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Barrier

import fsspec
import numpy as np
import pytest
import xarray as xr
from distributed import Client

from sobolev_batch import Lattice, StoreError, Study, open_store, run, verify
from sobolev_batch.batch.cluster.clients import local_client, thread_client
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import LOCK_KEY, Lock, acquire
from sobolev_batch.batch.store.create import prepare_store
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.store.tables import table_attributes, write_table
from sobolev_batch.batch.study.plan import make_plan
from sobolev_batch.errors import LockError
from tests.support.commands import STUDY, call, command
from tests.support.object_storage import BUCKET, SECRET, TOKEN, Server, serving, taken_for_s3
from tests.support.stores import READER, differences
from tests.support.studies import small_table, variable

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


def key_of(url: str) -> str:
    return url.removeprefix(f"s3://{BUCKET}/")


@pytest.fixture(scope="module")
def stored(server: Server, threads: Client) -> str:
    """The small study's store after a run; not to be changed."""
    url = f"s3://{BUCKET}/finished/results.zarr"
    assert len(run(Study.from_table(small_table()), url, threads).computed) == 5
    return url


@pytest.mark.all
def test_a_study_on_two_processes_equals_that_of_a_folder(server: Server, url: str, finished_store: Path) -> None:
    with local_client(2) as client:
        assert len(run(Study.from_table(small_table()), url, client).computed) == 5
    tree = open_store(url)
    assert list(differences(tree, open_store(finished_store))) == []
    assert len(set(variable(tree, "meshes", "worker").values.tolist())) == 2
    # What is written is what a folder holds, key for key.
    keys = server.keys(key_of(url))
    assert {key.split("results.zarr/")[1] for key in keys} == {
        str(path.relative_to(finished_store)) for path in finished_store.rglob("*") if path.is_file()
    }


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
    written = {request.path for request in requests if request.method not in ("GET", "HEAD")}
    assert written == {f"{root}/zarr.json", f"{root}/records/zarr.json", f"{root}/claim.json"}
    # Each write is preceded by a look at the lock. Each key of tables, coordinates and metadata is read once.
    read = Counter(request.path for request in requests if request.method == "GET")
    assert len(requests) - len(read) < 42
    assert not [path for path in read if "/fourier/fourier/c/" in path]


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
    # Coordinates of tables are 48 of them.
    assert counts[0] < 315


def test_another_lattice_leaves_nothing_of_the_first(server: Server, url: str) -> None:
    plan = make_plan(Study.from_table(small_table(accuracy={"rtol": 0.3}, lattice=None, norm={"orders": [-8.0]})))
    store = prepare_store(url, plan)
    prefix = key_of(url)
    empty = server.keys(prefix)
    store.write_field(1, plan.lattice.place(plan.blocks[0]), np.zeros(plan.lattice.shape))
    store.write_record(1, Record("key", "complete"))
    write_table(store, "norms", xr.Dataset({"norm": ("mesh", np.ones(5))}))
    store.consolidate()
    assert len(server.keys(prefix)) == len(empty) + 5
    finer = plan.with_choice(replace(plan.choice, lattice=Lattice(plan.lattice.xi_max, 2 * plan.lattice.M)))
    again = prepare_store(url, finer)
    assert server.keys(prefix) == empty
    assert again.records() == (None,) * 5
    assert table_attributes(again, "norms") is None
    assert np.isnan(again.read_fields([1], finer.lattice.place(finer.blocks[0]))).all()
    assert Store.open(url).labels() == store.labels()


@pytest.mark.all
def test_a_process_with_xarray_alone_reads_everything(stored: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", READER, stored], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 0, done.stderr
    assert 0.003 < float(done.stdout) < 0.006


@pytest.mark.all
def test_the_command_line_and_credentials_that_stay_in_the_environment(
    server: Server, tmp_path: Path, url: str
) -> None:
    (tmp_path / "study.toml").write_text(STUDY)
    assert f"{url}, 0 of 3 already stored" in call("plan", "study.toml", "--store", url, folder=tmp_path).stdout
    done = command("--debug", "run", "study.toml", "--store", url, folder=tmp_path, AWS_SESSION_TOKEN=TOKEN)
    assert done.returncode == 0, done.stderr
    assert f"3 computed, 0 reused, 0 failed; store: {url}\n" in done.stdout
    assert "DEBUG" in done.stderr
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


@pytest.fixture
def deaf() -> Iterator[str]:
    """An endpoint that takes connections and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield f"http://127.0.0.1:{listening.getsockname()[1]}"


@pytest.mark.all
def test_no_store_there_is_not_the_same_as_no_way_there(server: Server, tmp_path: Path, deaf: str) -> None:
    (tmp_path / "study.toml").write_text(STUDY)
    there, nowhere = f"s3://{BUCKET}/nothing.zarr", "s3://no-such-bucket/results.zarr"
    taken = f"s3://{BUCKET}/taken.zarr"
    server.client().put_object(Bucket=BUCKET, Key="taken.zarr/precious.txt", Body=b"text")
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
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
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
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
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
        with local_client(1) as client:
            patch.undo()
            with pytest.raises(
                StoreError, match=r"the worker tcp://\S+ cannot use the store: s3://.*Could not connect"
            ):
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
    with pytest.raises(
        StoreError, match=r"stays in the memory of one process, and the worker tcp://\S+ is another one"
    ):
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


@pytest.mark.all
def test_of_many_drivers_at_once_one_has_the_store(server: Server, url: str) -> None:
    location = Location.parse(url)
    together = Barrier(6)

    def attempt(number: int) -> bool:
        together.wait()
        try:
            acquire(location, Lock.of_this_process())
        except LockError:
            return False
        return True

    with ThreadPoolExecutor(6) as pool:
        for _ in range(5):
            assert sum(pool.map(attempt, range(6))) == 1
            location.discard(LOCK_KEY)


@pytest.mark.all
def test_a_damaged_field_is_found_and_repaired(server: Server, threads: Client, url: str, stored: str) -> None:
    study, s3 = Study.from_table(small_table()), server.client()
    run(study, url, threads)
    place = {"Bucket": BUCKET, "Key": key_of(url) + "/fourier/fourier/c/2/0/0/0"}
    data = bytearray(s3.get_object(**place)["Body"].read())
    data[1000] ^= 4
    s3.put_object(**place, Body=bytes(data))
    assert list(verify(url).fields) == ["ico/2"]
    assert run(study, url, threads).computed == ("ico/2",)
    assert verify(url).is_sound
    assert list(differences(open_store(url), open_store(stored))) == []
