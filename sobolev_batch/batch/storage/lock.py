"""A claim: the key by which one driver at a time has a store to itself.

Tasks of one run never meet in a chunk, but those of two runs would. The claim lies in the store, so
that drivers on different machines see it, and is made by the one operation that only one of them can succeed
with. It is taken away when its run ends, by whatever way leaves time for that; what a killed driver
leaves is taken over where it is certain that its process is gone, and elsewhere released by people.
"""

from __future__ import annotations

import json
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Self
from uuid import uuid4

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.timestamps import utc_now
from sobolev_batch.errors import ClaimError, StoreError

_log = logging.getLogger(__name__)

# States of a process that only waits for its parent to take notice.
_ENDED = ("Z", "X")

CLAIM = "claim.json"
# There while somebody takes over from the dead: several may try.
_SUCCESSION = "claim.succession.json"
CLAIM_KEYS = frozenset({CLAIM, _SUCCESSION})


@dataclass(frozen=True)
class Claim:
    """Who has a store to itself.

    Attributes:
        run: what the claim is for; whoever knows it may take the claim over, as a worker does from the process
            that has submitted the run, or from a worker that is lost.
        holder: who has it now.
        driver: the holder in words: the process and its host.
        since: when it was taken, in UTC.
        process: the holder's process, as `_process_mark` tells it; empty where its end must not end the claim.
        folder: "made" where the store's folder was made for the claim.
    """

    run: str
    holder: str
    driver: str
    since: str
    process: str = ""
    folder: str = ""

    @classmethod
    def of_this_process(cls, run: str = "", *, outlives_process: bool = False) -> Self:
        """A new claim, for a new run unless one is named."""
        mark = "" if outlives_process else _process_mark(os.getpid())
        return cls(run or uuid4().hex, uuid4().hex, this_process(), utc_now(), mark)

    def to_json(self) -> bytes:
        """The claim as a document."""
        return json.dumps(asdict(self)).encode()

    @classmethod
    def read(cls, location: Location) -> Self | None:
        """The claim on a store, or None where there is none.

        Raises:
            StoreError: the store cannot be reached.
        """
        text = location.read(CLAIM)
        if text is None:
            return None
        try:
            entries = json.loads(text)
            if not all(isinstance(entry, str) for entry in entries.values()):
                raise TypeError("a claim holds texts")
            return cls(**entries)
        except (ValueError, TypeError, AttributeError):
            # Its holder was killed while it wrote this, or is about to end writing it.
            return cls("", "", "a process that has not written its name", "an unknown time")

    @property
    def is_of_the_dead(self) -> bool:
        """Whether it is certain that the holder's process is gone."""
        return self._is_of_this_machine and not self.is_of_the_living

    @property
    def is_of_the_living(self) -> bool:
        """Whether it is certain that the holder's process is there."""
        number = self.process.rpartition("/")[2].partition("@")[0]
        return self._is_of_this_machine and number.isdecimal() and _process_mark(int(number)) == self.process

    @property
    def _is_of_this_machine(self) -> bool:
        machine = self.process.rpartition("/")[0]
        return bool(machine) and machine == _machine()

    def require(self, location: Location) -> None:
        """Check that its holder still has the store.

        Raises:
            ClaimError: it was released, or somebody else has it.
        """
        if not self.is_on(location):
            raise ClaimError(f"{location}: the store was released, or removed, and is no longer that of this process")

    def is_on(self, location: Location) -> bool:
        """Whether its holder still has the store.

        Raises:
            StoreError: the store cannot be reached.
        """
        there = Claim.read(location)
        return there is not None and there.holder == self.holder


@contextmanager
def claimed(location: Location, claim: Claim) -> Iterator[None]:
    """Have a store to oneself, a claim for the same run being taken over.

    Raises:
        ClaimError: another run has it; the message names its driver.
        StoreError: the store cannot be reached or written.
    """
    take(location, claim)
    try:
        yield
    finally:
        give_up(location, claim)


def take(location: Location, claim: Claim) -> None:
    """Take a claim on a store, or the one over that is there for the same run.

    Raises:
        ClaimError: another run has it; the message names its driver.
        StoreError: the store cannot be reached or written.
    """
    claim = replace(claim, folder="" if location.is_folder() else "made")
    there = None
    # What is there may be given up between two looks at it.
    while there is None:
        if location.create(CLAIM, claim.to_json()):
            return
        there = Claim.read(location)
    # Of a request whose answer was lost, a driver hears that the key is there.
    claim = replace(claim, folder=there.folder)
    if there.run == claim.run:
        location.write({CLAIM: claim.to_json()})
    else:
        _succeed(location, claim, there)


def _succeed(location: Location, claim: Claim, dead: Claim) -> None:
    """Take a store over from a process that is gone."""
    taken = (
        f"{location}: another run has this store to itself: {dead.driver}, since {dead.since}. "
        "Wait for it or stop it; if it is gone without having been able to say so, "
        f"release the store with: sobolev-batch release {location}"
    )
    if not dead.is_of_the_dead or not location.create(_SUCCESSION, claim.to_json()):
        raise ClaimError(taken)
    try:
        # Another one may have succeeded since.
        if not dead.is_on(location):
            raise ClaimError(taken)
        location.write({CLAIM: claim.to_json()})
    finally:
        location.discard(_SUCCESSION)
    _log.warning("%s: taken over from %s, which was ended in the middle of its run", location, dead.driver)


def remove_claim(location: Location) -> None:
    """Take any claim away.

    Raises:
        StoreError: it cannot be removed.
    """
    for key in CLAIM_KEYS:
        location.discard(key)


def give_up(location: Location, claim: Claim) -> None:
    """Take a claim away, unless somebody else has taken it over; what cannot be removed is only reported."""
    try:
        there = Claim.read(location)
        if there is not None and there.holder == claim.holder:
            location.discard(CLAIM, with_folder=there.folder == "made")
    except StoreError as error:
        _log.warning("the store stays claimed, release it with: sobolev-batch release %s (%s)", location, error)


def this_process() -> str:
    """This process, for people."""
    return f"process {os.getpid()} on {socket.gethostname()}"


def _process_mark(number: int) -> str:
    """A mark that no two processes share, by the machine that they run on; empty where it cannot be had."""
    machine = _machine()
    try:
        fields = Path(f"/proc/{number}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    # The name in brackets may hold anything. The start is counted from that of the machine: unlike a time of day,
    # it does not move when the clock is set.
    state, started = (fields.rpartition(")")[2].split()[place] for place in (0, 19))
    if state in _ENDED:
        return ""
    return machine and f"{machine}/{number}@{started}"


def _machine() -> str:
    """Where a process number means the same process: a machine since it was started, a container of it."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot}/{os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""
