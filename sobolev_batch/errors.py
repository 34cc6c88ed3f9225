"""Exceptions of the package: one tree, with plain messages, safe to pickle between processes."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO
from uuid import uuid4

from sobolev_batch.visible import visible

__all__ = [
    *("AccuracyError", "BackendError", "ClusterError", "DamageError", "ForeignError", "InputError", "LatticeError"),
    *("LockError", "MemoryLimitError", "MeshError", "OrderError", "SobolevBatchError", "SpaceError", "StoreError"),
    "StudyError",
]

# Characters of another library's message that are worth keeping.
_LONGEST = 2000


class SobolevBatchError(Exception):
    """Base of every error that the package raises on purpose.

    All arguments reach `Exception`, so that errors survive the trip from a worker to the client. The message
    names the file or mesh, what was found, what was expected, and what to do.
    """

    def __str__(self) -> str:
        # The other arguments are those of attributes.
        return str(self.args[0]) if self.args else ""


class InputError(SobolevBatchError):
    """The input is wrong; computing again would not help."""


class MeshError(InputError):
    """A mesh, or the file that should hold it, is not usable."""


class LatticeError(InputError):
    """A lattice is malformed, or a surface does not fit into its period."""


class MemoryLimitError(InputError):
    """A transform is allowed too little memory."""


class OrderError(InputError):
    """The norm of a surface measure is infinite for a Sobolev order."""


class AccuracyError(InputError):
    """An accuracy is impossible within the allowed memory.

    Attributes:
        requested: Requested rtol.
        reachable: Smallest rtol that is expected to be met.
    """

    def __init__(self, message: str, requested: float, reachable: float) -> None:
        super().__init__(message, requested, reachable)
        self.requested = requested
        self.reachable = reachable


class StudyError(InputError):
    """A study file is malformed, or requests something that does not exist."""


class StoreError(InputError):
    """A store cannot be read or written, or belongs to another study."""


class ForeignError(StoreError):
    """At the place of a store is something that no run has written, or that belongs to another study."""


class SpaceError(StoreError):
    """A disk is full, or a quota is used up; the same command goes on once there is room."""


class LockError(StoreError):
    """Another run holds the lock on a store."""


class DamageError(StoreError):
    """Stored data are not as they were written.

    Attributes:
        what: Description of the damage, without the name of the data.
        row: Row of the damaged field; None where it is no field.
    """

    def __init__(self, message: str, what: str, row: int | None = None) -> None:
        super().__init__(message, what, row)
        self.what = what
        self.row = row


class BackendError(SobolevBatchError):
    """A GPU was requested and cannot be used: a library, the driver or the device is missing or fails."""


class ClusterError(SobolevBatchError):
    """The Dask cluster cannot be reached, or stopped serving."""


def one_line(error: BaseException) -> str:
    """Return the message of an error on one line, or the name of its type if it has none.

    Line breaks of our own messages are those of names, and stay visible. Long ones of other libraries lose their end.
    """
    message = ""
    with suppress(Exception):  # a user's own may have no text
        message = str(error)
    if not isinstance(error, SobolevBatchError):
        message = " ".join(message[:_LONGEST].split())
    return visible(message) or type(error).__name__


@contextmanager
def refused_by_pydantic() -> Iterator[None]:
    """Turn an InputError into the ValueError by which pydantic knows a refusal."""
    try:
        yield
    except InputError as error:
        raise ValueError(str(error)) from error


def is_for_want_of_space(error: BaseException) -> bool:
    """Tell whether something could not be written since a disk is full, or a quota is used up."""
    return getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)


@contextmanager
def written(place: object, what: str, kind: type[InputError] = StoreError) -> Iterator[None]:
    """Turn a failure to write a file into an error that says what cannot be written, where, and why."""
    try:
        yield
    except (OSError, ValueError) as error:  # the latter for a null character in the name
        kind = SpaceError if is_for_want_of_space(error) else kind
        reason = getattr(error, "strerror", None) or error
        raise kind(f"{place}: {what} cannot be written there: {reason}") from error


@contextmanager
def new_file_beside(path: Path, what: str, kind: type[InputError] = StoreError) -> Iterator[IO[bytes]]:
    """Open a file that may replace another one, and is gone at the end unless it has; see `written`."""
    with written(path, what, kind):
        # A link stays, and may lead to another disk.
        place = Path(os.path.realpath(path)).with_name(f".{uuid4().hex}{path.suffix}")
    try:
        with written(path, what, kind), place.open("xb") as file:
            yield file
    finally:
        place.unlink(missing_ok=True)


def write_file(path: Path, data: bytes | memoryview, what: str, kind: type[InputError] = StoreError) -> None:
    """Write a file; the old one stays until the new one is whole, since a disk may be full. See `written`."""
    if path.exists() and not path.is_file():  # /dev/stdout, for example
        with written(path, what, kind):
            path.write_bytes(data)
        return
    with new_file_beside(path, what, kind) as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
        os.replace(file.name, os.path.realpath(path))


def require_writable(path: Path, what: str) -> None:
    """Refuse a file that cannot be written, before what it is to hold is computed; see `written`."""
    with written(path, what):
        if path.exists():
            path.open("ab").close()
        else:
            path.touch()
            path.unlink()


@contextmanager
def from_extra(extra: str, purpose: str, kind: type[InputError] = InputError) -> Iterator[None]:
    """Turn an import that fails into an error that names its purpose, and the extra that has the library."""
    try:
        yield
    except ImportError as error:
        raise kind(
            f"{purpose} a library that is missing ({error}); install the extra: pip install 'sobolev-batch[{extra}]'"
        ) from error


@contextmanager
def naming(what: str, kind: type[InputError] = StudyError) -> Iterator[None]:
    """Name in an error of a kind what it is about, unless that is empty."""
    try:
        yield
    except kind as error:
        error.args = (f"{what}: {error}" if what else str(error), *error.args[1:])
        raise
