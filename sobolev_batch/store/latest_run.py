"""The latest run of a store: its record with signs of life, by which a store whose run is gone can be unlocked."""

import json
import math
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, Self

from sobolev_batch.errors import LockError, StoreError
from sobolev_batch.parameters import check_flags
from sobolev_batch.store.checked import CHANGED
from sobolev_batch.store.encoding import ROOT, group_document
from sobolev_batch.store.layout import DIGEST, RECORDS, Store, document_digest
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import LOCK_KEYS, Lock, Time, age_seconds
from sobolev_batch.store.metadata import damaged_record, record_in
from sobolev_batch.store.objects import Objects, root_of

# A run counts as lost if its record was not renewed for this time.
LOST_AFTER_SECONDS = 60.0
# The attribute of the group of records that holds the record.
_RUN = "run"
RunState = Literal["submitted", "running", "done", "failed"]


@dataclass(frozen=True)
class RunRecord:
    """State of the latest run of a study.

    Attributes:
        state: "submitted" until a worker starts it, then "running", "done" or "failed".
        driver: Description of the driver: its process and host, and its cluster.
        seen: Time of the driver's latest heartbeat, in UTC.
        error: Reason of the failure, or obstacle to the run; empty otherwise.
    """

    state: RunState
    driver: str
    started: Time
    seen: Time
    stage: str = ""
    error: str = ""

    @classmethod
    def read(cls, store: Store) -> Self | None:
        """Return the record in a store, or None before the first run."""
        if (document := store.stored_document(RECORDS)) is None:
            raise store.damage(f"{RECORDS}/{ROOT}", "it is not there")
        if (table := document.get("attributes", {}).get(_RUN)) is None:
            return None
        digest = table.pop(DIGEST, "") if isinstance(table, dict) else ""
        name = f"{store.path}: {RECORDS}/{ROOT}, the record of the latest run,"
        if digest != document_digest(table):
            raise damaged_record(name, CHANGED, table)
        return record_in(cls, table, name)

    def write(self, store: Store) -> None:
        """Replace the record in a store: an attribute of the group of records, in one key."""
        # The store does not remember it: consolidated metadata would tell readers of a run that ended long ago.
        attributes = {_RUN: {**asdict(self), DIGEST: document_digest(asdict(self))}}
        store.location.write({f"{RECORDS}/{ROOT}": json.dumps(group_document(attributes)).encode()})


def unlock(store: str | Path | Location, *, force: bool = False) -> Lock | None:
    """Remove the lock of a run that cannot do so itself, because it or its machine was killed.

    A run that is still going on notices within seconds, and ends.

    Args:
        store: Path or URL of the store, or that of one of its objects.
        force: Whether to also remove the lock of a run that was alive a moment ago.

    Returns:
        The lock, or None if the store had none. Its `driver` names the process that held it since the UTC time `since`.

    Raises:
        LockError: The run was alive a moment ago.
        StoreError: There is no store, or it cannot be read or written.

    >>> import sobolev_batch as sb
    >>> sb.unlock("memory://new.zarr")
    Traceback (most recent call last):
        ...
    sobolev_batch.errors.ForeignError: memory://new.zarr: it holds no store of a study
    """
    check_flags(force=force)
    location = root_of(Location.parse(store))
    if (lock := Lock.read(location)) is None:
        if Objects.read(location) is None:
            Store.open(location)
        return None
    if not force and lock.holder_is_alive:
        raise LockError(f"{location}: {lock.driver} is alive; stop it, or unlock the store all the same by --force")
    silence = math.inf if force or lock.holder_is_gone else _silence_seconds(location, lock)
    if silence < -LOST_AFTER_SECONDS:
        raise LockError(
            f"{location}: the last sign of life of {lock.driver} is {-silence:.0f} s ahead of the clock here, so its "
            "age is unknown; stop it, or if it is gone, unlock the store by --force"
        )
    if silence < LOST_AFTER_SECONDS:
        raise LockError(
            f"{location}: {lock.driver} was alive {max(silence, 0):.0f} s ago; stop it, or wait until it has been "
            f"silent for {LOST_AFTER_SECONDS:.0f} s; --force unlocks the store all the same"
        )
    for key in LOCK_KEYS:
        location.discard(key)
    return lock


def _silence_seconds(location: Location, lock: Lock) -> float:
    moments = [lock.since] if lock.run else []
    # If the store cannot be read, only the lock itself is known.
    with suppress(StoreError):
        store = Store(location)
        run = RunRecord.read(store) if store.exists() else None
        if run is not None and run.driver.startswith(lock.driver):
            moments.append(run.seen)
    return min(map(age_seconds, moments), default=math.inf)
