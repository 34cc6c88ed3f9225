"""Whether the workers of a cluster reach a store: asked before anything is computed, once of each."""

from __future__ import annotations

import logging
import os
import uuid

from distributed import Client

from sobolev_batch.batch.location import Location
from sobolev_batch.errors import StoreError

_log = logging.getLogger(__name__)

# Made when a process imports this; a forked one has its parent's, but another id.
_PROCESS = uuid.uuid4().hex


def require_reach(client: Client, location: Location) -> None:
    """Check that all workers there are reach the location of a store, where that is a URL.

    Drivers and credentials are matters of each process: what this one reaches, a worker may not.

    Raises:
        StoreError: a worker does not; the message names one.
    """
    if not location.scheme:
        return
    for worker, (process, problem) in _answers(client, location).items():
        if location.is_of_this_process and process != _this_process():
            raise StoreError(
                f"{location}: what is written there stays in the memory of one process, and the worker {worker} is "
                "another one; name a folder or an s3:// URL, or leave out the client"
            )
        if problem:
            raise StoreError(f"the worker {worker} cannot use the store: {problem}")


def _answers(client: Client, location: Location) -> dict[str, tuple[str, str]]:
    found = client.run(_look, location, on_error="return")
    lost = {worker: answer for worker, answer in found.items() if isinstance(answer, BaseException)}
    for worker, error in lost.items():
        # One that has just gone says nothing about the store; tasks will tell.
        _log.warning("the worker %s does not say whether it reaches %s: %s", worker, location, error)
    return {worker: answer for worker, answer in found.items() if worker not in lost}


def _look(location: Location) -> tuple[str, str]:
    """This process, and why it does not reach a location."""
    try:
        location.read("zarr.json")
    except StoreError as error:
        return _this_process(), str(error)
    return _this_process(), ""


def _this_process() -> str:
    return f"{_PROCESS}/{os.getpid()}"
