"""glTF 2.0: scenes of triangles, .gltf or .glb, as they stand before any animation.

The library at hand silently leaves out primitives, placements and encodings; here they are read or refused. Source:
Khronos Group, "glTF 2.0" (2021), with KHR_mesh_quantization, KHR_node_visibility and EXT_mesh_gpu_instancing.
"""

import base64
import json
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count, repeat, takewhile
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.errors import MeshError
from sobolev_batch.extras.formats.shared import joined, placed
from sobolev_batch.geometry.formats.by_name import Format
from sobolev_batch.geometry.formats.parsing import Raw, triangle_strips, unpacked_limit
from sobolev_batch.geometry.mesh import merge_coincident

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
# Indices have no sign: negative ones, which would count from the end, are as wrong as those beyond it.
_INDEX = np.uint32
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# Modes of primitives: points and lines have none of the area; triangles, strips and fans of them follow.
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_INSTANCING, _VISIBILITY = "EXT_mesh_gpu_instancing", "KHR_node_visibility"
# Required extensions that do not change the positions of vertices, or that are read.
_HARMLESS = re.compile(
    r"[A-Z]+_(materials|texture|techniques|lights|animation)_.*|KHR_(mesh_quantization|xmp.*)|"
    rf"EXT_(mesh_features|instance_features|structural_metadata)|{_INSTANCING}|{_VISIBILITY}"
)
# What places a node within its parent.
_PLACING = frozenset({"matrix", "translation", "rotation", "scale"})
# Nodes of large assemblies are hundreds of thousands.
_MOST_NODES = 500_000
# Vertices (n, 3) and triangles (m, 3).
_Part = tuple[Reals, Indices]
# What a part takes at least.
_PART_BYTES = 1000
_PLAIN = "export it without; a compression by npx @gltf-transform/cli copy scan.glb plain.glb"


def parse_gltf(data: bytes, beside: Mapping[str, bytes]) -> Raw:
    """Return the vertices and triangles of the default scene, in its own frame; coinciding vertices are merged.

    What other files hold is given by their names, as `files_beside` returns them.
    """
    tree, binary = _document(data)
    required = [name for name in map(str, tree.get("extensionsRequired", [])) if not _HARMLESS.fullmatch(name)]
    if required:
        raise MeshError(f"it requires the glTF extension {', '.join(required)}; {_PLAIN}")
    file = _File(tree, _loaded_buffers(tree, binary, beside))
    most, total = unpacked_limit(len(data) + sum(map(len, beside.values()))), 0

    def grow(size: int) -> None:
        """Refuse what takes so many bytes more: nodes may share a mesh or a skin, and primitives an array."""
        nonlocal total
        total += max(size, _PART_BYTES)
        if total > most:
            raise MeshError(f"its scene repeats parts until they take over {most} bytes; export it unfolded")

    parts: list[_Part] = []
    matrices = _node_matrices(tree)
    for index, matrix in matrices.items():
        node = tree["nodes"][index]
        if "mesh" not in node:
            continue
        mesh = _entry(tree, "meshes", node["mesh"])
        for primitive in mesh["primitives"]:
            grow(0)
            if primitive.get("mode", _TRIANGLES) in range(_TRIANGLES):
                continue
            part = vertices, triangles = _primitive(file, primitive, node.get("weights", mesh.get("weights", [])))
            if "skin" in node:
                skin = _entry(tree, "skins", node["skin"])
                grow(matrix.nbytes * len(skin["joints"]))
                vertices = _skinned(file, primitive["attributes"], skin, matrices, part)
            for instance in _instances(file, node):
                grow(vertices.nbytes + triangles.nbytes)
                # Its joints alone place a skin.
                one = np.eye(4) if "skin" in node else matrix @ instance
                parts.append(placed(vertices, triangles, one[:3, :3].T, one[:3, 3]))
    if not parts:
        raise MeshError("the file's scene has no faces")
    others = sum("mesh" in node for index, node in enumerate(tree["nodes"]) if index not in matrices)
    notes = (f"{others:,} nodes with meshes are outside of the scene that is shown, and left out",) if others else ()
    vertices, triangles = merge_coincident(*joined(parts))
    # Nodes that turn nothing leave the single precision of the file.
    single = vertices.astype(np.float32)
    return Raw(single if np.array_equal(single, vertices) else vertices, triangles, notes)


def files_beside(data: bytes) -> tuple[str, ...]:
    """Return the names of files that hold the buffers of a document."""
    uris = [buffer.get("uri") for buffer in _document(data)[0].get("buffers", [])]
    return tuple(unquote(uri) for uri in uris if uri is not None and not uri.startswith("data:"))


def _loaded_buffers(tree: dict[str, Any], binary: bytes | None, beside: Mapping[str, bytes]) -> list[bytes]:
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
            buffers.append(beside[unquote(uri)])
        if len(buffers[-1]) < buffer["byteLength"]:
            raise MeshError(f"buffer {index} announces {buffer['byteLength']} bytes, found {len(buffers[-1])}")
    return buffers


def _entry(tree: Mapping[str, Any], kind: str, index: Any) -> Any:
    """Return an entry of a list of the document; its index need not be one."""
    entries = tree.get(kind, [])
    if type(index) is not int or not 0 <= index < len(entries):
        raise MeshError(f"it refers to the entry {str(index)[:20]} of its {kind}, of which it has {len(entries)}")
    return entries[index]


@dataclass(frozen=True)
class _File:
    """A document, and the bytes of its buffers."""

    tree: dict[str, Any]
    buffers: list[bytes]

    def values(self, index: int, kind: str, expected: int | None = None) -> NDArray[Any]:
        """Return the values of an accessor: (count,) of a SCALAR, (count, 3) of a VEC3 ..., as many as expected."""
        accessor = _entry(self.tree, "accessors", index)
        count, component, sparse = accessor["count"], accessor["componentType"], accessor.get("sparse")
        if expected not in (None, count):
            raise MeshError(f"accessor {index} has {count} entries, expected {expected}")
        if accessor["type"] != kind:
            raise MeshError(f"accessor {index} has the type {accessor['type']}, expected {kind}")
        if "bufferView" in accessor:
            values = self._held(accessor, (count, _WIDTHS[kind]), component)
        elif sparse is None or count > max(map(len, self.buffers), default=0):
            raise MeshError(f"accessor {index} has no data, as in compressed files; {_PLAIN}")
        else:
            values = np.zeros((count, _WIDTHS[kind]), _COMPONENTS[component])
        if sparse is not None:
            some, places, values = sparse["count"], sparse["indices"], values.copy()
            rows = self._held(places, (some, 1), places["componentType"])[:, 0].astype(_INDEX)
            values[rows] = self._held(sparse["values"], (some, _WIDTHS[kind]), component)
        if accessor.get("normalized"):
            values = np.maximum(values / np.iinfo(values.dtype).max, -1.0)
        return values[:, 0] if kind == "SCALAR" else values

    def _held(self, place: Mapping[str, Any], shape: tuple[int, int], component: int) -> NDArray[Any]:
        """Return the rows at some place of a view of a buffer."""
        view, dtype = _entry(self.tree, "bufferViews", place["bufferView"]), np.dtype(_COMPONENTS[component])
        count, width = shape[0], dtype.itemsize * shape[1]
        stride, offset = view.get("byteStride", width), place.get("byteOffset", 0)
        if stride < width:
            raise MeshError(f"an accessor has entries of {width} bytes every {stride} bytes")
        if min(offset, count) < 0 or (count and offset + stride * (count - 1) + width > view["byteLength"]):
            raise MeshError(f"an accessor announces {count} entries, more than its {view['byteLength']} bytes hold")
        start, buffer = view.get("byteOffset", 0), _entry({"buffers": self.buffers}, "buffers", view["buffer"])
        if start < 0 or start + view["byteLength"] > len(buffer):
            raise MeshError(f"a buffer view ends at byte {start + view['byteLength']} of a buffer of {len(buffer)}")
        return np.ndarray(shape, dtype, buffer, start + offset, (stride, dtype.itemsize))


def _document(data: bytes) -> tuple[dict[str, Any], bytes | None]:
    """Return the JSON of a file and the second chunk of a binary one."""
    binary = None
    if data[:4] == b"glTF":
        version, length, size = struct.unpack_from("<III", data, 4)
        _require_second(str(version))
        if length != len(data):
            raise MeshError(f"a GLB file announces {length} bytes, found {len(data)}")
        if rest := data[20 + size :]:
            binary_size = struct.unpack_from("<I", rest, 0)[0]
            binary = rest[8 : 8 + binary_size]
            if len(binary) != binary_size:
                raise MeshError(f"a GLB chunk announces {binary_size} bytes, found {len(binary)}")
        data = data[20 : 20 + size]
    # Some programs fill up the first chunk with zeros.
    tree = json.loads(data.rstrip(b"\0").decode("utf-8"))
    if not isinstance(tree, dict):
        raise MeshError("the file's JSON is not an object")
    # The meshes of the first version have names.
    _require_second(str(tree.get("asset", {}).get("version", 1 + isinstance(tree.get("meshes", []), list))))
    return tree, binary


def _require_second(version: str) -> None:
    if version.split(".")[0] != "2":
        raise MeshError(f"it is of version {version[:20]} of glTF, expected 2.0; export it as glTF 2.0")


def _node_matrices(tree: dict[str, Any]) -> dict[int, Reals]:
    """Return the matrix that places each node of the default scene that is not hidden, by the node's index."""
    nodes = tree.get("nodes", [])
    if len(nodes) > _MOST_NODES:
        raise MeshError(f"it has {len(nodes)} nodes, of which {_MOST_NODES} are read; export it with fewer")
    if tree.get("scenes"):
        roots = _entry(tree, "scenes", tree.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [index for index in range(len(nodes)) if index not in children]
    pending = list(zip(reversed(roots), repeat(np.eye(4))))
    found: dict[int, Reals] = {}
    while pending:
        index, parent_matrix = pending.pop()
        if index in found:
            raise MeshError(f"node {index} of the scene has two parents")
        node = _entry(tree, "nodes", index)
        if not node.get("extensions", {}).get(_VISIBILITY, {}).get("visible", True):
            continue
        found[index] = matrix = parent_matrix if _PLACING.isdisjoint(node) else parent_matrix @ _matrix(node)
        pending += [(child, matrix) for child in reversed(node.get("children", []))]
    return found


def _matrix(node: dict[str, Any]) -> Reals:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    rotation = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    # Some programs write few digits, which would also stretch.
    x, y, z, w = np.divide(rotation, np.linalg.norm(rotation) or 1, dtype=np.float64)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= node.get("scale", (1.0, 1.0, 1.0))
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _instances(file: _File, node: dict[str, Any]) -> Iterator[Reals]:
    """Yield the matrix of each instance of a node's mesh, within the node."""
    found = node.get("extensions", {}).get(_INSTANCING)
    if found is None:
        yield np.eye(4)
        return
    kinds = {"TRANSLATION": "VEC3", "ROTATION": "VEC4", "SCALE": "VEC3"}
    columns = {name.lower(): file.values(at, kinds[name]) for name, at in found["attributes"].items() if name in kinds}
    if not columns:
        raise MeshError(f"a node has instances ({_INSTANCING}) without places; export it without the extension")
    for rows in zip(*columns.values(), strict=True):
        yield _matrix(dict(zip(columns, rows, strict=True)))


def _skinned(
    file: _File, attributes: dict[str, int], skin: dict[str, Any], matrices: dict[int, Reals], part: _Part
) -> Reals:
    """Return the vertices of a skin where its joints hold them, and no numbers for those that none holds."""
    if lost := [joint for joint in skin["joints"] if joint not in matrices]:
        raise MeshError(f"a skin has the joint {str(lost[0])[:20]}, which is no node of the scene; export it whole")
    joints = np.array([matrices[joint] for joint in skin["joints"]])
    if "inverseBindMatrices" in skin:
        inverse = file.values(skin["inverseBindMatrices"], "MAT4").reshape(-1, 4, 4).transpose(0, 2, 1)
        if len(inverse) < len(joints):
            raise MeshError(f"a skin has {len(joints)} joints and {len(inverse)} matrices to bind them")
        joints = joints @ inverse[: len(joints)]
    vertices, triangles = part
    found, total = np.zeros_like(vertices), np.zeros((len(vertices), 1))
    for group in takewhile(lambda group: f"JOINTS_{group}" in attributes, count()):
        held = file.values(attributes[f"JOINTS_{group}"], "VEC4", len(vertices)).astype(_INDEX)
        weights = file.values(attributes[f"WEIGHTS_{group}"], "VEC4", len(vertices))
        for joint in range(4):
            by = joints[held[:, joint], :3]
            total += weights[:, joint, None]
            found += weights[:, joint, None] * (np.einsum("nij,nj->ni", by[..., :3], vertices) + by[..., 3])
    if not (total[triangles] > 0).all():
        raise MeshError("a skin has vertices that no joint holds; export it posed, without the skin")
    # Bytes round weights, and some programs leave their sum open.
    return found / total


def _primitive(file: _File, primitive: dict[str, Any], weights: list[float]) -> _Part:
    """Return positions and triangles of a primitive, morphed by the weights of its targets."""
    vertices = file.values(primitive["attributes"]["POSITION"], "VEC3").astype(np.float64)
    for target, weight in zip(primitive.get("targets", []), weights, strict=False):
        if weight and "POSITION" in target:
            vertices += weight * file.values(target["POSITION"], "VEC3", len(vertices))
    if "indices" in primitive:
        corners = file.values(primitive["indices"], "SCALAR").astype(_INDEX).astype(np.int64)
    else:
        corners = np.arange(len(vertices), dtype=np.int64)
    mode = primitive.get("mode", _TRIANGLES)
    if mode == _STRIP:
        triangles = triangle_strips(corners, np.array([len(corners)]))
    elif mode == _FAN and len(corners) > 2:
        triangles = np.stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]], axis=1)
    elif mode == _TRIANGLES and len(corners) % 3 == 0:
        triangles = corners.reshape(-1, 3)
    else:
        raise MeshError(f"{len(corners)} indices make no whole triangles of the mode {mode}")
    if (triangles >= len(vertices)).any():
        raise MeshError(f"a primitive has the index {triangles.max()}, outside 0..{len(vertices) - 1}")
    return vertices, triangles


FORMATS = (Format((".gltf", ".glb"), parse_gltf, 18, 190, files_beside=files_beside),)
