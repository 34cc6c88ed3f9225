"""A check that the workers of a cluster see a store, before anything is computed."""

from __future__ import annotations

import logging
import os
import uuid

from distributed import Client

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import Lock
from sobolev_batch.errors import StoreError

_log = logging.getLogger(__name__)

# One for each process that imports this; a forked process has its parent's, but another number.
_PROCESS = uuid.uuid4().hex


def require_store_access(client: Client, location: Location, lock: Lock) -> None:
    """Check that all workers see the store that this process has locked.

    Drivers and credentials differ between processes: a store that this process reaches, a worker may not. And a
    folder of the same name may be another folder on another machine.

    Raises:
        StoreError: A worker does not see it; the message names the worker.
    """
    for worker, answer in client.run(_look, location, lock, on_error="return").items():
        if isinstance(answer, BaseException):
            # A worker that has just gone says nothing about the store; tasks will tell.
            _log.warning("the worker %s does not say whether it reaches %s: %s", worker, location, answer)
            continue
        process, problem = answer
        if location.is_in_memory and process != _this_process():
            raise StoreError(
                f"{location}: what is written there stays in the memory of one process, and the worker {worker} is "
                "another one; name a folder or an s3:// URL, or leave out the client"
            )
        if problem:
            raise StoreError(f"the worker {worker} cannot use the store: {problem}")


def _look(location: Location, lock: Lock) -> tuple[str, str]:
    """Return the process that runs this, and why it does not see the store."""
    try:
        sees_lock = lock.is_held(location)
    except StoreError as error:
        return _this_process(), str(error)
    elsewhere = f"{location} is another place there; name one that all machines share"
    return _this_process(), "" if sees_lock else elsewhere


def _this_process() -> str:
    return f"{_PROCESS}/{os.getpid()}"
