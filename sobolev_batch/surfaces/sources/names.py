"""Names that people give to families and files, and that become labels of surfaces.

Labels stand in tables, logs and stores side by side: each must be seen as what it is, and be told from all others.
"""

from __future__ import annotations

import re
import reprlib
import unicodedata
from collections.abc import Iterable

# Short enough for every file system, with a number before it and a suffix after it.
_LONGEST_STEM = 60
# Printable to Python, and yet nothing is seen of them: joiners, fillers, selectors of variants, the empty Braille cell.
_INVISIBLE = frozenset(
    "\u034f\u115f\u1160\u17b4\u17b5\u2800\u3164\uffa0"
    + "".join(map(chr, (*range(0x180B, 0x1810), *range(0xFE00, 0xFE10), *range(0xE0100, 0xE01F0))))
)


def shown(value: object, longest: int = 80) -> str:
    """A value as it is quoted in a message: on one line, no longer than it takes to recognise it."""
    if isinstance(value, int) and value.bit_length() > 64:
        # Of long ones Python refuses to tell the digits.
        return f"an integer of {value.bit_length()} bits"
    short = reprlib.Repr()
    short.maxstring = short.maxother = longest - 20
    short.maxlist = short.maxtuple = short.maxdict = 4
    short.maxlevel = 3
    try:
        found = short.repr(value)
    except ValueError:
        return f"a {type(value).__name__} that holds an integer of too many digits"
    return found if len(found) <= longest else found[: longest - 3] + "..."


def flaw(text: str, longest: int, forbidden: str = "") -> str | None:
    """What keeps a text from being a name, in words; None where nothing does.

    A name has a character at least and ``longest`` at most, all of them visible or single blanks within it,
    and none of the forbidden ones.
    """
    if not text:
        return "it is empty"
    if len(text) > longest:
        return f"it has {len(text)} characters, {longest} are allowed"
    unseen = next((c for c in text if not c.isprintable() or c in _INVISIBLE), None)
    if unseen is not None:
        return f"it holds the character {_code(unseen)}, which is not seen as what it is"
    barred = next((c for c in text if c in forbidden), None)
    if barred is not None:
        return f"it holds {barred!r}"
    if text != text.strip():
        return "it begins or ends with a blank"
    return None


def folded(name: str) -> str:
    """The same for names that differ in nothing but case and the spelling of accents (Unicode's D145)."""
    return unicodedata.normalize("NFD", unicodedata.normalize("NFD", name).casefold())


def file_stem(number: int, label: str) -> str:
    """A name for a file of a label, which itself may hold anything: its number tells it from all others."""
    plain = unicodedata.normalize("NFKD", label).encode("ascii", "ignore").decode("ascii")
    readable = re.sub(r"[^A-Za-z0-9]+", "-", plain).strip("-")[:_LONGEST_STEM].rstrip("-")
    return f"{number:04d}-{readable}" if readable else f"{number:04d}"


def twins(names: Iterable[str]) -> list[list[str]]:
    """Groups of names that are the same when folded."""
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(folded(name), []).append(name)
    return [group for group in groups.values() if len(group) > 1]


def _code(character: str) -> str:
    name = unicodedata.name(character, "")
    return f"U+{ord(character):04X}" + (f" ({name})" if name else "")
