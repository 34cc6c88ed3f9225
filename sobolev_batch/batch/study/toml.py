"""Study files as TOML: reading them within bounds, and the usual causes of errors in their syntax."""

from __future__ import annotations

import codecs
import os
import re
import tomllib
from pathlib import Path
from typing import Any

from sobolev_batch.errors import StudyError
from sobolev_batch.surfaces.formats.raw_files import open_regular
from sobolev_batch.surfaces.sources.names import quoted

# Larger study files are mistakes, or made to keep the parser busy.
_LARGEST_FILE_BYTES = 4 << 20
# The parser takes time that is quadratic in the number of dotted parts of a key.
_LONG_KEY = re.compile(rb"""(?<![\w-])(?:(?>[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*+\.[ \t]*+){100}""")
_POSITION = re.compile(r" \(at (?:line (\d+), column \d+|end of document)\)$")
_LONGEST_LINE = 1000

# Usual causes of what the parser says, by the line where it stopped. The first one that fits is named.
_CAUSES = r"""
Cannot (declare|overwrite) @ ^\[+\s*family\s*\] @ [[family]] needs two brackets on each side, before each family
Cannot (declare|overwrite) @ ^\[+(?P<it>[^]]*) @ the section [{it}] is there twice; make it one
Cannot (overwrite|mutate) @ ^(?P<it>[^=]*?)\s*= @ the key {it} is there twice; keep one
Duplicate @ ^ @ a key is there twice; keep one
@ ^[^"'#]*=\s*= @ = is there twice; write one
@ ^[\w.-]+\s*: @ write = in place of the colon
@ [“”„‟‘’‚«»] @ write straight quotes
@ ^(//|;|--|/\*|<) @ a comment begins with #
Unescaped|escape @ \\ @ write / in place of each backslash, or single quotes around the text
Invalid value @ =\s*([Tt]rue|[Yy]es|[Oo]n)\b @ write true, in small letters and without quotes
Invalid value @ =\s*([Ff]alse|[Nn]o|[Oo]ff)\b @ write false, in small letters and without quotes
Invalid value @ =\s*(None|null|nil)\b @ leave the key out to have its default
@ [=\[,]\s*[+-]?\.\d @ a number has a digit before its point, such as 0.5
@ [=\[,]\s*[+-]?\d+\.(?!\d) @ a number has a digit behind its point, such as 5.0
@ [=\[,]\s*[+-]?0\d @ a number does not begin with 0 unless a point follows
new @ ^(?P<key>[\w.-]+)\s*=\s*(?P<it>[-+.\de]+(\s*,[-+.\de\s]+)+)\s*(#|$) @ a list needs brackets: {key} = [{it}]
Invalid value @ ^(?P<key>[\w.-]+)\s*=\s*(?P<it>[A-Za-z_./~*][^"'#]*?)\s*(#.*)?$ @ text needs quotes: {key} = "{it}"
Invalid value @ =\s*(#.*)?$ @ a value is missing behind =
Invalid value @ [\[,]\s*[A-Za-z_./~*] @ text needs quotes, such as paths = ["a.ply"]
Unclosed array @ ^ @ a list has a comma between its entries and ends with ]
inline table|Invalid initial character for a key @ \{ @ a table in braces has commas between its keys only, on one line
Expected '\]|initial character @ ^\[ @ the name of a section needs closed brackets, such as [norm]
Unterminated|Expected "'|Illegal character '\\n' @ ^ @ a text lacks its closing quote
Expected newline @ ^ @ a line has one key and its value, and nothing else
Expected '='|Invalid statement @ ^ @ a line has a section, such as [norm], or a key and its value, such as rtol = 1e-2
"""
_PARTED = [[part.strip() for part in line.split("@")] for line in _CAUSES.strip().splitlines()]
_PATTERNS = [(re.compile(said), re.compile(line), cause) for said, line, cause in _PARTED]


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a study file.

    Raises:
        StudyError: It cannot be read, is too large, or is not TOML. The message does not name it.
    """
    try:
        with open_regular(path) as file:
            length = os.fstat(file.fileno()).st_size
            data = file.read(_LARGEST_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        raise StudyError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(data) > _LARGEST_FILE_BYTES:
        raise StudyError(
            f"a study file has at most {_LARGEST_FILE_BYTES} bytes, found {max(length, len(data))}; "
            "globs name many meshes in few words"
        )
    if data.startswith(codecs.BOM_UTF8):
        raise StudyError("not a TOML file: it begins with a byte order mark; save it as UTF-8 without one")
    if _LONG_KEY.search(data):
        raise StudyError("a key has 100 dotted parts or more; those of a study have two")
    try:
        text = data.decode("utf-8")
        return tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise StudyError(f"not a TOML file: {error}; save it as UTF-8") from error
    except RecursionError as error:
        raise StudyError("its tables and lists are nested too deeply") from error
    # Beyond TOML's own errors, numbers and dates that Python cannot hold.
    except ValueError as error:
        raise StudyError(f"not a TOML file: {_explained(str(error), text)}") from error


def _explained(message: str, text: str) -> str:
    """Return where the parser stopped, what stands there, and the usual cause."""
    position = _POSITION.search(message)
    if position is None:
        return message
    # The parser counts these as the ends of lines, and no others.
    lines = text.replace("\r\n", "\n").split("\n")
    if position[1] is None:
        number = max((i for i, line in enumerate(lines, 1) if line.strip()), default=1)
    else:
        number = int(position[1])
    said, line = message[: position.start()], lines[number - 1].strip()
    return f"line {number}, {quoted(line)}: {_cause(said, line[:_LONGEST_LINE]) or said}"


def _cause(said: str, line: str) -> str:
    for of_message, of_line, cause in _PATTERNS:
        found = of_line.search(line)
        if found is not None and of_message.search(said):
            return cause.format_map({name: quoted(part).strip("'") for name, part in found.groupdict().items()})
    return ""
