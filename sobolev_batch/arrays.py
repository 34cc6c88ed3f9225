"""Types of arrays, for annotations, whose shapes are in docstrings; and slices of long ones."""

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]
Indices = NDArray[np.int64]
# In double precision, or in single where a field is stored so.
Complexes = NDArray[np.complexfloating[Any, Any]]
# The name of the type of a field.
ComplexDtype = Literal["complex128", "complex64"]
# Of the backend that computes: NumPy's, or CuPy's, which may not be installed.
Array = Any


def slices(count: int, size: int, start: int = 0) -> Iterator[slice]:
    """Return the slices, of at most a size each, that make up a count of entries, or those from one of them on."""
    return (slice(first, min(first + size, count)) for first in range(start, count, size))
