"""Loops over pairs that numba compiles: the same formulas as the array code beside which they stand, without arrays.

Array expressions over pairs of a triangle and a frequency, or of a point and a triangle, spend their time on moving
temporaries through memory. A compiled loop keeps them in registers and takes a fifth to a tenth of the time. But numba
takes half a second to import and some seconds to compile a loop, once for a machine. So a process begins with arrays,
and turns to loops as soon as its work on arrays has taken, or is predicted to take, as long as that.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from threading import Lock
from typing import Any, TypeVar

Loop = TypeVar("Loop", bound=Callable[..., Any])

# Processor seconds on arrays from which on numba is worth its import.
_WORTH_SECONDS = 1.0
# One number: the processor seconds that work on arrays was predicted to take in this process.
_spent: ContextVar[list[float]] = ContextVar("spent", default=[0.0])  # noqa: B039
_adding = Lock()


@contextmanager
def by_itself(*, loops: bool) -> Iterator[None]:
    """Let loops pay at once or as the work within goes on, so that its digits do not depend on any other work."""
    token = _spent.set([math.inf if loops else 0.0])
    try:
        yield
    finally:
        _spent.reset(token)


def pays(seconds: float) -> bool:
    """Tell whether compiled loops pay for work that would take some processor seconds on arrays.

    The seconds of all calls in a process add up, so that many small pieces of work turn to loops as one large one does.
    """
    spent = _spent.get()
    with _adding:
        spent[0] += seconds
        return spent[0] > _WORTH_SECONDS


def loop(function: Loop) -> Loop:
    """Compile a loop when it is first called, for all threads at once, and keep it for later processes if possible."""
    import numba

    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)  # type: ignore[no-any-return]
    except RuntimeError:  # no folder for what is compiled: a package that cannot be written, and a user without a home
        return numba.njit(nogil=True, error_model="numpy")(function)  # type: ignore[no-any-return]


def part(function: Loop) -> Loop:
    """Compile a function into each loop that calls it: a call within a loop would keep LLVM from making vectors.

    A product and a sum may be rounded once instead of twice.
    """
    import numba

    parts = numba.njit(forceinline=True, fastmath={"contract"}, error_model="numpy")
    return parts(function)  # type: ignore[no-any-return]
