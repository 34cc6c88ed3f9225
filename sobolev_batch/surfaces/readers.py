"""Mesh files into meshes, with the checks that the libraries which parse them leave out.

The parsers' raw arrays are used, not their mesh classes, which drop or repair what they dislike in
silence. Every count that a file announces is compared with what came out.
"""

from __future__ import annotations

import gzip
import io
import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
from numpy.typing import NDArray
from trimesh.exchange import gltf, obj, off, ply, stl
from trimesh.resolvers import FilePathResolver
from trimesh.scene.transforms import SceneGraph

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.mesh import Mesh

Raw = tuple[NDArray[Any], NDArray[Any]]

# A bound against decompression bombs; 8 GiB hold some 160 million binary STL triangles.
_LARGEST_BYTES = 8 << 30


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
    suffixes = [suffix.lower() for suffix in path.suffixes]
    compressed = suffixes[-1:] == [".gz"]
    suffix = (suffixes[:-1] if compressed else suffixes)[-1:]
    parser = _PARSERS.get(suffix[0]) if suffix else None
    if parser is None:
        known = ", ".join(_PARSERS)
        raise MeshError(f"{path}: no mesh format has this name; known are {known}, each also with .gz")
    data = _read_bytes(path, compressed)
    try:
        vertices, triangles = parser(data, path)
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    except Exception as error:
        # The parsers raise anything from struct.error to RecursionError on damaged input.
        reason = " ".join(str(error).split())[:200] or "no details"
        raise MeshError(f"{path}: not a readable {suffix[0]} file: {type(error).__name__}: {reason}") from error
    try:
        return Mesh(vertices, triangles)
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error


def _read_bytes(path: Path, compressed: bool) -> bytes:
    try:
        with gzip.open(path) if compressed else path.open("rb") as file:
            data = file.read(_LARGEST_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise MeshError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(data) > _LARGEST_BYTES:
        raise MeshError(f"{path}: larger than {_LARGEST_BYTES} bytes after decompression")
    if not data:
        raise MeshError(f"{path}: the file is empty")
    return data


def _parse_ply(data: bytes, path: Path) -> Raw:
    header, found, body = data.partition(b"end_header")
    counts = {name.decode(): int(count) for name, count in re.findall(rb"^element\s+(\w+)\s+(\d+)", header, re.M)}
    if not found or "vertex" not in counts or "face" not in counts:
        raise MeshError("the PLY header does not announce vertices and faces")
    if re.search(rb"^format\s+ascii", header, re.M):
        lines = sum(1 for line in body.splitlines()[1:] if line.strip())
        if lines != sum(counts.values()):
            raise MeshError(f"the PLY header announces {sum(counts.values())} entries, found {lines}")
    elif sum(counts.values()) > len(body):
        raise MeshError(f"the PLY header announces {counts}, but only {len(body)} bytes follow")
    vertices, triangles = _single(ply.load_ply(io.BytesIO(data), skip_materials=True))
    if len(vertices) != counts["vertex"] or len(triangles) < counts["face"]:
        raise MeshError(
            f"the PLY header announces {counts['vertex']} vertices and {counts['face']} faces, "
            f"found {len(vertices)} vertices and {len(triangles)} triangles"
        )
    return vertices, triangles


def _parse_obj(data: bytes, path: Path) -> Raw:
    text = data.decode("utf-8", errors="replace").replace("\\\n", " ")
    faces = [line.split("#")[0].split()[1:] for line in text.splitlines() if re.match(r"\s*f\s", line)]
    seen = 0
    for number, face in enumerate(faces, 1):
        for corner in face:
            if re.match(r"[+-]?0*(/|$)", corner):
                raise MeshError(f"face {number} has the vertex index 0; OBJ counts from 1")
        if len(face) < 3:
            raise MeshError(f"face {number} has {len(face)} vertices, expected three or more")
        seen += len(face) - 2
    vertices, triangles = _merged_scene(obj.load_obj(io.StringIO(text), skip_materials=True, maintain_order=True))
    if len(triangles) != seen:
        raise MeshError(f"its {len(faces)} faces make {seen} triangles, but {len(triangles)} could be read")
    return vertices, triangles


def _parse_off(data: bytes, path: Path) -> Raw:
    text = data.decode("utf-8", errors="replace")
    lines = [content for line in text.splitlines() if (content := line.split("#")[0].strip())]
    # The counts stand after the keyword, on its own line or the next.
    counts = re.match(r"\S*OFF\s+(\d+)\s+(\d+)", " ".join(lines[:2]))
    if counts is None:
        raise MeshError("the OFF header does not announce vertices and faces")
    announced = int(counts[1]) + int(counts[2])
    found = len(lines) - (1 if len(lines[0].split()) > 1 else 2)
    if found != announced:
        raise MeshError(f"the OFF header announces {announced} vertices and faces, found {found}")
    return _single(off.load_off(io.StringIO(text)))


def _parse_stl(data: bytes, path: Path) -> Raw:
    announced = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + 50 * announced:
        expected = announced
    elif data.lstrip()[:5].lower() == b"solid":
        expected = len(re.findall(rb"^\s*facet\b", data, re.M | re.I))
    else:
        raise MeshError(
            f"a binary STL file of {len(data)} bytes holds {(len(data) - 84) / 50:.2f} triangles, "
            f"but its header announces {announced}"
        )
    vertices, triangles = _merged_scene(stl.load_stl(io.BytesIO(data)))
    if len(triangles) != expected:
        raise MeshError(f"it announces {expected} triangles, but {len(triangles)} could be read")
    return _merge_coincident(vertices, triangles)


def _parse_gltf(data: bytes, path: Path) -> Raw:
    load = gltf.load_glb if data[:4] == b"glTF" else gltf.load_gltf
    loaded = load(io.BytesIO(data), resolver=FilePathResolver(str(path.resolve())), skip_materials=True)
    return _merge_coincident(*_merged_scene(loaded))


def _parse_gifti(data: bytes, path: Path) -> Raw:
    image = nibabel.GiftiImage.from_bytes(data)
    points = image.get_arrays_from_intent("NIFTI_INTENT_POINTSET")
    triangles = image.get_arrays_from_intent("NIFTI_INTENT_TRIANGLE")
    if len(points) != 1 or len(triangles) != 1:
        raise MeshError(
            f"a GIFTI surface has one point set and one triangle array, found {len(points)} and {len(triangles)}"
        )
    return points[0].data, triangles[0].data


def _single(loaded: dict[str, Any]) -> Raw:
    if "faces" not in loaded or loaded["faces"] is None:
        raise MeshError("the file has no faces")
    return np.asarray(loaded["vertices"]), np.asarray(loaded["faces"])


def _merged_scene(loaded: dict[str, Any]) -> Raw:
    """The meshes of a scene in the scene's own frame, one after the other."""
    if "geometry" not in loaded:
        return _single(loaded)
    geometry = {name: part for name, part in loaded["geometry"].items() if "faces" in part}
    if not geometry:
        raise MeshError("the file has no faces")
    graph = SceneGraph()
    for edge in loaded["graph"]:
        graph.update(**edge)
    vertices: list[NDArray[Any]] = []
    triangles: list[NDArray[Any]] = []
    for node in sorted(graph.nodes_geometry):
        matrix, name = graph[node]
        if name not in geometry:
            continue
        points, faces = _single(geometry[name])
        if faces.size and not (faces.min() >= 0 and faces.max() < len(points)):
            raise MeshError(f"the part {name!r} has vertex indices outside 0..{len(points) - 1}")
        triangles.append(faces + sum(map(len, vertices)))
        if not np.array_equal(matrix, np.eye(4)):
            points = points.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        vertices.append(points)
    if not vertices:
        raise MeshError("no part of the file's scene has faces")
    return np.concatenate(vertices), np.concatenate(triangles)


def _merge_coincident(vertices: NDArray[Any], triangles: NDArray[Any]) -> Raw:
    if not (triangles.size and triangles.min() >= 0 and triangles.max() < len(vertices)):
        return vertices, triangles
    merged, index = np.unique(vertices, axis=0, return_inverse=True)
    return merged, index.reshape(-1)[triangles]


_PARSERS: dict[str, Callable[[bytes, Path], Raw]] = {
    ".ply": _parse_ply,
    ".obj": _parse_obj,
    ".stl": _parse_stl,
    ".off": _parse_off,
    ".gltf": _parse_gltf,
    ".glb": _parse_gltf,
    ".gii": _parse_gifti,
}
