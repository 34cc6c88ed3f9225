"""Names that people give to families and files, and that become labels of surfaces.

Labels stand side by side in tables, logs and stores, so each must be legible and distinct.
"""

import difflib
import re
import reprlib
import unicodedata
from collections.abc import Iterable
from fnmatch import fnmatchcase

# A file's stem has up to 255 bytes; a path in its place may be longer.
_LONGEST_LABEL = 1000
# Of a file system's names; and characters of what becomes a name in a store.
_MOST_BYTES, _LONGEST_NODE = 255, 100
# Longer keys are quoted, and not compared with others.
_LONGEST_KEY = 40
# Short enough for every file system, with a number before it and a suffix after it.
_LONGEST_STEM = 60
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")


def quoted(value: object, longest: int = 80) -> str:
    """Return a value as messages quote it: on one line of at most ``longest`` characters."""
    if isinstance(value, int) and value.bit_length() > 64:
        # Python refuses to print the digits of long integers.
        return f"an integer of {value.bit_length()} bits"
    short = reprlib.Repr()
    short.maxstring = short.maxother = longest - 20
    short.maxlist = short.maxtuple = short.maxdict = 4
    short.maxlevel = 3
    try:
        text = short.repr(value)
    except ValueError:
        return f"a {type(value).__name__} that holds an integer of too many digits"
    return text if len(text) <= longest else text[: longest - 3] + "..."


def shown_value(value: object) -> str:
    """Return a value as a study file spells it, on one short line."""
    return str(value).lower() if isinstance(value, bool) else quoted(value)


def name_problem(text: str, longest: int, forbidden: str = "") -> str | None:
    """Describe why a text is not 1 to ``longest`` visible characters, or single blanks between; None where it is."""
    if not text:
        return "it is empty"
    if len(text) > longest:
        return f"it has {len(text)} characters, {longest} are allowed"
    if (invisible := next((c for c in text if not c.isprintable()), None)) is not None:
        return f"it holds the invisible character U+{ord(invisible):04X} {unicodedata.name(invisible, '')}".rstrip()
    if (barred := next((c for c in text if c in forbidden), None)) is not None:
        return f"it holds {barred!r}"
    if text != text.strip():
        return "it begins or ends with a blank"
    return None


def label_problem(name: str) -> str | None:
    """Describe why a name of a member cannot be a label; None where it can."""
    return name_problem(name, _LONGEST_LABEL, "\\")


def node_problem(name: object) -> str | None:
    """Describe why a value cannot name an array or a group of a store, which is a folder there; None where it can."""
    if not isinstance(name, str):
        return "it is no text"
    problem = name_problem(name, _LONGEST_NODE, "/\\")
    if problem is None and name.startswith((".", "__")):
        return f"it begins with {name[0] if name[0] == '.' else '__'}"
    if problem is None and name.casefold().endswith(".json"):
        return "it ends with .json, as keys of stores do"
    if problem is None and len(name.encode()) > _MOST_BYTES:
        return f"it has {len(name.encode())} bytes, {_MOST_BYTES} are allowed"
    return problem


def caseless_key(name: str) -> str:
    """Return a key that is equal for names that differ only in case and the encoding of accents (Unicode's D145)."""
    return unicodedata.normalize("NFD", unicodedata.normalize("NFD", name).casefold())


def fits(name: str, pattern: str) -> bool:
    r"""Tell whether a name is another one or matches it as a pattern, however accents are encoded.

    >>> fits("caf\N{LATIN SMALL LETTER E WITH ACUTE}", "cafe\N{COMBINING ACUTE ACCENT}"), fits("mmg/0.1", "mmg/*")
    (True, True)
    """
    name, pattern = (unicodedata.normalize("NFC", text) for text in (name, pattern))
    # A name may have characters that mean something else in a pattern.
    return name == pattern or fnmatchcase(name, pattern)


def known_names(name: str, known: Iterable[str]) -> str:
    """Return the name that an unknown one is probably meant to be, or else all that are known."""
    by_lower = {candidate.lower(): candidate for candidate in known}
    near = difflib.get_close_matches(name.lower(), by_lower, n=1) if len(name) <= _LONGEST_KEY else []
    return f"did you mean {by_lower[near[0]]}?" if near else f"known are {', '.join(map(readable_key, known))}"


def readable_key(key: str) -> str:
    """Return a key, in quotes where it is unusual."""
    return key if name_problem(key, _LONGEST_KEY) is None else quoted(key)


def numbers_in(text: str) -> list[float]:
    """Return the numbers in a name, from left to right."""
    return [*map(float, _NUMBER.findall(text))]


def natural_key(text: str) -> list[tuple[str, float]]:
    """Return a key that sorts names by the numbers in them: 2 before 10."""
    return list(zip(_NUMBER.split(text), [*numbers_in(text), 0.0], strict=True))


def file_stem(number: int, label: str) -> str:
    """Return a name for a file of a label, which may hold any characters; the number makes it unique."""
    plain = unicodedata.normalize("NFKD", label).encode("ascii", "ignore").decode("ascii")
    readable = re.sub(r"[^A-Za-z0-9]+", "-", plain).strip("-")[:_LONGEST_STEM].rstrip("-")
    return f"{number:04d}-{readable}" if readable else f"{number:04d}"


def duplicate_names(names: Iterable[str]) -> list[list[str]]:
    """Return the groups of names with one `caseless_key`."""
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(caseless_key(name), []).append(name)
    return [group for group in groups.values() if len(group) > 1]
