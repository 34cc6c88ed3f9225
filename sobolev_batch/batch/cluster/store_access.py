"""Whether the workers of a cluster see a store: asked before anything is computed, once of each."""

from __future__ import annotations

import logging
import os
import uuid

from distributed import Client

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import Lock
from sobolev_batch.errors import StoreError

_log = logging.getLogger(__name__)

# Made when a process imports this; a forked one has its parent's, but another id.
_PROCESS = uuid.uuid4().hex


def require_reach(client: Client, location: Location, lock: Lock) -> None:
    """Check that all workers there are see the store that this process has claimed.

    Drivers and credentials are matters of each process: what this one reaches, a worker may not. And a
    folder of the same name may be another one on another machine.

    Raises:
        StoreError: a worker does not; the message names one.
    """
    for worker, (process, problem) in _answers(client, location, lock).items():
        if location.is_in_memory and process != _this_process():
            raise StoreError(
                f"{location}: what is written there stays in the memory of one process, and the worker {worker} is "
                "another one; name a folder or an s3:// URL, or leave out the client"
            )
        if problem:
            raise StoreError(f"the worker {worker} cannot use the store: {problem}")


def _answers(client: Client, location: Location, lock: Lock) -> dict[str, tuple[str, str]]:
    found = client.run(_look, location, lock, on_error="return")
    lost = {worker: answer for worker, answer in found.items() if isinstance(answer, BaseException)}
    for worker, error in lost.items():
        # One that has just gone says nothing about the store; tasks will tell.
        _log.warning("the worker %s does not say whether it reaches %s: %s", worker, location, error)
    return {worker: answer for worker, answer in found.items() if worker not in lost}


def _look(location: Location, lock: Lock) -> tuple[str, str]:
    """This process, and why it does not see the store."""
    try:
        seen = lock.is_held(location)
    except StoreError as error:
        return _this_process(), str(error)
    elsewhere = f"{location} is another place there; name one that all machines share"
    return _this_process(), "" if seen else elsewhere


def _this_process() -> str:
    return f"{_PROCESS}/{os.getpid()}"
