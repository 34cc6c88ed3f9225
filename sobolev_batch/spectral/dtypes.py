"""The two precisions that fields are computed and stored in."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

ComplexDtype = Literal["complex128", "complex64"]
Complexes = NDArray[np.complexfloating[Any, Any]]


def item_bytes(dtype: ComplexDtype) -> int:
    """Bytes of one sample of a field."""
    return 16 if dtype == "complex128" else 8
