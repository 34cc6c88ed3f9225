"""Retries of requests to object storage, which end after a while.

The drivers repeat most requests, but not all. They do not ask again for a range of a key above 50 MB whose
transfer breaks off, and they ignore keys that a server did not remove. They also give up after different
times. Keys are always written whole, so writing one again is safe even if the first attempt succeeded and its
answer was lost.
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

# A run that cannot go on should say so within a minute.
LONGEST_SECONDS = 40.0
_SLOWEST_BYTES_PER_SECOND = 500_000
# Besides the first attempt; the drivers have tried several times in each.
_RETRIES, _LEAST_DELAY, _LARGEST_DELAY, _JITTER = 2, 0.5, 5.0, 1.0
# Another attempt would not change these answers.
_FINAL = (PermissionError, FileNotFoundError, NotADirectoryError)


async def with_retries(
    attempt: Callable[[], Awaitable[T]], size_bytes: int = 0, final: tuple[type[Exception], ...] = _FINAL
) -> T:
    """Return the result of the first attempt that succeeds, or raise the error of the last one.

    Args:
        attempt: Function that makes one request.
        size_bytes: Largest number of bytes that it transfers.
        final: Exceptions after which it is not called again.

    Raises:
        OSError: No attempt succeeded in the time that any working storage should need.
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

    seconds = LONGEST_SECONDS + size_bytes / _SLOWEST_BYTES_PER_SECOND
    try:
        async with asyncio.timeout(seconds):
            result, error = await retry(
                outcome, _RETRIES, _LEAST_DELAY, _LARGEST_DELAY, _JITTER, Exception, "access to object storage"
            )
    except TimeoutError as late:
        # An earlier error says more. fsspec would drop the message of a TimeoutError.
        silent = OSError(f"no success within {seconds:.0f} s, however often it was tried")
        raise failures[-1] if failures else silent from late
    if error is not None:
        raise error
    return result  # type: ignore[no-any-return]


class RetryingStore(FsspecStore):
    """zarr's store behind a driver of fsspec, with retries.

    Attributes:
        largest_bytes: Largest size of one key.
    """

    largest_bytes: int = 0

    @classmethod
    def at(cls, url: str, options: dict[str, Any], largest_bytes: int) -> Self:
        """Return the store at a URL, with options for its driver."""
        store = cast(Self, cls.from_url(url, storage_options=options))
        store.largest_bytes = largest_bytes
        return store

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """Return the bytes of a key or of a range of it, or None if it does not exist."""
        return await with_retries(partial(super().get, key, prototype, byte_range), self.largest_bytes)

    async def set(self, key: str, value: Buffer, byte_range: tuple[int, int] | None = None) -> None:
        """Replace a key."""
        # After a multipart upload whose answer was lost, its parts are not found; the next attempt starts anew.
        await with_retries(partial(super().set, key, value, byte_range), len(value), (PermissionError,))


async def put_all(files: AbstractFileSystem, documents: dict[str, bytes]) -> None:
    """Write all keys at once."""
    puts = (
        with_retries(partial(files._pipe_file, path, document), len(document), (PermissionError,))
        for path, document in documents.items()
    )
    # All are awaited, since asyncio logs failures that nobody retrieved.
    for outcome in await asyncio.gather(*puts, return_exceptions=True):
        if isinstance(outcome, BaseException):
            raise outcome


async def remove_all(files: AbstractFileSystem, prefix: str) -> None:
    """Remove all keys below a prefix.

    Raises:
        FileNotFoundError: No key has this prefix.
    """

    async def remove() -> None:
        await files._rm(prefix, recursive=True)
        # A server may remove some of them only; s3fs does not check.
        remaining = await files._find(prefix)
        if remaining:
            raise OSError(f"{len(remaining)} keys are still there, such as {remaining[0]}")

    await with_retries(remove)
