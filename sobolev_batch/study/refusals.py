"""Refusals of study files: a message for each key that is wrong, with what was found and what is allowed."""

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import reduce
from operator import getitem
from typing import Any, TypeVar

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from sobolev_batch.errors import StudyError
from sobolev_batch.sources.names import known_names, quoted, readable_key, shown_value
from sobolev_batch.sources.registry import MESH_HINT, source_type_of
from sobolev_batch.study import schema

Sections = TypeVar("Sections", bound=schema.SurfaceSections)

_MOST_OFFENDERS = 10
# Sections that are lists.
_REPEATED = ("family", "object")
# What a value must be in the words of TOML, by the type of pydantic's error or the first word of it.
_WORDS = {
    "list": "be a list",
    "tuple": "be a list",
    "dict": "be a table",
    "model": "be a table",
    "int": "be a whole number",
    "float": "be a number",
    "bool": "be true or false",
    "string_type": "be text in quotes",
}
# The place of a value in nested tables and lists.
_Key = tuple[int | str, ...]


def validated(model: type[Sections], values: Mapping[str, Any]) -> Sections:
    """Return the sections that a study's tables describe, as `plain_tables` gives them.

    StudyError with a message for each key that is wrong.
    """
    meshes = values.get("mesh")
    try:
        return model.model_validate(values, context=meshes if isinstance(meshes, dict) else {})
    except ValidationError as error:
        messages = _refusals(error, values)
        more = len(messages) - _MOST_OFFENDERS
        shown = [*messages[:_MOST_OFFENDERS], *([f"and {more} more"] if more > 0 else [])]
        raise StudyError("; ".join(shown)) from error


def _refusals(error: ValidationError, values: Mapping[str, Any]) -> list[str]:
    messages, allowed, told = list[str](), dict[_Key, list[str]](), set[str]()
    items = error.errors(include_url=False)
    # What is wrong with a named mesh is wrong wherever it is named.
    for item in [item for item in items if item["loc"][:1] == ("mesh",)] or items:
        kind, key = item["type"], _key_in(values, item)
        name = _named(key, values)
        if kind == "extra_forbidden":
            hint = known_names(str(key[-1]), _known_keys(values, key[:-1]))
            messages.append(f"{name} is unknown{f'; {hint}' * (hint not in told)}")
            told.add(hint)
        elif kind == "missing":
            hint = f"; {MESH_HINT}" if key[-1] == "mesh" else ""
            messages.append(f"{name} is missing{hint}")
        elif kind == "value_error":
            said, value = str(item["ctx"]["error"]), _value_at(values, key)
            is_said = isinstance(value, Mapping) or "found " in said or shown_value(value) in said
            found = "" if is_said else f", found {shown_value(value)}"
            messages.append(": ".join(filter(None, (name, said + found))))
        # Wrong entries are not counted; the list may be long enough with them.
        elif kind != "too_short" or _value_at(values, key) == []:
            allowed.setdefault(key, []).append(_demand(item))
    for key, demands in allowed.items():
        text = " or ".join(dict.fromkeys(demands)).replace(" or be ", " or ")
        messages.append(f"{_named(key, values)} must {text}, found {shown_value(_value_at(values, key))}")
    return messages


def _demand(item: ErrorDetails) -> str:
    """Return what a value must do: be a list, be greater than 0, have at most 3 items."""
    kind, said = item["type"], item["msg"]
    if item["loc"][-1:] == ("[key]",):
        return f"be called {item['ctx']['expected']}"
    words = _WORDS.get(kind) or _WORDS.get(kind.partition("_")[0])
    return words or re.sub(r"^\w+ should | after validation.*$", "", said)


def _key_in(values: object, item: ErrorDetails) -> _Key:
    """Return the location of an error without the parts that name the alternatives of a type."""
    location = item["loc"]
    if location[:1] == ("family",) and location[2:3] == ("source",):
        # Its keys are those of the family.
        location = (*location[:2], *location[3:])
    key: list[int | str] = []
    for number, part in enumerate(location, 1):
        is_list = isinstance(values, list | tuple) and isinstance(part, int) and part < len(values)
        if is_list or (isinstance(values, Mapping) and part in values):
            values = values[part]  # type: ignore[index]
        elif item["type"] != "missing" or number < len(location):
            continue
        key.append(part)
    return tuple(key)


def _value_at(values: Any, key: _Key) -> Any:
    return reduce(getitem, key, values)


def _known_keys(values: Mapping[str, Any], key: _Key) -> Iterable[str]:
    if not key:
        return schema.StudyDocument.model_fields
    table = _value_at(values, key)
    with suppress(ValueError):  # as where a key is that of another section
        table = schema.with_named_meshes(table, values.get("mesh", {}))
    if "source" not in table:
        return next(schema.models_in(schema.StudyDocument.model_fields[str(key[0])].annotation)).model_fields
    if key == ("reference",) and table["source"] == "family":
        return (*schema.FamilyReference.model_fields, "source")
    is_family = key[0] == "family" and len(key) == len(("family", 0))
    own = (*schema.KEYS_OF_FAMILY, *schema.KEYS_OF_SEARCH) if is_family else ()
    return (*source_type_of(table["source"]).model_fields, "source", *own)


def _named(key: _Key, values: Mapping[str, Any]) -> str:
    """Return a key with its place: ``[norm]: entry 2 of orders``. Entries count from one."""
    if not key:
        return ""
    section, rest = str(key[0]), key[1:]
    value = values.get(section)
    if not rest and section in values and not isinstance(value, dict | list):
        return readable_key(section)
    place = f"[[{section}]]" if section in _REPEATED else f"[{readable_key(section)}]"
    if section in _REPEATED and rest:
        entry, rest = _value_at(value, rest[:1]), rest[1:]
        place += f" {int(key[1]) + 1}"
        if isinstance(entry, Mapping) and isinstance(entry.get("name"), str):
            place += f" (named {quoted(entry['name'])})"
    if section == "mesh" and rest:
        place, rest = f"[mesh.{readable_key(str(rest[0]))}]", rest[1:]
    name = ".".join(readable_key(part) for part in rest if isinstance(part, str))
    if numbers := ", ".join(str(part + 1) for part in rest if isinstance(part, int)):
        name = f"entry {numbers} of {name}" if name else f"entry {numbers}"
    return ": ".join(filter(None, (place, name)))
