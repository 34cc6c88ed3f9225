"""glTF 2.0: scenes of triangles, .gltf or .glb.

The library at hand silently leaves out primitives, placements and encodings; here they are refused. Source: Khronos
Group, "glTF 2.0" (2021).
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.errors import MeshError
from sobolev_batch.geometry.formats.by_name import Format
from sobolev_batch.geometry.formats.parsing import Raw, merge_coincident, unpacked_limit

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3}
# Modes of primitives: points and lines have none of the area; triangles, strips and fans of them follow.
_TRIANGLES = 4
# Required extensions that do not change the positions of vertices.
_HARMLESS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "KHR_mesh_quantization", "KHR_xmp")


def parse_gltf(data: bytes) -> Raw:
    """Return the vertices and triangles of the default scene, in its own frame; coinciding vertices are merged."""
    tree, binary = _document(data)
    required = [name for name in tree.get("extensionsRequired", []) if not str(name).startswith(_HARMLESS)]
    if required:
        raise MeshError(f"it requires the glTF extension {', '.join(map(str, required))}; export it without")
    buffers = _loaded_buffers(tree, binary)
    most = unpacked_limit(len(data))
    placed: list[tuple[Reals, Indices]] = []
    total = 0
    for matrix, mesh in _placed_meshes(tree):
        for vertices, triangles in _primitives(tree, buffers, tree["meshes"][mesh]):
            placed.append((vertices @ matrix[:3, :3].T + matrix[:3, 3], triangles))
            total += vertices.nbytes + triangles.nbytes
            # Any number of nodes may place one mesh, and any number of primitives use one array.
            if total > most:
                raise MeshError(f"its scene repeats parts until they take more than {most} bytes; export it unfolded")
    if not placed:
        raise MeshError("the file's scene has no faces")
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in placed)])
    triangles = np.concatenate([indices + offset for (_, indices), offset in zip(placed, offsets[:-1], strict=True)])
    return merge_coincident(np.concatenate([vertices for vertices, _ in placed]), triangles)


def _loaded_buffers(tree: dict[str, Any], binary: bytes | None) -> list[bytes]:
    """Return the bytes of each buffer of a document."""
    buffers: list[bytes] = []
    for index, buffer in enumerate(tree.get("buffers", [])):
        uri = buffer.get("uri")
        if uri is None:
            if index != 0 or binary is None:
                raise MeshError(f"buffer {index} has no data")
            buffers.append(binary)
        elif uri.startswith("data:"):
            buffers.append(base64.b64decode(uri.partition(",")[2], validate=True))
        else:
            raise MeshError(f"its buffer {uri[:80]!r} is a file of its own; export the scene as one file, .glb")
        if len(buffers[-1]) < buffer["byteLength"]:
            raise MeshError(f"buffer {index} announces {buffer['byteLength']} bytes, found {len(buffers[-1])}")
    return buffers


def _values(tree: dict[str, Any], buffers: list[bytes], index: int, kind: str) -> NDArray[Any]:
    """Return the values of an accessor: (count,) of a SCALAR, (count, 3) of a VEC3."""
    accessor = tree["accessors"][index]
    if accessor["type"] != kind:
        raise MeshError(f"accessor {index} has the type {accessor['type']}, expected {kind}")
    if "sparse" in accessor or accessor.get("normalized") or "bufferView" not in accessor:
        raise MeshError(f"accessor {index} is sparse, normalized or without data: not supported, export it plainly")
    view = tree["bufferViews"][accessor["bufferView"]]
    dtype, width, count = np.dtype(_COMPONENTS[accessor["componentType"]]), _WIDTHS[kind], accessor["count"]
    stride = view.get("byteStride", dtype.itemsize * width)
    offset = accessor.get("byteOffset", 0)
    end = offset + (stride * (count - 1) + dtype.itemsize * width if count else 0)
    if stride < dtype.itemsize * width:
        raise MeshError(f"accessor {index} has entries of {dtype.itemsize * width} bytes every {stride} bytes")
    if min(offset, count) < 0 or end > view["byteLength"]:
        raise MeshError(f"accessor {index} announces {count} entries, more than its {view['byteLength']} bytes hold")
    start, buffer = view.get("byteOffset", 0), buffers[view["buffer"]]
    if start < 0 or start + view["byteLength"] > len(buffer):
        raise MeshError(f"a buffer view ends at byte {start + view['byteLength']} of a buffer of {len(buffer)}")
    values: NDArray[Any] = np.ndarray((count, width), dtype, buffer, start + offset, (stride, dtype.itemsize))
    return values[:, 0] if kind == "SCALAR" else values


def _document(data: bytes) -> tuple[dict[str, Any], bytes | None]:
    """Return the JSON of a file and the second chunk of a binary one."""
    binary = None
    if data[:4] == b"glTF":
        version, length = struct.unpack_from("<II", data, 4)
        if version != 2 or length != len(data):
            raise MeshError(
                f"a GLB file of version {version} and {length} bytes, found {len(data)}; expected version 2"
            )
        size = struct.unpack_from("<I", data, 12)[0]
        rest = data[20 + size :]
        if rest:
            binary_size = struct.unpack_from("<I", rest, 0)[0]
            binary = rest[8 : 8 + binary_size]
            if len(binary) != binary_size:
                raise MeshError(f"a GLB chunk announces {binary_size} bytes, found {len(binary)}")
        data = data[20 : 20 + size]
    tree = json.loads(data.decode("utf-8"))
    if not isinstance(tree, dict):
        raise MeshError("the file's JSON is not an object")
    return tree, binary


def _placed_meshes(tree: dict[str, Any]) -> Iterator[tuple[Reals, int]]:
    """Yield the index of each mesh of the default scene, with the matrix that places it."""
    nodes = tree.get("nodes", [])
    scenes = tree.get("scenes")
    if scenes:
        roots = scenes[tree.get("scene", 0)].get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [index for index in range(len(nodes)) if index not in children]
    pending = [(index, np.eye(4)) for index in reversed(roots)]
    visited: set[int] = set()
    while pending:
        index, parent_matrix = pending.pop()
        if index in visited or not 0 <= index < len(nodes):
            raise MeshError(f"node {index} of the scene is missing or has two parents")
        visited.add(index)
        matrix = parent_matrix @ _matrix(nodes[index])
        pending += [(child, matrix) for child in reversed(nodes[index].get("children", []))]
        if "mesh" in nodes[index]:
            yield matrix, nodes[index]["mesh"]


def _matrix(node: dict[str, Any]) -> Reals:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= node.get("scale", (1.0, 1.0, 1.0))
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _primitives(tree: dict[str, Any], buffers: list[bytes], mesh: dict[str, Any]) -> Iterator[tuple[Reals, Indices]]:
    """Yield positions and triangles of each primitive that has area, so no points or lines."""
    for primitive in mesh["primitives"]:
        mode = primitive.get("mode", _TRIANGLES)
        if mode < _TRIANGLES:
            continue
        if mode > _TRIANGLES:
            raise MeshError(f"a primitive has the mode {mode}, strips or fans; export plain triangles")
        vertices = _values(tree, buffers, primitive["attributes"]["POSITION"], "VEC3").astype(np.float64)
        if "indices" in primitive:
            corners = _values(tree, buffers, primitive["indices"], "SCALAR").astype(np.int64)
        else:
            corners = np.arange(len(vertices), dtype=np.int64)
        if len(corners) % 3:
            raise MeshError(f"{len(corners)} indices make no whole triangles")
        triangles = corners.reshape(-1, 3)
        bad = np.flatnonzero((triangles >= len(vertices)).any(axis=1))
        if bad.size:
            raise MeshError(
                f"{bad.size} of {len(triangles)} triangles of a primitive have indices outside 0..{len(vertices) - 1}"
            )
        yield vertices, triangles


FORMATS = (Format((".gltf", ".glb"), parse_gltf, 18, 190),)
