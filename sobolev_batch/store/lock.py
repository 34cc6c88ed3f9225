"""Locks: the key by which one run at a time has a store to itself.

Tasks of one run never write the same chunk, but those of two runs would. The lock lies in the store, where drivers on
different machines see it, and is created by an operation that succeeds for one of them only. It is removed when its run
ends. That of a killed driver is taken over if its process is certainly gone, and is otherwise unlocked by hand.

A task may outlive its driver: a worker that was stopped goes on when it is continued, perhaps after another run has
stored something newer. Before each write it looks whether the lock is still that of its run.
"""

from __future__ import annotations

import calendar
import logging
import os
import shlex
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, Self
from uuid import uuid4

from pydantic import AfterValidator, TypeAdapter, ValidationError

from sobolev_batch.errors import LockError, StoreError
from sobolev_batch.store.location import Location

_log = logging.getLogger(__name__)

_TIME_FORMAT = "%Y-%m-%dT%H:%M:%SZ"

LOCK_KEY = "claim.json"
# This one is held during a takeover, since several drivers may try.
_TAKEOVER_KEY = "claim.succession.json"
LOCK_KEYS = frozenset({LOCK_KEY, _TAKEOVER_KEY})


def _checked_time(text: str) -> str:
    age_seconds(text)
    return text


# Such a time is one that `utc_now` returned.
Time = Annotated[str, AfterValidator(_checked_time)]


@dataclass(frozen=True)
class Lock:
    """The lock on a store.

    Attributes:
        run: Run that it belongs to. A process that knows it may take the lock over, as a worker does from the
            process that submitted the run, or from a worker that was lost.
        holder: Random name of the holder, which tells it from other processes of its run.
        driver: Description of the holder, see `this_process`; that of its heartbeats begins with it.
        since: Time at which it was acquired, in UTC.
        process: Mark of the holder's process, see `_process_mark`; empty if the lock outlives it.
        folder: "made" if the store's folder was created for the lock.
    """

    run: str
    holder: str
    driver: str
    since: Time
    process: str = ""
    folder: str = ""

    @classmethod
    def of_this_process(cls, run: str = "", *, outlives_process: bool = False) -> Self:
        """Return a lock for this process, for a new run unless one is named."""
        mark = "" if outlives_process else _process_mark(os.getpid())
        return cls(run or uuid4().hex, uuid4().hex, this_process(), utc_now(), mark)

    def to_json(self) -> bytes:
        """Return the lock as JSON."""
        return _adapter.dump_json(self)

    @classmethod
    def read(cls, location: Location) -> Lock | None:
        """Return the lock on a store, or None if it has none."""
        if (text := location.read(LOCK_KEY)) is None:
            return None
        try:
            return _adapter.validate_json(text)
        except ValidationError:
            # Its holder was killed while it wrote this, or is still writing.
            return cls("", "", "a process that has not written its name", "an unknown time")

    @property
    def holder_is_gone(self) -> bool:
        """True if the holder's process has certainly ended."""
        machine = self.process.rpartition("/")[0]
        return bool(machine) and machine == _machine() and not self.holder_is_alive

    @property
    def holder_is_alive(self) -> bool:
        """True if the holder's process certainly runs."""
        number = self.process.rpartition("/")[2].partition("@")[0]
        return number.isdecimal() and _process_mark(int(number)) == self.process

    def is_held(self, location: Location) -> bool:
        """Return whether its holder still has the store."""
        current = Lock.read(location)
        return current is not None and current.holder == self.holder

    def fenced(self, location: Location, by: Literal["run", "holder"] = "run") -> Location:
        """Return a location that may be written, with all below, as long as the lock's run, or its holder, has it."""
        return replace(location, fence=partial(self._require, location, by))

    def _require(self, location: Location, part: Literal["run", "holder"]) -> None:
        if (current := Lock.read(location)) is None or getattr(current, part) != getattr(self, part):
            others = f"{current.driver} has it now" if current else "the store was unlocked, or its run is over"
            raise LockError(f"{location}: nothing more is written by a run that no longer has the store: {others}")


_adapter = TypeAdapter(Lock)


@contextmanager
def locked(location: Location, lock: Lock) -> Iterator[None]:
    """Hold the lock on a store. See `acquire`."""
    acquire(location, lock)
    try:
        yield
    finally:
        release(location, lock)


def acquire(location: Location, lock: Lock) -> None:
    """Acquire the lock on a store, or take over the one of the same run; LockError where another run has it."""
    lock = replace(lock, folder="" if location.scheme or Path(location.name).is_dir() else "made")
    current = None
    # The current lock may be released between two attempts.
    while current is None:
        if location.create(LOCK_KEY, lock.to_json()):
            return
        current = Lock.read(location)
    # After a request whose answer was lost, a driver hears that its own key exists.
    lock = replace(lock, folder=current.folder)
    if current.run == lock.run:
        location.write({LOCK_KEY: lock.to_json()})
    else:
        _take_over(location, lock, current)


def _take_over(location: Location, lock: Lock, current: Lock) -> None:
    refusal = LockError(
        f"{location}: another run has this store to itself: {current.driver}, since {current.since}. "
        f"Wait for it or stop it; if it is gone, unlock the store with: {unlock_command(str(location))}"
    )
    if not current.holder_is_gone or not location.create(_TAKEOVER_KEY, lock.to_json()):
        raise refusal
    try:
        # Another driver may have taken over since.
        if not current.is_held(location):
            raise refusal
        location.write({LOCK_KEY: lock.to_json()})
    finally:
        location.discard(_TAKEOVER_KEY)
    _log.warning("%s: taken over from %s, which was ended in the middle of its run", location, current.driver)


def release(location: Location, lock: Lock) -> None:
    """Release a store unless another process has taken it over. A failure is only reported."""
    try:
        if (current := Lock.read(location)) is not None and current.holder == lock.holder:
            location.discard(LOCK_KEY)
            if current.folder == "made":
                with suppress(OSError):  # It holds a store, or is no folder.
                    Path(location.name).rmdir()
    except StoreError as error:
        _log.warning("the store stays locked, unlock it with: %s (%s)", unlock_command(str(location)), error)


def unlock_command(store: str) -> str:
    """Return the command that unlocks a store, for a shell."""
    return f"sobolev-batch unlock {shlex.quote(store)}"


def this_process() -> str:
    """Return a description of this process for people."""
    return f"process {os.getpid()} on {socket.gethostname()}"


def _process_mark(number: int) -> str:
    """Return a mark that no two processes share, with the machine that they run on; empty if unknown."""
    machine = _machine()
    try:
        fields = Path(f"/proc/{number}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    # The name in brackets may hold anything. The start is counted from the boot, which no setting of the clock moves.
    state, started = (fields.rpartition(")")[2].split()[index] for index in (0, 19))
    # In these states, it only waits for its parent to take notice.
    return "" if state in ("Z", "X") else machine and f"{machine}/{number}@{started}"


def _machine() -> str:
    """Return the scope in which process numbers are unique: a boot of a machine, and a container on it."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot}/{os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def utc_now() -> str:
    """Return the time in UTC, in ISO 8601, to the second.

    >>> len(utc_now())
    20
    """
    return time.strftime(_TIME_FORMAT, time.gmtime())


def age_seconds(moment: str) -> float:
    """Return the seconds since a time that `utc_now` returned; ValueError where it is none."""
    return time.time() - calendar.timegm(time.strptime(moment, _TIME_FORMAT))
