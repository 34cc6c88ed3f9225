"""Bytes of files: regular ones only, unpacked where they are gzipped, and never more than is sensible."""

from __future__ import annotations

import errno
import gzip
import os
import stat
import zlib
from io import BufferedReader
from pathlib import Path
from typing import IO, cast

from sobolev_batch.errors import MeshError

# No larger file is read; 8 GiB hold some 160 million binary STL triangles.
_LARGEST_BYTES = 8 << 30
# Mesh files shrink to a tenth at best: packed ones may grow by such a factor, or to a harmless size.
_LARGEST_PACKING, _HARMLESS_BYTES = 100, 16 << 20
_CHUNK_BYTES = 1 << 20


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file for reading. Pipes could keep a reader waiting for ever, devices could never end.

    Raises:
        OSError: The file cannot be opened, or is no regular file.
        ValueError: No file can have this name.
    """
    mode = path.stat().st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "it is a pipe, a socket or a device, and no regular file")
    return path.open("rb")


def checked_length(file: IO[bytes]) -> int:
    """Return the length of an open file.

    Raises:
        MeshError: The file is too large to be read; the message does not name it.
    """
    length = os.fstat(file.fileno()).st_size
    if length > _LARGEST_BYTES:
        raise MeshError(f"larger than {_LARGEST_BYTES} bytes, which is the most that is read: {length}")
    return length


def is_gzipped(path: Path) -> bool:
    """Return whether the name of a file says that it is compressed."""
    return path.name.lower().endswith(".gz")


def read_regular(path: Path, *, gzipped: bool) -> bytes:
    """Return the bytes of a regular file.

    Raises:
        MeshError: The file cannot be read, is empty, or is too large; the message does not name it.
    """
    try:
        with open_regular(path) as file:
            length = checked_length(file)
            if gzipped:
                most = unpacked_limit(length)
                with gzip.GzipFile(fileobj=file) as unpacked:
                    data = _read_bounded(cast(IO[bytes], unpacked), most)
            else:
                most = _LARGEST_BYTES
                data = _read_bounded(file, most)
    except (OSError, EOFError, ValueError, zlib.error) as error:
        raise MeshError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(data) > most:
        raise MeshError(f"larger than {most} bytes once it is unpacked from {length}: no mesh file shrinks so much")
    if not data:
        raise MeshError("the file is empty")
    return data


def read_unpacked(path: Path) -> bytes:
    """Return the bytes of a file, unpacked if its name ends in .gz.

    Raises:
        MeshError: The file cannot be read, is empty, or is too large; the message starts with its path.
    """
    try:
        return read_regular(path, gzipped=is_gzipped(path))
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error


def unpacked_limit(packed_bytes: int) -> int:
    """Return the most bytes that packed ones may unpack to: a hundredfold, at least 16 MiB and at most 8 GiB."""
    return min(_LARGEST_BYTES, max(_HARMLESS_BYTES, _LARGEST_PACKING * packed_bytes))


def _read_bounded(file: IO[bytes], most: int) -> bytes:
    """Return all of a file, or a little more than the bound; one large read would reserve the bound at once."""
    chunks = []
    total = 0
    while total <= most and (chunk := file.read(_CHUNK_BYTES)):
        chunks.append(chunk)
        total += len(chunk)
    return b"".join(chunks)
