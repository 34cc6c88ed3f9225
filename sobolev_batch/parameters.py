"""Parameters of the public interface: numbers, names, lengths, paths, functions and more, checked where they enter."""

import math
import re
from collections.abc import Callable, Collection, Iterable
from numbers import Integral
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from pydantic import ByteSize, TypeAdapter, ValidationError

from sobolev_batch.errors import InputError

_BYTE_SIZE = TypeAdapter(ByteSize)
# Units of length that are converted into each other, in metres.
_METRES = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
_LENGTH = re.compile(r"\s*(?P<number>(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?)\s*(?P<unit>\S.*?)?\s*")


def is_whole_number(value: object) -> TypeGuard[int]:
    """Return whether a value is an integer of Python or NumPy, and no truth value.

    >>> import numpy as np
    >>> is_whole_number(np.int64(3)), is_whole_number(True), is_whole_number(3.0)
    (True, False, False)
    """
    return isinstance(value, Integral) and not isinstance(value, bool)


def check_seed(seed: object) -> None:
    """Refuse anything but a whole number from 0 on, by an InputError."""
    if not is_whole_number(seed) or seed < 0:
        raise InputError(f"seed must be a whole number from 0 on, found {seed!r}")


def path_of(path: object) -> Path:
    """Return a path that a text or a path names; InputError where it is neither."""
    try:
        return Path(path)  # type: ignore[arg-type]
    except TypeError as error:
        raise InputError(f"a path is a text or a pathlib.Path, found {type(path).__name__}") from error


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Refuse what is none of some texts, by an InputError."""
    if not isinstance(value, str) or value not in choices:
        raise InputError(f"{name} must be one of {', '.join(choices)}, found {value!r}")


def check_flags(**flags: object) -> None:
    """Refuse truth values, by their names, that are neither True nor False, by an InputError: any text is true."""
    for name, value in flags.items():
        if not isinstance(value, bool | np.bool_):
            raise InputError(f"{name} must be True or False, found {value!r}")


def callback(on_progress: Callable[..., object] | None) -> Callable[..., Any]:
    """Return a function that tells of progress, by default one that tells nobody; InputError where it is none."""
    if on_progress is not None and not callable(on_progress):
        raise InputError(f"on_progress must be a function, found {on_progress!r}")
    return on_progress or (lambda *_: None)


def as_names(given: str | Iterable[str]) -> list[str]:
    """Return names, or the one that a text is, of whose letters it is a sequence otherwise; InputError for others.

    >>> as_names("decimated"), as_names(("decimated", "remeshed"))
    (['decimated'], ['decimated', 'remeshed'])
    """
    names = [given] if isinstance(given, str) or not isinstance(given, Iterable) else [*given]
    if not all(isinstance(name, str) for name in names):
        raise InputError(f"expected a name or a list of names, which are texts; found {given!r}")
    return names


def byte_count(memory: float | str) -> int:
    """Return a size of memory in bytes, from their number or a text; InputError where it is neither, or not positive.

    >>> byte_count("4GB"), byte_count("800MiB"), byte_count(2e9)
    (4000000000, 838860800, 2000000000)
    """
    try:
        # Pydantic refuses a float that is no whole number.
        count = int(_BYTE_SIZE.validate_python(int(memory) if isinstance(memory, float) else memory))
    except (ValidationError, ValueError, OverflowError):
        count = 0
    if not 0 < count < 2**63 or isinstance(memory, bool):
        raise InputError(
            f"memory must be a positive number of bytes, or a size such as '4GB' or '800MiB', found {memory!r}"
        )
    return count


def fraction(value: float | str) -> float:
    """Return a positive fraction, given as a number or in per cent; InputError where it is neither, or not positive.

    >>> fraction("1%"), fraction("0.01"), fraction(0.01)
    (0.01, 0.01, 0.01)
    """
    text = str(value).strip()
    try:
        number = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        number = math.nan
    if isinstance(value, bool) or not 0 < number < math.inf:
        raise InputError(f"a fraction is a positive number such as 0.01, or a text such as '1%', found {value!r}")
    return number


def length_in(length: float | str, unit: str | None) -> float:
    """Return a length as a number of a unit, whose name is None where it is not known.

    >>> length_in("1 in", "mm"), length_in(0.5, None), length_in("2 voxels", "voxels")
    (25.4, 0.5, 2.0)
    """
    found = None if isinstance(length, bool) else _LENGTH.fullmatch(str(length))
    number, own = (float(found["number"]), found["unit"]) if found else (math.nan, None)
    if not 0 < number < math.inf:
        raise InputError(f"a length is a positive number, alone or with a unit as in '0.1 mm', found {length!r}")
    if own is None or own == unit:
        return number
    if own not in _METRES:
        raise InputError(f"{length!r} has the unit {own!r}; known are {', '.join(_METRES)}, and that of the meshes")
    if unit is None:
        raise InputError(
            f"{length!r} has a unit, but that of the meshes is not known: name it, as unit='mm' in Python, --unit mm, "
            "or length_unit in a study file, or give the length as a number in the unit of the meshes"
        )
    if unit not in _METRES:
        raise InputError(f"{length!r} cannot be converted into {unit!r}; give the length as a number of {unit}")
    return number * (_METRES[own] / _METRES[unit])


def format_bytes(count: float) -> str:
    """Return a number of bytes as people read it.

    >>> format_bytes(4e9)
    '4.0GB'
    """
    return ByteSize(count).human_readable(decimal=True)
