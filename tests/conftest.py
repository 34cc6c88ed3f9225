"""Clusters, stores and files that tests of several folders share, and the markers of what a test takes."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import Client

from sobolev_batch import Mesh, Study, read_mesh, run
from sobolev_batch.batch.cluster.clients import local_client
from tests.support.mesh_files import Read
from tests.support.spheres import make_study
from tests.support.studies import small_table

# A test that asks for one of these fixtures, or calls one of these functions, has the marker.
_SIGNS = {
    "cluster": {
        *("client", "cluster", "driving", "finished_store", "mixed", "s3_client", "spheres"),
        *("local_client", "remote_client", "run", "run_icospheres", "started", "tcp_cluster"),
    },
    "s3": {"served", "server", "serving", "storage"},
    "browser": {"browser", "reader"},
}
_CLUSTER_FOLDERS = ("faults", "soak")


def pytest_configure() -> None:
    """Let processes that tests start hear Ctrl-C, also where the shell runs the tests in the background."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests by what they use, and put the longest files first: at the end, one core would wait for them."""
    for item in items:
        if isinstance(item, pytest.Function):
            used = {*item.fixturenames, *(vars(item.module).keys() & set(item.function.__code__.co_names))}
            for marker, signs in _SIGNS.items():
                if used & signs:
                    item.add_marker(marker)
        if any(f"tests/{folder}/" in item.nodeid for folder in _CLUSTER_FOLDERS):
            item.add_marker("cluster")
    slow, clustered = ({item.path for item in items if item.get_closest_marker(name)} for name in ("slow", "cluster"))
    items.sort(key=lambda item: (item.path not in slow, item.path not in clustered))


@pytest.fixture(scope="session")
def client() -> Iterator[Client]:
    """Two worker processes, shared by all tests that only submit to them."""
    with local_client(2) as client:
        yield client


@pytest.fixture
def study() -> Study:
    return Study.from_table(small_table())


@pytest.fixture
def store_path(tmp_path: Path) -> Path:
    return tmp_path / "results.zarr"


@pytest.fixture(scope="session")
def finished_store(client: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The store of the small study after a run; not to be changed."""
    path = tmp_path_factory.mktemp("finished") / "results.zarr"
    run(Study.from_table(small_table()), path, client)
    return path


@pytest.fixture(scope="session")
def spheres(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """The store of a study of spheres, and the folder of its files."""
    folder = tmp_path_factory.mktemp("spheres")
    place = "memory://spheres.zarr"
    make_study(folder, place)
    return place, folder


@pytest.fixture
def read(tmp_path: Path) -> Read:
    """Write a file whose name has this ending, and read it."""

    def write_and_read(ending: str, content: bytes) -> Mesh:
        path = tmp_path / f"mesh{ending}"
        path.write_bytes(content)
        return read_mesh(path)

    return write_and_read
