"""Values that a key of a study takes: what was probably meant by one that it does not take, or an example."""

from __future__ import annotations

import difflib
import json
import re
import tomllib
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from pydantic.errors import PydanticSchemaGenerationError, PydanticUserError
from pydantic.fields import FieldInfo

# Longer texts are not repeated.
_LONGEST_TEXT = 40
# Names are recognised by this many first letters.
_SHORTEST_BEGINNING = 3
# One value for each key, as a study file spells it; those of other packages may have examples of their own.
_EXAMPLES = """
name = "scans"
title = "Scans of a statue"
xi_max = 5.0
M = 64
octaves = 4
rtol = 1e-2
memory = "4GB"
best_effort = true
orders = [-4.0]
pairs = "all"
eps = 1e-9
dtype = "complex128"
quadrature = "auto"
backend = "auto"
mode = "none"
scale = 0.1
origin = [0.0, 0.0, 0.0]
points = 10000
weight = "area"
area = 12.5
source = "files"
family = "scans"
member = "a"
paths = ["meshes/*.ply"]
meshes = "meshes.csv"
order_by = "names"
reference = { source = "files", paths = ["a.ply"] }
scaling = { mode = "none" }
distribution = "nilearn"
times = [0.0, 0.5, 1.0]
mesh = { source = "files", paths = ["a.ply"] }
target = { source = "files", paths = ["a.ply"] }
sphere = { source = "files", paths = ["sphere.ply"] }
triangles = [1000, 4000]
levels = [0, 1, 2]
radius = 1.0
center = [0.0, 0.0, 0.0]
axes = [1.0, 1.0, 2.0]
R = 2.0
r = 0.5
around = 12
across = 6
period = 5.0
strength = 2.0
order = -2.0
steps = 150
smoothing = 0.25
keep_boundary = true
distances = [0.01, 0.02]
direction = [1.0, 0.0, 0.0]
amplitudes = [0.01, 0.02]
seed = 0
"""
_TEXTS: dict[str, str] = dict(line.split(" = ", 1) for line in _EXAMPLES.strip().splitlines())


def example_of(model: type[BaseModel], key: str) -> str:
    """Return an example of a key as a study file spells it; empty if there is none.

    Args:
        model: Model of the table.
        key: One of its keys.
    """
    field = model.model_fields.get(key)
    if field is not None and field.examples:
        return _spelt(field.examples[0])
    return _TEXTS.get(key, "")


def suggested(model: type[BaseModel], key: Sequence[int | str], whole: object, found: object, expected: str) -> str:
    """Return what may stand in place of a value that is refused; empty where that is not known.

    Args:
        model: Model of the table.
        key: Key in the table, followed by the number of an entry if only that is refused.
        whole: Value of the key.
        found: What is refused: the value, or the entry.
        expected: What it must be, in words; texts that can be chosen stand in quotes.
    """
    name = str(key[0]) if key else ""
    field, text = model.model_fields.get(name), example_of(model, name)
    if field is None:
        return ""
    example = tomllib.loads(f"it = {text}")["it"] if text else None
    if len(key) == 1:
        meant = next((value for value in _near(found, expected) if _is_taken(field, value)), None)
        if meant is not None and meant != example:
            return f"{name} = {_spelt(meant)}"
        return f"{name} = {text}" if text else ""
    if len(key) > 2 or not isinstance(whole, list):
        return ""
    entries = [*_near(found, expected), *(example if isinstance(example, list) else [])]
    # Other entries may be wrong too, and a list may need so many.
    fitting = (entry for entry in entries if _is_taken(field, [entry]) or _is_taken(field, [entry] * len(whole)))
    entry = next(fitting, None)
    return "" if entry is None else _spelt(entry)


def similar_name(name: str, known: Sequence[str]) -> str:
    """Return the known name that is probably meant; empty if there is none."""
    by_lower = {one.lower(): one for one in known}
    if len(name) > _LONGEST_TEXT:
        return ""
    longer = [one for one in by_lower if len(name) >= _SHORTEST_BEGINNING and one.startswith(name.lower())]
    close = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=0.7) or longer
    return by_lower[close[0]] if close else ""


def _spelt(value: object) -> str:
    # JSON spells texts, numbers and lists of them as TOML does.
    return json.dumps(value, ensure_ascii=False)


def _near(found: object, expected: str) -> Iterator[object]:
    """Yield what may be meant by a value."""
    choices = re.findall(r"'([^']*)'", expected)
    # Of several types, it cannot be told which one was meant.
    is_ambiguous = " or " in expected and not choices and expected != "true or false"
    if is_ambiguous or isinstance(found, bool) or (isinstance(found, str) and len(found) > _LONGEST_TEXT):
        return
    if isinstance(found, str):
        yield from difflib.get_close_matches(found.lower(), choices, n=1)
        if found.lower() in ("true", "false"):
            yield found.lower() == "true"
        for number_type in (int, float):
            try:
                yield from (number_type(found), [number_type(found)])
            except ValueError:
                continue
    if isinstance(found, float) and found.is_integer() and abs(found) < 1 << 53:
        yield int(found)
    if isinstance(found, int | float):
        yield str(found)
    if isinstance(found, str | int | float):
        yield [found]
    if isinstance(found, list) and len(found) == 1:
        yield found[0]


def _is_taken(field: FieldInfo, value: object) -> bool:
    """Return whether a key takes a value."""
    annotated: Any = Annotated[field.annotation, field]
    try:
        TypeAdapter(annotated, config=ConfigDict(strict=True)).validate_python(value)
    except (ValidationError, PydanticUserError, PydanticSchemaGenerationError):
        return False
    return True
