"""Parameters of the public interface: whole numbers, sizes of memory, and names that were spelt differently before."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import wraps
from numbers import Integral
from typing import ParamSpec, TypeGuard, TypeVar

from pydantic import ByteSize, TypeAdapter, ValidationError

from sobolev_batch.errors import InputError

P = ParamSpec("P")
Result = TypeVar("Result")

_BYTE_SIZE = TypeAdapter(ByteSize)


def is_whole_number(value: object) -> TypeGuard[int]:
    """Return whether a value is an integer of Python or NumPy, and no truth value.

    >>> import numpy as np
    >>> is_whole_number(np.int64(3)), is_whole_number(True), is_whole_number(3.0)
    (True, False, False)
    """
    return isinstance(value, Integral) and not isinstance(value, bool)


def byte_count(memory: float | str) -> int:
    """Return a size of memory in bytes.

    Args:
        memory: Number of bytes, or a text such as "4GB" or "800MiB".

    Raises:
        InputError: It is neither, or not positive.

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
    """Return a positive fraction, given as a number or in per cent.

    Args:
        value: Number such as 0.01, or a text such as "0.01", "1%" or "1 %".

    Raises:
        InputError: It is neither, or not positive.

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


def renamed_parameters(**names: str) -> Callable[[Callable[P, Result]], Callable[P, Result]]:
    """Let a function take parameters under their old names for one more release, with a DeprecationWarning.

    Args:
        **names: New name of each parameter, by its old one.

    >>> @renamed_parameters(orders="order")
    ... def double(order):
    ...     return 2 * order
    >>> double(order=3)
    6
    """

    def decorate(function: Callable[P, Result]) -> Callable[P, Result]:
        @wraps(function)
        def call(*arguments: P.args, **options: P.kwargs) -> Result:
            for old in names.keys() & options.keys():
                new = names[old]
                if new in options:
                    raise TypeError(
                        f"{function.__name__}() got both {new!r} and its old name {old!r}; give {new!r} alone"
                    )
                warnings.warn(
                    f"the parameter {old!r} of {function.__name__}() is now called {new!r}; "
                    f"{old!r} will be refused from the next release on",
                    DeprecationWarning,
                    stacklevel=2,
                )
                options[new] = options.pop(old)
            return function(*arguments, **options)

        return call

    return decorate
