"""Refusals of malformed studies: each key that is wrong, what was found, and what is allowed; all problems at once."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from sobolev_batch.surfaces.sources.names import name_problem, quoted
from sobolev_batch.surfaces.sources.registry import Source, source_type_of

_MOST_OFFENDERS = 10
# Longer names are not compared with others.
_LONGEST_NAME = 40
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

Key = tuple[int | str, ...]


def refusals(
    error: ValidationError,
    values: Mapping[str, Any],
    model: type[BaseModel],
    place: str = "",
    others: Sequence[str] = (),
) -> list[str]:
    """Return what is wrong in a table, a message for each key.

    Args:
        error: Error of the model.
        values: The table.
        model: Model of the table.
        place: Place of the table, such as ``[norm]``; empty for a whole study.
        others: Keys that the table may have besides those of the model.
    """
    messages: list[str] = []
    allowed: dict[Key, list[str]] = {}
    for item in error.errors(include_url=False):
        kind, key = item["type"], _key_in(values, item)
        if kind == "extra_forbidden":
            owner = _model_at(model, values, key[:-1])
            keys = (
                *owner.model_fields,
                *(("source",) if issubclass(owner, Source) else ()),
                *(others if len(key) == 1 else ()),
            )
            messages.append(f"{_named(place, key, values)} is unknown; {known_names(str(key[-1]), keys)}")
        elif kind == "missing":
            messages.append(f"{_named(place, key, values)} is missing")
        elif kind == "value_error":
            said = str(item["ctx"]["error"])
            found = "" if not key or "found " in said else f", found {shown_value(_value_at(values, key))}"
            messages.append(": ".join(filter(None, (_named(place, key, values), said + found))))
        # Wrong entries are not counted; the list may be long enough with them.
        elif kind != "too_short" or len(_value_at(values, key)) < item["ctx"]["min_length"]:
            allowed.setdefault(key, []).append(_demand(item))
    for key, demands in allowed.items():
        text = " or ".join(dict.fromkeys(demands)).replace(" or be ", " or ")
        messages.append(f"{_named(place, key, values)} must {text}, found {shown_value(_value_at(values, key))}")
    return messages


def joined(messages: Sequence[str]) -> str:
    """Return messages on one line; a long list is cut."""
    more = len(messages) - _MOST_OFFENDERS
    return "; ".join(messages[:_MOST_OFFENDERS]) + (f"; and {more} more" if more > 0 else "")


def known_names(name: str, known: Sequence[str]) -> str:
    """Return the name that an unknown one is probably meant to be, or else all that are known."""
    by_lower = {candidate.lower(): candidate for candidate in known}
    near = difflib.get_close_matches(name.lower(), by_lower, n=1) if len(name) <= _LONGEST_NAME else []
    return f"did you mean {by_lower[near[0]]}?" if near else f"known are {', '.join(map(_readable, known))}"


def dotted_key(path: Sequence[object]) -> str:
    """Return the dotted key of a value, with unusual keys in quotes."""
    return ".".join(_readable(str(key)) for key in path[:8]) or "study"


def shown_value(value: object) -> str:
    """Return a value as a study file spells it, on one short line."""
    return str(value).lower() if isinstance(value, bool) else quoted(value)


def _readable(key: str) -> str:
    return key if name_problem(key, _LONGEST_NAME) is None else quoted(key)


def _demand(item: ErrorDetails) -> str:
    """Return what a value must do: be a list, be greater than 0, have at most 3 items."""
    kind, said = item["type"], item["msg"]
    words = _WORDS.get(kind) or _WORDS.get(kind.partition("_")[0])
    return words or re.sub(r"^\w+ should | after validation.*$", "", said)


def _key_in(values: object, item: ErrorDetails) -> Key:
    """Return the location of an error without the parts that name the alternatives of a type."""
    key: list[int | str] = []
    for number, part in enumerate(item["loc"], 1):
        is_list = isinstance(values, list | tuple) and isinstance(part, int) and part < len(values)
        if is_list or (isinstance(values, Mapping) and part in values):
            values = values[part]  # type: ignore[index]
        elif item["type"] != "missing" or number < len(item["loc"]):
            continue
        key.append(part)
    return tuple(key)


def _value_at(values: Any, key: Key) -> Any:
    for part in key:
        values = values[part]
    return values


def _model_at(model: type[BaseModel], values: Any, key: Key) -> type[BaseModel]:
    """Return the model of a table within a table."""
    for part in key:
        values = values[part]
        if isinstance(values, Mapping) and "source" in values:
            model = source_type_of(values["source"])
        else:
            annotation = model.model_fields[str(part)].annotation
            kinds = (annotation, *get_args(annotation))
            model = next(kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel))
    return model


def _named(place: str, key: Key, values: Mapping[str, Any]) -> str:
    """Return a key with its place: ``[norm]: entry 2 of orders``. Entries count from one."""
    if not place and key and isinstance(key[0], str) and (len(key) > 1 or isinstance(values.get(key[0]), dict | list)):
        place, key = _header(key[0]), key[1:]
    elif not place and key and str(key[0]) not in values:
        place, key = _header(str(key[0])), ()
    name = ".".join(_readable(part) for part in key if isinstance(part, str))
    numbers = ", ".join(str(part + 1) for part in key if isinstance(part, int))
    if numbers:
        name = f"entry {numbers} of {name}" if name else f"entry {numbers}"
    return ": ".join(filter(None, (place, name)))


def _header(section: str) -> str:
    return f"[[{section}]]" if section in _REPEATED else f"[{_readable(section)}]"
