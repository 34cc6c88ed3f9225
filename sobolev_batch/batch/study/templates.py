"""Templates of a collection: texts with {object} and {method}, filled in, or matched with files."""

from __future__ import annotations

import re
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

from sobolev_batch.errors import StudyError
from sobolev_batch.surfaces.sources.files import expand

OBJECT, METHOD = "{object}", "{method}"
# Characters of globs and templates, which the names of objects and methods cannot have.
RESERVED = "*?[]{}/\\"

_PART = re.compile(r"(\*\*/|\*\*|\*|\?|\[[^\]]*\]|\{object\}|\{method\})")
_PATTERNS = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}


def holds(value: Any, placeholder: str) -> bool:
    """Return True where any text of nested tables has a placeholder."""
    if isinstance(value, str):
        return placeholder in value
    if isinstance(value, Mapping):
        return any(holds(entry, placeholder) for entry in value.values())
    return isinstance(value, list | tuple) and any(holds(entry, placeholder) for entry in value)


def filled(value: Any, placeholder: str, name: str) -> Any:
    """Return nested tables with a name in place of a placeholder."""
    if isinstance(value, str):
        return value.replace(placeholder, name)
    if isinstance(value, Mapping):
        return {key: filled(entry, placeholder, name) for key, entry in value.items()}
    return [filled(entry, placeholder, name) for entry in value] if isinstance(value, list | tuple) else value


def names_of(template: str, placeholder: str, folder: Path, others: Container[Path] = ()) -> list[str]:
    """Return the names that a placeholder has among the files that match a template, in their natural order.

    The placeholder stands for as many characters as it can, of one part of the path.

    Args:
        template: Path or glob with one or more placeholders.
        placeholder: Placeholder to look for.
        folder: Folder where relative paths start.
        others: Files that do not count.

    Raises:
        StudyError: No file matches, or one outside the folder that the template names.
    """
    files = expand(folder, template.replace(OBJECT, "*").replace(METHOD, "*"))
    paths = [path for path in files if path not in others]
    match = re.compile(_pattern(template)).fullmatch
    group = placeholder.strip("{}")
    found = {matched[group] for path in paths if (matched := match(as_written(path, folder))) is not None}
    if not found:
        raise StudyError(
            f"no file gives {placeholder} of {template!r} one name; it stands for a part of a path, without /"
        )
    return sorted(found)


def as_written(path: Path, folder: Path) -> str:
    """Return a path as a template of the study would have it."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.as_posix()


def _pattern(template: str) -> str:
    """Return the regular expression of a template. A repeated placeholder stands for the same name."""
    seen: set[str] = set()
    pattern = ""
    for part in _PART.split(Path(template).as_posix()):
        if part in (OBJECT, METHOD):
            group = part.strip("{}")
            pattern += f"(?P={group})" if part in seen else f"(?P<{group}>[^/]+)"
            seen.add(part)
        elif part.startswith("[") and part.endswith("]"):
            pattern += "[^" + re.escape(part[2:-1]) + "]" if part[1:2] == "!" else part
        else:
            pattern += _PATTERNS.get(part) or re.escape(part)
    return pattern
