"""Clusters, stores and files that tests of several folders share, and the markers of what a test takes."""

from __future__ import annotations

import gc
import os
import platform
import shutil
import signal
import subprocess
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack
from functools import wraps
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import dask
import pytest
from distributed import Client
from distributed.utils import get_mp_context

from sobolev_batch import Mesh, Study, read_mesh, run
from sobolev_batch.batch.cluster.clients import local_client, thread_client
from tests.support import durations
from tests.support.made_tree import near, tree  # noqa: F401
from tests.support.mesh_files import Read
from tests.support.repository import ROOT
from tests.support.spheres import make_study
from tests.support.studies import small_table

# A test that asks for one of these fixtures, or calls one of these functions, has the marker.
_SIGNS = {
    "process": {
        *("client", "cluster", "copy", "driving", "finished_store", "s3_client"),
        *("local_client", "started", "tcp_cluster"),
    },
    "all": {"browser", "reader"},
}
_running: list[pytest.Item] = []
_seconds: dict[str, float] = defaultdict(float)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--record-durations", action="store_true", help="write the seconds of each file to durations.tsv")


def pytest_configure() -> None:
    """Let processes that tests start hear Ctrl-C, and refuse to start any in tests without the marker for it."""
    # Imports make much that stays: to look it through again and again takes a fifth of the time of collection.
    gc.disable()
    # The width of tables is not that of the terminal in which tests run.
    os.environ["COLUMNS"] = "100"
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # Dask asks for it once in each process, for which Python starts another.
    platform.processor()
    for owner, name in ((subprocess.Popen, "__init__"), (BaseProcess, "start")):
        setattr(owner, name, _only_if_marked(getattr(owner, name)))


def _only_if_marked(start: Callable[..., None]) -> Callable[..., None]:
    @wraps(start)
    def checked(*arguments: Any, **options: Any) -> None:
        if _running and not any(map(_running[-1].get_closest_marker, ("process", "all"))):
            raise AssertionError(f"{_running[-1].nodeid} starts a process: mark it with pytest.mark.process")
        start(*arguments, **options)

    return checked


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    _running.append(item)
    try:
        return (yield)
    finally:
        _running.pop()


def pytest_collection_finish() -> None:
    """Collect garbage again, but not among what was imported."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests by what they use, and put the longest files first: at the end, one core would wait for them."""
    for item in items:
        if isinstance(item, pytest.Function):
            used = {*item.fixturenames, *(vars(item.module).keys() & set(item.function.__code__.co_names))}
            for marker, signs in _SIGNS.items():
                if used & signs:
                    item.add_marker(marker)
    seconds = durations.recorded_seconds()
    items.sort(key=lambda item: -seconds.get(item.path.relative_to(ROOT).as_posix(), 0.0))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    _seconds[report.location[0]] += report.duration


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if config.getoption("record_durations"):
        durations.record(_seconds)
    terminalreporter.section("slowest files")
    for line in durations.summary(_seconds):
        terminalreporter.line(line)


@pytest.fixture(scope="session")
def client() -> Iterator[Client]:
    """Two worker processes, shared by all tests that only submit to them.

    They are forked from one process that has imported everything, five times as fast, and have its environment.
    """
    with ExitStack() as stack:
        with dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
            get_mp_context().set_forkserver_preload(["sobolev_batch.batch.run"])
            client = stack.enter_context(local_client(2))
        yield client


@pytest.fixture(scope="session")
def threads() -> Iterator[Client]:
    """A worker that is a thread of this process, for what does not depend on processes."""
    with thread_client(1) as client:
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


@pytest.fixture
def copy(finished_store: Path, store_path: Path) -> Path:
    """A copy of that store, which a test may change."""
    return Path(shutil.copytree(finished_store, store_path))


@pytest.fixture(scope="session")
def spheres(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """The store of a study of spheres, and the folder of its files."""
    folder = tmp_path_factory.mktemp("spheres")
    place = "memory://spheres.zarr"
    make_study(folder, place)
    return place, folder


@pytest.fixture
def read(tmp_path: Path) -> Read:
    def write_and_read(ending: str, content: bytes) -> Mesh:
        path = tmp_path / f"mesh{ending}"
        path.write_bytes(content)
        return read_mesh(path)

    return write_and_read
