"""Patience with object storage: what fails for a moment is tried again, and given up after a while.

The drivers repeat most requests by themselves, but not all: a part of a key above 50 MB whose transfer
breaks off is not asked for again, and keys that a server did not remove are not even mentioned. Nor do
they agree on when to give up. Keys are always written whole, so that writing one again is safe, also
where the first time had succeeded and nobody was told.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, Self, TypeVar, cast

from distributed.utils_comm import retry
from fsspec import AbstractFileSystem
from zarr.abc.store import ByteRequest
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import FsspecStore

T = TypeVar("T")

# Who waits for a run that cannot go on wants to know within a minute.
_SECONDS = 40.0
_SLOWEST_BYTES_PER_SECOND = 500_000
# Besides the first time; the drivers have tried several times each time.
_MORE_TIMES, _LEAST_DELAY, _LARGEST_DELAY, _JITTER = 2, 0.5, 5.0, 1.0
# Asking again would not change the answer.
_FINAL = (PermissionError, FileNotFoundError, NotADirectoryError)


async def patiently(
    attempt: Callable[[], Awaitable[T]], size_bytes: int = 0, final: tuple[type[Exception], ...] = _FINAL
) -> T:
    """What an attempt returns, or raises for the last time.

    Args:
        attempt: called anew each time.
        size_bytes: what it transfers at most.
        final: what it raises if it need not be called again.

    Raises:
        OSError: nothing came of it in the time that any storage in use should need.
    """
    failures: list[Exception] = []

    async def outcome() -> tuple[T, None] | tuple[None, Exception]:
        try:
            return await attempt(), None
        except final as error:
            return None, error
        except Exception as error:
            failures.append(error)
            raise

    seconds = _SECONDS + size_bytes / _SLOWEST_BYTES_PER_SECOND
    try:
        async with asyncio.timeout(seconds):
            found, error = await retry(
                outcome, _MORE_TIMES, _LEAST_DELAY, _LARGEST_DELAY, _JITTER, Exception, "access to object storage"
            )
    except TimeoutError as late:
        # What was said before tells more. Of a TimeoutError, fsspec would not keep the message.
        silent = OSError(f"no success within {seconds:.0f} s, however often it was tried")
        raise failures[-1] if failures else silent from late
    if error is not None:
        raise error
    return found  # type: ignore[no-any-return]


class PatientKeys(FsspecStore):
    """Keys that zarr reads and writes through a driver of fsspec.

    Attributes:
        largest_bytes: what one of them holds at most.
    """

    largest_bytes: int = 0

    @classmethod
    def at(cls, url: str, options: dict[str, Any], largest_bytes: int) -> Self:
        """Those below a URL, with options of its driver."""
        keys = cast(Self, cls.from_url(url, storage_options=options))
        keys.largest_bytes = largest_bytes
        return keys

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """The bytes of a key or of a part of it, None where there is none."""
        return await patiently(partial(super().get, key, prototype, byte_range), self.largest_bytes)

    async def set(self, key: str, value: Buffer, byte_range: tuple[int, int] | None = None) -> None:
        """Replace a key."""
        # An upload in parts that has ended unheard is not found any more; the next one is another.
        await patiently(partial(super().set, key, value, byte_range), len(value), (PermissionError,))


async def put_all(files: AbstractFileSystem, documents: dict[str, bytes]) -> None:
    """Write keys, all at once."""
    # All are waited for, since asyncio logs the failures that nobody asked for.
    puts = (
        patiently(partial(files._pipe_file, path, document), len(document), (PermissionError,))
        for path, document in documents.items()
    )
    for outcome in await asyncio.gather(*puts, return_exceptions=True):
        if isinstance(outcome, BaseException):
            raise outcome


async def remove_all(files: AbstractFileSystem, prefix: str) -> None:
    """Remove all keys below a prefix.

    Raises:
        FileNotFoundError: there are none.
    """

    async def remove() -> None:
        await files._rm(prefix, recursive=True)
        # A server may remove some of them; s3fs does not look at what became of the others.
        left = await files._find(prefix)
        if left:
            raise OSError(f"{len(left)} keys are still there, such as {left[0]}")

    await patiently(remove)
