"""The contents of files: read whole, unpacked where they are gzipped, and never more than is sensible."""

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

# No file is read beyond this; 8 GiB hold some 160 million binary STL triangles.
_LARGEST_BYTES = 8 << 30
# Mesh files shrink to a tenth at best: what is packed may become so many times larger, or as large as does no harm.
_LARGEST_PACKING, _HARMLESS_BYTES = 100, 16 << 20
_STEP_BYTES = 1 << 20


def open_regular(path: Path) -> BufferedReader:
    """Open a file for reading that is one: a pipe could be waited for without end, and a device read without end.

    Raises:
        OSError: it cannot be opened, or is no regular file.
        ValueError: no file can have this name.
    """
    mode = path.stat().st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "it is a pipe, a socket or a device, and no regular file")
    return path.open("rb")


def bounded_length(file: IO[bytes]) -> int:
    """The length of an open file.

    Raises:
        MeshError: it is too large to be read; the message does not name it.
    """
    length = os.fstat(file.fileno()).st_size
    if length > _LARGEST_BYTES:
        raise MeshError(f"larger than {_LARGEST_BYTES} bytes, which is the most that is read: {length}")
    return length


def is_gzipped(path: Path) -> bool:
    """Whether a file's name says that it is compressed."""
    return path.name.lower().endswith(".gz")


def read_contents(path: Path, *, gzipped: bool) -> bytes:
    """The bytes of a regular file.

    Raises:
        MeshError: it cannot be read, is empty, or is too large; the message does not name it.
    """
    try:
        with open_regular(path) as file:
            length = bounded_length(file)
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


def read_bytes(path: Path) -> bytes:
    """The bytes of a file, unpacked if its name ends in .gz.

    Raises:
        MeshError: it cannot be read, is empty, or is too large; the message starts with its path.
    """
    try:
        return read_contents(path, gzipped=is_gzipped(path))
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error


def unpacked_limit(packed_bytes: int) -> int:
    """The most bytes that so many may stand for: a hundred times as many, or 16 MiB where that is more, up to 8 GiB."""
    return min(_LARGEST_BYTES, max(_HARMLESS_BYTES, _LARGEST_PACKING * packed_bytes))


def _read_bounded(file: IO[bytes], most: int) -> bytes:
    """All of a file, or a little more than the bound; one large read would reserve the bound at once."""
    parts = []
    total = 0
    while total <= most and (part := file.read(_STEP_BYTES)):
        parts.append(part)
        total += len(part)
    return b"".join(parts)
