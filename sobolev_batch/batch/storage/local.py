"""Containment: what is read and written of a store in a folder lies there; no link below that folder is followed.

A store may come from somebody else, and a link in it may lead to a device that never ends, or have a run
write beside what it was given. Checksums would tell of a wrong chunk only after it was read.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Any

from zarr.storage import LocalStore

from sobolev_batch.errors import StoreError


def place_of(root: str | Path, key: str) -> Path:
    """Where a key of a store in a folder lies. The folder itself may be reached by a link.

    Raises:
        StoreError: the key climbs out of the folder, or something on its way is a link or no regular file.
    """
    if key.startswith("/") or ".." in key.split("/"):
        raise StoreError(f"{root}: {key} leads out of the store")
    here = os.fspath(root)
    # Looked at one by one, since resolving a whole path takes ten times as long, and each record is a key.
    for part in filter(None, key.split("/")):
        here = f"{here}/{part}"
        try:
            mode = os.lstat(here).st_mode
        except (FileNotFoundError, NotADirectoryError):
            break
        if stat.S_ISLNK(mode):
            raise StoreError(f"{here}: a link, which may lead out of the store; put what it leads to in its place")
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise StoreError(f"{here}: neither a file nor a folder, in a store; remove it")
    return Path(root) / key


class ContainedStore(LocalStore):
    """zarr's store in a folder, which follows no link in it."""

    async def get(self, key: str, *arguments: Any, **options: Any) -> Any:
        """Read a key."""
        place_of(self.root, key)
        return await super().get(key, *arguments, **options)

    def get_sync(self, key: str, *arguments: Any, **options: Any) -> Any:
        """Read a key, as newer versions of zarr do."""
        place_of(self.root, key)
        return super().get_sync(key, *arguments, **options)

    async def set(self, key: str, *arguments: Any, **options: Any) -> None:
        """Write a key."""
        place_of(self.root, key)
        await super().set(key, *arguments, **options)

    async def set_if_not_exists(self, key: str, *arguments: Any, **options: Any) -> None:
        """Write a key where there is none."""
        place_of(self.root, key)
        await super().set_if_not_exists(key, *arguments, **options)

    def set_sync(self, key: str, *arguments: Any, **options: Any) -> None:
        """Write a key, as newer versions of zarr do."""
        place_of(self.root, key)
        super().set_sync(key, *arguments, **options)

    async def delete(self, key: str) -> None:
        """Remove a key."""
        place_of(self.root, key)
        await super().delete(key)

    def delete_sync(self, key: str) -> None:
        """Remove a key, as newer versions of zarr do."""
        place_of(self.root, key)
        super().delete_sync(key)
