"""Stores whose keys are compared with what was recorded of them, before zarr decodes them.

The checksum in a chunk says that the chunk is whole. It does not say that it is the right one: two chunks of equal
length may trade places, and a backup may bring an old one back.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import google_crc32c
import numpy as np
from numpy.typing import NDArray
from zarr.abc.store import ByteRequest
from zarr.abc.store import Store as ZarrStore
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import WrapperStore

from sobolev_batch.errors import DamageError

MISSING = "it is not there"
CHANGED = "it is not what was written"
# Of the codec of strings: the number of strings, and the length of the first one.
_STRING_HEADER_BYTES, _CHECKSUM_BYTES = 8, 4


def digest_of(content: bytes) -> str:
    """Return the SHA-256 of the content of a key."""
    return hashlib.sha256(content).hexdigest()


def document_digest(document: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a JSON document, however it is spelled."""
    return digest_of(json.dumps(document, sort_keys=True, separators=(",", ":")).encode())


def checksum_of(values: NDArray[Any]) -> int:
    """Return the CRC-32C of a C-ordered array."""
    data: Any = values.view(np.uint8).reshape(-1)
    # The library takes only what cannot change while it reads.
    data.flags.writeable = False
    return int(google_crc32c.value(data))


@dataclass(frozen=True)
class RecordedChunks:
    """Array along meshes of which each record has a checksum of the values of every chunk of its row.

    Attributes:
        name: Path of the array.
        records: Path of the array of records, one in each chunk.
        shape: Shape of the array.
        chunks: Shape of a chunk, which is one row long.
        dtype: Data type.
        first: Number of the checksum of the first chunk of a row; negative if counted from the last one.
    """

    name: str
    records: str
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: str
    first: int = 0

    def place(self, key: str) -> tuple[int, ...] | None:
        """Return the index of the chunk with a key; None for other keys."""
        prefix = f"{self.name}/c/"
        return tuple(map(int, key.removeprefix(prefix).split("/"))) if key.startswith(prefix) else None

    def fits(self, place: tuple[int, ...], content: bytes | None, record: bytes | None) -> bool:
        """Tell whether a chunk is the one that the record of its row tells of; true if that tells of none."""
        table = _table_of(record)
        checksums = table.get("checksums", ())
        if not checksums:
            return True
        if table.get("row") != place[0]:
            return False
        counts = [-(-length // step) for length, step in zip(self.shape[1:], self.chunks[1:], strict=True)]
        number = self.first + int(np.ravel_multi_index(place[1:], counts))
        size = math.prod(self.chunks) * np.dtype(self.dtype).itemsize
        if content is None or len(content) != size + _CHECKSUM_BYTES or number >= len(checksums):
            return False
        values = np.frombuffer(content, self.dtype, math.prod(self.chunks)).reshape(self.chunks[1:])
        starts = (index * step for index, step in zip(place[1:], self.chunks[1:], strict=True))
        within = tuple(slice(0, length - start) for length, start in zip(self.shape[1:], starts, strict=True))
        return bool(checksum_of(np.ascontiguousarray(values[within])) == checksums[number])


class CheckedStore(WrapperStore[ZarrStore]):
    """zarr's store whose keys are compared with digests and with the checksums in records as they are read.

    Args:
        store: Store to read from.
        name: Path or URL of the store, for messages.
        digests: Digest of the content of each key that has one.
        recorded: Arrays whose chunks are held against the records of their rows.
    """

    def __init__(
        self, store: ZarrStore, name: str, digests: Mapping[str, str], recorded: Sequence[RecordedChunks] = ()
    ) -> None:
        super().__init__(store)
        self._name, self._digests, self._recorded = name, digests, recorded
        # Records are read once, unless a chunk does not fit: then a run may have replaced both.
        self._records: dict[str, bytes | None] = {}

    def _with_store(self, store: ZarrStore) -> Self:
        return type(self)(store, self._name, self._digests, self._recorded)

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """Return the bytes of a key.

        Raises:
            DamageError: They are not what was written.
        """
        found = await super().get(key, prototype, byte_range)
        if byte_range is not None:
            return found
        if key in self._digests:
            self._require_digest(key, found)
        for array in self._recorded:
            if (place := array.place(key)) is not None:
                await self._require_recorded(array, place, found, prototype)
        if found is not None and self._is_record(key):
            self._require_record(key, found.to_bytes())
        return found

    def _require_digest(self, key: str, found: Buffer | None) -> None:
        if found is None or digest_of(found.to_bytes()) != self._digests[key]:
            problem = MISSING if found is None else CHANGED
            raise DamageError(
                f"{self._name}: {_array_of(key)} is damaged ({problem}), or a run has replaced it since it was opened; "
                "open the store again, and run the study again if it stays so",
                problem,
            )

    def _is_record(self, key: str) -> bool:
        groups = {array.records.partition("/")[0] for array in self._recorded}
        return "/c/" in key and key.partition("/")[0] in groups

    def _require_record(self, key: str, content: bytes) -> None:
        row = int(key.rpartition("/")[2])
        values, checksum = content[:-_CHECKSUM_BYTES], content[-_CHECKSUM_BYTES:]
        is_whole = google_crc32c.value(values).to_bytes(_CHECKSUM_BYTES, "little") == checksum
        if not is_whole or _table_of(content).get("row") != row:
            raise DamageError(
                f"{self._name}: row {row} of {_array_of(key)} is damaged ({CHANGED}); sobolev-batch verify names the "
                "mesh, and run computes it again",
                CHANGED,
                row,
            )

    async def _require_recorded(
        self, array: RecordedChunks, place: tuple[int, ...], found: Buffer | None, prototype: BufferPrototype
    ) -> None:
        content = None if found is None else found.to_bytes()
        key = f"{array.records}/c/{place[0]}"
        for is_known in (key in self._records, False):
            if not is_known:
                record = await super().get(key, prototype)
                self._records[key] = None if record is None else record.to_bytes()
            if array.fits(place, content, self._records[key]):
                return
        problem = MISSING if content is None else CHANGED
        raise DamageError(
            f"{self._name}: row {place[0]} of {array.name} is damaged ({problem}), or a run has just replaced it; "
            "sobolev-batch verify names the mesh, and run computes it again",
            problem,
            place[0],
        )


class NotingStore(WrapperStore[ZarrStore]):
    """zarr's store that notes the digest of every key that is written.

    Args:
        store: Store to write to.
        digests: Digests by their keys, which are added to.
    """

    def __init__(self, store: ZarrStore, digests: dict[str, str]) -> None:
        super().__init__(store)
        self._digests = digests

    def _with_store(self, store: ZarrStore) -> Self:
        return type(self)(store, self._digests)

    async def set(self, key: str, value: Buffer) -> None:
        """Replace a key, and note its digest."""
        await super().set(key, value)
        self._digests[key] = digest_of(value.to_bytes())


def _array_of(key: str) -> str:
    return key.partition("/c/")[0].removesuffix("/c")


def _table_of(record: bytes | None) -> dict[str, Any]:
    """Return the table in the chunk of a record; an empty one if it is damaged, or there is none."""
    try:
        return dict(json.loads((record or b"")[_STRING_HEADER_BYTES:-_CHECKSUM_BYTES]))
    except (ValueError, TypeError):
        return {}
