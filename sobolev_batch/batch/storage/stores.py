"""Where the keys of a store are: in a folder, or wherever a driver of fsspec reaches.

A store may come from somebody else. A link in it may lead to a device that never ends, or make a run write outside of
the store. So no link below its folder is followed: checksums would reveal a wrong chunk only after it was read.

Credentials are never part of a URL. The drivers take them from the environment of each process.
"""

from __future__ import annotations

import asyncio
import inspect
import os
import re
import shutil
import stat
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast
from uuid import uuid4

from fsspec.asyn import AsyncFileSystem, sync
from fsspec.core import url_to_fs
from fsspec.implementations.asyn_wrapper import AsyncFileSystemWrapper
from zarr.abc.store import ByteRequest
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import FsspecStore, LocalStore

from sobolev_batch.errors import DamageError, StoreError

T = TypeVar("T")

# zarr also gives files such names until they are complete.
PARTIAL_FILE = re.compile(r"\.[0-9a-f]{32}\.partial")

BUCKET_SCHEMES = ("s3", "s3a", "gs", "gcs")
_EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gcs", "gcs": "gcs"}
# A run that cannot go on should say so within a minute, and a question is to be answered sooner.
LONGEST_SECONDS, _ANSWER_SECONDS = 40.0, 20
_SLOWEST_BYTES_PER_SECOND = 500_000
# s3fs requests the size of every key first, to read ranges of 50 MB of larger ones at once.
_RANGE_BYTES = 50 << 20
# Another attempt would not change these answers.
_FINAL = (PermissionError, FileNotFoundError, NotADirectoryError)


def path_in(root: str | Path, key: str) -> Path:
    """Return the path of a key of a store in a folder. The folder itself may be reached by a link.

    Raises:
        StoreError: The key leads out of the folder, or its path holds a link or a special file.
    """
    if key.startswith("/") or ".." in key.split("/"):
        raise StoreError(f"{root}: {key} leads out of the store")
    path = os.fspath(root)
    # One by one, since resolving a whole path takes ten times as long, and each record is a key.
    for name in filter(None, key.split("/")):
        path = f"{path}/{name}"
        try:
            mode = os.lstat(path).st_mode
        except (FileNotFoundError, NotADirectoryError):
            break
        if stat.S_ISLNK(mode):
            raise StoreError(f"{path}: a link, which may lead out of the store; put what it leads to in its place")
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise StoreError(f"{path}: neither a file nor a folder, in a store; remove it")
    return Path(root) / key


class FolderStore(LocalStore):
    """zarr's store in a folder, which follows no link in it."""

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        """Return the bytes of ranges of keys."""
        ranges = list(key_ranges)
        for key, _ in ranges:
            path_in(self.root, key)
        return await super().get_partial_values(prototype, ranges)


def _checked(method: Callable[..., Any]) -> Callable[..., Any]:
    def call(self: FolderStore, *arguments: Any, **options: Any) -> Any:
        path_in(self.root, arguments[0] if arguments else options.get("key", options.get("prefix", "")))
        return method(self, *arguments, **options)

    return call


# By their arguments, since newer versions of zarr add some.
for _name, _method in inspect.getmembers(LocalStore, inspect.isfunction):
    if not _name.startswith("_") and list(inspect.signature(_method).parameters)[1:2] in (["key"], ["prefix"]):
        setattr(FolderStore, _name, _checked(_method))


class Folder:
    """Keys of a store as files in a folder."""

    # Any other exception is a defect.
    failures: tuple[type[Exception], ...] = (OSError,)

    def __init__(self, path: str) -> None:
        self._path = path

    def zarr_store(self, largest_bytes: int) -> FolderStore:
        """Return zarr's store in the folder."""
        return FolderStore(self._path)

    def read(self, key: str, most_bytes: int | None) -> bytes:
        """Return the content of a file."""
        path = path_in(self._path, key)
        if most_bytes is not None and path.stat().st_size > most_bytes:
            problem = f"{key} has more than {most_bytes} bytes"
            raise DamageError(f"{self._path}: {problem}", problem)
        return path.read_bytes()

    def write(self, documents: Mapping[str, bytes]) -> None:
        """Write files, each under a temporary name first."""
        for key, document in documents.items():
            path = path_in(self._path, key)
            path.parent.mkdir(parents=True, exist_ok=True)
            # A reader finds the old document or the new one, never half of it.
            with _partial_file(path, document) as partial:
                partial.replace(path)

    def create(self, key: str, document: bytes) -> None:
        """Write a file unless it exists."""
        path = path_in(self._path, key)
        path.parent.mkdir(exist_ok=True)
        with _partial_file(path, document) as partial:
            # Unlike opening a new file, a link never shows the key without its content.
            os.link(partial, path)

    def delete(self, key: str) -> None:
        """Remove a file."""
        path_in(self._path, key).unlink()

    def delete_all(self, prefix: str) -> None:
        """Remove a folder below."""
        shutil.rmtree(path_in(self._path, prefix))

    def delete_partial_files(self) -> None:
        """Remove files that were not written to their end."""
        for folder, _, names in os.walk(self._path):
            for name in filter(PARTIAL_FILE.search, names):
                # It may have got its final name since, from a task that outlived its run.
                (Path(folder) / name).unlink(missing_ok=True)

    def sizes(self, prefix: str) -> dict[str, int]:
        """Return the sizes of all files below a prefix."""
        sizes = {}
        for folder, _, names in os.walk(path_in(self._path, prefix)):
            for name in names:
                path = os.path.join(folder, name)
                with suppress(FileNotFoundError):  # removed since
                    status = os.lstat(path)
                    if stat.S_ISREG(status.st_mode):
                        sizes[os.path.relpath(path, self._path).replace(os.sep, "/")] = status.st_size
        return sizes

    def names(self) -> set[str]:
        """Return the names of files and folders."""
        return set(os.listdir(self._path)) if Path(self._path).exists() else set()

    def require_usable(self) -> None:
        """Check that the folder exists or can be made."""
        path = Path(self._path)
        if path.exists() and not path.is_dir():
            raise StoreError(f"{path}: it is a file; name a folder that is new or holds a store")
        parent = path.absolute().parent
        if not parent.is_dir():
            raise StoreError(f"{path}: there is no folder {parent} to hold the store; make it first")


@contextmanager
def _partial_file(path: Path, document: bytes) -> Iterator[Path]:
    """Write a document to a file beside a path. The file is removed unless it was moved to the path."""
    partial = path.with_name(f"{path.name}.{uuid4().hex}.partial")
    try:
        partial.write_bytes(document)
        yield partial
    finally:
        partial.unlink(missing_ok=True)


async def _twice(attempt: Callable[[], Awaitable[T]], size_bytes: int = 0, final: Any = _FINAL) -> T:
    """Make a request of the driver, and once more if it fails; then, or after a minute, raise the first failure.

    The drivers repeat most requests several times, but not a range whose transfer breaks off, nor an upload whose last
    answer was lost. Keys are written whole, so writing one again is safe.
    """
    failure: Exception = OSError("nothing answers there")  # fsspec would drop the message of a TimeoutError
    try:
        async with asyncio.timeout(LONGEST_SECONDS + size_bytes / _SLOWEST_BYTES_PER_SECOND):
            try:
                return await attempt()
            except final:
                raise
            except Exception as error:
                failure = error
                return await attempt()
    except TimeoutError:
        raise failure from None


class RemoteStore(FsspecStore):
    """zarr's store behind a driver of fsspec."""

    largest_bytes = 0

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """Return the bytes of a key or of a range of it, or None if it does not exist."""
        return await _twice(partial(super().get, key, prototype, byte_range), self.largest_bytes)

    async def set(self, key: str, value: Buffer, byte_range: tuple[int, int] | None = None) -> None:
        """Replace a key."""
        await _twice(partial(super().set, key, value, byte_range), len(value), PermissionError)


class ObjectStorage:
    """Keys of a store below a URL."""

    # The exceptions of drivers have no common base.
    failures: tuple[type[Exception], ...] = (Exception,)

    def __init__(self, url: str, scheme: str) -> None:
        self._url, self._scheme = url, scheme

    def zarr_store(self, largest_bytes: int) -> RemoteStore:
        """Return zarr's store below the URL."""
        self._driver()
        store = RemoteStore.from_url(self._url, storage_options=self._options(largest_bytes))
        cast(RemoteStore, store).largest_bytes = largest_bytes
        return cast(RemoteStore, store)

    def read(self, key: str, most_bytes: int | None) -> bytes:
        """Return the content of a key, of any size."""
        return cast(bytes, self._ask("cat_file", key))

    def write(self, documents: Mapping[str, bytes]) -> None:
        """Write keys, all at once."""
        files, root = self._driver()

        async def put_all() -> None:
            puts = (
                _twice(partial(files._pipe_file, f"{root}/{key}", document), len(document), PermissionError)
                for key, document in documents.items()
            )
            # All are awaited, since asyncio logs failures that nobody retrieved.
            for outcome in await asyncio.gather(*puts, return_exceptions=True):
                if isinstance(outcome, BaseException):
                    raise outcome

        sync(files.loop, put_all)

    def create(self, key: str, document: bytes) -> None:
        """Write a key by a conditional request."""
        self._ask("pipe_file", key, document, mode="create")

    def delete(self, key: str) -> None:
        """Remove a key."""
        self._ask("rm_file", key)

    def delete_all(self, prefix: str) -> None:
        """Remove all keys below a prefix."""
        files, root = self._driver()

        async def remove() -> None:
            await files._rm(f"{root}/{prefix}", recursive=True)
            # A server may remove some of them only; s3fs does not check.
            if remaining := await files._find(f"{root}/{prefix}"):
                raise OSError(f"{len(remaining)} keys are still there, such as {remaining[0]}")

        sync(files.loop, _twice, remove)

    def sizes(self, prefix: str) -> dict[str, int]:
        """Return the sizes of all keys below a prefix."""
        entries = self._ask("find", prefix, detail=True)
        return {path.removeprefix(f"{self._driver()[1]}/"): entry["size"] for path, entry in entries.items()}

    def names(self) -> set[str]:
        """Return the names of keys at the first level."""
        # The name alone may stand for a folder that was emptied; only existing keys are listed.
        paths = self._ask("ls", "", detail=False) if self._ask("exists", "") else ()
        return {path.rstrip("/").rpartition("/")[2] for path in paths}

    def is_absent(self, error: OSError) -> bool:
        """Return whether the key is missing, and not its bucket."""
        return not _lacks_bucket(error)

    def explain(self, error: Exception, text: str) -> str:
        """Return the reason of a failure and its remedy."""
        if _lacks_bucket(error) or (self._scheme in BUCKET_SCHEMES and isinstance(error, FileNotFoundError)):
            return f"there is no bucket {self._url.split('/')[2]!r} ({text})"
        if isinstance(error, TimeoutError):
            return f"nothing answers there within {_ANSWER_SECONDS} s"
        if "Credentials" in type(error).__name__:
            return f"no credentials ({text}); set those of {self._scheme}:// in the environment of every process"
        if isinstance(error, PermissionError):
            return f"access is denied ({text}); check the credentials in the environment and what they allow"
        return text

    def _ask(self, method: str, key: str, *arguments: Any, **options: Any) -> Any:
        """Call a method of the driver with a path, and wait for a while only."""
        files, root = self._driver()
        return getattr(files, method)(f"{root}/{key}".rstrip("/"), *arguments, **options, timeout=_ANSWER_SECONDS)

    def _options(self, largest_bytes: int = 0) -> dict[str, Any]:
        # fsspec remembers listings, but other processes write to the same store.
        one_request = {"max_concurrency": 1} if self._scheme in ("s3", "s3a") and largest_bytes <= _RANGE_BYTES else {}
        return {"use_listings_cache": False, **one_request}

    def _driver(self) -> tuple[AsyncFileSystem, str]:
        try:
            files, root = url_to_fs(self._url, **self._options())
        except ImportError as error:
            extra = _EXTRAS.get(self._scheme)
            remedy = f"pip install 'sobolev-batch[{extra}]'" if extra else "install it"
            raise StoreError(
                f"{self._url}: the driver of {self._scheme}:// is missing here ({error}): {remedy}"
            ) from error
        except ValueError as error:
            raise StoreError(f"{self._url}: no store can lie there ({error}); name a folder or an s3:// URL") from error
        # The driver of memory:// is the only common one that is not asynchronous.
        return files if files.async_impl else AsyncFileSystemWrapper(files, asynchronous=False), str(root)


def _lacks_bucket(error: Exception) -> bool:
    """Return whether the bucket is missing, for drivers that report a missing key in the same way."""
    response: Any = getattr(error.__cause__, "response", None)
    return isinstance(response, dict) and response.get("Error", {}).get("Code") == "NoSuchBucket"
