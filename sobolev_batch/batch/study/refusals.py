"""Refusals of malformed studies, in the words of study files: which place, what was found, what would work."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from sobolev_batch.batch.study.suggestions import example_of, similar_name, suggested
from sobolev_batch.surfaces.sources.names import name_problem, quoted
from sobolev_batch.surfaces.sources.registry import keys_by_source, source_type_of

_MOST_OFFENDERS = 10

Key = tuple[int | str, ...]

_SECTION_EXAMPLES = {
    "study": 'name = "scans"',
    "norm": "orders = [-4.0]",
    "reference": 'source = "sphere"',
    "family": 'name = "spheres", source = "icosphere" and levels = [0, 1, 2]',
}
# What a key must be, by the type of the validator's error; the braces name its context.
_EXPECTED = {
    **dict.fromkeys(("list_type", "tuple_type", "set_type", "frozen_set_type", "iterable_type"), "a list"),
    **dict.fromkeys(("dict_type", "model_type", "model_attributes_type", "mapping_type", "dataclass_type"), "a table"),
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float", "int_parsing_size"), "a whole number"),
    **dict.fromkeys(("float_type", "float_parsing"), "a number"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false"),
    **dict.fromkeys(("literal_error", "enum"), "{expected}"),
    "finite_number": "a finite number",
    "string_type": "text in quotes",
    "greater_than": "above {gt}",
    "greater_than_equal": "{ge} or more",
    "less_than": "below {lt}",
    "less_than_equal": "at most {le}",
    "string_too_short": "a text that is not empty",
    "too_short": "a list with {min_length} or more entries",
    "too_long": "a list of at most {max_length} entries",
}


@dataclass(frozen=True)
class _Table:
    """A table of a study that was refused.

    Attributes:
        values: The table, as found.
        model: Model of its keys.
        place: Name of the table in messages, such as ``[norm]``; empty for the whole study.
        keys: Keys that may stand in it.
        sections: Models of all sections of a study, by their names.
    """

    values: Mapping[str, Any]
    model: type[BaseModel]
    place: str
    keys: tuple[str, ...]
    sections: Mapping[str, type[BaseModel]]

    def refusals(self, items: Iterable[ErrorDetails]) -> Iterator[str]:
        """Yield a message for each offender, given errors with their locations in the table."""
        expected: dict[Key, list[str]] = {}
        missing: list[str] = []
        meant: set[str] = set()
        nested: dict[str, list[ErrorDetails]] = {}
        for item in items:
            key, kind = self._known_part(item["loc"], item["type"]), item["type"]
            inner = self.values.get(str(key[0])) if len(key) > 1 else None
            if isinstance(inner, Mapping) and "source" in inner:
                nested.setdefault(str(key[0]), []).append({**item, "loc": item["loc"][1:]})
            elif kind == "extra_forbidden":
                hint, similar = self._hint(str(key[-1]))
                meant.add(similar)
                yield f"{self._before}unknown key {_dotted(key)}: {hint}"
            elif kind == "missing" and isinstance(key[-1], str):
                missing.append(key[-1])
            elif kind == "missing":
                expected[key[:-1]] = [f"a list of {int(key[-1]) + 1} entries"]
            elif kind == "value_error":
                message = str(item["ctx"]["error"])
                shown = "" if not key or "found " in message else f", found {shown_value(_value_at(self.values, key))}"
                yield f"{self._before}{_dotted(key)}{': ' if key else ''}{message}{shown}"
            elif kind != "too_short" or len(_value_at(self.values, key)) < item["ctx"]["min_length"]:
                # Otherwise the list is only short of its wrong entries.
                words = _EXPECTED.get(kind, "a value of another kind").format_map(item.get("ctx", {}))
                expected.setdefault(key, []).append(words)
        for key, words_of_key in expected.items():
            yield self._before + self._mismatch(key, " or ".join(dict.fromkeys(words_of_key)))
        for name in missing:
            if name not in meant:
                example = example_of(self.model, name)
                yield f"{self._before}{name} is missing; add it{f', such as {name} = {example}' if example else ''}"
        for name, inner_items in nested.items():
            yield from self._nested(name).refusals(inner_items)

    @property
    def _before(self) -> str:
        return f"{self.place}: " if self.place else ""

    def _known_part(self, location: Key, kind: str) -> Key:
        """Return a location without the parts that are no keys, but names of the alternatives of a type."""
        node: Any = self.values
        key: list[int | str] = []
        for number, part in enumerate(location):
            is_there = (isinstance(node, Mapping) and part in node) or (
                isinstance(node, list | tuple) and isinstance(part, int) and part < len(node)
            )
            if is_there:
                node = node[part]
                key.append(part)
            elif kind == "missing" and number == len(location) - 1:
                key.append(part)
        return tuple(key)

    def _mismatch(self, key: Key, expected: str) -> str:
        whole, found = _value_at(self.values, key[:1]), _value_at(self.values, key)
        suggestion = suggested(self.model, key, whole, found, expected)
        example = f", such as {suggestion}" if suggestion else ""
        return f"{_dotted(key)} must be {expected}{example}, found {shown_value(found)}"

    def _nested(self, name: str) -> _Table:
        """Return the table of another source within the one of this source."""
        values = self.values[name]
        model = source_type_of(values["source"])
        return _Table(values, model, f"{self._before}{name}", (*model.model_fields, "source"), self.sections)

    def _hint(self, key: str) -> tuple[str, str]:
        """Return what to do about an unknown key, and the known one of this table that is probably meant."""
        similar = similar_name(key, self.keys)
        if similar:
            return f"did you mean {similar}?", similar
        for section, model in self.sections.items():
            if key in model.model_fields and f"[{section}]" != self.place:
                return f"it belongs in [{section}]", ""
        owners = [source for source, keys in keys_by_source().items() if key in keys]
        own = f"{self.place or 'a study'} has {', '.join(map(_dotted_name, self.keys))}"
        if owners and self.place.startswith("["):
            where = "" if "source" in self.keys else " in [reference] and [[family]]"
            names = ", ".join(f'"{owner}"' for owner in owners[:4])
            return f"it is a key of the source{'s' * (len(owners) > 1)} {names}{where}; {own}", ""
        for section, model in self.sections.items():
            elsewhere = similar_name(key, tuple(model.model_fields))
            if elsewhere:
                return f"did you mean {elsewhere} in [{section}]?", ""
        return own, ""


def source_refusals(
    error: ValidationError,
    values: Mapping[str, Any],
    place: str,
    model: type[BaseModel],
    document: type[BaseModel],
) -> list[str]:
    """Return what is wrong in the table of a family or of the reference.

    Args:
        error: Error of the model.
        values: The table.
        place: Its name in messages.
        model: Model of its keys, of which the table may have more.
        document: Model of whole studies.
    """
    # A family has a name besides the keys of its source, and the reference has none.
    others = ("name", "source") if place.startswith("[[") else ("source",)
    keys = tuple(dict.fromkeys((*model.model_fields, *others)))
    return list(_Table(values, model, place, keys, _sections(document)).refusals(error.errors(include_url=False)))


def study_refusals(error: ValidationError, values: Mapping[str, Any], document: type[BaseModel]) -> list[str]:
    """Return what is wrong in the sections of a study.

    Args:
        error: Error of the model of the study.
        values: Tables of the study.
        document: Model of whole studies.
    """
    sections = _sections(document)
    messages: list[str] = []
    meant: set[str] = set()
    by_place: dict[Key, list[ErrorDetails]] = {}
    for item in error.errors(include_url=False):
        by_place.setdefault(item["loc"][:1], []).append(item)
    for place, items in by_place.items():
        if not place:
            messages += [str(item["ctx"]["error"]) for item in items]
            continue
        name = str(place[0])
        kinds = {item["type"] for item in items if len(item["loc"]) == 1}
        if "extra_forbidden" in kinds:
            text, similar = _unknown_section(name, values[name], document, sections)
            messages.append(text)
            meant.add(similar)
        elif "missing" in kinds:
            continue
        elif name in sections and isinstance(values[name], Mapping):
            model = sections[name]
            table = _Table(values[name], model, f"[{name}]", tuple(model.model_fields), sections)
            messages += table.refusals({**item, "loc": item["loc"][1:]} for item in items)
        else:
            messages.append(_wrong_section(name, values[name], document))
    for place in by_place:
        name = str(place[0]) if place else ""
        if name in document.model_fields and name not in values and name not in meant:
            messages.append(f"{_header(name, document)} is missing; add it, with {_SECTION_EXAMPLES[name]}")
    return messages


def joined(messages: Sequence[str]) -> str:
    """Return messages on one line, of which a long list shows the first."""
    more = len(messages) - _MOST_OFFENDERS
    return "; ".join(messages[:_MOST_OFFENDERS]) + (f"; and {more} more" if more > 0 else "")


def dotted_key(path: Sequence[object]) -> str:
    """Return the dotted key of a value, with unusual keys in quotes."""
    return ".".join(_dotted_name(str(key)) for key in path[:8]) or "study"


def _dotted_name(key: str) -> str:
    return key if name_problem(key, 40) is None else quoted(key)


def _dotted(key: Key) -> str:
    """Return a key as messages name it; entries of lists count from one."""
    name = ".".join(_dotted_name(part) for part in key if isinstance(part, str))
    numbers = [str(part + 1) for part in key if isinstance(part, int)]
    return f"entry {', '.join(numbers)} of {name}" if numbers and name else name


def shown_value(value: object) -> str:
    """Return a value as a study file spells it, on one short line."""
    return str(value).lower() if isinstance(value, bool) else quoted(value)


def _value_at(values: object, key: Key) -> Any:
    for part in key:
        values = values[part]  # type: ignore[index]
    return values


def _sections(document: type[BaseModel]) -> dict[str, type[BaseModel]]:
    """Return the models of the sections that have one."""
    found = {}
    for name, field in document.model_fields.items():
        for candidate in (field.annotation, *get_args(field.annotation)):
            if isinstance(candidate, type) and issubclass(candidate, BaseModel):
                found[name] = candidate
    return found


def _is_repeated(name: str, document: type[BaseModel]) -> bool:
    return "list" in str(document.model_fields[name].annotation)


def _header(name: str, document: type[BaseModel]) -> str:
    return f"[[{name}]]" if _is_repeated(name, document) else f"[{name}]"


def _unknown_section(
    name: str, value: object, document: type[BaseModel], sections: Mapping[str, type[BaseModel]]
) -> tuple[str, str]:
    """Return the message about an unknown key at the top of a study, and the section that is probably meant."""
    if not isinstance(value, Mapping | list):
        hint, similar = _Table({}, document, "", tuple(document.model_fields), sections)._hint(name)
        return f"unknown key {_dotted_name(name)}: {hint}", similar
    written = f"[[{_dotted_name(name)}]]" if isinstance(value, list) else f"[{_dotted_name(name)}]"
    similar = similar_name(name, tuple(document.model_fields))
    if similar:
        return f"unknown section {written}: did you mean {_header(similar, document)}?", similar
    known = ", ".join(_header(section, document) for section in document.model_fields)
    return f"unknown section {written}: a study has {known}", ""


def _wrong_section(name: str, value: object, document: type[BaseModel]) -> str:
    """Return the message about a section that is no table, or not as many as it should be."""
    header = _header(name, document)
    if _is_repeated(name, document):
        if isinstance(value, Mapping):
            return f"write {header}, with two brackets on each side, before each; found [{name}], with one"
        if value == []:
            return f"at least one {header} is needed, with {_SECTION_EXAMPLES[name]}; found none"
        return f"{name} must be written as sections, {header} before each, found {quoted(value)}"
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        return f"write {header}, with one bracket on each side: a study has one; found [[{name}]], with two"
    return f"{name} must be a section: {header} on a line, and its keys below; found {shown_value(value)}"
