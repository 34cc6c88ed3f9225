"""What parsers of the extras share: XML in small parts, words of any type, and parts that are placed and joined."""

import re
from collections.abc import Iterator, Sequence
from typing import Any, Literal
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.errors import MeshError
from sobolev_batch.geometry.formats.parsing import as_declared, reals

# XML that parsers would go through again and again, or hold in memory many times over: one tag with its attributes,
# comment or instruction, elements within each other, and elements in all. Those of surfaces are a few hundred bytes,
# five deep and a few hundred.
_LONGEST_MARKUP, _DEEPEST, _MOST_ELEMENTS = 1 << 16, 100, 100_000
_XML_BYTES = 1 << 14
# What NumPy calls the orders of bytes that files of XML name.
BYTE_ORDERS: dict[str, Literal["<", ">"]] = {"LittleEndian": "<", "BigEndian": ">"}
# The command that takes the surface of cells with volume.
SURFACE = "python -c \"import pyvista; pyvista.read('scan{}').extract_surface().triangulate().save('scan.vtp')\""
_INTEGERS = re.compile("[-+0-9]*")
_Event = tuple[str, str, dict[str, str]]


def xml_events(data: bytes, kind: str, most_elements: int = _MOST_ELEMENTS) -> Iterator[_Event]:
    """Parse XML a little at a time, and refuse what would take memory out of proportion in a file of some kind.

    Yield ("start", name, attributes) and ("end", name, {}) of each element, and ("text", piece, {}) between them.
    """
    events, heard = list[_Event](), 0

    def refuse_entity(name: str, *_: object) -> None:
        raise MeshError(f"the XML declares the entity {name[:40]!r}; a {kind} file has none, write it without")

    def hear(_: str) -> None:
        nonlocal heard
        heard += 1

    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.EntityDeclHandler, parser.DefaultHandlerExpand = refuse_entity, hear
    parser.StartElementHandler = lambda name, attributes: events.append(("start", name, attributes))
    parser.EndElementHandler = lambda name: events.append(("end", name, {}))
    parser.CharacterDataHandler = lambda piece: events.append(("text", piece, {}))
    silent = depth = elements = 0
    for place in range(0, len(data), _XML_BYTES):
        heard = 0
        parser.Parse(memoryview(data)[place : place + _XML_BYTES], False)
        # The parser tells of text at once, and keeps everything else until it is complete.
        silent = 0 if heard or events else silent + _XML_BYTES
        if silent > _LONGEST_MARKUP:
            raise MeshError(
                f"the XML has an attribute, name or comment of more than {_LONGEST_MARKUP} bytes, which goes on "
                f"at byte {place + _XML_BYTES}; a {kind} file has none, write it without"
            )
        for event in events:
            elements += event[0] == "start"
            depth += (event[0] == "start") - (event[0] == "end")
            if depth > _DEEPEST or elements > most_elements:
                raise MeshError(
                    f"the XML has element {elements} at the depth {depth}; a {kind} file has at most {most_elements} "
                    f"elements, nested up to {_DEEPEST} deep: save it with the surface alone"
                )
            yield event
        events.clear()
    parser.Parse(b"", True)
    yield from events


def xml_tree(data: bytes, kind: str) -> Element:
    """Parse XML with the limits of `xml_events` into its elements."""
    builder = TreeBuilder()
    for event, value, attributes in xml_events(data, kind):
        match event:
            case "start":
                builder.start(value, attributes)
            case "end":
                builder.end(value)
            case _:
                builder.data(value)
    return builder.close()


def typed(words: Sequence[str], dtype: np.dtype[Any], owner: str) -> NDArray[Any]:
    """Return words as numbers of a type; an error begins with their owner."""
    if dtype.kind in "iu" and not _INTEGERS.fullmatch("".join(words)):
        raise MeshError(f"{owner} has fractions or other words for integers")
    return as_declared(reals(words, owner), dtype, owner)


def beside_volume(cells: int, faces: int) -> tuple[str, ...]:
    """Return what notes say of cells with volume, which have no part in the surface of the faces beside them."""
    return (f"{cells:,} cells with volume are left out beside {faces:,} faces",) if cells else ()


def placed(vertices: Reals, triangles: Indices, linear: Reals, shift: Reals) -> tuple[Reals, Indices]:
    """Return vertices x as x @ linear + shift, and their triangles, which a mirror turns round."""
    return vertices @ linear + shift, triangles[:, :: -1 if np.linalg.det(linear) < 0 else 1]


def joined(parts: Sequence[tuple[Reals, Indices]]) -> tuple[Reals, Indices]:
    """Return the vertices (n, 3) and triangles (m, 3) of parts as those of one mesh."""
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    triangles = [indices + offset for (_, indices), offset in zip(parts, offsets[:-1], strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(triangles)
