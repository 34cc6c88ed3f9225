"""Workers, schedulers and clients with other versions than the rest of their cluster; all are real processes."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import Client, Future

from sobolev_batch import ClusterError, Study, run
from sobolev_batch.batch.cluster.versions import require_same_versions
from sobolev_batch.batch.cluster.worker_plugin import prepare_workers
from sobolev_batch.batch.store.store import Store
from tests.support.processes import PATIENCE_SECONDS, SCHEDULER, WORKER, dask, scheduler_address, stop, tcp_cluster
from tests.support.studies import small_table

_POLL_SECONDS = 0.02


def installed(folder: Path, name: str, version: str) -> Path:
    """A folder in which a distribution seems to be installed."""
    information = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    return folder


@pytest.fixture
def other(tmp_path: Path) -> Path:
    """A folder that makes a process believe in another version of this package."""
    return installed(tmp_path / "other", "sobolev-batch", "9.9")


@pytest.fixture
def lacking(tmp_path: Path) -> Path:
    """A folder without which a process would find this package."""
    (tmp_path / "lacking" / "sobolev_batch").mkdir(parents=True)
    (tmp_path / "lacking" / "sobolev_batch" / "__init__.py").write_text("raise ImportError('it is not installed')\n")
    return tmp_path / "lacking"


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """The address of a scheduler with one worker that is right."""
    with tcp_cluster([]) as (address, _):
        yield address


def plugins(client: Client) -> dict[str, bytes]:
    """What the scheduler has workers set up that join later."""
    found: dict[str, bytes] = client.run_on_scheduler(lambda dask_scheduler: dict(dask_scheduler.worker_plugins))
    return {name: plugin for name, plugin in found.items() if name.startswith("sobolev")}


def test_workers_that_differ_are_named_before_anything_is_computed(
    cluster: str, other: Path, lacking: Path, store_path: Path
) -> None:
    wrong = [dask("worker", cluster, *WORKER, "--name", folder.name, found_first=folder) for folder in (other, lacking)]
    try:
        with Client(cluster) as client:
            client.wait_for_workers(3, timeout=PATIENCE_SECONDS)
            addresses = {
                worker["id"]: address for address, worker in client.scheduler_info(n_workers=-1)["workers"].items()
            }
            with pytest.raises(ClusterError) as caught:
                run(Study.from_table(small_table()), store_path, client)
            assert plugins(client) == {}
    finally:
        for process in wrong:
            stop(process)
    message = str(caught.value)
    assert f"sobolev-batch 9.9 at the worker {addresses['other']}, " in message
    assert f"sobolev-batch is missing at the worker {addresses['lacking']}, " in message
    assert "Install the same ones everywhere" in message
    assert message.count("tcp://") == 4  # of the one that lacks it also numerics and schema, none of the right one
    assert Store(store_path).records() == (None,) * 5


def wait_for(file: str) -> str | None:
    while not Path(file).exists():
        time.sleep(_POLL_SECONDS)
    return os.environ.get("PYTHONPATH")


@pytest.mark.all
def test_workers_that_join_later_take_no_task_and_harm_none(
    cluster: str, other: Path, lacking: Path, tmp_path: Path
) -> None:
    with Client(cluster) as client:
        prepare_workers(client)
        right = client.submit(lambda: os.environ.get("PYTHONPATH"), pure=False).result()
        tasks: list[Future] = client.map(wait_for, [str(tmp_path / "go")] * 40, pure=False)
        wrong = [
            dask("worker", cluster, *WORKER, found_first=other),
            dask("worker", cluster, *WORKER, "--nanny", found_first=lacking),
        ]
        try:
            said = [process.communicate(timeout=PATIENCE_SECONDS)[1] for process in wrong]
        finally:
            (tmp_path / "go").touch()
            for process in wrong:
                process.kill()
        assert [process.returncode for process in wrong] == [1, 1]
        assert "this worker may not join: it has sobolev-batch 9.9, and the study" in said[0]
        assert "this worker may not join: it has sobolev-batch missing, and the study" in said[1]
        assert set(client.gather(tasks)) == {right}
        # Those that were meant for them count as no suspects: their workers could be restarted for ever.
        assert client.run_on_scheduler(
            lambda dask_scheduler: {t.suspicious for t in dask_scheduler.tasks.values()}
        ) == {0}
        assert len(prepare_workers(client).members) == 1


CLIENT = """
import sys
from distributed import Client
from sobolev_batch import ClusterError
from sobolev_batch.batch.cluster.worker_plugin import prepare_workers

with Client(sys.argv[1]) as client:
    try:
        prepare_workers(client)
    except ClusterError as error:
        print(error)
"""


def test_a_client_that_differs_is_refused_and_leaves_the_cluster_as_it_is(cluster: str, other: Path) -> None:
    paths = os.pathsep.join([str(other), str(Path(__file__).parents[3])])
    with Client(cluster) as client:
        prepare_workers(client)
        before = plugins(client)
        done = subprocess.run(
            [sys.executable, "-c", CLIENT, cluster],
            env={**os.environ, "PYTHONPATH": paths},
            cwd=other,
            capture_output=True,
            text=True,
            timeout=PATIENCE_SECONDS,
            check=True,
        )
        assert "9.9 here" in done.stdout
        assert plugins(client) == before
        assert list(before) == ["sobolev-batch-versions"]


@pytest.mark.process
@pytest.mark.filterwarnings("ignore::distributed.versions.VersionMismatchWarning")
def test_a_scheduler_with_another_dask(tmp_path: Path) -> None:
    folder = installed(tmp_path / "old", "dask", "1.0")
    scheduler = dask(*SCHEDULER, found_first=folder)
    try:
        address = scheduler_address(scheduler)
        with Client(address) as client, pytest.raises(ClusterError, match=rf"dask 1\.0 at the scheduler {address}, "):
            require_same_versions(client)
    finally:
        stop(scheduler)


def test_another_python_is_found_without_sending_it_code(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = client.get_versions()
    for answer in answers["workers"].values():
        answer["packages"]["python"] = "3.9.1.final.0"
    monkeypatch.setattr(client, "get_versions", lambda: answers)
    monkeypatch.setattr(client, "run", None)
    with pytest.raises(ClusterError, match=r"python 3\.9 at the worker tcp://\S+, tcp://\S+, 3\.\d+ here"):
        require_same_versions(client)


def test_an_extra_that_the_study_needs(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    require_same_versions(client, ["sobolev-batch-remesher"])  # here is none either, as planning will tell
    monkeypatch.syspath_prepend(str(installed(tmp_path, "sobolev-batch-remesher", "2.0")))
    require_same_versions(client)
    with pytest.raises(ClusterError, match=r"sobolev-batch-remesher is missing at the worker .*, 2\.0 here"):
        require_same_versions(client, ["sobolev-batch-remesher"])


@pytest.mark.slow
def test_a_study_knows_what_its_sources_need() -> None:
    sphere = {"source": "icosphere", "levels": [3]}
    remeshed = {"source": "remesh", "mesh": sphere, "triangles": [100]}
    decimated = {"name": "a", "source": "decimate", "mesh": remeshed, "triangles": [50]}
    assert Study.from_table(small_table()).libraries == ()
    assert Study.from_table(small_table(family=[decimated])).libraries == ("pyacvd",)
    assert Study.from_table(small_table(reference=remeshed)).libraries == ("pyacvd",)
