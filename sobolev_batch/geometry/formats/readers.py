"""Meshes from files."""

import binascii
import codecs
import gzip
import json
import re
import zlib
from collections.abc import Iterable
from io import BufferedReader
from pathlib import Path
from xml.parsers.expat import ExpatError
from zipfile import BadZipFile

import numpy as np

from sobolev_batch.errors import MeshError
from sobolev_batch.geometry.formats import parsing
from sobolev_batch.geometry.formats.by_name import BY_SUFFIX, CONVERTED, mesh_format
from sobolev_batch.geometry.formats.ply import HEADER_BYTES
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.parameters import path_of

_LONGEST_REASON = 250
# How files begin that are taken for meshes, and what they are.
_MISTAKEN = {
    rb"(<\?xml[^>]*>\s*)?<(!doctype )?(html|error)\b": "the message of a server or a web page; download the file again",
    rb"version https://git-lfs": "a pointer of Git's large file storage; fetch the file itself by git lfs pull",
    rb"\xff\xfe|\xfe\xff|([\t-~]\0|\0[\t-~]){4}": "a text in UTF-16; save it in UTF-8",
    rb"\x1f\x8b": "compressed by gzip; unpack it, or let its name end in .gz",
    rb"(?s:.{257})ustar": "an archive; unpack it by tar -xf",
    rb"#!ascii": "FreeSurfer's text; convert it: mris_convert lh.asc lh.gii",
    rb"BZh\d1AY|\xfd7zXZ|\x28\xb5\x2f\xfd": "packed; unpack it",
}
# How files of some formats begin.
_BEGINNINGS = {".ply": rb"ply\s", ".stl": rb"solid\s", ".off": rb"(st|c|n)*off\s", ".vtk": rb"# vtk ", ".glb": rb"gltf"}
_BEGINNINGS |= {".3mf or other zip": rb"pk\x03\x04", ".msh": rb"\$meshformat", ".mesh": rb"meshversionformatted"}
_START_BYTES = 1024
# What errors of libraries mean on damaged input, the special ones first.
_DAMAGES: dict[type[Exception], str] = {
    json.JSONDecodeError: "its JSON is damaged",
    ExpatError: "its XML is damaged",
    UnicodeError: "its text is damaged, or not in UTF-8",
    BadZipFile: "it is no whole zip archive",
    zlib.error: "its packed data are damaged",
    binascii.Error: "its data in base64 are damaged",
    KeyError: "it lacks an entry",
    Exception: "it has entries that do not fit together, or breaks off",
}
# Coordinates so many times the size of a mesh have four digits of it in single precision.
_FAR = 1000
# What rounding to double precision leaves of a digit behind the seventh.
_NO_DIGIT = 1e-6
# Factor by which gzip usually shrinks mesh files.
_PACKING = 4
# Bytes of a file that is mostly a list of files beside it; larger ones hold their data themselves.
_LONGEST_INDEX = 16 << 20


def read_mesh(path: str | Path) -> Mesh:
    """Read a mesh from a PLY, OBJ, STL, OFF, glTF, GIFTI, VTK, 3MF, Medit, Gmsh or FreeSurfer file, gzipped or not.

    The format follows from the name: FreeSurfer's are such as lh.pial, VTK's end in .vtk, .vtp or .vtu. Coordinates
    keep the precision of the file. Polygons are cut into triangles, where they bend least. STL and glTF repeat
    vertices, so those that coincide exactly are merged; vertices of other formats stay as they are.

    Args:
        path: Path of the file.

    Raises:
        MeshError: The file is missing, of no known format, damaged, or holds no valid mesh. The message
            starts with the path.

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import sobolev_batch as sb
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "triangle.off")
    ...     with path.open("w") as file:
    ...         print("OFF", "3 1 0", "0 0 0", "1 0 0", "0 1 0", "3 0 1 2", sep=chr(10), file=file)
    ...     sb.read_mesh(path)
    Mesh(3 vertices, 1 triangles)
    """
    return read_mesh_by(path_of(path), BufferedReader.read)


def files_beside(path: Path) -> tuple[Path, ...]:
    """Return the files in its folder that a mesh file needs; none where it cannot be read."""
    form = BY_SUFFIX.get(mesh_format(path))
    if form is None or form.files_beside is None:
        return ()
    try:
        data = parsing.read_unpacked(path, form.memory_bytes / form.file_bytes)
        return tuple(_files_beside(path, form.files_beside(data)).values())
    except Exception:
        # Parsers raise anything; reading the mesh tells what is wrong.
        return ()


def _files_beside(path: Path, names: Iterable[str]) -> dict[str, Path]:
    """Return the paths of files that a file names; MeshError for one that does not lie in its folder, or below."""
    found, folder = {}, path.parent.resolve()
    for name in names:
        # Links are followed here, so that none leads elsewhere.
        found[name] = (folder / name).resolve()
        if not found[name].is_relative_to(folder) or ":" in name or not found[name].is_file():
            raise MeshError(f"it needs {name[:80]!r}, which is no file in its folder; put it there, or export one file")
    return found


def read_mesh_by(path: Path, read: parsing.Read) -> Mesh:
    """Read a mesh as `read_mesh` does, by a function that reads the bytes of its file."""
    suffix = mesh_format(path)
    if suffix in CONVERTED:
        name, command = CONVERTED[suffix]
        raise MeshError(f"{path}: it is a file of the format {name}, which is not read; convert it: {command}")
    if suffix not in BY_SUFFIX:
        if path.is_dir():
            raise MeshError(f"{path}: it is a folder; name the files in it")
        known = ", ".join(name for name, form in BY_SUFFIX.items() if form.is_name is None)
        raise MeshError(
            f"{path}: no mesh format that is read has this name; known are {known} and FreeSurfer's names such as "
            "lh.pial, each also with .gz. docs/formats.md shows how to convert others"
        )
    form, start = BY_SUFFIX[suffix], b""
    factor = form.memory_bytes / form.file_bytes
    try:
        # The header of a PLY file tells more than its length.
        parsing.require_memory_to_read(expected_size(path)[1])
        data = [parsing.read_unpacked(path, factor, read)]
        start = data[0][:_START_BYTES]
        # Numbers that overflow become infinite, which the mesh refuses.
        with np.errstate(all="ignore"):
            beside = []
            if form.files_beside is not None:
                parts = _files_beside(path, form.files_beside(data[0]))
                size = len(data[0]) + sum(part.stat().st_size for part in parts.values())
                parsing.require_memory_to_read(factor * size)
                beside = [{name: parsing.read_unpacked(part, factor, read) for name, part in parts.items()}]
            # Only the parser holds the bytes, so that it can free them early.
            raw = _without_unused(parsing.Raw(*form.parse(data.pop(), *beside)))
            for array in (raw.vertices, raw.triangles):
                array.setflags(write=False)
            return _with_lost_digits(Mesh(*raw), raw.vertices.dtype.newbyteorder("=") == np.float32)
    except MeshError as error:
        raise MeshError(f"{path}: {_mistaken(start, suffix) or _shortened(error)}") from error
    except MemoryError as error:
        raise MeshError(f"{path}: reading it takes more memory than there is: {_shortened(error)}") from error
    except Exception as error:
        # On damaged input parsers raise anything from struct.error to RecursionError.
        damage = next(what for kind, what in _DAMAGES.items() if isinstance(error, kind))
        reason = _mistaken(start, suffix) or f"{damage}: {_shortened(error)}"
        raise MeshError(f"{path}: not a readable {suffix.removeprefix('.')} file: {reason}") from error


def expected_size(path: Path) -> tuple[int, float]:
    """Estimate the number of triangles in a file, and the peak of the memory in bytes that reading it takes.

    The estimate rests on the header of a PLY file, and on the length of others. It never exceeds what a file
    of this length can hold. Both are zero where the file cannot be read.
    """
    form = BY_SUFFIX.get(mesh_format(path))
    if form is None:
        return 0, 0.0
    try:
        with parsing.open_regular(path) as file:
            length, packed = parsing.checked_length(file), parsing.is_packed(path, file)
            if packed:
                length = min(_PACKING * length, parsing.unpacked_limit(length))
            if form.announced_size is not None:
                unpacked = gzip.GzipFile(fileobj=file) if packed else file
                return form.announced_size(unpacked.read(HEADER_BYTES).removeprefix(codecs.BOM_UTF8), length)
        if length <= _LONGEST_INDEX:
            length += sum(part.stat().st_size for part in files_beside(path))
    except (OSError, EOFError, ValueError, zlib.error, MeshError):
        return 0, 0.0
    triangles = int(length / form.file_bytes)
    return triangles, float(triangles * form.memory_bytes)


def _without_unused(raw: parsing.Raw) -> parsing.Raw:
    """Leave out vertices that are no numbers and that no triangle uses, with a note."""
    vertices, triangles, notes = raw
    if not np.isfinite(vertices).all() and 0 <= triangles.min() <= triangles.max() < len(vertices):
        is_bad = ~np.isfinite(vertices).all(axis=1)
        if not is_bad[triangles].any():
            vertices, triangles = vertices[~is_bad], (np.cumsum(~is_bad) - 1)[triangles]
            notes += (f"{np.count_nonzero(is_bad):,} vertices without coordinates, which no face uses, are left out",)
    return parsing.Raw(vertices, triangles, notes)


def _with_lost_digits(mesh: Mesh, is_single: bool) -> Mesh:
    """Note it where a mesh in single precision, or in a text of as many digits, is far from the origin for its size."""
    lower, upper = mesh.extent.box
    times = np.abs([lower, upper]).max() / np.linalg.norm(upper - lower)
    if times <= _FAR:
        return mesh
    if not is_single:
        numbers = mesh.vertices[mesh.vertices != 0]
        counts = numbers / 10 ** (np.floor(np.log10(np.abs(numbers))) - 6)
        # Whole numbers may be all that there is.
        if not (np.abs(counts - np.rint(counts)) < _NO_DIGIT).all() or not (numbers % 1).any():
            return mesh
    note = (
        f"coordinates are {times:,.0f} times the size of the mesh, of which "
        f"{'single precision' if is_single else 'a text of seven digits'} keeps "
        f"{max(0.0, -np.log10(times * np.finfo(np.float32).eps / 2)):.0f} digits"
    )
    return Mesh.from_checked(mesh.vertices, mesh.triangles, (*mesh.notes, note))


def _mistaken(start: bytes, suffix: str) -> str:
    """Return what a file is that begins so and could not be read; empty where that is not known."""
    start = start.lstrip()
    known = {pattern: f"is {what}" for pattern, what in _MISTAKEN.items()}
    others = {at: other for other, at in _BEGINNINGS.items() if not other.startswith(suffix)}
    known |= {at: f"begins as a {other} file; name it so" for at, other in others.items()}
    return next((f"it {what}" for pattern, what in known.items() if re.match(pattern, start, re.IGNORECASE)), "")


def _shortened(error: Exception) -> str:
    """Return the message of an error on one line; it may quote any length of a file."""
    reason = " ".join(str(error).split()) or "no details"
    return reason if len(reason) <= _LONGEST_REASON else reason[: _LONGEST_REASON - 3] + "..."
