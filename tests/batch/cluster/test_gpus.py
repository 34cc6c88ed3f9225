"""Workers of a host do not share a GPU, and clusters have workers with and without one."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from subprocess import PIPE
from types import SimpleNamespace

import numpy as np
import pytest

from sobolev_batch import Study, open_store, run
from sobolev_batch.batch.cluster.clients import remote_client
from sobolev_batch.batch.cluster.workers import (
    GPU,
    chosen_devices,
    lock_gpu,
    prepare_workers,
    release_gpu,
    visible_devices,
)
from sobolev_batch.errors import BackendError
from tests.support.processes import tcp_cluster
from tests.support.repository import ROOT
from tests.support.studies import small_table, variable

HOST = ("GPU-aaaa-1", "GPU-aabb-2", "GPU-cccc-3")


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ("0", HOST[:1]),
        ("2,0", (HOST[2], HOST[0])),
        ("1,1", HOST[1:2]),
        ("GPU-cccc-3", HOST[2:]),
        ("GPU-cccc-3, 0", (HOST[2], HOST[0])),
        ("MIG-7d-5", ("MIG-7d-5",)),
        ("1,7,0", HOST[1:2]),  # ends at what is no device
        ("1,-1,0", HOST[1:2]),
        ("-1", ()),
        ("", ()),
        ("NoDevFiles", ()),
    ],
)
def test_visible_devices_are_read_as_cuda_does(wanted: str, expected: tuple[str, ...]) -> None:
    assert chosen_devices(wanted, HOST) == expected


class _LibraryNotFoundError(Exception):
    pass


@pytest.mark.parametrize(
    ("uuids", "visible", "expected"),
    [
        (None, None, "no GPU: the NVIDIA driver is not installed on this machine"),
        ([], None, "no GPU: the NVIDIA driver sees none"),
        (HOST, "", "no GPU: CUDA_VISIBLE_DEVICES= hides all 3"),
        (HOST, "7", "no GPU: CUDA_VISIBLE_DEVICES=7 hides all 3"),
        (HOST, None, HOST),
        (HOST, "1", HOST[1:2]),
    ],
)
def test_what_the_driver_lists(
    monkeypatch: pytest.MonkeyPatch, uuids: tuple[str, ...] | None, visible: str | None, expected: object
) -> None:
    def start() -> None:
        if uuids is None:
            raise _LibraryNotFoundError

    library = SimpleNamespace(
        NVMLError=Exception,
        NVMLError_LibraryNotFound=_LibraryNotFoundError,
        nvmlInit=start,
        nvmlDeviceGetCount=lambda: len(uuids or ()),
        nvmlDeviceGetHandleByIndex=lambda index: index,
        nvmlDeviceGetUUID=lambda index: (uuids or ())[index],
    )
    monkeypatch.setitem(sys.modules, "pynvml", library)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    if isinstance(expected, str):
        with pytest.raises(BackendError) as caught:
            visible_devices()
        assert str(caught.value) == expected
    else:
        assert visible_devices() == expected
    monkeypatch.setitem(sys.modules, "pynvml", None)
    with pytest.raises(BackendError, match=r"nvidia-ml-py.* is not installed: pip install 'sobolev-batch\[gpu\]'"):
        visible_devices()


WORKER = """
import os, sys
from sobolev_batch.batch.cluster.workers import lock_gpu
print(lock_gpu(sys.argv[1:]), os.environ.get("CUDA_VISIBLE_DEVICES"), flush=True)
sys.stdin.read()
"""


@pytest.mark.process
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="devices are locked on Linux only")
def test_each_process_gets_a_device_of_its_own_and_a_dead_one_leaves_its_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    first, second = devices = [f"GPU-{os.getpid()}-{number}" for number in range(2)]
    words = [sys.executable, "-c", WORKER, *devices]
    processes: list[subprocess.Popen[str]] = []

    def start() -> str:
        processes.append(stack.enter_context(subprocess.Popen(words, stdin=PIPE, stdout=PIPE, text=True)))
        assert processes[-1].stdout is not None
        return processes[-1].stdout.readline().strip()

    # They end with their input.
    with ExitStack() as stack:
        assert [start() for _ in range(3)] == [f"{first} {first}", f"{second} {second}", "None None"]
        processes[0].kill()
        processes[0].wait()
        assert start() == f"{first} {first}"
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "before")
        own = f"{first}-own"
        for _ in range(2):
            assert lock_gpu([first, own]) == own
            assert lock_gpu([own]) is None
            release_gpu(own)


PRETEND = ["--preload", str(ROOT / "tests" / "support" / "pretend_gpu.py")]


@pytest.mark.all
def test_one_device_serves_one_worker_and_studies_use_what_there_is(
    finished_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The name of a device that no other test has.
    monkeypatch.setenv("PRETEND_GPU", f"GPU-pretend-{os.getpid()}-{os.urandom(4).hex()}")
    # Two find the host's one GPU, one finds none.
    with tcp_cluster(PRETEND, PRETEND, []) as (address, _), remote_client(address) as client:
        workers = prepare_workers(client)
        without, other, equipped = sorted(workers.members, key=lambda member: (member.backend, member.note))
        assert [member.backend for member in (without, other, equipped)] == ["cpu", "cpu", "gpu"]
        assert without.note.startswith("no GPU left: other workers have all of the 1 that it may use")
        assert equipped.note.startswith("fake, ")
        declared = client.scheduler_info(n_workers=-1)["workers"]
        assert [address for address in declared if declared[address]["resources"].get(GPU)] == [equipped.address]
        family = [{"name": "ico", "source": "icosphere", "levels": [0, 1, 2, 3, 4]}]
        for backend in ("gpu", "auto", "cpu"):
            study = Study.from_table(small_table(transform={"backend": backend}, family=family))
            assert not run(study, tmp_path / f"{backend}.zarr", client).failed
    expected = variable(open_store(finished_store), "fourier", "fourier")
    # Each worker with what it has, and the store tells by whom.
    for backend, libraries in (("gpu", {"cufinufft"}), ("auto", {"cufinufft", "finufft"}), ("cpu", {"finufft"})):
        tree = open_store(tmp_path / f"{backend}.zarr")
        meshes = tree["meshes"].to_dataset().drop_sel(mesh="reference")
        for library, worker in zip(meshes["backend"].values, meshes["worker"].values, strict=True):
            assert library in libraries
            assert backend == "cpu" or (library == "cufinufft") == (worker == equipped.address)
        found = variable(tree, "fourier", "fourier").sel(mesh=expected["mesh"])
        assert np.abs(found.values - expected.values).max() < 5e-9 * 4 * np.pi
