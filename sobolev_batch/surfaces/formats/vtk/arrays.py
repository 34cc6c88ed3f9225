"""Arrays of VTK's XML files: bytes or base64 text, compressed or not, whose announced sizes are checked."""

from __future__ import annotations

import base64
import lzma
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.raw_files import unpacked_limit

_COMPRESSORS = {"": "", "vtkZLibDataCompressor": "zlib", "vtkLZMADataCompressor": "lzma"}
_HEADERS = {"UInt32": "u4", "UInt64": "u8"}
_ORDERS = {"LittleEndian": "<", "BigEndian": ">"}
# Memory of the decoder of LZMA, whose files may ask for any.
_LZMA_BYTES = 128 << 20


@dataclass(frozen=True)
class Encoded:
    """Bytes as a file has them.

    Attributes:
        data: Contents.
        is_base64: True where they are text in base64.
    """

    data: bytes
    is_base64: bool

    def read(self, place: int, count: int) -> tuple[bytes, int]:
        """Return so many bytes from a place on, and the place behind them.

        Raises:
            MeshError: The file has fewer.
        """
        end = place + (4 * -(-count // 3) if self.is_base64 else count)
        if place < 0 or end > len(self.data):
            raise MeshError(f"an array announces {count} bytes at {place}, more than the {len(self.data)} there are")
        found = self.data[place:end]
        decoded = base64.b64decode(found, validate=True)[:count] if self.is_base64 else found
        if len(decoded) < count:
            raise MeshError(f"an array announces {count} bytes, found {len(decoded)}")
        return decoded, end


@dataclass
class Packing:
    """Packing of the values of arrays in a file, with a limit on what they unpack to.

    Attributes:
        header: Type of the numbers before each array.
        compressor: "zlib", "lzma", or empty.
        limit: Bytes that all arrays together may take.
        taken: Bytes that they have taken so far.
    """

    header: np.dtype[Any]
    compressor: str
    limit: int
    taken: int = 0

    @classmethod
    def of(cls, attributes: Mapping[str, str], file_bytes: int) -> Packing:
        """Return the packing that the attributes of the element VTKFile describe.

        Raises:
            MeshError: It is not known.
        """
        compressor = attributes.get("compressor", "")
        if compressor not in _COMPRESSORS:
            raise MeshError(f"the file is compressed by {compressor[:40]}; save it with zlib, LZMA or no compression")
        order, header = attributes.get("byte_order", ""), attributes.get("header_type", "UInt32")
        if order not in _ORDERS or header not in _HEADERS:
            raise MeshError(f"the file has the byte order {order[:40]!r} and headers of {header[:40]!r}")
        return cls(np.dtype(_ORDERS[order] + _HEADERS[header]), _COMPRESSORS[compressor], unpacked_limit(file_bytes))

    def values(self, source: Encoded, place: int, code: str) -> NDArray[Any]:
        """Return the array that begins at a place.

        Args:
            source: Contents of the file that hold it.
            place: Where it begins there.
            code: NumPy's code of its values, without a byte order.

        Raises:
            MeshError: The array does not fit its announced size.
        """
        content = self._unpacked(source, place) if self.compressor else self._plain(source, place)
        dtype = np.dtype(code).newbyteorder(self.header.byteorder)
        if len(content) % dtype.itemsize:
            raise MeshError(f"an array of {len(content)} bytes makes no whole values of {dtype.itemsize} bytes")
        return np.frombuffer(content, dtype).astype(dtype.newbyteorder("="))

    def _plain(self, source: Encoded, place: int) -> bytes:
        ((count,), _) = self._numbers(source, place, 1)
        content, _ = source.read(place, self.header.itemsize + count)
        self._take(count)
        return content[self.header.itemsize :]

    def _unpacked(self, source: Encoded, place: int) -> bytes:
        ((count,), _) = self._numbers(source, place, 1)
        if not count:
            return b""
        (_, size, last, *packed_sizes), place = self._numbers(source, place, 3 + count)
        sizes = [size] * (count - 1) + [last or size]
        self._take(sum(sizes))
        packed, _ = source.read(place, sum(packed_sizes))
        blocks, start = [], 0
        for block_size, packed_size in zip(sizes, packed_sizes, strict=True):
            blocks.append(self._block(packed[start : start + packed_size], block_size))
            start += packed_size
        return b"".join(blocks)

    def _block(self, packed: bytes, size: int) -> bytes:
        """Return an unpacked block, of which no more is made than was announced."""
        unpacker: Any = (
            zlib.decompressobj() if self.compressor == "zlib" else lzma.LZMADecompressor(memlimit=_LZMA_BYTES)
        )
        # Zero would mean no limit; one byte more shows whether the block is longer.
        block: bytes = unpacker.decompress(packed, size + 1)
        if len(block) != size or not unpacker.eof:
            raise MeshError(f"a block of an array unpacks to more or fewer than the {size} bytes announced")
        return block

    def _numbers(self, source: Encoded, place: int, count: int) -> tuple[list[int], int]:
        """Return numbers of a header, and the place behind them."""
        content, end = source.read(place, count * self.header.itemsize)
        return np.frombuffer(content, self.header).tolist(), end

    def _take(self, count: int) -> None:
        # Several arrays may be made of the same bytes.
        self.taken += count
        if self.taken > self.limit:
            raise MeshError(f"its arrays unpack to more than {self.limit} bytes: no mesh file shrinks so much")
