"""Workers of a host do not share a GPU."""

from __future__ import annotations

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from sobolev_batch import BackendError
from sobolev_batch.batch.cluster.workers import chosen_devices, lock_gpu, release_gpu, visible_devices

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


def test_without_the_library_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
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
    devices = [f"GPU-{os.getpid()}-{number}" for number in range(2)]
    processes: list[subprocess.Popen[str]] = []

    def start() -> str:
        process = subprocess.Popen(
            [sys.executable, "-c", WORKER, *devices],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={key: value for key, value in os.environ.items() if key != "CUDA_VISIBLE_DEVICES"},
        )
        processes.append(process)
        assert process.stdout is not None
        return process.stdout.readline().strip()

    try:
        assert [start() for _ in range(3)] == [f"{devices[0]} {devices[0]}", f"{devices[1]} {devices[1]}", "None None"]
        processes[0].kill()
        processes[0].wait()
        assert start() == f"{devices[0]} {devices[0]}"
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "before")
        own = f"{devices[0]}-own"
        for _ in range(2):
            assert lock_gpu([devices[0], own]) == own
            assert lock_gpu([own]) is None
            release_gpu(own)
    finally:
        for process in processes:
            process.kill()
            process.communicate()
