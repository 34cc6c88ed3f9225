"""The formats of mesh files: how each is parsed and written, and predictions of sizes."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.gltf import buffer_paths, parse_gltf
from sobolev_batch.surfaces.formats.neuroimaging import is_freesurfer_name, parse_freesurfer, parse_gifti
from sobolev_batch.surfaces.formats.parsing import (
    Raw,
    checked_length,
    is_gzipped,
    open_regular,
    read_unpacked,
    require_memory_to_read,
    unpacked_limit,
)
from sobolev_batch.surfaces.formats.ply import HEADER_BYTES, announced_sizes, parse_ply, write_ply
from sobolev_batch.surfaces.formats.text_formats import (
    parse_obj,
    parse_off,
    parse_stl,
    write_obj,
    write_off,
    write_stl,
)
from sobolev_batch.surfaces.formats.vtk import parse_vtk
from sobolev_batch.surfaces.shapes.mesh import Mesh


@dataclass(frozen=True)
class Format:
    """A format of mesh files.

    Attributes:
        suffixes: Suffixes of its files, in lower case.
        parse: Function of the contents of a file and its path, which returns vertices and triangles.
        file_bytes: Bytes of each triangle, in a file of nothing but positions and triangles.
        memory_bytes: Bytes of each triangle, at the measured peak of reading it.
        write: Function of a mesh, which returns the contents of a file; None for a format that is only read.
    """

    suffixes: tuple[str, ...]
    parse: Callable[[bytes, Path], Raw]
    file_bytes: int
    memory_bytes: int
    write: Callable[[Mesh], bytes] | None = None


# FreeSurfer's files have names of their own.
_FREESURFER = "freesurfer"
_FORMATS = (
    Format((".ply",), lambda data, _: parse_ply(data), 19, 90, write_ply),
    Format((".obj",), lambda data, _: parse_obj(data), 35, 240, write_obj),
    Format((".stl",), lambda data, _: parse_stl(data), 50, 270, write_stl),
    Format((".off",), lambda data, _: parse_off(data), 35, 240, write_off),
    Format((".gltf", ".glb"), parse_gltf, 18, 190),
    Format((".gii",), lambda data, _: parse_gifti(data), 10, 90),
    Format((".vtk",), parse_vtk, 22, 290),
    Format((".vtp", ".vtu"), parse_vtk, 10, 215),
    Format((_FREESURFER,), lambda data, _: parse_freesurfer(data), 18, 80),
)
_BY_SUFFIX = {suffix: form for form in _FORMATS for suffix in form.suffixes}
# What makes the contents of a file from a mesh, by suffix.
WRITERS = {suffix: form.write for suffix, form in _BY_SUFFIX.items() if form.write is not None}

_LONGEST_REASON = 250
# Factor by which gzip usually shrinks mesh files.
_PACKING = 4
# Smallest possible sizes of a vertex and a face in a PLY file.
_LEAST_VERTEX_BYTES, _LEAST_FACE_BYTES = 3, 4
# Usual sizes in a PLY file: of a vertex in double precision, and of a corner.
_VERTEX_BYTES, _CORNER_BYTES = 24, 4.4
# Memory of reading a PLY file: factor of reading row by row, and bytes of each vertex beyond one for two triangles.
_TEXT_FACTOR, _VERTEX_MEMORY = 7.0, 70.0


def read_mesh(path: str | Path) -> Mesh:
    """Read a mesh from a PLY, OBJ, STL, OFF, glTF, GLB, GIFTI, VTK or FreeSurfer file, gzipped or not.

    The format follows from the name: FreeSurfer's are such as lh.pial, VTK's end in .vtk, .vtp or .vtu. Coordinates
    keep the precision of the file. Polygons are cut into fans of triangles, which is exact for convex ones. STL and
    glTF repeat vertices, so those that coincide exactly are merged; vertices of other formats stay as they are.

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
    path = Path(path)
    suffix = mesh_format(path).removesuffix(".gz")
    if suffix not in _BY_SUFFIX:
        known = ", ".join(name for name in _BY_SUFFIX if name != _FREESURFER)
        raise MeshError(
            f"{path}: no mesh format that is read has this name; known are {known} and FreeSurfer's names such as "
            "lh.pial, each also with .gz. docs/formats.md shows how to convert others"
        )
    data = [_checked_bytes(path)]
    try:
        # Numbers that overflow become infinite, which the mesh refuses.
        with np.errstate(all="ignore"):
            # Only the parser holds the bytes, so that it can free them early.
            vertices, triangles = _BY_SUFFIX[suffix].parse(data.pop(), path)
            for array in (vertices, triangles):
                array.setflags(write=False)
            return Mesh(vertices, triangles)
    except MeshError as error:
        raise MeshError(f"{path}: {_shortened(error)}") from error
    except MemoryError as error:
        raise MeshError(f"{path}: reading it takes more memory than there is: {_shortened(error)}") from error
    except Exception as error:
        # On damaged input parsers raise anything from struct.error to RecursionError.
        raise MeshError(
            f"{path}: not a readable {suffix.removeprefix('.')} file: {type(error).__name__}: {_shortened(error)}"
        ) from error


def _checked_bytes(path: Path) -> bytes:
    """Return the bytes of a file that there is the memory to read."""
    try:
        # The header of a PLY file tells more than its length.
        require_memory_to_read(expected_size(path)[1])
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    return read_unpacked(path, memory_factor(path))


def memory_factor(path: Path) -> float:
    """Return the bytes of memory that reading takes for each byte of a mesh file, unpacked."""
    form = _BY_SUFFIX[mesh_format(path).removesuffix(".gz")]
    return form.memory_bytes / form.file_bytes


def expected_size(path: Path) -> tuple[int, float]:
    """Estimate the number of triangles in a file, and the peak of the memory in bytes that reading it takes.

    The estimate rests on the header of a PLY file, and on the length of others. It never exceeds what a file
    of this length can hold. Both are zero where the file cannot be read.
    """
    suffix = mesh_format(path)
    unpacked_suffix = suffix.removesuffix(".gz")
    form = _BY_SUFFIX.get(unpacked_suffix)
    if form is None:
        return 0, 0.0
    try:
        with open_regular(path) as file:
            length = checked_length(file)
            if suffix.endswith(".gz"):
                length = min(_PACKING * length, unpacked_limit(length))
            if unpacked_suffix == ".ply":
                unpacked = gzip.GzipFile(fileobj=file) if suffix.endswith(".gz") else file
                return _announced_size(unpacked.read(HEADER_BYTES), length)
        if suffix == ".gltf":
            length += sum(buffer.stat().st_size for buffer in set(companion_files(path)))
    except (OSError, EOFError, ValueError, zlib.error, MeshError):
        return 0, 0.0
    triangles = int(length / form.file_bytes)
    return triangles, float(triangles * form.memory_bytes)


def _announced_size(header: bytes, length: int) -> tuple[int, float]:
    """Estimate the same for a PLY file of this length, whose header may announce anything."""
    vertices, faces, text = announced_sizes(header)
    vertices, faces = min(vertices, length // _LEAST_VERTEX_BYTES), min(faces, length // _LEAST_FACE_BYTES)
    # The length of the file shows whether faces have more than three corners.
    corners = (length - vertices * _VERTEX_BYTES) / max(faces, 1) / _CORNER_BYTES
    triangles = faces if text or corners < 4 else 2 * faces
    memory_bytes = _BY_SUFFIX[".ply"].memory_bytes * (_TEXT_FACTOR if text or triangles > faces else 1)
    return triangles, triangles * memory_bytes + _VERTEX_MEMORY * max(0.0, vertices - triangles / 2)


def mesh_format(path: Path) -> str:
    """Return the suffix in lower case or "freesurfer", with .gz where it has that: it decides on the parser."""
    name, packing = _unpacked_name(path).lower(), ".gz" if is_gzipped(path) else ""
    suffix = Path(name).suffix
    return (_FREESURFER if suffix not in _BY_SUFFIX and is_freesurfer_name(name) else suffix) + packing


def is_mesh_name(path: Path) -> bool:
    """Return whether a file has the name of a mesh in a format that is read."""
    return mesh_format(path).removesuffix(".gz") in _BY_SUFFIX


def mesh_stem(path: Path) -> str:
    """Return the name of a file without its format and compression; FreeSurfer's names are all stem."""
    name = _unpacked_name(path)
    return name if mesh_format(path).startswith(_FREESURFER) else Path(name).stem


def _unpacked_name(path: Path) -> str:
    return path.name[: -len(".gz")] if is_gzipped(path) else path.name


def companion_files(path: Path) -> list[Path]:
    """Return the further files that a mesh file consists of: the buffers of a glTF file.

    Raises:
        MeshError: The file cannot be read.
    """
    if mesh_format(path).removesuffix(".gz") not in (".gltf", ".glb"):
        return []
    try:
        return buffer_paths(read_unpacked(path, memory_factor(path)), path)
    except MeshError:
        raise
    except Exception as error:
        raise MeshError(f"{path}: not a readable glTF file: {type(error).__name__}") from error


def _shortened(error: Exception) -> str:
    """Return the message of an error on one line; it may quote any length of a file."""
    reason = " ".join(str(error).split()) or "no details"
    return reason if len(reason) <= _LONGEST_REASON else reason[: _LONGEST_REASON - 3] + "..."
