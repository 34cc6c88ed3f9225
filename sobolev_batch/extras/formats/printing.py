"""3MF: what printers build, as XML in a zip archive.

Sources: 3MF Consortium, "3D Manufacturing Format: Core Specification" 1.3 (2021), and "Production Extension" 1.1, by
which objects lie in further parts of the archive.
"""

from __future__ import annotations

import io
import re
import zipfile
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.errors import MeshError
from sobolev_batch.extras.formats.shared import joined, placed, xml_events
from sobolev_batch.geometry.formats.by_name import Format
from sobolev_batch.geometry.formats.parsing import Raw, reals, require_memory_to_read, unpacked_limit, whole

_RELATIONS, _OF_MODEL = "_rels/.rels", "/3dmodel"
_UNIT, _SUPPORTS = "millimeter", ("support", "solidsupport")
_AS_IT_IS = "1 0 0 0 1 0 0 0 1 0 0 0"
# Extensions that do not change what is built, by words of their names.
_HARMLESS = ("/material/", "/production/", "/trianglesets/")
# Shapes of extensions, which a file need not require.
_UNREAD = frozenset(("beamlattice", "booleanshape", "displacementmesh", "levelset"))
# Where slicers say what they print in another way, or not at all.
_SETTINGS = ("/slic3r_pe_model.config", "/model_settings.config")
_UNLIKE = re.compile(rb'subtype="(?!normal_part)|"(?:ParameterModifier|NegativeVolume|SupportEnforcer|SupportBlocker)"')
# Objects within each other.
_DEEPEST = 30
# Bytes of memory for each of XML, and for each object that is placed.
_MEMORY, _OBJECT_BYTES = 3, 1000
# Part and number of an object, and the matrix (4, 3) behind rows that places it.
_Placing = tuple[str, str, Reals]


@dataclass
class _Object:
    kind: str
    vertices: array[float] = field(default_factory=lambda: array("d"))
    triangles: array[int] = field(default_factory=lambda: array("q"))
    components: list[_Placing] = field(default_factory=list)


class _Package:
    """An archive whose parts are read once, and unpack to no more than a bound."""

    def __init__(self, data: bytes) -> None:
        self.archive = zipfile.ZipFile(io.BytesIO(data))
        # Names of parts are the same in upper case, and some programs for archives turn their slashes round.
        self.names = {name.replace("\\", "/").lower(): name for name in self.archive.namelist()}
        self.most = self.left = unpacked_limit(len(data))
        self.parts: dict[str, dict[str, _Object]] = {}
        self.items: list[_Placing] = []
        self.units: set[str] = set()
        self.unread: set[str] = set()
        self.supports = self.unprinted = self.size = 0

    def read(self, name: str) -> bytes:
        """Return the bytes of a part; it has no more than its entry says, or is refused by the library."""
        entry = self.archive.getinfo(self.names.get(name.lower(), name))
        self.left -= entry.file_size
        if self.left < 0 or entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise MeshError(f"its part {name[:80]!r} unpacks to more than mesh files do, or is packed in a rare way")
        require_memory_to_read(_MEMORY * (self.most - self.left))
        return self.archive.read(entry)

    def part(self, name: str) -> dict[str, _Object]:
        """Return the objects of a part by their numbers."""
        if name in self.parts:
            return self.parts[name]
        objects = self.parts[name] = {}
        data, prefixes = self.read(name), set[str]()
        for event, tag, values in xml_events(data, "3MF", len(data)):
            prefix, _, word = tag.rpartition(":")
            # The names of the core may have a prefix: that of the root, or another one of the same meaning.
            if not prefixes:
                meaning = values.get(f"xmlns:{prefix}" if prefix else "xmlns")
                prefixes = {prefix, *(key[len("xmlns:") :] for key in values if values[key] == meaning)}
            match event, word if prefix in prefixes else "":
                case "start", "" if word in _UNREAD:
                    self.unread.add(word)
                case "start", "model":
                    self.units.add(values.get("unit", _UNIT))
                    required = values.get("requiredextensions", "").split()
                    names = [values.get(f"xmlns:{short}", short) for short in required]
                    if wrong := [one for one in names if not any(word in one for word in _HARMLESS)]:
                        raise MeshError(f"it requires the 3MF extension {', '.join(wrong)}; export it without")
                case "start", "object":
                    if values["id"] in objects:
                        raise MeshError(f"a part has two objects of the number {values['id'][:20]}")
                    found = objects[values["id"]] = _Object(values.get("type", "model"))
                case "start", "vertex":
                    found.vertices.extend(reals([values[axis] for axis in "xyz"], "a vertex"))
                case "start", "triangle":
                    found.triangles.extend(whole(values[corner], "a triangle") for corner in ("v1", "v2", "v3"))
                case "start", "component":
                    found.components.append(_placing(values, name))
                case "start", "item":
                    self.items.append(_placing(values, name))
                    self.unprinted += values.get("printable") == "0"
        return objects

    def placed(self, placing: _Placing, outer: Reals, depth: int = 0) -> Iterator[tuple[Reals, Indices]]:
        """Yield the vertices and triangles of an object and its components, placed by a matrix (4, 4)."""
        name, number, matrix = placing
        found = self.part(name)[number]
        matrix = np.column_stack([matrix, [0, 0, 0, 1]]) @ outer
        # Any number of components may place one object.
        self.size += _OBJECT_BYTES + 8 * (len(found.vertices) + len(found.triangles))
        if depth > _DEEPEST or self.size > self.most:
            raise MeshError(f"it repeats objects, {_DEEPEST} deep or up to {self.most} bytes; save it unfolded")
        if found.kind in _SUPPORTS:
            self.supports += 1
            return
        vertices = np.array(found.vertices).reshape(-1, 3)
        triangles = np.array(found.triangles, dtype=np.int64).reshape(-1, 3)
        if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(vertices):
            raise MeshError(f"object {number[:20]} has an index outside 0..{len(vertices) - 1}")
        yield placed(vertices, triangles, matrix[:3, :3], matrix[3, :3])
        for component in found.components:
            yield from self.placed(component, matrix, depth + 1)


def parse_3mf(data: bytes) -> Raw:
    """Return the vertices and triangles of all that a 3MF file builds, without supports, in its unit of length."""
    package = _Package(data)
    relations = xml_events(package.read(_RELATIONS), "3MF")
    roots = [values["Target"] for _, _, values in relations if values.get("Type", "").endswith(_OF_MODEL)]
    package.part("".join(roots[:1]).lstrip("/"))
    # What further parts would build does not count.
    parts = [one for item in tuple(package.items) for one in package.placed(item, np.eye(4))]
    if not sum(len(triangles) for _, triangles in parts):
        raise MeshError("the file builds no faces")
    if len(package.units) > 1:
        raise MeshError(f"its parts have several units of length: {', '.join(sorted(package.units))}")
    notes = [f"{package.supports} supports are left out"] if package.supports else []
    notes += [f"its unit of length is the {unit}" for unit in package.units - {_UNIT}]
    settings = b"".join(package.read(name) for name in package.names if name.endswith(_SETTINGS))
    if others := len(_UNLIKE.findall(settings)):
        notes.append(f"{others} parts that the slicer calls modifiers, negative or for supports count like all others")
    if package.unread:
        notes.append(f"shapes of the kind {', '.join(sorted(package.unread))} are left out, as extensions of 3MF")
    if package.unprinted:
        notes.append(f"{package.unprinted} items that the slicer does not print count like all others")
    return Raw(*joined(parts), tuple(notes))


def _placing(values: Mapping[str, str], part: str) -> _Placing:
    """Return which object a component or an item of a part places, and how."""
    matrix = np.array(reals(values.get("transform", _AS_IT_IS).split(), "a transform")).reshape(4, 3)
    other = next((value for name, value in values.items() if name.endswith(":path")), part)
    return other.lstrip("/"), values["objectid"], matrix


FORMATS = (Format((".3mf",), parse_3mf, 14, 180),)
