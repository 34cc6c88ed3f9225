"""Mesh files into meshes: which parser reads which, and what every one of them must hold."""

from __future__ import annotations

import gzip
import math
import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, cast

import nibabel
import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.gltf import buffer_paths, parse_gltf
from sobolev_batch.surfaces.mesh import Mesh
from sobolev_batch.surfaces.ply import announced_sizes, parse_ply
from sobolev_batch.surfaces.stl import parse_stl
from sobolev_batch.surfaces.text_formats import parse_obj, parse_off

Raw = tuple[NDArray[Any], NDArray[Any]]

# A bound against decompression bombs; 8 GiB hold some 160 million binary STL triangles.
_LARGEST_BYTES = 8 << 30
_STEP_BYTES = 1 << 20
# Where the header of a PLY file is looked for.
_HEADER_BYTES = 1 << 16
# What gzip makes of mesh files, about.
_PACKING = 4
# Of PLY files: the least bytes of a face; bytes of a vertex in double precision and of a corner; how much more
# reading takes row by row than at once; and what a vertex takes beyond the one for every two triangles
# that the table counts in.
_LEAST_FACE_BYTES = 4
_VERTEX_BYTES, _CORNER_BYTES, _TEXT_FACTOR, _VERTEX_MEMORY = 24, 4.4, 7.0, 70.0
# Of each triangle in a file without anything but positions and triangles, and at the measured peak of reading it.
_BYTES_PER_TRIANGLE = {
    ".ply": (19, 90),
    ".obj": (35, 420),
    ".stl": (50, 270),
    ".off": (35, 1050),
    ".gltf": (18, 190),
    ".glb": (18, 190),
    ".gii": (10, 90),
}


def read_mesh(path: str | Path) -> Mesh:
    """Read a mesh from a PLY, OBJ, STL, OFF, glTF, GLB or GIFTI file, gzipped or not.

    The format follows from the name. Double precision is kept where the file has it. Polygons are
    cut into fans of triangles, which is exact for convex ones. STL and glTF vertices that coincide
    exactly are merged, since these formats repeat them; all other vertices stay as they are.

    Raises:
        MeshError: the file is missing, of no known format, damaged, or does not hold a valid mesh;
            the message starts with its path.
    """
    path = Path(path)
    suffix = mesh_format(path).removesuffix(".gz")
    if suffix not in _PARSERS:
        raise MeshError(f"{path}: no mesh format has this name; known are {', '.join(_PARSERS)}, each also with .gz")
    data = [read_bytes(path)]
    try:
        # The parser alone holds the bytes, and lets go of them as soon as it can.
        vertices, triangles = _PARSERS[suffix](data.pop(), path)
        for array in (vertices, triangles):
            array.setflags(write=False)
        return Mesh(vertices, triangles)
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    except Exception as error:
        # Damaged input makes the parsers raise anything from struct.error to RecursionError.
        reason = " ".join(str(error).split())[:200] or "no details"
        raise MeshError(f"{path}: not a readable {suffix} file: {type(error).__name__}: {reason}") from error


def expected_size(path: Path) -> tuple[int, float]:
    """About how many triangles a file holds, and the bytes of memory that reading it takes at its peak.

    From the length of the file, but for PLY, whose header tells; zero where it cannot be read.
    """
    suffix = mesh_format(path)
    each_in_file, each_in_memory = _BYTES_PER_TRIANGLE.get(suffix.removesuffix(".gz"), (math.inf, 0.0))
    packed = suffix.endswith(".gz")
    try:
        length = path.stat().st_size * (_PACKING if packed else 1)
        if suffix == ".gltf":
            length += sum(buffer.stat().st_size for buffer in companion_files(path))
        triangles = int(length / each_in_file)
        if suffix.startswith(".ply"):
            with gzip.open(path) if packed else path.open("rb") as file:
                vertices, faces, text = announced_sizes(file.read(_HEADER_BYTES))
            # Faces with more corners than three show in the length of the file.
            corners = (length - vertices * _VERTEX_BYTES) / max(faces, 1) / _CORNER_BYTES
            # A header may announce anything: no face takes less than this.
            faces = min(faces, int(length / _LEAST_FACE_BYTES))
            triangles = faces if text or corners < 4 else 2 * faces
            each_in_memory *= _TEXT_FACTOR if text or triangles > faces else 1
            return triangles, triangles * each_in_memory + _VERTEX_MEMORY * max(0.0, vertices - triangles / 2)
    except (OSError, EOFError, zlib.error, MeshError):
        return 0, 0.0
    return triangles, triangles * each_in_memory


def mesh_format(path: Path) -> str:
    """The suffix, in lower case, that says how a file is read, .gz included."""
    name = path.name.lower()
    return Path(name.removesuffix(".gz")).suffix + (".gz" if name.endswith(".gz") else "")


def mesh_stem(path: Path) -> str:
    """The file's name without its format and compression."""
    bare = path.name[: -len(".gz")] if path.name.lower().endswith(".gz") else path.name
    return Path(bare).stem


def companion_files(path: Path) -> list[Path]:
    """The further files that a mesh file consists of: the buffers of a glTF file.

    Raises:
        MeshError: the file cannot be read.
    """
    if mesh_format(path).removesuffix(".gz") not in (".gltf", ".glb"):
        return []
    try:
        return buffer_paths(read_bytes(path), path)
    except MeshError:
        raise
    except Exception as error:
        raise MeshError(f"{path}: not a readable glTF file: {type(error).__name__}") from error


def read_bytes(path: Path) -> bytes:
    """The bytes of a file, unpacked if its name ends in .gz.

    Raises:
        MeshError: it cannot be read, is empty, or is larger than 8 GiB.
    """
    try:
        with gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb") as file:
            data = _read_bounded(cast(IO[bytes], file))
    except (OSError, EOFError, ValueError, zlib.error) as error:
        raise MeshError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(data) > _LARGEST_BYTES:
        raise MeshError(f"{path}: larger than {_LARGEST_BYTES} bytes")
    if not data:
        raise MeshError(f"{path}: the file is empty")
    return data


def _read_bounded(file: IO[bytes]) -> bytes:
    """All of a file, or a little more than the bound; one large read would reserve the bound at once."""
    parts = []
    total = 0
    while total <= _LARGEST_BYTES and (part := file.read(_STEP_BYTES)):
        parts.append(part)
        total += len(part)
    return b"".join(parts)


def _parse_gifti(data: bytes, path: Path) -> Raw:
    image = nibabel.GiftiImage.from_bytes(data)
    announced = re.search(rb'NumberOfDataArrays\s*=\s*"(\d+)"', data)
    if announced is not None and int(announced[1]) != len(image.darrays):
        raise MeshError(f"the GIFTI header announces {int(announced[1])} arrays, found {len(image.darrays)}")
    points = image.get_arrays_from_intent("NIFTI_INTENT_POINTSET")
    triangles = image.get_arrays_from_intent("NIFTI_INTENT_TRIANGLE")
    if len(points) != 1 or len(triangles) != 1:
        raise MeshError(
            f"a GIFTI surface has one point set and one triangle array, found {len(points)} and {len(triangles)}"
        )
    return np.asarray(points[0].data), np.asarray(triangles[0].data)


_PARSERS: dict[str, Callable[[bytes, Path], Raw]] = {
    ".ply": parse_ply,
    ".obj": lambda data, _: parse_obj(data),
    ".stl": lambda data, _: parse_stl(data),
    ".off": lambda data, _: parse_off(data),
    ".gltf": parse_gltf,
    ".glb": parse_gltf,
    ".gii": _parse_gifti,
}
