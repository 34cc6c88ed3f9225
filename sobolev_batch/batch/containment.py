"""Containment: what is read and written of a store in a folder lies in that folder, whatever links are there.

A store may come from somebody else, and a link in it may lead to a device that never ends, or have a run
write beside what it was given. Checksums would tell of a wrong chunk only after it was read.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from zarr.storage import LocalStore

from sobolev_batch.errors import StoreError


def place_of(root: str | Path, key: str) -> Path:
    """Where a key of a store in a folder lies. The folder itself may be reached by a link.

    Raises:
        StoreError: a link leads out of the folder, or the key is no regular file.
    """
    path = Path(root) / key
    real_root, real = os.path.realpath(root), os.path.realpath(path)
    if os.path.commonpath([real_root, real]) != real_root:
        raise StoreError(f"{root}: {key} leads out of the store, to {real}; put what belongs there in its place")
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise StoreError(f"{root}: {key} is neither a file nor a folder; remove it")
    return path


class ContainedStore(LocalStore):
    """zarr's store in a folder, which follows no link out of it."""

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
