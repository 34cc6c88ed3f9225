"""Writers of mesh files, independent of the libraries that the package reads them with.

They check nothing, so that tests can write damaged files: with wrong counts, indices or coordinates.
"""

from __future__ import annotations

import base64
import io
import json
import locale
import struct
import zipfile
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import nibabel
import numpy as np
from nibabel.gifti import GiftiDataArray
from numpy.typing import ArrayLike

from sobolev_batch import Mesh
from tests.support.shapes import BOX_TRIANGLES, BOX_VERTICES

Faces = Sequence[Sequence[int]]


def write_with(writer: Any) -> bool:
    """Let a writer of VTK write its file: older ones leave the locale at C, in which text is ASCII to later tests."""
    before = locale.setlocale(locale.LC_ALL)
    try:
        return bool(writer.Write())
    finally:
        locale.setlocale(locale.LC_ALL, before)


# Writes contents to a file whose name has an ending, and reads the mesh: see the fixture `read`.
Read = Callable[[str, bytes], Mesh]

LITTLE, BIG = "binary_little_endian", "binary_big_endian"

_STRUCT_CODES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I"}
_STRUCT_CODES |= {"float": "f", "double": "d"}


def numbers(row: ArrayLike) -> str:
    """Return the shortest decimals that read back as the same doubles."""
    return " ".join(repr(float(x)) for x in np.asarray(row).ravel())


def ply(
    vertices: ArrayLike,
    faces: Faces,
    encoding: str = "ascii",
    *,
    real: str = "float",
    length: str = "uchar",
    index: str = "int",
    vertex_count: int | None = None,
    face_count: int | None = None,
    more: str = "",
) -> bytes:
    """Return a PLY file; ``more`` names further real vertex properties, whose values are all 1/2."""
    rows = [[*row, *([0.5] * len(more))] for row in np.asarray(vertices).tolist()]
    header = [
        "ply",
        f"format {encoding} 1.0",
        "comment element vertex 77",
        f"element vertex {len(rows) if vertex_count is None else vertex_count}",
        *[f"property {real} {name}" for name in "xyz" + more],
        f"element face {len(faces) if face_count is None else face_count}",
        f"property list {length} {index} vertex_indices",
        "end_header",
    ]
    start = "".join(f"{line}\n" for line in header).encode()
    if encoding == "ascii":
        lines = [numbers(row) for row in rows] + [" ".join(map(str, [len(face), *face])) for face in faces]
        return start + "".join(f"{line}\n" for line in lines).encode()
    order = "<" if encoding == LITTLE else ">"
    body = b"".join(struct.pack(order + _STRUCT_CODES[real] * len(row), *row) for row in rows)
    for face in faces:
        body += struct.pack(f"{order}{_STRUCT_CODES[length]}", len(face))
        body += struct.pack(order + _STRUCT_CODES[index] * len(face), *face)
    return start + body


def obj(vertices: ArrayLike, faces: Faces, corner: Callable[[int, int], str] | None = None) -> bytes:
    """Return an OBJ file; ``corner`` writes a corner of a face from the index of its vertex, from 1, and its rank."""
    spell = corner or (lambda vertex, place: str(vertex))
    lines = [f"v {numbers(row)}" for row in np.asarray(vertices)]
    lines += ["f " + " ".join(spell(vertex + 1, place) for place, vertex in enumerate(face)) for face in faces]
    return "".join(f"{line}\n" for line in lines).encode()


def off(
    vertices: ArrayLike,
    faces: Faces,
    header: str = "OFF\n",
    *,
    vertex_count: int | None = None,
    face_count: int | None = None,
) -> bytes:
    rows = np.asarray(vertices)
    counts = (len(rows) if vertex_count is None else vertex_count, len(faces) if face_count is None else face_count)
    lines = [f"{counts[0]} {counts[1]} 0", *[numbers(row) for row in rows]]
    lines += [" ".join(map(str, [len(face), *face])) for face in faces]
    return (header + "".join(f"{line}\n" for line in lines)).encode()


def off_binary(vertices: ArrayLike, faces: Faces, kind: str = "", more: int = 0, colors: int = 0) -> bytes:
    """Return an OFF file in binary, with further numbers behind each vertex and each face."""
    rows = b"".join(struct.pack(f">{3 + more}f", *row, *[0.5] * more) for row in np.asarray(vertices).tolist())
    for face in faces:
        rows += struct.pack(f">{len(face) + 2}i{colors}f", len(face), *face, colors, *[0.5] * colors)
    return f"{kind}OFF BINARY\n".encode() + struct.pack(">3i", len(np.asarray(vertices)), len(faces), 0) + rows


def vtk_legacy(vertices: ArrayLike, faces: Faces) -> bytes:
    """Return a legacy file of VTK of polygons, in text."""
    points = [numbers(row) for row in np.asarray(vertices)]
    rows = "\n".join(" ".join(map(str, [len(face), *face])) for face in faces)
    return (
        f"# vtk DataFile Version 3.0\nscan\nASCII\nDATASET POLYDATA\nPOINTS {len(points)} double\n"
        + "\n".join(points)
        + f"\nPOLYGONS {len(faces)} {sum(map(len, faces)) + len(faces)}\n{rows}\n"
    ).encode()


def stl_text(vertices: ArrayLike, faces: Faces, name: str = "box") -> bytes:
    rows = np.asarray(vertices)
    facets = [
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {numbers(rows[vertex])}\n" for vertex in face)
        + "endloop\nendfacet\n"
        for face in faces
    ]
    return f"solid {name}\n{''.join(facets)}endsolid {name}\n".encode()


def stl_binary(vertices: ArrayLike, faces: Faces, start: bytes = b"box", *, count: int | None = None) -> bytes:
    rows = np.asarray(vertices, dtype=np.float64)
    facets = [struct.pack("<12fH", 0, 0, 0, *rows[list(face)].ravel(), 0) for face in faces]
    return start.ljust(80, b"\0") + struct.pack("<I", len(facets) if count is None else count) + b"".join(facets)


GltfPart = tuple[ArrayLike, ArrayLike | None, int | None]
_COMPONENTS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}


class Gltf:
    """A glTF scene, with its JSON document as ``tree``, which may be changed, and its one buffer as ``blob``.

    Args:
        meshes: Primitives of each mesh: vertices, indices (or None) and mode (or None).
        nodes: Nodes, as in the JSON document.
        roots: Indices of the scene's root nodes; all nodes unless given.
        real: Type of the coordinates.
        index: Type of the indices.
    """

    def __init__(
        self,
        meshes: Sequence[Sequence[GltfPart]],
        nodes: Sequence[dict[str, Any]],
        roots: Sequence[int] | None = None,
        *,
        real: str = "float32",
        index: str = "uint16",
    ) -> None:
        self.blob = b""
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": list(range(len(nodes)) if roots is None else roots)}],
            "nodes": list(nodes),
            "accessors": [],
            "bufferViews": [],
        }
        self.tree["meshes"] = [
            {"primitives": [self._primitive(*part, real, index) for part in parts]} for parts in meshes
        ]
        self.tree["buffers"] = [{"byteLength": len(self.blob)}]

    def accessor(self, values: ArrayLike, kind: str, dtype: str) -> int:
        """Append values to the buffer, and return the index of their accessor."""
        array = np.ascontiguousarray(values, dtype=dtype)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.blob), "byteLength": array.nbytes})
        place = len(self.tree["accessors"])
        accessor = {"bufferView": place, "componentType": _COMPONENTS[dtype], "count": len(array), "type": kind}
        self.tree["accessors"].append(accessor)
        self.blob += array.tobytes()
        self.blob += bytes(-len(self.blob) % 4)
        return place

    def _primitive(
        self, vertices: ArrayLike, indices: ArrayLike | None, mode: int | None, real: str, index: str
    ) -> dict[str, Any]:
        primitive: dict[str, Any] = {"attributes": {"POSITION": self.accessor(vertices, "VEC3", real)}}
        if indices is not None:
            primitive["indices"] = self.accessor(np.asarray(indices).ravel(), "SCALAR", index)
        if mode is not None:
            primitive["mode"] = mode
        return primitive

    def glb(self) -> bytes:
        self.tree["buffers"][0]["byteLength"] = len(self.blob)
        document = json.dumps(self.tree).encode()
        document += b" " * (-len(document) % 4)
        length = 12 + 8 + len(document) + 8 + len(self.blob)
        head = struct.pack("<4sIII4s", b"glTF", 2, length, len(document), b"JSON")
        return head + document + struct.pack("<I4s", len(self.blob), b"BIN\0") + self.blob

    def gltf(self, uri: str | None = None) -> bytes:
        """Return the JSON form; the buffer is embedded, or in the file that ``uri`` names."""
        embedded = "data:application/octet-stream;base64," + base64.b64encode(self.blob).decode()
        self.tree["buffers"][0] = {"byteLength": len(self.blob), "uri": uri or embedded}
        return json.dumps(self.tree).encode()


def gifti(
    vertices: ArrayLike | None,
    faces: ArrayLike | None,
    encoding: str = "GIFTI_ENCODING_B64GZ",
    *,
    ordering: str = "C",
    points: int = 1,
) -> bytes:
    """Return a GIFTI file with several point sets."""
    settings = {"encoding": encoding, "ordering": ordering}
    arrays = []
    if vertices is not None:
        places = np.asarray(vertices, dtype=np.float32)
        arrays += [GiftiDataArray(places, intent="NIFTI_INTENT_POINTSET", **settings)] * points
    if faces is not None:
        arrays.append(GiftiDataArray(np.asarray(faces), intent="NIFTI_INTENT_TRIANGLE", **settings))
    return bytes(nibabel.GiftiImage(darrays=arrays).to_bytes())


def freesurfer(
    vertices: ArrayLike, triangles: ArrayLike, volume: bytes = b"", *, counts: tuple[int, int] | None = None
) -> bytes:
    rows, corners = np.asarray(vertices), np.asarray(triangles)
    header = b"\xff\xff\xfecreated by somebody on a Monday\n\n"
    header += struct.pack(">2i", *(counts or (len(rows), len(corners))))
    return header + rows.astype(">f4").tobytes() + corners.astype(">i4").tobytes() + volume


def medit(vertices: ArrayLike, faces: Faces, more: str = "", *, face_count: int | None = None) -> bytes:
    """Return a Medit mesh of triangles and quadrilaterals, with more sections behind them."""
    lines = ["MeshVersionFormatted 2 # by hand", "", "Dimension", "3", "Vertices", str(len(np.asarray(vertices)))]
    lines += [f"{numbers(row)} 0" for row in np.asarray(vertices)]
    for name, size in (("Triangles", 3), ("Quadrilaterals", 4)):
        rows = [face for face in faces if len(face) == size]
        lines += [name, str(len(rows) if face_count is None else face_count)] if rows or size == 3 else []
        lines += [" ".join(str(vertex + 1) for vertex in row) + " 7" for row in rows]
    return "\n".join([*lines, more, "End", ""]).encode()


def gmsh_first(vertices: ArrayLike, faces: Faces, *, face_count: int | None = None) -> bytes:
    """Return a Gmsh mesh of the format 2.2, with nodes numbered 10, 20 ... from the last, and a point and a line."""
    rows = [f"{10 * (i + 1)} {numbers(row)}" for i, row in enumerate(np.asarray(vertices))][::-1]
    cells = ["1 15 2 0 1 10", "2 1 2 0 1 10 20"]
    cells += [
        f"{i + 9} {len(face) - 1} 3 0 1 2 " + " ".join(str(10 * (v + 1)) for v in face) for i, face in enumerate(faces)
    ]
    count = str(len(cells) if face_count is None else face_count + 2)
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$PhysicalNames", "0", "$EndPhysicalNames"]
    lines += ["$Nodes", str(len(rows)), *rows, "$EndNodes", "$Elements", count, *cells, "$EndElements", ""]
    return "\n".join(lines).encode()


def gmsh_first_binary(vertices: ArrayLike, faces: Faces, order: str = "<") -> bytes:
    """Return the same in binary of an order, with two blocks of each kind of cell, and tetrahedra after them."""
    rows = [struct.pack(f"{order}i3d", 10 * (i + 1), *map(float, row)) for i, row in enumerate(np.asarray(vertices))]
    cells = [struct.pack(f"{order}6i", 15, 1, 2, 1, 0, 1) + struct.pack(f"{order}i", 10)]
    for size in sorted({len(face) for face in faces}):
        some = [face for face in faces if len(face) == size]
        for part in (some[:1], some[1:]):
            cells.append(struct.pack(f"{order}3i", size - 1, len(part), 3) if part else b"")
            cells += [struct.pack(f"{order}{4 + size}i", 9, 0, 1, 2, *(10 * (v + 1) for v in face)) for face in part]
    cells.append(struct.pack(f"{order}3i", 4, 1, 0) + struct.pack(f"{order}5i", 99, 10, 20, 30, 50))
    head = b"$MeshFormat\n2.2 1 8\n" + struct.pack(f"{order}i", 1) + b"\n$EndMeshFormat\n$Nodes\n"
    body = b"%d\n%s\n$EndNodes\n$Elements\n" % (len(rows), b"".join(rows[::-1]))
    return head + body + b"%d\n%s\n$EndElements\n" % (2 + len(faces), b"".join(cells))


def gmsh(vertices: ArrayLike, faces: Faces, order: str = "", *, face_count: int | None = None) -> bytes:
    """Return a Gmsh mesh of the format 4.1, in text or in binary of an order, with nodes of parametric coordinates."""

    def packed(code: str, *values: float) -> bytes:
        return (
            struct.pack(f"{order}{len(values)}{code}", *values) if order else f"{' '.join(map(str, values))}\n".encode()
        )

    rows = np.asarray(vertices, dtype=np.float64)
    sections = {b"MeshFormat": b"4.1 %d 8\n" % bool(order) + (packed("i", 1) + b"\n" if order else b"")}
    nodes = packed("Q", 2, len(rows), 3, 10 * len(rows)) + packed("i", 2, 1, 1) + packed("Q", len(rows) - 1)
    nodes += b"".join(packed("Q", 10 * (i + 1)) for i in range(1, len(rows)))
    nodes += b"".join(packed("d", *map(float, row), 0.5, 0.25) for row in rows[1:])
    nodes += packed("i", 0, 1, 0) + packed("Q", 1) + packed("Q", 10) + packed("d", *map(float, rows[0]))
    kinds = sorted({len(face) for face in faces})
    cells = packed("Q", len(kinds) + 1, len(faces) + 1, 1, len(faces) + 1)
    cells += packed("i", 0, 1, 15) + packed("Q", 1) + packed("Q", 1, 10)
    for size in kinds:
        some = [face for face in faces if len(face) == size]
        cells += packed("i", 2, 1, size - 1) + packed("Q", len(some) if face_count is None else face_count)
        cells += b"".join(packed("Q", i + 2, *(10 * (vertex + 1) for vertex in face)) for i, face in enumerate(some))
    sections |= {b"Nodes": nodes, b"Elements": cells}
    return b"".join(
        b"$%s\n%s\n$End%s\n" % (name, body.rstrip(b"\n") if not order else body, name)
        for name, body in sections.items()
    )


AS_IT_IS = "1 0 0 0 1 0 0 0 1 0 0 0"
_NO_DATE = (1980, 1, 1, 0, 0, 0)


def archive(parts: dict[str, bytes]) -> bytes:
    """Return a zip archive of parts by their names."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as package:
        for name, content in parts.items():
            package.writestr(zipfile.ZipInfo(name, _NO_DATE), content, zipfile.ZIP_DEFLATED)
    return file.getvalue()


def model(objects: str, items: str = '<item objectid="1"/>', attributes: str = 'unit="millimeter"') -> bytes:
    """Return the main part of a 3MF file."""
    start = f'<model {attributes} xmlns:p="http://schemas.microsoft.com/3dmanufacturing/production/2015/06">'
    return f"{start}<resources>{objects}</resources><build>{items}</build></model>".encode()


def object_3mf(vertices: ArrayLike, faces: Faces, number: int = 1, attributes: str = "") -> str:
    rows = "".join('<vertex x="{!r}" y="{!r}" z="{!r}"/>'.format(*map(float, row)) for row in np.asarray(vertices))
    triangles = "".join('<triangle v1="{}" v2="{}" v3="{}"/>'.format(*face) for face in faces)
    mesh = f"<mesh><vertices>{rows}</vertices><triangles>{triangles}</triangles></mesh>"
    return f'<object id="{number}" {attributes}>{mesh}</object>'


def package_3mf(main: bytes, **parts: bytes) -> bytes:
    """Return a 3MF file of its main part and others by their names."""
    kind = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
    relations = f'<Relationships><Relationship Target="/3D/main.model" Id="r" Type="{kind}"/></Relationships>'
    return archive({"_rels/.rels": relations.encode(), "3D/main.model": main, **parts})


def three_mf(vertices: ArrayLike, faces: Faces) -> bytes:
    return package_3mf(model(object_3mf(vertices, faces)))


# What stands in a surface behind its triangles: the geometry of the volume that it was made of.
VOLUME = (
    b"\0\0\0\2\0\0\0\0\0\0\0\x14valid = 1  # volume info valid\nfilename = ../mri/filled.mgz\nvolume = 256 256 256\n"
)

# The end of a file's name, and its bytes.
Content = tuple[str, bytes]


def box_scene() -> Gltf:
    """Return the box as a new scene of one node, which may be changed."""
    return Gltf([[(BOX_VERTICES, BOX_TRIANGLES, None)]], [{"mesh": 0}])


OFF_BOX = off(BOX_VERTICES, BOX_TRIANGLES)
BOXES: dict[str, Content] = {
    "ply ascii float": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES)),
    "ply ascii double": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, real="double")),
    "ply little float": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, LITTLE)),
    "ply little double": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, LITTLE, real="double", index="uint")),
    "ply big float": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, BIG, index="ushort")),
    "ply big double": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, BIG, real="double", length="int")),
    "obj": (".obj", obj(BOX_VERTICES, BOX_TRIANGLES)),
    "off": (".off", OFF_BOX),
    "stl ascii": (".stl", stl_text(BOX_VERTICES, BOX_TRIANGLES)),
    "stl binary": (".stl", stl_binary(BOX_VERTICES, BOX_TRIANGLES)),
    "stl binary that starts with solid": (".stl", stl_binary(BOX_VERTICES, BOX_TRIANGLES, b"solid box")),
    "gltf": (".gltf", box_scene().gltf()),
    "glb": (".glb", box_scene().glb()),
    "gifti gzipped": (".gii", gifti(BOX_VERTICES, np.array(BOX_TRIANGLES, dtype=np.int32))),
    "gifti base64": (".gii", gifti(BOX_VERTICES, np.array(BOX_TRIANGLES, np.int32), "GIFTI_ENCODING_B64BIN")),
    "gifti ascii": (".gii", gifti(BOX_VERTICES, np.array(BOX_TRIANGLES, np.int32), "GIFTI_ENCODING_ASCII")),
    "freesurfer": ("_lh.pial", freesurfer(BOX_VERTICES, BOX_TRIANGLES, VOLUME)),
    "freesurfer without volume": (".rh.white", freesurfer(BOX_VERTICES, BOX_TRIANGLES)),
    "medit": (".mesh", medit(BOX_VERTICES, BOX_TRIANGLES)),
    "gmsh 2.2": (".msh", gmsh_first(BOX_VERTICES, BOX_TRIANGLES)),
    "gmsh 2.2 little": (".msh", gmsh_first_binary(BOX_VERTICES, BOX_TRIANGLES)),
    "gmsh 4.1": (".msh", gmsh(BOX_VERTICES, BOX_TRIANGLES)),
    "gmsh 4.1 little": (".msh", gmsh(BOX_VERTICES, BOX_TRIANGLES, "<")),
    "gmsh 4.1 big": (".msh", gmsh(BOX_VERTICES, BOX_TRIANGLES, ">")),
    "3mf": (".3mf", three_mf(BOX_VERTICES, BOX_TRIANGLES)),
    "gifti by columns": (".gii", gifti(BOX_VERTICES, np.array(BOX_TRIANGLES, np.int32), ordering="F")),
}

# Of each form: the end of a file's name, and what writes vertices and faces.
WRITERS: dict[str, tuple[str, Callable[..., bytes]]] = {
    "ply ascii": (".ply", ply),
    "ply little": (".ply", partial(ply, encoding=LITTLE)),
    "ply big": (".ply", partial(ply, encoding=BIG)),
    "obj": (".obj", obj),
    "off": (".off", off),
    "stl ascii": (".stl", stl_text),
    "stl binary": (".stl", stl_binary),
    "glb": (".glb", lambda vertices, faces: Gltf([[(vertices, faces, None)]], [{"mesh": 0}]).glb()),
    "gifti": (".gii", lambda vertices, faces: gifti(vertices, np.array(faces, np.int32).reshape(-1, 3))),
    "freesurfer": ("_lh.pial", freesurfer),
    "medit": (".mesh", medit),
    "gmsh 2.2": (".msh", gmsh_first),
    "gmsh 4.1": (".msh", gmsh),
    "gmsh 4.1 little": (".msh", partial(gmsh, order="<")),
    "3mf": (".3mf", three_mf),
}
