"""Formats that are only read: glTF 2.0, GIFTI, FreeSurfer's surfaces, and those of VTK.

The first three are read here because the libraries at hand leave out or believe what they should refuse: that of glTF
silently leaves out primitives, placements and encodings; that of GIFTI expands the entities of XML, unpacks data of any
size, believes any counts, and only warns of missing arrays. VTK, which the extra vtk installs, reports what it cannot
read and returns the rest; here every report is an error.

Sources: Khronos Group, "glTF 2.0" (2021); "GIFTI surface data format" 1.0 (2011), https://www.nitrc.org/projects/gifti;
FreeSurfer wiki, "Surface file format", https://surfer.nmr.mgh.harvard.edu/fswiki/FileFormats.
"""

from __future__ import annotations

import base64
import io
import json
import math
import re
import struct
import zlib
from collections import deque
from collections.abc import Iterator, Mapping
from functools import partial
from tempfile import NamedTemporaryFile
from threading import Lock
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.errors import MeshError, from_extra
from sobolev_batch.geometry.formats.by_name import Format
from sobolev_batch.geometry.formats.parsing import Raw, merge_coincident, triangle_fans, unpacked_limit, xml_events

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


_MOST_DIMENSIONS = 6
_GIFTI_TYPES = {
    f"NIFTI_TYPE_{name}": np.dtype(name.lower())
    for name in ("UINT8", "INT16", "UINT16", "INT32", "UINT32", "INT64", "UINT64", "FLOAT32", "FLOAT64")
}
_POINTS, _FACES = "NIFTI_INTENT_POINTSET", "NIFTI_INTENT_TRIANGLE"
# lh.pial, rh.white, sub-01.lh.sphere.reg, inner_skull.surf; but lh.aparc.annot has values at vertices.
_NAME = re.compile(r"(?:^|[._-])[lr]h\.[^.].*(?<!\.annot)(?<!\.label)(?<!\.mgh)(?<!\.mgz)$|.\.surf$")
_MAGIC = b"\xff\xff\xfe"
# The two lines after the number of the format: who made the file and when, and an empty one.
_HEADER_LINES = re.compile(rb"[^\n]{0,1000}\n[^\n]{0,1000}\n")
# Behind the triangles there may be the geometry of the volume, which begins with one of these.
_VOLUME = (b"\0\0\0\x14", b"\0\0\0\2\0\0\0\0\0\0\0\x14")


def parse_gifti(data: bytes) -> Raw:
    """Return the vertices and triangles of a GIFTI surface."""
    arrays: dict[str, list[NDArray[Any]]] = {_POINTS: [], _FACES: []}
    announced, found = None, 0
    attributes: Mapping[str, str] = {}
    texts: list[str] | None = None
    for event, name, values in xml_events(data, "GIFTI"):
        match event, name:
            case "start", "GIFTI":
                announced = values.get("NumberOfDataArrays")
            case "start", "DataArray":
                attributes, found = values, found + 1
            case "start", "Data":
                # Others hold normals, or values at vertices.
                texts = [] if attributes.get("Intent") in arrays else None
            case "text", piece if texts is not None:
                texts.append(piece)
            case "end", "Data" if texts is not None:
                of_kind = arrays[attributes["Intent"]]
                of_kind.append(_decoded("".join(texts), attributes, found, unpacked_limit(len(data))))
                texts = None
                if len(of_kind) > 1:
                    break
    else:
        if announced is not None and int(announced) != found:
            raise MeshError(f"the GIFTI header announces {announced[:20]} arrays, found {found}")
    points, faces = arrays.values()
    if len(points) != 1 or len(faces) != 1:
        raise MeshError(
            f"a GIFTI surface has one point set and one triangle array, found {len(points)} and {len(faces)}"
        )
    return points[0], faces[0]


def _decoded(text: str, attributes: Mapping[str, str], number: int, most_bytes: int) -> NDArray[Any]:
    """Return the data of a DataArray, which is the file's array of that number, from 1."""
    encoding = attributes.get("Encoding", "")
    if attributes.get("ExternalFileName") or "External" in encoding:
        raise MeshError("its data lie in another file; write it with them inside")
    dtype = _GIFTI_TYPES.get(kind := attributes.get("DataType", ""))
    if dtype is None:
        raise MeshError(f"array {number} of the file is of the type {kind[:40]!r}, expected {', '.join(_GIFTI_TYPES)}")
    count = int(attributes.get("Dimensionality", 0))
    if not 1 <= count <= _MOST_DIMENSIONS:
        raise MeshError(f"array {number} of the file has {count} dimensions, expected 1 to {_MOST_DIMENSIONS}")
    shape = [int(attributes[f"Dim{axis}"]) for axis in range(count)]
    if min(shape) < 0:
        raise MeshError(f"array {number} of the file has a negative dimension: {shape}")
    size = math.prod(shape) * dtype.itemsize
    order: Literal["C", "F"] = "F" if attributes.get("ArrayIndexingOrder") == "ColumnMajorOrder" else "C"
    if encoding == "ASCII":
        if not text.strip():
            raise MeshError(f"array {number} of the file is empty")
        values: NDArray[Any] = np.loadtxt(io.StringIO(text), dtype, comments=None, ndmin=1)
    else:
        decoded = base64.b64decode(text)
        if encoding == "GZipBase64Binary":
            if size > most_bytes:
                raise MeshError(f"its arrays unpack to more than {most_bytes} bytes: no mesh file shrinks that far")
            # One byte more shows whether there are more.
            decoded = zlib.decompressobj().decompress(decoded, size + 1)
        elif encoding != "Base64Binary":
            raise MeshError(f"array {number} of the file has the encoding {encoding[:40]!r}, which GIFTI does not have")
        if len(decoded) != size:
            wrong = "more" if len(decoded) > size else "fewer"
            raise MeshError(f"array {number} of the file unpacks to {wrong} than the {size} bytes announced")
        values = np.frombuffer(decoded, dtype.newbyteorder(">" if attributes.get("Endian") == "BigEndian" else "<"))
    return np.asarray(values.reshape(shape, order=order))


def is_freesurfer_name(name: str) -> bool:
    """Return whether a file's name, without .gz, is one that FreeSurfer gives to surfaces.

    >>> [is_freesurfer_name(name) for name in ("lh.pial", "sub-01_rh.white", "inner_skull.surf", "ball.pial")]
    [True, True, True, False]
    """
    return _NAME.search(name.lower()) is not None


def parse_freesurfer(data: bytes) -> Raw:
    """Return the vertices and triangles of a FreeSurfer surface."""
    if len(data) >= 15 and len(data) == 15 + 4 * math.prod(np.frombuffer(data, ">i4", 3, 3)[[0, 2]].tolist()):
        raise MeshError(
            "it holds values at vertices, such as thickness or curvature; give the surface, such as lh.pial"
        )
    if not data.startswith(_MAGIC):
        raise MeshError(
            f"it begins with the bytes {data[:3].hex(' ')} and is no FreeSurfer surface of triangles, which begins "
            f"with {_MAGIC.hex(' ')}; give a surface such as lh.pial, or a name with the suffix of its own format"
        )
    lines = _HEADER_LINES.match(data, len(_MAGIC))
    if lines is None or len(data) < lines.end() + 8:
        raise MeshError("the file breaks off before the counts of its vertices and triangles")
    vertices, triangles = np.frombuffer(data, ">i4", 2, lines.end()).tolist()
    start = lines.end() + 8
    end = start + 12 * (vertices + triangles)
    if min(vertices, triangles) < 0 or end > len(data):
        raise MeshError(
            f"the header announces {vertices} vertices and {triangles} triangles, but the file has {len(data)} bytes"
        )
    if end < len(data) and not data[end : end + 12].startswith(_VOLUME):
        raise MeshError(f"the file has {len(data) - end} bytes behind its {triangles} triangles")
    coordinates = np.frombuffer(data, ">f4", 3 * vertices, start)
    corners = np.frombuffer(data, ">i4", 3 * triangles, start + coordinates.nbytes)
    return coordinates.reshape(-1, 3), corners.reshape(-1, 3)


# VTK's numbers for types of cells: vertices and lines, then those with area, triangles, polygons and quadrilaterals.
_WITHOUT_AREA, _VTK_TRIANGLE, _POLYGON, _QUAD = (1, 2, 3, 4), 5, 7, 9
_RAW_DATA = re.compile(rb"<AppendedData[^>]{0,200}encoding\s{0,9}=\s{0,9}[\"']raw[\"'][^>]{0,200}>\s{0,99}_")
_END = b"</VTKFile>"
# VTK has one place for the reports of all threads.
_shared = Lock()


def parse_vtk(data: bytes, suffix: str) -> Raw:
    """Return the vertices and triangles of a VTK file, legacy (.vtk) or XML (.vtp, .vtu)."""
    if suffix != ".vtk":
        _check_xml(data)
    with from_extra("vtk", "VTK files need", MeshError):
        import pyvista
    dataset = _dataset(data, suffix)
    kind = "nothing" if dataset is None else dataset.GetClassName()
    if kind == "vtkUnstructuredGrid":
        cells = dataset.GetCells()
        # PyVista knows what each version of VTK calls them.
        kinds = np.asarray(pyvista.wrap(dataset).celltypes, dtype=np.int64)
    elif kind == "vtkPolyData":
        if dataset.GetNumberOfStrips():
            raise MeshError("the file has strips; cut them: in PyVista by mesh.triangulate()")
        cells = dataset.GetPolys()
        kinds = np.full(cells.GetNumberOfCells(), _POLYGON)
    else:
        raise MeshError(
            f"the file holds {kind}, no polygons; take its surface first: in PyVista by "
            "mesh.extract_surface().triangulate(), then save it as .vtp"
        )
    ghosts = dataset.GetCellGhostArray()
    if ghosts is not None and _vtk_values(ghosts).any():
        raise MeshError(
            "the file has ghost cells, which belong to other parts of a surface; remove them: in PyVista by "
            "mesh.remove_ghost_cells()"
        )
    triangles = _vtk_triangles(kinds, _vtk_values(cells.GetConnectivityArray()), _vtk_values(cells.GetOffsetsArray()))
    return _vtk_values(dataset.GetPoints().GetData()), triangles


def _check_xml(data: bytes) -> None:
    """Refuse XML that would keep the library busy, and a file that breaks off."""
    if not data.rstrip().endswith(_END):
        raise MeshError(f"the file breaks off: it does not end with {_END.decode()}")
    raw = _RAW_DATA.search(data)
    # Raw bytes are no XML.
    document = data if raw is None else data[: raw.end()] + b"</AppendedData>" + _END
    deque(xml_events(document, "VTK"), maxlen=0)


def _dataset(data: bytes, suffix: str) -> Any:
    """Return the data set in a file, if VTK reports nothing about it."""
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkIOLegacy import vtkDataSetReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    readers: dict[str, Any] = {
        ".vtk": vtkDataSetReader,
        ".vtp": vtkXMLPolyDataReader,
        ".vtu": vtkXMLUnstructuredGridReader,
    }
    reports, reader = vtkStringOutputWindow(), readers[suffix]()
    with NamedTemporaryFile(suffix=suffix) as file, _shared:
        file.write(data)
        file.flush()
        window, verbosity = vtkOutputWindow.GetInstance(), vtkLogger.GetCurrentVerbosityCutoff()
        vtkOutputWindow.SetInstance(reports)
        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
        try:
            reader.SetFileName(file.name)
            reader.Update()
        finally:
            vtkLogger.SetStderrVerbosity(verbosity)
            vtkOutputWindow.SetInstance(window)
    if reports.GetOutput():
        # Each report begins with a place in VTK's code.
        raise MeshError(f"VTK reports: {re.sub(r'.*, line [0-9]+|[(]0x[0-9a-f]+[)]', '', reports.GetOutput())}")
    return reader.GetOutput()


def _vtk_values(array: Any) -> NDArray[Any]:
    """Return an array of VTK's, with integers in 64 bits."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    values = np.asarray(vtk_to_numpy(array))
    return values.astype(np.int64) if values.dtype.kind in "iu" else values


def _vtk_triangles(kinds: Indices, corners: Indices, offsets: Indices) -> Indices:
    """Return the triangles (m, 3) of cells of some types, from the corners of all and the places where each begins."""
    sizes = np.diff(offsets)
    if len(sizes) != len(kinds) or (sizes < 0).any() or sizes.sum() != len(corners):
        raise MeshError(f"the offsets of its {len(kinds)} cells do not run from 0 up to their {len(corners)} corners")
    has_area = ~np.isin(kinds, _WITHOUT_AREA)
    expected = np.select([kinds == _VTK_TRIANGLE, kinds == _QUAD, kinds == _POLYGON], [3, 4, sizes], -1)
    wrong = np.flatnonzero(has_area & (sizes != expected))
    if wrong.size:
        raise MeshError(
            f"cell {wrong[0] + 1} is of VTK's type {kinds[wrong[0]]} with {sizes[wrong[0]]} corners, no flat polygon; "
            "take the surface and cut it into triangles first: in PyVista by "
            "grid.extract_surface().triangulate(), then save it as .vtp"
        )
    return triangle_fans(corners[np.repeat(has_area, sizes)], sizes[has_area])


FORMATS = (
    Format((".gltf", ".glb"), parse_gltf, 18, 190),
    Format((".gii",), parse_gifti, 10, 90),
    Format((".vtk",), partial(parse_vtk, suffix=".vtk"), 22, 290),
    *(Format((suffix,), partial(parse_vtk, suffix=suffix), 10, 215) for suffix in (".vtp", ".vtu")),
    Format(("freesurfer",), parse_freesurfer, 18, 80, is_name=is_freesurfer_name),
)
