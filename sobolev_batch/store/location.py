"""Locations of stores: a local folder, or a URL of object storage, through the stores of zarr.

A location holds no credentials, so it can be stored, logged and sent: drivers take them from the environment.

A store may come from somebody else. A link in it may lead to a device that never ends, or make a run write outside of
the store. So no link below its folder is followed: checksums would reveal a wrong chunk only after it was read.
"""

from __future__ import annotations

import asyncio
import os
import re
import stat
from collections.abc import AsyncIterator, Callable, Collection, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache
from glob import escape
from pathlib import Path
from typing import Any, Self, cast
from uuid import uuid4

from fsspec import available_protocols
from zarr.abc.store import ByteRequest
from zarr.buffer.cpu import Buffer as CpuBuffer
from zarr.core.buffer import Buffer, BufferPrototype, default_buffer_prototype
from zarr.core.common import AccessModeLiteral
from zarr.core.sync import sync
from zarr.storage import FsspecStore, LocalStore

from sobolev_batch.errors import DamageError, ForeignError, SpaceError, StoreError, is_for_want_of_space
from sobolev_batch.parameters import path_of

_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)(://|::)(.*)", re.DOTALL)
_FOLDER_SCHEMES = ("file", "local")
# The extra of this package that has the driver of each scheme with buckets.
_EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gcs", "gcs": "gcs"}
# zarr gives such names to files until they are complete.
PARTIAL_FILE = re.compile(r"\.[0-9a-f]{32}\.partial")
# A run that cannot go on should say so within a minute.
_ANSWER_SECONDS = 30.0
_SLOWEST_BYTES_PER_SECOND = 500_000
_ABSENT = (FileNotFoundError, NotADirectoryError)


@dataclass(frozen=True)
class Location:
    """Location of a store. It is cheap to make, to compare and to pickle, and nothing is accessed in advance.

    Methods that read or write raise a `StoreError` if the location cannot be read or written.

    Attributes:
        name: Path, or URL such as s3://bucket/name.zarr, without credentials.
        fence: Function called before every write, here and below; it raises a `StoreError` unless that is permitted.
    """

    name: str
    fence: Callable[[], None] | None = field(default=None, compare=False, repr=False)

    @classmethod
    def parse(cls, store: str | Path | Location) -> Location:
        """Return the location that a path or URL names; StoreError, without secrets, where it cannot name a store."""
        if isinstance(store, Location):
            return store
        if (url := _URL.match(str(store))) is None:
            return cls(_folder_name(store))
        scheme, separator, rest = url.groups()
        if separator == "::" or "::" in rest:
            raise StoreError(f"{scheme}::...: a chain of URLs cannot hold a store; name the last of them alone")
        if scheme in _FOLDER_SCHEMES:
            return cls(str(Path(rest)))
        _require_no_credentials(scheme, rest)
        if scheme in _EXTRAS and not all(rest.rstrip("/").partition("/")):
            raise StoreError(f"{store}: names no place in a bucket; a store lies at {scheme}://bucket/name.zarr")
        return cls(f"{scheme}://{rest.rstrip('/')}")

    def __str__(self) -> str:
        return self.name

    @property
    def scheme(self) -> str:
        """Scheme of the URL; empty for a local path."""
        url = _URL.match(self.name)
        return url[1] if url else ""

    @property
    def is_in_memory(self) -> bool:
        """True if no other process can see the store."""
        return self.scheme == "memory"

    def absolute(self) -> Location:
        """Return the same location for processes that were started in another folder."""
        return self if self.scheme else replace(self, name=str(Path(self.name).absolute()))

    def below(self, name: str) -> Location:
        """Return the location of a name below this one; ForeignError where it is a link."""
        return replace(self, name=f"{self.name}/{name}" if self.scheme else str(path_in(self.name, name)))

    def beside(self, name: str) -> Location:
        """Return the location of a name in the folder of this one; the empty name is the folder itself."""
        if not self.scheme:
            return replace(self, name=str(Path(self.name).absolute().parent / name))
        folder = self.name.rpartition("/")[0]
        return replace(self, name=f"{folder}/{name}" if name or folder.endswith("/") else folder)

    def zarr_store(self, largest_bytes: int = 0) -> FolderStore | RemoteStore:
        """Return the store that zarr and xarray take to read and write here."""
        return _remote_store(self.name, self.scheme, largest_bytes) if self.scheme else FolderStore(self.name)

    def read(self, key: str, most_bytes: int | None = None) -> bytes | None:
        """Return the bytes of a key, or None if it does not exist."""
        with self.access("read"):
            if isinstance(store := self.zarr_store(), FolderStore):
                return store.content(key, most_bytes)
            content = sync(store.get(key, default_buffer_prototype()))
            return None if content is None else content.to_bytes()

    def write(self, documents: Mapping[str, bytes]) -> None:
        """Write small documents by their keys, in any order. Each is replaced as a whole."""
        if isinstance(store := self.zarr_store(), FolderStore):
            with self.access("written"):
                for key, document in documents.items():
                    store.put(key, document)
            return

        async def write_all() -> None:
            writes = (store.set(key, CpuBuffer.from_bytes(document)) for key, document in documents.items())
            # All are awaited, since asyncio logs failures that nobody retrieved.
            for outcome in await asyncio.gather(*writes, return_exceptions=True):
                if isinstance(outcome, BaseException):
                    raise outcome

        with self.access("written"):
            sync(write_all())

    def create(self, key: str, document: bytes) -> bool:
        """Write a small document that nobody else writes unless its key exists, and return whether it was written.

        Of several processes one succeeds; without conditional writes it is the last one: read the key again later.
        """
        with self.access("written"):
            sync(self.zarr_store().set_if_not_exists(key, CpuBuffer.from_bytes(document)))
        # After a request whose answer was lost, a driver is told that its own key exists.
        return self.read(key) == document

    def discard(self, *keys: str) -> None:
        """Remove keys, those of them that exist."""
        with self.access("written"), suppress(NotADirectoryError):
            sync(self.zarr_store().delete_keys(keys))

    def remove(self, prefix: str) -> None:
        """Remove all keys below a prefix."""
        store = self.zarr_store()
        with self.access("written"), suppress(NotADirectoryError):
            sync(store.delete(prefix) if isinstance(store, FolderStore) else store.delete_dir(prefix))

    def remove_partial_files(self, besides: Collection[str] = ()) -> None:
        """Remove what killed writers left of keys, but not in folders of some names. No other run may be writing."""
        with self.access("read"):
            files = () if self.scheme else _files_below(self.name, {os.path.join(self.name, name) for name in besides})
            partial = [file.path for file in files if PARTIAL_FILE.search(file.name)]
        for path in partial:
            with self.access("written"):
                # It may have got its final name since, from a task that outlived its run.
                Path(path).unlink(missing_ok=True)

    def sizes(self, prefix: str) -> dict[str, int]:
        """Return the number of bytes of every key below a prefix."""
        with self.access("read"):
            return sync(self.zarr_store().sizes(prefix))

    def tags(self, prefix: str) -> dict[str, str]:
        """Return what object storage says of the content of every key below a prefix, another one for each content.

        Local folders, and storage that says nothing, have none.
        """
        store = self.zarr_store()
        with self.access("read"):
            entries = sync(store.entries(prefix)) if isinstance(store, RemoteStore) else {}
        tags = {key: entry.get("ETag", entry.get("etag")) for key, entry in entries.items()}
        return {key: str(tag) for key, tag in tags.items() if tag}

    def names(self) -> frozenset[str]:
        """Return the names at the first level."""
        with self.access("read"):
            return sync(self.zarr_store().names())

    def lacks_folder(self) -> str:
        """Return that no folder can hold a store here, if so: none is made, since its name may be a mistake."""
        is_there = self.scheme or (parent := Path(self.name).absolute().parent).is_dir()
        return "" if is_there else f"{self.name}: there is no folder {parent} to hold the store; make it first"

    def require_free(self, besides: Collection[str] = ()) -> None:
        """Check that a store may be created here, without writing."""
        if not self.scheme:
            path = Path(self.name)
            if path.exists() and not path.is_dir():
                raise ForeignError(f"{path}: it is a file; name a folder that is new or holds a store")
            if problem := self.lacks_folder():
                raise StoreError(problem)
        # A driver that was killed while it wrote the first key leaves a partial file.
        if any(name not in besides and not PARTIAL_FILE.search(name) for name in self.names()):
            raise ForeignError(f"{self}: the folder is not empty and holds no store; name another")

    @contextmanager
    def access(self, verb: str) -> Iterator[None]:
        """Turn failures of the storage into a `StoreError` that says why it cannot be "read" or "written".

        Put nothing but access to the location inside. Drivers of object storage have exceptions without a common base,
        so every exception counts as a failure of the access. The fence has to allow what is written.
        """
        if verb == "written" and self.fence is not None:
            self.fence()
        try:
            yield
        except StoreError:
            raise
        except Exception as error:
            if not self.scheme and not isinstance(error, OSError):
                raise  # This is a defect.
            text = " ".join((getattr(error, "strerror", None) or str(error) or type(error).__name__).split())
            if not self.scheme and (place := getattr(error, "filename", None)):
                text += f": {place}"
            is_full = is_for_want_of_space(error)
            text += "; make room there" if is_full else ""
            if self.scheme:
                # The address of a server may contain a password.
                text = self._explain(error, re.sub(r"//[^/\s]*@", "//", text))
            raise (SpaceError if is_full else StoreError)(f"{self}: the store cannot be {verb}: {text}") from error

    def _explain(self, error: Exception, text: str) -> str:
        """Return the reason of a failure of object storage, and its remedy."""
        if _lacks_bucket(error) or (self.scheme in _EXTRAS and isinstance(error, FileNotFoundError)):
            return f"there is no bucket {self.name.split('/')[2]!r} ({text})"
        if isinstance(error, TimeoutError):
            return f"nothing answers there within {_ANSWER_SECONDS:g} s"
        if "Credentials" in type(error).__name__:
            return f"no credentials ({text}); set those of {self.scheme}:// in the environment of every process"
        if isinstance(error, PermissionError):
            return f"access is denied ({text}); check the credentials in the environment and what they allow"
        return text


def _folder_name(store: str | Path) -> str:
    if not str(store) or "\0" in str(store):
        raise StoreError(f"the path of a store must be neither empty nor hold a null character, found {store!r}")
    first = next(iter(path_of(store).parts), "")
    if first.endswith(":") and first[:-1] in available_protocols():
        # The rest may hold a password.
        raise StoreError(f"this begins with {first}/ and a URL with {first}//; a Path cannot hold a URL, a text can")
    # It is expanded here, since libraries underneath would do so in some places and not in others.
    try:
        return str(Path(store).expanduser())
    except RuntimeError as error:
        raise StoreError(f"{store}: {error}; name a folder, or ./~... for one of that name") from error


def _require_no_credentials(scheme: str, rest: str) -> None:
    advice = "credentials and options come from the environment of each process, see docs/store.md"
    if "?" in rest:
        raise StoreError(f"a {scheme}:// URL of a store with a query in it; {advice}")
    # A secret may hold slashes, so all of it is searched. An Azure URL has an @, but no colon before it.
    before, at, _ = rest.partition("@")
    if at and (":" in before or (scheme in _EXTRAS and "/" not in before)):
        raise StoreError(f"a {scheme}:// URL of a store with credentials in it; {advice}")


def path_in(root: str | Path, key: str) -> Path:
    """Return the path of a key of a store in a folder. The folder itself may be reached by a link."""
    if key.startswith("/") or ".." in key.split("/"):
        raise StoreError(f"{root}: {key} leads out of the store")
    path = os.fspath(root)
    # Names are looked at one by one: resolving a whole path takes ten times as long, and each record is a key.
    for name in filter(None, key.split("/")):
        path = f"{path}/{name}"
        try:
            mode = os.lstat(path).st_mode
        except _ABSENT:
            break
        if stat.S_ISLNK(mode):
            raise ForeignError(f"{path}: a link, which may lead out of the store; put what it leads to in its place")
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise ForeignError(f"{path}: neither a file nor a folder, in a store; remove it")
    return Path(root) / key


class _Root(type(Path())):  # type: ignore[misc]  # that of this system; before Python 3.12 a plain Path has no subclass
    """The folder of a store, below which no link is followed."""

    def __truediv__(self, key: str) -> Path:
        return path_in(os.fspath(self), key)


class FolderStore(LocalStore):
    """zarr's store in a folder, which follows no link in it: all its paths are made from the root and a key."""

    def __init__(self, root: Path | str, *, read_only: bool = False) -> None:
        super().__init__(_Root(root), read_only=read_only)

    async def _open(self, *, mode: AccessModeLiteral | None = None) -> None:
        # That of zarr makes the folder, also of a store that is only read.
        self._is_open = True

    def content(self, key: str, most_bytes: int | None = None) -> bytes | None:
        """Return what a file holds, None where there is none: `get` takes milliseconds to go to another thread."""
        path = self.root / key
        try:
            # A file may be sparse, and larger than the memory.
            if most_bytes is not None and path.stat().st_size > most_bytes:
                problem = f"{key} has more than {most_bytes} bytes"
                raise DamageError(f"{self.root}: {problem}", problem)
            return path.read_bytes()
        except (*_ABSENT, IsADirectoryError):
            return None

    def put(self, key: str, content: bytes) -> None:
        """Replace a file as a whole, as `set` does."""
        path = self.root / key
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(f".{uuid4().hex}.partial")
        try:
            partial.write_bytes(content)
            partial.replace(path)
        except Exception:
            partial.unlink(missing_ok=True)
            raise

    async def delete_keys(self, keys: Sequence[str]) -> None:
        """Remove the files of keys that exist."""
        for key in keys:
            await self.delete(key)

    async def names(self) -> frozenset[str]:
        """Return the names of files and folders."""
        return frozenset([name async for name in self.list_dir("")])

    async def sizes(self, prefix: str) -> dict[str, int]:
        """Return the sizes of all files below a prefix; links count as empty, and are refused once they are read."""
        sizes, root = {}, len(os.path.join(self.root, ""))
        for file in _files_below(path_in(self.root, prefix)):
            with suppress(FileNotFoundError):  # It was removed since.
                is_file = file.is_file(follow_symlinks=False)
                sizes[file.path[root:]] = file.stat(follow_symlinks=False).st_size if is_file else 0
        return sizes


def _files_below(folder: str | Path, besides: Collection[str] = ()) -> Iterator[os.DirEntry[str]]:
    """Yield what lies below a folder, and not some others, and is no folder: twice as fast as os.walk for many."""
    folders = [os.fspath(folder)]
    while folders:
        # It may be removed meanwhile, or be no folder. What cannot be read is not missing.
        with suppress(*_ABSENT), os.scandir(folders.pop()) as entries:
            for entry in entries:
                if not entry.is_dir(follow_symlinks=False):
                    yield entry
                elif entry.path not in besides:
                    folders.append(entry.path)


def _in_time(size_bytes: int = 0) -> asyncio.Timeout:
    """Return the limit of a request and of all its repetitions by the driver."""
    return asyncio.timeout(_ANSWER_SECONDS + size_bytes / _SLOWEST_BYTES_PER_SECOND)


class RemoteStore(FsspecStore):
    """zarr's store behind a driver of fsspec."""

    largest_bytes = 0

    def with_read_only(self, read_only: bool = False) -> Self:
        """Return the same store, to be read only or not."""
        store = cast(Self, super().with_read_only(read_only))
        store.largest_bytes = self.largest_bytes
        return store

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """Return the bytes of a key or of a range of it, or None if it does not exist."""
        async with _if_present(self.largest_bytes):
            return await super().get(key, prototype, byte_range)
        return None

    async def set(self, key: str, value: Buffer, byte_range: tuple[int, int] | None = None) -> None:
        """Replace a key."""
        async with _in_time(len(value)):
            await super().set(key, value, byte_range)

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Write a key by a conditional request."""
        with suppress(FileExistsError):
            async with _in_time():
                await self.fs._pipe_file(f"{self.path}/{key}", value.to_bytes(), mode="create")

    async def delete(self, key: str) -> None:
        """Remove a key if it exists."""
        async with _if_present():
            await self.fs._rm_file(f"{self.path}/{key}")

    async def delete_keys(self, keys: Sequence[str]) -> None:
        """Remove keys that exist, several by one request."""
        if len(keys) == 1:
            await self.delete(keys[0])
            return
        async with _if_present():
            # Drivers take a path for a pattern.
            await self.fs._rm([escape(f"{self.path}/{key}") for key in keys])

    async def delete_dir(self, prefix: str) -> None:
        """Remove all keys below a prefix."""
        path = f"{self.path}/{prefix}"
        async with _if_present():
            # A server may remove some of them only, and s3fs neither checks nor repeats.
            for _ in range(2):
                await self.fs._rm(path, recursive=True)
                if not (remaining := await self.fs._find(path)):
                    return
            raise OSError(f"{len(remaining)} keys are still there, such as {remaining[0]}")

    async def names(self) -> frozenset[str]:
        """Return the names of keys at the first level."""
        async with _in_time():
            # The name alone may stand for a folder that was emptied; only existing keys are listed.
            paths = await self.fs._ls(self.path, detail=False) if await self.fs._exists(self.path) else ()
        return frozenset(path.rstrip("/").rpartition("/")[2] for path in paths)

    async def sizes(self, prefix: str) -> dict[str, int]:
        """Return the sizes of all keys below a prefix."""
        return {key: entry["size"] for key, entry in (await self.entries(prefix)).items()}

    async def entries(self, prefix: str) -> dict[str, dict[str, Any]]:
        """Return what is listed of all keys below a prefix."""
        async with _in_time():
            entries = await self.fs._find(f"{self.path}/{prefix}", detail=True)
        return {path.removeprefix(f"{self.path}/"): entry for path, entry in entries.items()}


@cache
def _remote_store(url: str, scheme: str, largest_bytes: int) -> RemoteStore:
    """Return the store at a URL, whose connections all threads share: fsspec would open others for each of them."""
    # fsspec remembers listings, but other processes write to the same store.
    options: dict[str, Any] = {"use_listings_cache": False}
    if scheme in ("s3", "s3a"):
        # Otherwise s3fs requests the size of each key first, and does not repeat a range that breaks off.
        options["max_concurrency"] = 1
    try:
        store = cast(RemoteStore, RemoteStore.from_url(url, options, allowed_exceptions=()))
    except ImportError as error:
        extra = _EXTRAS.get(scheme)
        remedy = f"pip install 'sobolev-batch[{extra}]'" if extra else "install it"
        raise StoreError(f"{url}: the driver of {scheme}:// is missing here ({error}): {remedy}") from error
    except ValueError as error:
        raise StoreError(f"{url}: no store can lie there ({error}); name a folder or an s3:// URL") from error
    store.largest_bytes = largest_bytes
    return store


# A child has no thread that would answer.
os.register_at_fork(after_in_child=_remote_store.cache_clear)


@asynccontextmanager
async def _if_present(size_bytes: int = 0) -> AsyncIterator[None]:
    """Limit the time of a request, and ignore that its key is missing, but not that its bucket is."""
    try:
        async with _in_time(size_bytes):
            yield
    except _ABSENT as error:
        if _lacks_bucket(error):
            raise


def _lacks_bucket(error: Exception) -> bool:
    """Return whether the bucket is missing, for drivers that report a missing key in the same way."""
    response: Any = getattr(error.__cause__, "response", None)
    return isinstance(response, dict) and response.get("Error", {}).get("Code") == "NoSuchBucket"
