"""Which GPU of its host a worker process has for itself."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock

from sobolev_batch.errors import BackendError
from sobolev_batch.spectral.backends.cuda import INSTALL

_VISIBLE = "CUDA_VISIBLE_DEVICES"
# What this process has: one device at most, since CUDA settles on what it sees at its start.
_held: set[str] = set()
_claiming = Lock()


@dataclass(frozen=True, eq=False)
class Claim:
    """A device that belongs to this process until it ends or lets go.

    Attributes:
        device: the UUID.
    """

    device: str
    _hold: socket.socket

    def release(self) -> None:
        """Let another process have the device."""
        self._hold.close()
        _held.discard(self.device)


def visible_devices() -> tuple[str, ...]:
    """The UUIDs of the GPUs that this process may use: those of CUDA_VISIBLE_DEVICES, or all of the host.

    CUDA itself is not started: it would settle on its devices for good.

    Raises:
        BackendError: there are none, or nobody can tell.
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
    wanted = os.environ.get(_VISIBLE)
    found = tuple(uuids) if wanted is None else chosen_devices(wanted, uuids)
    if not found:
        hidden = f"CUDA_VISIBLE_DEVICES={wanted} hides all {count}" if count else "the NVIDIA driver sees none"
        raise BackendError(f"no GPU: {hidden}")
    return found


def chosen_devices(wanted: str, uuids: Sequence[str]) -> tuple[str, ...]:
    """What a value of CUDA_VISIBLE_DEVICES stands for: as CUDA does, it ends at the first entry that is no device.

    Args:
        wanted: indices, UUIDs or unique beginnings of them, or names of MIG instances, with commas in between.
        uuids: of the host's devices, in the order of their indices.
    """
    chosen: list[str] = []
    for entry in (part.strip() for part in wanted.split(",")):
        if entry.isdecimal() and int(entry) < len(uuids):
            found = uuids[int(entry)]
        elif entry.startswith("MIG-"):
            found = entry
        else:
            matching = [uuid for uuid in uuids if entry and uuid.startswith(entry)]
            if len(matching) != 1:
                break
            found = matching[0]
        chosen.append(found)
    return tuple(dict.fromkeys(chosen))


def claim_device(devices: Sequence[str]) -> Claim | None:
    """Take the first device that no other process of this host has taken, and make it the only visible one.

    None where all are taken, or this process has one already. A claim is a socket bound to a name that
    Linux keeps in memory: it is exclusive, needs no permissions, leaves no file, and ends with the
    process however that ends.
    """
    if not sys.platform.startswith("linux"):
        return None
    with _claiming:
        for device in () if _held else devices:
            hold = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                hold.bind(f"\0sobolev-batch/{device}")
            except OSError:
                hold.close()
                continue
            _held.add(device)
            os.environ[_VISIBLE] = device
            return Claim(device, hold)
    return None
