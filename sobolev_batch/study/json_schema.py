"""The JSON schema of study files, by which editors complete and check them."""

from operator import attrgetter
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from sobolev_batch.reduction.searched import SearchedSource
from sobolev_batch.sources.registry import Source, source_type_of, sources_by_name
from sobolev_batch.study.schema import KEYS_OF_FAMILY, KEYS_OF_SEARCH, Family, FamilyReference, StudyDocument

_DIALECT = "https://json-schema.org/draft/2020-12/schema"
# A table that names a mesh of the study, and may change some of its keys.
_OF_NAMED = {
    "type": "object",
    "properties": {"mesh": {"type": "string"}},
    "required": ["mesh"],
    "not": {"required": ["source"]},
}


def study_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of study files, with the sources that are installed.

    A file that it accepts may still be refused, since it knows no relations between keys.

    >>> study_schema()["required"]
    ['reference', 'family', 'study']
    """
    sources: dict[str, type[BaseModel]] = {name: source_type_of(name) for name in sorted(sources_by_name())}
    models: set[type[BaseModel]] = {StudyDocument, Source, Family, FamilyReference, SearchedSource, *sources.values()}
    in_order = sorted(models, key=attrgetter("__name__"))
    references, whole = models_json_schema([(model, "validation") for model in in_order])
    known = whole["$defs"]
    keys = {model: known[reference["$ref"].rsplit("/", 1)[1]] for (model, _), reference in references.items()}
    of_family = {key: keys[Family]["properties"][key] for key in KEYS_OF_FAMILY}
    of_search = {key: keys[SearchedSource]["properties"][key] for key in KEYS_OF_SEARCH}
    tables = []
    named: dict[str, type[BaseModel]] = {**sources, "family": FamilyReference}
    for name, model in named.items():
        # Two names may share a class.
        own = {"source": {"const": name}, **keys[model]["properties"]}
        known[name] = {**keys[model], "properties": own, "required": ["source", *keys[model].get("required", ())]}
        tables.append({**known[name], "properties": {**own, **of_search, **of_family}, "required": ["name", "source"]})
    keys[Source].clear()
    keys[Source].update(anyOf=[{"type": "string"}, _OF_NAMED, *({"$ref": f"#/$defs/{name}"} for name in sources)])
    keys[Family].clear()
    keys[Family].update(anyOf=[{**_OF_NAMED, "required": ["name", "mesh"]}, *tables[:-1]])
    keys[FamilyReference].update(known.pop("family"))
    return {"$schema": _DIALECT, **_with_first_lines(keys[StudyDocument]), "$defs": _with_first_lines(known)}


def _with_first_lines(schema: Any) -> Any:
    """Return a schema in which each description is the first line of a docstring."""
    if isinstance(schema, list):
        return [_with_first_lines(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    return {
        key: value.split("\n")[0] if key == "description" and isinstance(value, str) else _with_first_lines(value)
        for key, value in schema.items()
    }
