"""Release of a store from the lock of a run that is gone."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import Lock, age_seconds, break_lock
from sobolev_batch.batch.store.heartbeat import LOST_AFTER_SECONDS
from sobolev_batch.batch.store.store import Store
from sobolev_batch.errors import LockError, StoreError


def release(store: str | Path | Location, *, force: bool = False) -> Lock | None:
    """Remove the lock of a run that cannot do so itself, because it or its machine was killed.

    A run that is still going on notices within seconds, and ends.

    Args:
        store: Path or URL of the store.
        force: Whether to remove the lock of a run that was alive a moment ago, too.

    Returns:
        The lock, or None if the store had none. Its `driver` names the process that held it since the UTC time `since`.

    Raises:
        LockError: The run was alive a moment ago.
        StoreError: The store cannot be read or written.

    >>> import sobolev_batch as sb
    >>> sb.release("memory://new.zarr") is None
    True
    """
    location = Location.parse(store)
    lock = Lock.read(location)
    if lock is None:
        return None
    if not force and lock.holder_is_alive:
        raise LockError(f"{location}: {lock.driver} is alive; stop it, or release the store all the same by --force")
    silence = math.inf if force or lock.holder_is_gone else _silence_seconds(location, lock)
    if silence < LOST_AFTER_SECONDS:
        raise LockError(
            f"{location}: {lock.driver} was alive {max(silence, 0):.0f} s ago; stop it, or wait until it has been "
            f"silent for {LOST_AFTER_SECONDS:.0f} s; --force releases the store all the same"
        )
    break_lock(location)
    return lock


def _silence_seconds(location: Location, lock: Lock) -> float:
    """Return the time since the latest heartbeat of a lock's holder."""
    moments = [lock.since]
    # If the store cannot be read, only the lock itself is known.
    with suppress(StoreError):
        store = Store(location)
        run = store.read_run() if store.exists() else None
        if run is not None and run.driver.startswith(lock.driver):
            moments.append(run.seen)
    ages = []
    for moment in moments:
        with suppress(ValueError):  # not a time that this program writes
            ages.append(age_seconds(moment))
    return min(ages, default=math.inf)
