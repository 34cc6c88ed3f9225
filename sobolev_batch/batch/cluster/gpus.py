"""The GPU of its host that a worker process has for itself."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Sequence
from threading import Lock

from sobolev_batch.errors import BackendError
from sobolev_batch.spectral.backends import INSTALL

_VISIBLE = "CUDA_VISIBLE_DEVICES"
# The device of this process and its lock. It has one at most, since CUDA settles on the devices that it sees at its
# start.
_own: dict[str, socket.socket] = {}
_locking = Lock()


def lock_gpu(devices: Sequence[str]) -> str | None:
    """Lock the first device that no other process of this host has, and make it the only visible one.

    The device belongs to this process until it ends or releases it. The lock is a socket bound to a name that Linux
    keeps in memory: it is exclusive, needs no permissions, leaves no file, and ends with the process however that ends.
    Containers share it if they share the network of the host. A file would not serve others better, since they have
    temporary folders of their own.

    Args:
        devices: UUIDs of the devices.

    Returns:
        UUID of the device, or None where all are locked or this process has one already.
    """
    if not sys.platform.startswith("linux"):
        return None
    with _locking:
        for device in () if _own else devices:
            name = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                name.bind(f"\0sobolev-batch/{device}")
            except OSError:
                name.close()
                continue
            _own[device] = name
            os.environ[_VISIBLE] = device
            return device
    return None


def release_gpu(device: str) -> None:
    """Let another process have a device that this process has locked."""
    _own.pop(device).close()


def visible_devices() -> tuple[str, ...]:
    """Return the UUIDs of the GPUs that this process may use: those of CUDA_VISIBLE_DEVICES, or all of the host.

    CUDA itself is not started: it would settle on its devices for good.

    Raises:
        BackendError: The host has none, or they cannot be listed.
    """
    try:
        import pynvml
    except ImportError as error:
        raise BackendError(f"no GPU: nvidia-ml-py, which lists them, is not installed: {INSTALL}") from error
    try:
        pynvml.nvmlInit()
        count = pynvml.nvmlDeviceGetCount()
        uuids = [str(pynvml.nvmlDeviceGetUUID(pynvml.nvmlDeviceGetHandleByIndex(i))) for i in range(count)]
    except pynvml.NVMLError_LibraryNotFound as error:
        raise BackendError("no GPU: the NVIDIA driver is not installed on this machine") from error
    except pynvml.NVMLError as error:
        raise BackendError(f"no GPU: the NVIDIA driver says: {error}") from error
    visible = os.environ.get(_VISIBLE)
    devices = tuple(uuids) if visible is None else chosen_devices(visible, uuids)
    if not devices:
        reason = f"CUDA_VISIBLE_DEVICES={visible} hides all {count}" if count else "the NVIDIA driver sees none"
        raise BackendError(f"no GPU: {reason}")
    return devices


def chosen_devices(visible: str, uuids: Sequence[str]) -> tuple[str, ...]:
    """Return the devices that a value of CUDA_VISIBLE_DEVICES names, up to the first entry that is no device.

    Args:
        visible: Indices, UUIDs or unique beginnings of them, or names of MIG instances, separated by commas.
        uuids: UUIDs of the host's devices, in the order of their indices.
    """
    chosen: list[str] = []
    for entry in map(str.strip, visible.split(",")):
        if entry.isdecimal() and int(entry) < len(uuids):
            chosen.append(uuids[int(entry)])
        elif entry.startswith("MIG-"):
            chosen.append(entry)
        else:
            matching = [uuid for uuid in uuids if entry and uuid.startswith(entry)]
            if len(matching) != 1:
                break
            chosen += matching
    return tuple(dict.fromkeys(chosen))
