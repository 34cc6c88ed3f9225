"""Study files and mappings as the nested tables, lists and values that TOML has."""

import os
import re
import tomllib
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sobolev_batch.errors import StudyError
from sobolev_batch.geometry.formats.parsing import open_regular
from sobolev_batch.sources.command import function_version
from sobolev_batch.sources.names import quoted, readable_key, shown_value

# Deeper tables and larger study files are mistakes.
DEEPEST, _LARGEST_FILE_BYTES = 20, 4 << 20


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a study file; StudyError, which does not name it, where it is no readable TOML."""
    try:
        with open_regular(path) as file:
            data = file.read(_LARGEST_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        raise StudyError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(data) > _LARGEST_FILE_BYTES:
        raise StudyError(f"a study file has at most {_LARGEST_FILE_BYTES} bytes; globs name many meshes in few words")
    try:
        # Some editors begin a file with a byte order mark.
        text = data.decode("utf-8-sig")
        return tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise StudyError(f"not a TOML file: {error}; save it as UTF-8") from error
    except RecursionError as error:
        raise StudyError("its tables and lists are nested too deeply") from error
    # Beyond TOML's own errors, numbers and dates that Python cannot hold.
    except ValueError as error:
        position = re.search(r"\(at line (\d+), ", str(error))
        line = f": {quoted(text.splitlines()[int(position[1]) - 1].strip())}" if position else ""
        raise StudyError(f"not a TOML file: {error}{line}") from error


def plain_tables(table: object) -> dict[str, Any]:
    """Return a study with DataFrames as lists of rows, NumPy's values as Python's, paths as texts; or StudyError."""
    if not isinstance(table, Mapping):
        raise StudyError(f"a study is a mapping of sections, such as {{'study': ...}}, found {shown_value(table)}")
    return {str(key): _plain(value, (key,)) for key, value in table.items()}


def _plain(value: Any, key: tuple[object, ...]) -> Any:
    if len(key) > DEEPEST:
        raise StudyError(f"{_dotted(key)}: nested more than {DEEPEST} deep")
    if isinstance(value, Mapping):
        if not all(isinstance(name, str) for name in value):
            raise StudyError(f"{_dotted(key)}: keys must be strings")
        if callable(value.get("source")):
            function = value["source"]
            known = {} if "version" in value else {"version": function_version(function)}
            value = {**known, **value, "source": "function", "function": function}
        return {name: _plain(entry, (*key, name)) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry, (*key, number)) for number, entry in enumerate(value)]
    if isinstance(value, pd.DataFrame):
        if len(repeated := value.columns[value.columns.duplicated()]):
            raise StudyError(f"{_dotted(key)}: a DataFrame has the column {quoted(repeated[0])} twice; rename one")
        known = value.astype(object).where(value.notna(), None)
        return _plain(known.to_dict(orient="records"), key)
    if isinstance(value, date):
        return value.isoformat()
    if isinstance(value, int) and value.bit_length() > 63:
        raise StudyError(f"{_dotted(key)}: an integer of TOML has 64 bits, found {quoted(value)}")
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return os.fspath(value) if isinstance(value, os.PathLike) else value


def _dotted(key: tuple[object, ...]) -> str:
    return ".".join(readable_key(str(part)) for part in key[:8])
