"""Stores in a folder. No link below the folder is followed.

A store may come from somebody else. A link in it may lead to a device that never ends, or make a run write
outside of the store. Checksums would reveal a wrong chunk only after it was read.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

from zarr.storage import LocalStore

from sobolev_batch.errors import StoreError

# zarr gives files such names, too, until they are complete.
PARTIAL_FILE = re.compile(r"\.[0-9a-f]{32}\.partial")


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


def _checked(method: Callable[..., Any]) -> Callable[..., Any]:
    def call(self: FolderStore, key: str, *arguments: Any, **options: Any) -> Any:
        path_in(self.root, key)
        return method(self, key, *arguments, **options)

    return call


for _name in ("get", "get_sync", "set", "set_sync", "set_if_not_exists", "delete", "delete_sync"):
    if hasattr(LocalStore, _name):  # some came with newer versions of zarr
        setattr(FolderStore, _name, _checked(getattr(LocalStore, _name)))


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
            raise StoreError(f"{self._path}: {key} has more than {most_bytes} bytes")
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
        for folder, _, names in os.walk(os.path.join(self._path, prefix)):
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
            raise StoreError(f"{path}: a file is there; name a folder that is new or holds a store")
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
