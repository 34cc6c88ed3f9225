"""The two dtypes that fields are computed and stored in."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

ComplexDtype = Literal["complex128", "complex64"]
Complexes = NDArray[np.complexfloating[Any, Any]]
