"""What parsers share: the bytes of regular files, unpacked but bounded; words as numbers; strips as triangles."""

from __future__ import annotations

import codecs
import errno
import gzip
import io
import os
import re
import stat
import zlib
from array import array
from collections.abc import Callable, Sequence
from io import BufferedReader
from pathlib import Path, PurePath
from typing import IO, Any, NamedTuple, cast

import numpy as np
from numpy.typing import DTypeLike, NDArray

from sobolev_batch.arrays import Indices
from sobolev_batch.errors import MeshError
from sobolev_batch.machine import machine_memory
from sobolev_batch.parameters import format_bytes


class Raw(NamedTuple):
    """Content of a file: vertices (n, 3), triangles (m, 3), and notes on what the parser found, in sentences."""

    vertices: NDArray[Any]
    triangles: NDArray[Any]
    notes: tuple[str, ...] = ()


# How the bytes of an open file are read, of which so many are wanted.
Read = Callable[[BufferedReader, int], bytes]

# No larger file is read; 8 GiB hold some 160 million binary STL triangles.
_LARGEST_BYTES = 8 << 30
# Mesh files shrink to a tenth at best: packed ones may grow by such a factor, or to a harmless size.
_LARGEST_PACKING, _HARMLESS_BYTES = 100, 16 << 20
_CHUNK_BYTES = 1 << 20
# Part of the machine's memory that reading a file may take; others use it too.
_MEMORY_PART = 0.75
# Lines per row, at most, of a text whose lines hold several rows: damage alone joins fewer.
MOST_LINES = 0.9
# Digits of an integer: all that fit into 64 bits.
_MOST_DIGITS = 18
_REAL = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf|infinity)", re.ASCII | re.IGNORECASE)
# Fortran writes the exponents of doubles with a D, and Windows what is no number as -nan(ind) or 1.#QNAN.
_FORTRAN = re.compile(r"(?<=[0-9.])[dD](?=[+-]?[0-9])")
_NO_NUMBER = re.compile(r"[+-]?(nan\(\w*\)|1\.#\w+)", re.ASCII | re.IGNORECASE)
# The index that ends a strip of triangles within a list.
_BREAK = -1


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file for reading; OSError or, for impossible names, ValueError where that fails.

    Pipes could keep a reader waiting for ever, devices could never end.
    """
    mode = path.stat().st_mode
    if stat.S_ISDIR(mode):
        raise OSError(errno.EISDIR, "it is a folder; name the files in it")
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "it is a pipe, a socket or a device, and no regular file")
    return path.open("rb")


def checked_length(file: IO[bytes]) -> int:
    """Return the length of an open file."""
    length = os.fstat(file.fileno()).st_size
    if length > _LARGEST_BYTES:
        raise MeshError(f"larger than {_LARGEST_BYTES} bytes, which is the most that is read: {length}")
    return length


def is_gzipped(path: PurePath) -> bool:
    """Return whether the name of a file says that it is compressed."""
    return path.name.lower().endswith(".gz")


def is_packed(path: PurePath, file: BufferedReader) -> bool:
    """Return whether an open file is compressed: what unpacks it, such as a browser, may leave its name."""
    return is_gzipped(path) and file.peek(2)[:2] == b"\x1f\x8b"


def require_memory_to_read(needed_bytes: float) -> None:
    """Refuse a file, before it is read, that takes more memory than reading may."""
    if needed_bytes <= _HARMLESS_BYTES:
        # To look at the limits takes longer than to read a small file.
        return
    most, source = machine_memory()
    if needed_bytes > _MEMORY_PART * most:
        raise MeshError(
            f"takes up to {format_bytes(needed_bytes)} of memory to read, and may take {_MEMORY_PART:.0%} of "
            f"{format_bytes(most)}, {source}; read it where there is more, or give a coarser mesh"
        )


def read_unpacked(path: Path, factor: float, read: Read = BufferedReader.read) -> bytes:
    """Return a file's bytes without a byte-order mark, unpacked from .gz, each of which takes a factor of memory."""
    try:
        with open_regular(path) as file:
            length, packed = checked_length(file), is_packed(path, file)
            if not packed:
                require_memory_to_read(factor * length)
            data = read(file, length)
            if not len(data) == length == checked_length(file):
                raise MeshError("it changed while it was read; read it again once it is whole")
        if packed:
            data = _unpacked_bounded(data, factor)
    except gzip.BadGzipFile as error:
        raise MeshError(f"its packed data are damaged, or other bytes follow them: {error}; pack it again") from error
    except (OSError, EOFError, ValueError, zlib.error) as error:
        raise MeshError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
    data = data.removeprefix(codecs.BOM_UTF8)
    if data.isascii() and b"\0" not in data:
        # Texts of old systems end with a control-Z, and their lines with a carriage return alone.
        data = data.removesuffix(b"\x1a")
        data = data if b"\n" in data else data.replace(b"\r", b"\n")
    if not data:
        raise MeshError("the file is empty")
    return data


def unpacked_limit(packed_bytes: int) -> int:
    """Return the most bytes that packed ones may unpack to: a hundredfold, at least 16 MiB and at most 8 GiB."""
    return min(_LARGEST_BYTES, max(_HARMLESS_BYTES, _LARGEST_PACKING * packed_bytes))


def _unpacked_bounded(packed: bytes, factor: float) -> bytes:
    """Return what packed bytes hold; they are refused as soon as that exceeds a bound."""
    most = unpacked_limit(len(packed))
    data = io.BytesIO()
    with gzip.GzipFile(fileobj=io.BytesIO(packed)) as unpacked:
        # One large read would reserve the bound at once.
        while chunk := cast(IO[bytes], unpacked).read(_CHUNK_BYTES):
            data.write(chunk)
            if data.tell() > most:
                raise MeshError(f"{len(packed)} bytes unpack to more than {most}: no mesh file shrinks that far")
            if data.tell() > _HARMLESS_BYTES:
                require_memory_to_read(factor * data.tell())
    return data.getvalue()


def reals(words: Sequence[str], owner: str) -> array[float]:
    """Return words as numbers, spelled as in C or Fortran; an error begins with their owner, such as "vertex 7"."""
    text = "".join(words)
    try:
        # Python takes underscores too, and the digits of all scripts.
        if "_" in text or not text.isascii():
            raise ValueError("no spelling of C")
        return array("d", map(float, words))
    except ValueError as error:
        plain = ["nan" if _NO_NUMBER.fullmatch(word) else _FORTRAN.sub("e", word) for word in words]
        wrong = [word for word in plain if not _REAL.fullmatch(word)]
        if wrong:
            hint = "; write decimals with a point, and blanks between numbers" * ("," in wrong[0])
            raise MeshError(f"{owner} has a word that is not a number: {wrong[0][:40]!r}{hint}") from error
        return array("d", map(float, plain))


def whole(word: str, owner: str) -> int:
    """Return a word as an integer; an error begins with its owner, such as "face 7"."""
    try:
        if len(word) > _MOST_DIGITS or "_" in word or not word.isascii():
            raise ValueError("too long, or no spelling of C")
        return int(word)
    except ValueError as error:
        raise MeshError(f"{owner} has {word[:40]!r} for an integer of up to {_MOST_DIGITS} digits") from error


def as_declared(numbers: NDArray[Any] | array[float], declared: DTypeLike, owner: str) -> NDArray[Any]:
    """Return numbers of a text, which are doubles, in their declared type, and others as they are."""
    values = np.asarray(numbers)
    with np.errstate(all="ignore"):
        converted = values.astype(np.dtype(declared).newbyteorder(values.dtype.byteorder), copy=False)
    wrong = values[converted != values] if converted is not values and converted.dtype.kind in "iu" else []
    if len(wrong):
        raise MeshError(f"{owner} has {wrong[0]:g} for an integer of {8 * converted.itemsize} bits")
    return converted


def triangle_strips(corners: Indices, sizes: Indices) -> Indices:
    """Cut strips into triangles (m, 3), every second one turned round, so that all face the same side.

    The corners are vertex indices of all lists, one after the other, the sizes their numbers. A list may hold several
    strips, with -1 between them. Triangles without area, which join strips, stay.
    """
    corners = np.insert(corners, np.cumsum(sizes), _BREAK)
    ends = np.flatnonzero(corners == _BREAK)
    begins = np.concatenate([[0], ends[:-1] + 1])[: len(ends)]
    # Breaks that follow each other have no strip between them.
    begins, ends = begins[ends > begins], ends[ends > begins]
    if (ends - begins < 3).any():
        raise MeshError(f"a strip of triangles has {(ends - begins).min()} vertices, expected three or more")
    counts = ends - begins - 2
    # The rank of each triangle in its strip, and the place of its first corner.
    ranks = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    places, odd = np.repeat(begins, counts) + ranks, ranks % 2
    return np.stack([corners[places + odd], corners[places + 1 - odd], corners[places + 2]], axis=1)
