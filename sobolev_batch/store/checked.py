"""Chunks that are checked before zarr decodes them.

zarr raises exceptions of many kinds for broken chunks, and takes any memory for texts whose count is damaged.
"""

import json
import math
import os
import socket
from collections.abc import Collection, Mapping
from contextlib import suppress
from typing import Any, Self

import google_crc32c
import numpy as np
from numpy.typing import NDArray
from zarr.abc.store import ByteRequest
from zarr.abc.store import Store as ZarrStore
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import LocalStore, WrapperStore

from sobolev_batch.errors import DamageError, StoreError
from sobolev_batch.store.encoding import ROOT, TEXTS
from sobolev_batch.store.metadata import Document, chunk_shape, consolidated

CHANGED = "it is not what was written"
CHECKSUM_BYTES = 4
# The codec of texts writes their number, and the length of each, in as many bytes.
_COUNT_BYTES = 4
# Records have checksums of all blocks of a field, and are the longest texts.
_LARGEST_TEXT_BYTES, _MEAN_TEXT_BYTES = 16 << 20, 16 << 10


def checksum_of(values: NDArray[Any]) -> int:
    """Return the CRC-32C of a C-ordered array."""
    data: Any = values.view(np.uint8).reshape(-1)
    # The library takes only what cannot change while it reads.
    data.flags.writeable = False
    return int(google_crc32c.value(data))


class CheckedStore(WrapperStore[ZarrStore]):
    """zarr's store whose chunks are checked as they are read, by the metadata documents of its arrays.

    Arrays in progress may lack chunks, which read as missing values.
    """

    def __init__(
        self, store: ZarrStore, name: str, documents: Mapping[str, Document], in_progress: Collection[str]
    ) -> None:
        super().__init__(store)
        self._name, self._documents, self._in_progress = name, documents, in_progress

    def _with_store(self, store: ZarrStore) -> Self:
        return type(self)(store, self._name, self._documents, self._in_progress)

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """Return the bytes of a key."""
        if key == ROOT and "" in self._documents:
            # What is not used is not there.
            return prototype.buffer.from_bytes(json.dumps(consolidated(self._documents)).encode())
        group, _, place = key.partition("/")
        name, _, place = place.partition("/")
        array = f"{group}/{name}"
        # Any of them may be named c.
        document = self._documents.get(array) if place.split("/")[0] == "c" else None
        if byte_range is not None or document is None:
            return await super().get(key, prototype, byte_range)
        problem = ""
        # A file may be sparse, and larger than the memory. On object storage this would be one more request.
        if isinstance(self._store, LocalStore):
            with suppress(FileNotFoundError, NotADirectoryError):
                size, most = await self._store.getsize(key), largest_chunk_bytes(document)
                problem = f"it has {size} bytes, more than {most}" if size > most else ""
        content = None if problem else await super().get(key, prototype)
        if content is not None:
            problem = problem_of_chunk(content.as_numpy_array(), document)
        elif not problem and document["data_type"] != "string" and not await self._store.exists(ROOT):
            # All its numbers would read as missing ones.
            raise StoreError(
                f"{self._name}: it is not there for process {os.getpid()} of {socket.gethostname()}; a worker of your "
                'Dask client needs the same path, or compute with scheduler="threads"'
            )
        elif array not in self._in_progress:
            problem = problem or "it is missing"
        if problem:
            place = place.removeprefix("c").removeprefix("/")
            raise DamageError(
                f"{self._name}: chunk {place or '0'} of {array} is damaged ({problem}), or a run has just replaced it; "
                "sobolev-batch verify names what is damaged, and run makes it again",
                problem,
            )
        return content


def largest_chunk_bytes(document: Mapping[str, Any]) -> int:
    """Return the most bytes that a chunk of an array may have, by its metadata."""
    dtype = document["data_type"]
    count: int = math.prod(chunk_shape(document))
    if dtype == "string":
        return max(_LARGEST_TEXT_BYTES, count * _MEAN_TEXT_BYTES)
    return count * int(np.dtype(dtype).itemsize) + CHECKSUM_BYTES


def problem_of_chunk(content: NDArray[np.uint8], document: Mapping[str, Any]) -> str:
    """Return why the bytes of a chunk (n,) are not one of an array, by its metadata; empty if they are."""
    count, dtype = math.prod(chunk_shape(document)), document["data_type"]
    data = content
    if document["codecs"][-1]["name"] == "crc32c":
        data = content[:-CHECKSUM_BYTES]
        if len(content) < CHECKSUM_BYTES or checksum_of(data).to_bytes(4, "little") != content[len(data) :].tobytes():
            return CHANGED
    if dtype == "string":
        return _problem_of_texts(data.tobytes(), count)
    size = count * np.dtype(dtype).itemsize
    return "" if len(data) == size else f"it has {len(data)} bytes, not {size}"


def _problem_of_texts(data: bytes, count: int) -> str:
    if int.from_bytes(data[:_COUNT_BYTES], "little") != count or len(data) < _COUNT_BYTES * (1 + count):
        return f"it does not hold {count} texts"
    try:
        written = bytes(TEXTS.encode(TEXTS.decode(data)))
    except ValueError as error:
        return f"its texts make no sense: {error}"
    return "" if written == data else "it holds more than its texts"
