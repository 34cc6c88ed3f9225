"""Types of arrays, for annotations. Shapes are in docstrings."""

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
