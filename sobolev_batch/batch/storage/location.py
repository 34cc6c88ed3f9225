"""Locations of stores: a local folder, or a URL of object storage.

A location holds no credentials, so it can be stored, logged and sent to a worker.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from fsspec import available_protocols
from zarr.abc.store import Store as ZarrStore

from sobolev_batch.batch.storage.stores import BUCKET_SCHEMES, PARTIAL_FILE, Folder, ObjectStorage
from sobolev_batch.errors import SobolevBatchError, StoreError

_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)(://|::)(.*)", re.DOTALL)
_FOLDER_SCHEMES = ("file", "local")


@dataclass(frozen=True)
class Location:
    """Location of a store. It is cheap to make, to compare and to pickle, and nothing is accessed in advance.

    Methods that read or write raise a `StoreError` if the location cannot be read or written.

    Attributes:
        name: Path, or URL such as s3://bucket/name.zarr, without credentials.
        fence: Function that raises a `StoreError` unless the location may be written; called before every write.
    """

    name: str
    fence: Callable[[Location], None] | None = field(default=None, compare=False, repr=False)

    @classmethod
    def parse(cls, store: str | Path | Location) -> Location:
        """Return the location that a path or URL names.

        Raises:
            StoreError: The URL holds credentials or cannot name a store. The message does not repeat secrets.
        """
        if isinstance(store, Location):
            return store
        url = _URL.match(str(store))
        if url is None:
            return cls(_folder_name(store))
        scheme, separator, rest = url.groups()
        if separator == "::" or "::" in rest:
            raise StoreError(f"{scheme}::...: a chain of URLs cannot hold a store; name the last of them alone")
        if scheme in _FOLDER_SCHEMES:
            return cls(str(Path(rest)))
        _require_no_credentials(scheme, rest)
        if scheme in BUCKET_SCHEMES and not all(rest.rstrip("/").partition("/")):
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

    def fenced(self, fence: Callable[[Location], None]) -> Location:
        """Return the same location for writers that have to stop once a condition fails."""
        return replace(self, fence=fence)

    def below(self, name: str) -> Location:
        """Return the location of a name below this one."""
        return Location(f"{self.name}/{name}" if self.scheme else str(Path(self.name) / name))

    def zarr_store(self, largest_bytes: int = 0) -> ZarrStore:
        """Return the store that zarr and xarray take to read and write here.

        Args:
            largest_bytes: Largest size of one key.

        Raises:
            StoreError: The scheme is unknown, or its driver is not installed.
        """
        return self._storage.zarr_store(largest_bytes)

    def read(self, key: str, most_bytes: int | None = None) -> bytes | None:
        """Return the bytes of a key, or None if it does not exist.

        Args:
            key: Key below this location.
            most_bytes: Largest size that a file may have.

        Raises:
            StoreError: The location cannot be read, does not answer within seconds, or the key is too large.
        """
        with self.access("read"), self._absence_ignored():
            return self._storage.read(key, most_bytes)
        return None

    def write(self, documents: Mapping[str, bytes]) -> None:
        """Write small documents by their keys, in any order. Each is replaced as a whole."""
        with self.access("written"):
            self._storage.write(documents)

    def create(self, key: str, document: bytes) -> bool:
        """Write a small document unless its key exists, and return whether it was written.

        Of several processes that try, one succeeds. Storage without conditional writes lets the last one win:
        read the key again later.

        Raises:
            StoreError: The location cannot be written, or the folder that should hold it does not exist.
        """
        with self.access("written"):
            try:
                self._storage.create(key, document)
            except FileExistsError:
                return False
        return True

    def is_folder(self) -> bool:
        """Return whether the location is a local folder that exists."""
        return not self.scheme and Path(self.name).is_dir()

    def discard(self, key: str) -> None:
        """Remove a key if it exists."""
        with self.access("written"), self._absence_ignored():
            self._storage.delete(key)

    def remove(self, prefix: str) -> None:
        """Remove all keys below a prefix."""
        with self.access("written"), self._absence_ignored():
            self._storage.delete_all(prefix)

    def remove_empty_folder(self) -> None:
        """Remove the local folder if nothing is in it."""
        if not self.scheme:
            with suppress(OSError):  # it holds a store
                Path(self.name).rmdir()

    def remove_partial_files(self) -> None:
        """Remove what writers left behind that were killed in the middle of a key. No other run may be writing."""
        with self.access("written"):
            if isinstance(self._storage, Folder):
                self._storage.delete_partial_files()

    def sizes(self, prefix: str) -> dict[str, int]:
        """Return the number of bytes of every key below a prefix."""
        with self.access("read"):
            return self._storage.sizes(prefix)

    def names(self) -> set[str]:
        """Return the names at the first level."""
        with self.access("read"):
            return self._storage.names()

    def require_free(self, besides: Collection[str] = ()) -> None:
        """Check that a store may be created here, without writing.

        Args:
            besides: Names that may exist already.

        Raises:
            StoreError: The location holds something else, cannot be read, or has no parent folder.
        """
        if isinstance(self._storage, Folder):
            self._storage.require_usable()
        # A driver that was killed while it wrote the first key leaves a partial file.
        if any(name not in besides and not PARTIAL_FILE.search(name) for name in self.names()):
            raise StoreError(f"{self}: the folder is not empty and holds no store; name another")

    @contextmanager
    def access(self, verb: str) -> Iterator[None]:
        """Turn failures of the storage into a `StoreError` that says why it cannot be read or written.

        Put nothing but access to the location inside. Drivers of object storage have exceptions without a common
        base, so every exception counts as a failure of the access.

        Args:
            verb: Kind of access: "read", or "written", which the fence has to allow.
        """
        if verb == "written" and self.fence is not None:
            self.fence(self)
        try:
            yield
        except SobolevBatchError:
            raise
        except self._storage.failures as error:
            text = " ".join((getattr(error, "strerror", None) or str(error) or type(error).__name__).split())
            if isinstance(self._storage, ObjectStorage):
                # The address of a server may contain a password.
                text = self._storage.explain(error, re.sub(r"//[^/\s]*@", "//", text))
            raise StoreError(f"{self}: the store cannot be {verb}: {text}") from error

    @contextmanager
    def _absence_ignored(self) -> Iterator[None]:
        try:
            yield
        except (FileNotFoundError, NotADirectoryError) as error:
            # A missing file is always a missing key.
            if isinstance(self._storage, ObjectStorage) and not self._storage.is_absent(error):
                raise

    @property
    def _storage(self) -> Folder | ObjectStorage:
        return ObjectStorage(self.name, self.scheme) if self.scheme else Folder(self.name)


def _folder_name(store: str | Path) -> str:
    if not str(store):
        raise StoreError("the path of the store is empty; name a folder or a URL")
    first = Path(store).parts[0] if Path(store).parts else ""
    if first.endswith(":") and first[:-1] in available_protocols():
        # The rest may hold a password.
        raise StoreError(
            f"this begins with {first}/ and a URL with {first}//; a Path cannot hold a URL, give it as a string"
        )
    # Expanded here, since libraries underneath would do so in some places and not in others.
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
    if at and (":" in before or (scheme in BUCKET_SCHEMES and "/" not in before)):
        raise StoreError(f"a {scheme}:// URL of a store with credentials in it; {advice}")
