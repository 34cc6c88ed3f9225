"""Metadata documents of a store, restricted to what this package writes.

zarr finds codecs, data types and storage transformers by the names in these documents. Some of them unpickle what
they read, and any installed distribution may offer more. A store may come from somebody else, so nothing of it
reaches zarr or xarray before its documents were checked here.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, TypeGuard, TypeVar, cast

from pydantic import TypeAdapter, ValidationError

from sobolev_batch.errors import DamageError
from sobolev_batch.sources.names import node_problem, quoted

# The layout that docs/store.md describes has this version.
SCHEMA_VERSION = 17

Document = dict[str, Any]

# No document is larger. That of the root repeats all others, with about 1 kB for each.
MOST_BYTES = 64_000_000

# Attributes of the root that are mappings. They are stored as JSON, since NetCDF has no attributes of attributes.
_TABLES = ("study", "similarity", "versions")
_GROUP_KEYS = {"attributes", "consolidated_metadata", "node_type", "zarr_format"}
_ARRAY_KEYS = {
    *("attributes", "chunk_grid", "chunk_key_encoding", "codecs", "data_type", "dimension_names", "fill_value"),
    *("node_type", "shape", "storage_transformers", "zarr_format"),
}
_DATA_TYPES = ("bool", "int64", "float32", "float64", "complex64", "complex128", "string")
_CODECS = ("bytes", "crc32c", "vlen-utf8")
# Arrays have no more elements than this, by the number of their axes: one without a single chunk takes no space in a
# store, and any amount of memory once it is read. Arrays with one axis are read when a store is opened, tables with two
# for a report, all others on demand.
_MOST_ELEMENTS = {0: 1, 1: 10**7, 2: 10**8}
_LONGEST_AXIS = 2**40
# These have values of all meshes, of which a few are read at a time: samples of octaves, and spectra.
_OF_MESHES = re.compile("octaves/octaves|spectra/.*")
Kind = TypeVar("Kind")
_adapter: Any = cache(TypeAdapter)


def chunk_shape(document: Mapping[str, Any]) -> list[int]:
    """Return the shape of the chunks of an array, by its metadata document."""
    shape: list[int] = document["chunk_grid"]["configuration"]["chunk_shape"]
    return shape


def consolidated(documents: Mapping[str, Document]) -> Document:
    """Return the document at the root with those of all nodes, as zarr consolidates them."""
    # Readers list the variables of a group in this order: the number and its error first.
    nodes = {name: documents[name] for name in sorted(filter(None, documents), key=lambda name: name.split("/")[0])}
    attributes = documents[""].get("attributes", {})
    texts = {name: json.dumps(attributes[name]) for name in _TABLES if name in attributes}
    listed = {"kind": "inline", "must_understand": False, "metadata": nodes}
    return {**documents[""], "attributes": {**attributes, **texts}, "consolidated_metadata": listed}


def attributes_of(root: Document) -> dict[str, Any]:
    """Return the attributes of a root as it is stored, with its mappings; ValueError where one is none."""
    attributes: dict[str, Any] = root.get("attributes", {})
    if not isinstance(attributes.get("removed", []), list):
        raise ValueError(f"the meshes that are removed are {quoted(attributes['removed'])}")
    return attributes | {name: mapping_in(attributes[name]) for name in _TABLES if name in attributes}


def mapping_in(text: str) -> dict[str, Any]:
    """Return the mapping that an attribute of the root holds as JSON; ValueError where it holds none."""
    try:
        return dict(json.loads(text))
    except (TypeError, RecursionError) as error:
        raise ValueError(f"no table: {error}") from error


def record_in(kind: type[Kind], table: Any, name: str) -> Kind:
    """Return the record that a table of JSON holds; DamageError where it holds something else."""
    try:
        return cast(Kind, _adapter(kind).validate_python(table))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        problem = ": ".join(filter(None, (".".join(map(str, first["loc"])), first["msg"])))
        raise damaged_record(name, problem, table) from error


def damaged_record(name: str, problem: str, content: object) -> DamageError:
    """Return the error for a record, by its name, whose content is not what was written."""
    return DamageError(f"{name} is damaged ({problem}): {str(content)[:80]!r}; run the study again", problem)


def problems_of(documents: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the paths of nodes, empty for the root, whose metadata documents are not used, and why."""
    for name, document in documents.items():
        if problem := _problem(name, document):
            yield name, problem
        # zarr repeats in each group what the root has.
        elif document.get("consolidated_metadata"):
            nodes, prefix = document["consolidated_metadata"]["metadata"], f"{name}/" if name else ""
            yield from problems_of({f"{prefix}{path}": node for path, node in nodes.items()})


def _problem(name: str, document: Any) -> str:
    parts = name.split("/")  # a group, or an array in one
    if name and (len(parts) > 2 or any(map(node_problem, parts))):
        return f"a node is named {quoted(name)}"
    node = name or "the root"
    if not isinstance(document, dict):
        return f"the metadata of {node} are no table"
    kind = document.get("node_type")
    if document.get("zarr_format") != 3 or kind != ("array" if "/" in name else "group"):
        return f"{node} is {quoted(kind)} of zarr format {quoted(document.get('zarr_format'))}"
    if unknown := set(document) - (_GROUP_KEYS if kind == "group" else _ARRAY_KEYS):
        return f"{node} has metadata {quoted(min(unknown))}"
    if not isinstance(document.get("attributes", {}), dict):
        return f"the attributes of {node} are no table"
    if kind == "array":
        return _problem_of_array(node, document)
    consolidated = document.get("consolidated_metadata") or {"kind": "inline", "metadata": {}}
    nodes = consolidated.get("metadata") if isinstance(consolidated, dict) else None
    if not isinstance(nodes, dict) or consolidated.get("kind") != "inline":
        return f"the consolidated metadata of {node} are {quoted(consolidated)}"
    return "a node is named ''" if "" in nodes else ""


def _problem_of_array(node: str, document: Document) -> str:
    if document.get("data_type") not in _DATA_TYPES:
        return f"the data type of {node} is {quoted(document.get('data_type'))}"
    codecs = document.get("codecs")
    for codec in codecs if codecs and isinstance(codecs, list) else [codecs or None]:
        codec = codec.get("name") if isinstance(codec, dict) else codec
        if codec not in _CODECS:
            return f"the codec of {node} is {quoted(codec)}"
    if document.get("storage_transformers"):
        return f"{node} has the storage transformers {quoted(document['storage_transformers'])}"
    for key, expected in (("chunk_grid", "regular"), ("chunk_key_encoding", "default")):
        if not isinstance(value := document.get(key), dict) or value.get("name") != expected:
            return f"the {key} of {node} is {quoted(value)}"
    shape, grid = document.get("shape"), document["chunk_grid"].get("configuration")
    chunk = grid.get("chunk_shape") if isinstance(grid, dict) else grid
    if _is_shape(shape, 0) and _is_shape(chunk, 1) and len(shape) == len(chunk):
        most = math.inf if len(shape) > 1 and _OF_MESHES.fullmatch(node) else _MOST_ELEMENTS.get(len(shape), math.inf)
        if math.prod(shape) <= most and max([*shape, *chunk], default=0) <= _LONGEST_AXIS:
            return ""
    return f"{node} has the shape {quoted(shape)} in chunks of {quoted(chunk)}"


def _is_shape(shape: Any, least: int) -> TypeGuard[list[int]]:
    return isinstance(shape, list) and all(type(length) is int and length >= least for length in shape)
