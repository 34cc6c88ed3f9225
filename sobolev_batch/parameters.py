"""Parameters of the public interface: numbers, fractions and sizes of memory, checked once where they come in."""

from __future__ import annotations

import math
from numbers import Integral
from typing import TypeGuard

from pydantic import ByteSize, TypeAdapter, ValidationError

from sobolev_batch.errors import InputError

_BYTE_SIZE = TypeAdapter(ByteSize)


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
    if count <= 0 or isinstance(memory, bool):
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


def format_bytes(count: float) -> str:
    """Return a number of bytes as people read it.

    >>> format_bytes(4e9)
    '4.0GB'
    """
    return ByteSize(count).human_readable(decimal=True)
