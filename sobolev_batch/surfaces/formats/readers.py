"""Readers of mesh files: the parser of each format, and predictions of sizes."""

from __future__ import annotations

import gzip
import shlex
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.freesurfer import is_freesurfer_name, parse_freesurfer
from sobolev_batch.surfaces.formats.gifti import parse_gifti
from sobolev_batch.surfaces.formats.gltf import buffer_paths, parse_gltf
from sobolev_batch.surfaces.formats.ply import HEADER_BYTES, announced_sizes, parse_ply
from sobolev_batch.surfaces.formats.raw_files import (
    checked_length,
    is_gzipped,
    open_regular,
    read_unpacked,
    require_memory_to_read,
    unpacked_limit,
)
from sobolev_batch.surfaces.formats.stl import parse_stl
from sobolev_batch.surfaces.formats.text_formats import parse_obj, parse_off
from sobolev_batch.surfaces.formats.vtk import parse_vtk
from sobolev_batch.surfaces.shapes.mesh import Mesh

Raw = tuple[NDArray[Any], NDArray[Any]]

_LONGEST_REASON = 250
_FREESURFER = "freesurfer"
# Factor by which gzip usually shrinks mesh files.
_PACKING = 4
# Smallest possible sizes of a vertex and a face in a PLY file.
_LEAST_VERTEX_BYTES, _LEAST_FACE_BYTES = 3, 4
# Usual sizes in a PLY file: of a vertex in double precision, and of a corner.
_VERTEX_BYTES, _CORNER_BYTES = 24, 4.4
# Memory of reading a PLY file: factor of reading row by row, and bytes of each vertex beyond one for two triangles.
_TEXT_FACTOR, _VERTEX_MEMORY = 7.0, 70.0
# Bytes of each triangle, in a file of nothing but positions and triangles, and at the measured peak of reading it.
_BYTES_PER_TRIANGLE = {
    ".ply": (19, 90),
    ".obj": (35, 240),
    ".stl": (50, 270),
    ".off": (35, 240),
    ".gltf": (18, 190),
    ".glb": (18, 190),
    ".gii": (10, 90),
    ".vtk": (22, 290),
    ".vtp": (10, 215),
    ".vtu": (10, 215),
    _FREESURFER: (18, 80),
}


def read_mesh(path: str | Path) -> Mesh:
    """Read a mesh from a PLY, OBJ, STL, OFF, glTF, GLB, GIFTI, VTK or FreeSurfer file, gzipped or not.

    The format follows from the name: FreeSurfer's are such as lh.pial, VTK's end in .vtk, .vtp or .vtu. Coordinates
    keep the precision of the file. Polygons are cut into fans of triangles, which is exact for convex ones. STL and
    glTF repeat vertices, so those that coincide exactly are merged; vertices of other formats stay as they are.

    Args:
        path: Path of the file.

    Raises:
        MeshError: The file is missing, of no known format, damaged, or holds no valid mesh. The message
            starts with the path, and says how to convert files of formats that are known, but not read.

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
    if suffix not in _PARSERS:
        raise MeshError(f"{path}: {_how_to_convert(path)}")
    data = [_checked_bytes(path)]
    try:
        # Numbers that overflow become infinite, which the mesh refuses.
        with np.errstate(all="ignore"):
            # Only the parser holds the bytes, so that it can free them early.
            vertices, triangles = _PARSERS[suffix](data.pop(), path)
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
    file_bytes, memory_bytes = _BYTES_PER_TRIANGLE[mesh_format(path).removesuffix(".gz")]
    return memory_bytes / file_bytes


def expected_size(path: Path) -> tuple[int, float]:
    """Estimate the number of triangles in a file, and the peak of the memory in bytes that reading it takes.

    The estimate rests on the header of a PLY file, and on the length of others. It never exceeds what a file
    of this length can hold. Both are zero where the file cannot be read.
    """
    suffix = mesh_format(path)
    unpacked_suffix = suffix.removesuffix(".gz")
    if unpacked_suffix not in _BYTES_PER_TRIANGLE:
        return 0, 0.0
    file_bytes, memory_bytes = _BYTES_PER_TRIANGLE[unpacked_suffix]
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
    triangles = int(length / file_bytes)
    return triangles, triangles * memory_bytes


def _announced_size(header: bytes, length: int) -> tuple[int, float]:
    """Estimate the same for a PLY file of this length, whose header may announce anything."""
    vertices, faces, text = announced_sizes(header)
    vertices, faces = min(vertices, length // _LEAST_VERTEX_BYTES), min(faces, length // _LEAST_FACE_BYTES)
    # The length of the file shows whether faces have more than three corners.
    corners = (length - vertices * _VERTEX_BYTES) / max(faces, 1) / _CORNER_BYTES
    triangles = faces if text or corners < 4 else 2 * faces
    memory_bytes = _BYTES_PER_TRIANGLE[".ply"][1] * (_TEXT_FACTOR if text or triangles > faces else 1)
    return triangles, triangles * memory_bytes + _VERTEX_MEMORY * max(0.0, vertices - triangles / 2)


def mesh_format(path: Path) -> str:
    """Return the suffix in lower case or "freesurfer", with .gz where it has that: it decides on the parser."""
    name, packing = _unpacked_name(path).lower(), ".gz" if is_gzipped(path) else ""
    suffix = Path(name).suffix
    is_other = suffix in _PARSERS or suffix in _COMMANDS or suffix in _REPLACEMENTS
    return (_FREESURFER if not is_other and is_freesurfer_name(name) else suffix) + packing


def is_mesh_name(path: Path) -> bool:
    """Return whether a file has the name of a mesh, in a format that is read or that can be converted."""
    suffix = mesh_format(path).removesuffix(".gz")
    return suffix in _PARSERS or suffix in _COMMANDS


def mesh_stem(path: Path) -> str:
    """Return the name of a file without its format and compression; FreeSurfer's names are all stem."""
    name = _unpacked_name(path)
    return name if mesh_format(path).startswith(_FREESURFER) else Path(name).stem


def _unpacked_name(path: Path) -> str:
    return path.name[: -len(".gz")] if is_gzipped(path) else path.name


def _how_to_convert(path: Path) -> str:
    """Return why a file's name names no format that is read, and what to do."""
    suffix = mesh_format(path).removesuffix(".gz")
    if suffix in _REPLACEMENTS:
        return f"{suffix} files hold {_REPLACEMENTS[suffix]}"
    if suffix in _COMMANDS:
        old, new = _unpacked_name(path), Path(_unpacked_name(path)).stem
        command = _COMMANDS[suffix].format(old=shlex.quote(old), new=shlex.quote(new))
        unpack = f"gunzip {shlex.quote(path.name)}; " if is_gzipped(path) else ""
        return f"{suffix} files are not read; convert it, for example by: {unpack}{command}"
    known = ", ".join(name for name in _PARSERS if name != _FREESURFER)
    return (
        f"no mesh format has this name; known are {known} and FreeSurfer's names such as lh.pial, each also with .gz. "
        "MeshLab and ParaView open many others and save them as .ply"
    )


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


_PARSERS: dict[str, Callable[[bytes, Path], Raw]] = {
    ".ply": parse_ply,
    ".obj": lambda data, _: parse_obj(data),
    ".stl": lambda data, _: parse_stl(data),
    ".off": lambda data, _: parse_off(data),
    ".gltf": parse_gltf,
    ".glb": parse_gltf,
    ".gii": parse_gifti,
    ".vtk": parse_vtk,
    ".vtp": parse_vtk,
    ".vtu": parse_vtk,
    _FREESURFER: parse_freesurfer,
}

# Commands that make a readable file of those of other formats: {old} is its name, {new} that of the new one without its
# ending.
_ASSIMP, _GMSH = "assimp export {old} {new}.ply", "gmsh {old} -2 -o {new}.stl"
_MESHIO = "meshio convert {old} {new}.vtu"
_PYMESHLAB = (
    "python -c 'import pymeshlab, sys; meshes = pymeshlab.MeshSet(); meshes.load_new_mesh(sys.argv[1]); "
    "meshes.generate_by_merging_visible_meshes(); meshes.save_current_mesh(sys.argv[2])' {old} {new}.ply"
)
_PYVISTA = (
    "python -c 'import pyvista, sys; pyvista.read(sys.argv[1]){0}.triangulate().save(sys.argv[2])' {{old}} {{new}}.vtp"
)
_BLENDER = (
    "blender --background{0} --python-expr 'import bpy, sys; {1}bpy.ops.wm.ply_export(filepath=sys.argv[-1])' -- "
    "{{old}} {{new}}.ply"
)
_OPEN_USD = "bpy.ops.wm.read_factory_settings(use_empty=True); bpy.ops.wm.usd_import(filepath=sys.argv[-2]); "
_COMMANDS: dict[str, str] = {
    **dict.fromkeys((".fbx", ".lwo"), _ASSIMP),
    **dict.fromkeys((".step", ".stp", ".iges", ".igs", ".brep"), _GMSH),
    **dict.fromkeys((".msh", ".mesh", ".inp", ".bdf", ".xdmf"), _MESHIO),
    **dict.fromkeys((".3ds", ".3mf", ".ctm", ".dae", ".wrl", ".x3d"), _PYMESHLAB),
    **dict.fromkeys((".vtm", ".pvd"), _PYVISTA.format(".combine().extract_surface()")),
    ".pvtp": _PYVISTA.format(""),
    ".pvtu": _PYVISTA.format(".extract_surface()"),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), _BLENDER.format("", _OPEN_USD)),
    ".blend": _BLENDER.format(" {old}", ""),
    ".drc": "draco_decoder -i {old} -o {new}.ply",
    ".asc": "mris_convert {old} {new}.gii",
}
# What other files hold that no command makes a surface of.
_REPLACEMENTS: dict[str, str] = {
    **dict.fromkeys((".csv", ".txt", ".xyz"), "points and no surface: make a mesh of them first"),
    **dict.fromkeys(
        (".annot", ".label", ".mgh"),
        "values at the vertices of a surface: give the surface, such as lh.pial",
    ),
    **dict.fromkeys(
        (".dcm", ".mgz", ".mha", ".mhd", ".nii", ".nrrd", ".vti"),
        "a volume: make the surface in it a mesh first, such as by skimage.measure.marching_cubes",
    ),
}
