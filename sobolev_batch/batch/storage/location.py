"""A location: where a store lies, a local folder or a URL of object storage, and how it is reached.

Credentials are never part of a location: fsspec's drivers take them from the environment of each
process, so a location can be stored, logged and sent to a worker.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

from fsspec import AbstractFileSystem, available_protocols
from fsspec.asyn import sync
from fsspec.core import url_to_fs
from zarr.abc.store import Store as ZarrStore

from sobolev_batch.batch.storage.local import ContainedStore, place_of
from sobolev_batch.batch.storage.remote import PatientKeys, put_all, remove_all
from sobolev_batch.errors import SobolevBatchError, StoreError

# Drivers repeat what fails for minutes. That helps a run that is under way; who asks whether a store is
# there wants an answer.
_ANSWER_SECONDS = 20
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)(://|::)(.*)", re.DOTALL)
_FOLDER_SCHEMES = ("file", "local")
_BUCKET_SCHEMES = ("s3", "s3a", "gs", "gcs")
_EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gcs", "gcs": "gcs"}
# s3fs asks for the size of every key first, to read the larger ones in parts of 50 MB at once.
_SIZED_SCHEMES = ("s3", "s3a")
_PART_BYTES = 50 << 20
# How zarr, too, names a file until it is whole.
_PARTIAL = ".partial"
_STRAY = re.compile(r"\.[0-9a-f]{32}\.partial")


@dataclass(frozen=True)
class Location:
    """Where a store lies. Cheap to make, to compare and to pickle; nothing is reached until it is asked.

    Attributes:
        name: a path, or a URL such as s3://bucket/name.zarr, without any credentials.
    """

    name: str

    @classmethod
    def of(cls, place: str | Path | Location) -> Location:
        """The location that a path or URL names.

        Raises:
            StoreError: a URL that holds credentials or cannot name a store; what may be secret in it
                is not repeated.
        """
        if isinstance(place, Location):
            return place
        found = _URL.match(str(place))
        if found is None:
            if not str(place):
                raise StoreError("the path of the store is empty; name a folder or a URL")
            first = Path(place).parts[0] if Path(place).parts else ""
            if first.endswith(":") and first[:-1] in available_protocols():
                # Not repeated: there may be a password in it.
                raise StoreError(
                    f"this begins with {first}/ and a URL with {first}//; a Path cannot hold a URL, give it as a string"
                )
            # Once, here: libraries underneath would expand it in some places and not in others.
            try:
                return cls(str(Path(place).expanduser()))
            except RuntimeError as error:
                raise StoreError(f"{place}: {error}; name a folder, or ./~... for one of that name") from error
        scheme, separator, rest = found.groups()
        if separator == "::" or "::" in rest:
            raise StoreError(f"{scheme}::...: a chain of URLs cannot hold a store; name the last of them alone")
        if scheme in _FOLDER_SCHEMES:
            return cls(str(Path(rest)))
        _require_no_credentials(scheme, rest)
        if scheme in _BUCKET_SCHEMES and not all(rest.rstrip("/").partition("/")):
            raise StoreError(f"{place}: names no place in a bucket; a store lies at {scheme}://bucket/name.zarr")
        return cls(f"{scheme}://{rest.rstrip('/')}")

    def __str__(self) -> str:
        return self.name

    @property
    def scheme(self) -> str:
        """The scheme of a URL; empty for a local path."""
        found = _URL.match(self.name)
        return found[1] if found else ""

    def absolute(self) -> Location:
        """The same location for processes that were started in another folder."""
        return self if self.scheme else Location(str(Path(self.name).absolute()))

    @property
    def is_of_this_process(self) -> bool:
        """Whether no other process can see what is written here."""
        return self.scheme == "memory"

    def keys(self, largest_bytes: int = 0) -> ZarrStore:
        """What zarr and xarray take to read and write here.

        Args:
            largest_bytes: what one key holds at most.

        Raises:
            StoreError: the scheme is unknown, or its driver is not installed.
        """
        if not self.scheme:
            return ContainedStore(self.name)
        self._filesystem()
        return PatientKeys.at(self.name, self._options(largest_bytes), largest_bytes)

    def read(self, key: str, most_bytes: int | None = None) -> bytes | None:
        """The bytes of a key, or None where there are none.

        Args:
            key: below this location.
            most_bytes: that it may have.

        Raises:
            StoreError: the location cannot be reached, within seconds, or not be read; or it has more bytes.
        """
        with self.access("read"):
            try:
                if not self.scheme:
                    path = place_of(self.name, key)
                    if most_bytes is not None and path.stat().st_size > most_bytes:
                        raise StoreError(f"{self}: {key} has more than {most_bytes} bytes")
                    return path.read_bytes()
                files, root = self._filesystem()
                found: bytes = files.cat_file(f"{root}/{key}", **_patience(files))
                return found
            except (FileNotFoundError, NotADirectoryError) as error:
                if _lacks_bucket(error):
                    raise
                return None

    def write(self, documents: Mapping[str, bytes]) -> None:
        """Write small documents by their keys, each at once and as a whole, in any order.

        Raises:
            StoreError: the location cannot be written.
        """
        with self.access("written"):
            if self.scheme:
                files, root = self._filesystem()
                named = {f"{root}/{key}": document for key, document in documents.items()}
                if files.async_impl:
                    sync(files.loop, put_all, files, named)
                else:
                    files.pipe(named)
                return
            for key, document in documents.items():
                path = place_of(self.name, key)
                path.parent.mkdir(parents=True, exist_ok=True)
                # A reader finds the old document or the new one, never a part of it.
                with _written(path, document) as partial:
                    partial.replace(path)

    def create(self, key: str, document: bytes) -> bool:
        """Write a small document unless its key is there; of several who try, one succeeds.

        Storage that does not know conditional writes lets the last one win: read it again later.

        Returns:
            Whether it was written.

        Raises:
            StoreError: the location cannot be written, or the folder in which it should lie is not there.
        """
        with self.access("written"):
            try:
                if self.scheme:
                    files, root = self._filesystem()
                    files.pipe_file(f"{root}/{key}", document, mode="create", **_patience(files))
                    return True
                path = place_of(self.name, key)
                path.parent.mkdir(exist_ok=True)
                with _written(path, document) as partial:
                    # Unlike a new file that is written, it is never there without its content.
                    os.link(partial, path)
            except FileExistsError:
                return False
        return True

    def is_folder(self) -> bool:
        """Whether a local folder is there."""
        return not self.scheme and Path(self.name).is_dir()

    def discard(self, key: str, *, with_folder: bool = False) -> None:
        """Remove one key, if it is there, and on request the location's folder if that leaves it empty.

        Raises:
            StoreError: it cannot be removed.
        """
        with self.access("written"):
            try:
                if self.scheme:
                    files, root = self._filesystem()
                    files.rm_file(f"{root}/{key}")
                    return
                place_of(self.name, key).unlink()
            except FileNotFoundError as error:
                if _lacks_bucket(error):
                    raise
                return
            if with_folder:
                with suppress(OSError):  # it holds a store
                    Path(self.name).rmdir()

    def sizes(self, prefix: str) -> dict[str, int]:
        """The bytes of every key below a prefix; empty where there is none.

        Raises:
            StoreError: the location cannot be reached.
        """
        with self.access("read"):
            if self.scheme:
                files, root = self._filesystem()
                found = files.find(f"{root}/{prefix}", detail=True, **_patience(files))
                return {path.removeprefix(f"{root}/"): entry["size"] for path, entry in found.items()}
            sizes = {}
            for folder, _, names in os.walk(os.path.join(self.name, prefix)):
                for name in names:
                    path = os.path.join(folder, name)
                    with suppress(FileNotFoundError):  # gone since
                        found = os.lstat(path)
                        if stat.S_ISREG(found.st_mode):
                            sizes[os.path.relpath(path, self.name).replace(os.sep, "/")] = found.st_size
            return sizes

    def sweep(self) -> None:
        """Remove what writers left behind that were killed in the middle of a key; nobody else may be writing.

        Raises:
            StoreError: it cannot be removed.
        """
        if not self.scheme:  # object storage shows a key when the whole of it is there
            with self.access("written"):
                for folder, _, names in os.walk(self.name):
                    for name in names:
                        if _STRAY.search(name):
                            # It may have got its name since, from a task that outlived its run.
                            (Path(folder) / name).unlink(missing_ok=True)

    def remove(self, prefix: str) -> None:
        """Remove everything below a prefix, if anything is there.

        Raises:
            StoreError: it cannot be removed.
        """
        with self.access("written"):
            try:
                if self.scheme:
                    files, root = self._filesystem()
                    if files.async_impl:
                        sync(files.loop, remove_all, files, f"{root}/{prefix}")
                    else:
                        files.rm(f"{root}/{prefix}", recursive=True)
                else:
                    shutil.rmtree(place_of(self.name, prefix))
            except FileNotFoundError as error:
                if _lacks_bucket(error):
                    raise

    def names(self) -> set[str]:
        """The names of what lies here at the first level; empty where nothing is.

        Raises:
            StoreError: the location cannot be reached.
        """
        with self.access("read"):
            if not self.scheme:
                return set(os.listdir(self.name)) if Path(self.name).exists() else set()
            files, root = self._filesystem()
            # The name alone may stand for a folder that was emptied; only what exists is listed.
            if not files.exists(root, **_patience(files)):
                return set()
            return {path.rstrip("/").rpartition("/")[2] for path in files.ls(root, detail=False, **_patience(files))}

    def require_free(self, besides: Collection[str] = ()) -> None:
        """Check that a store may be laid out here, as far as can be told without writing.

        Args:
            besides: the names of what may lie here already.

        Raises:
            StoreError: something is there, it cannot be reached, or there is no folder to hold it.
        """
        path = Path(self.name)
        if not self.scheme and path.exists() and not path.is_dir():
            raise StoreError(f"{self}: a file is there; name a folder that is new or holds a store")
        # Of a driver that was killed while it wrote the first key, only its stray is there.
        if any(name not in besides and not _STRAY.search(name) for name in self.names()):
            raise StoreError(f"{self}: the folder is not empty and holds no store; name another")
        if not self.scheme and not path.absolute().parent.is_dir():
            raise StoreError(f"{self}: there is no folder {path.absolute().parent} to hold the store; make it first")

    @contextmanager
    def access(self, verb: str) -> Iterator[None]:
        """Have what fails inside raise a `StoreError` that says why the store cannot be read or written.

        Nothing but access to the location belongs inside: drivers of object storage have exceptions
        of their own, with no base in common, so all are taken for failures of the access.
        """
        try:
            yield
        except SobolevBatchError:
            raise
        except Exception as error:
            if not self.scheme and not isinstance(error, OSError):
                raise
            raise StoreError(f"{self}: the store cannot be {verb}: {self._reason(error)}") from error

    def _options(self, largest_bytes: int) -> dict[str, Any]:
        # fsspec remembers listings, but other processes write to the same store.
        options: dict[str, Any] = {"use_listings_cache": False}
        if self.scheme in _SIZED_SCHEMES and largest_bytes <= _PART_BYTES:
            options["max_concurrency"] = 1
        return options

    def _filesystem(self) -> tuple[AbstractFileSystem, str]:
        try:
            files, root = url_to_fs(self.name, **self._options(0))
        except ImportError as error:
            extra = _EXTRAS.get(self.scheme)
            remedy = f"pip install 'sobolev-batch[{extra}]'" if extra else "install it"
            raise StoreError(f"{self}: the driver of {self.scheme}:// is missing here ({error}): {remedy}") from error
        except ValueError as error:
            raise StoreError(f"{self}: no store can lie there ({error}); name a folder or an s3:// URL") from error
        return files, str(root)

    def _reason(self, error: Exception) -> str:
        text = " ".join((getattr(error, "strerror", None) or str(error) or type(error).__name__).split())
        # An endpoint, too, can be given with a password in it.
        text = re.sub(r"//[^/\s]*@", "//", text)
        if not self.scheme:
            return text
        if _lacks_bucket(error) or (self.scheme in _BUCKET_SCHEMES and isinstance(error, FileNotFoundError)):
            return f"there is no bucket {self.name.split('/')[2]!r} ({text})"
        if isinstance(error, TimeoutError):
            return f"nothing answers there within {_ANSWER_SECONDS} s"
        if "Credentials" in type(error).__name__:
            return f"no credentials ({text}); set those of {self.scheme}:// in the environment of every process"
        if isinstance(error, PermissionError):
            return f"access is denied ({text}); check the credentials in the environment and what they allow"
        return text


@contextmanager
def _written(path: Path, document: bytes) -> Iterator[Path]:
    """A file beside a path, for its content to be put in place at once; nothing of it is left where that fails."""
    partial = path.with_name(f"{path.name}.{uuid4().hex}{_PARTIAL}")
    try:
        partial.write_bytes(document)
        yield partial
    finally:
        partial.unlink(missing_ok=True)


def _require_no_credentials(scheme: str, rest: str) -> None:
    advice = "credentials and options come from the environment of each process, see docs/store.md"
    if "?" in rest:
        raise StoreError(f"a {scheme}:// URL of a store with a query in it; {advice}")
    # A secret may hold slashes, so the whole is searched. An Azure URL has an @, but no colon before it.
    before, at, _ = rest.partition("@")
    if at and (":" in before or (scheme in _BUCKET_SCHEMES and "/" not in before)):
        raise StoreError(f"a {scheme}:// URL of a store with credentials in it; {advice}")


def _lacks_bucket(error: Exception) -> bool:
    """Whether a driver that reports a missing bucket like a missing key met the former."""
    response: Any = getattr(error.__cause__, "response", None)
    return isinstance(response, dict) and response.get("Error", {}).get("Code") == "NoSuchBucket"


def _patience(files: AbstractFileSystem) -> dict[str, Any]:
    """How long to wait for one call of a filesystem that speaks to a network."""
    return {"timeout": _ANSWER_SECONDS} if files.async_impl else {}
