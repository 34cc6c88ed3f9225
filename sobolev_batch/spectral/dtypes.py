"""The two precisions that fields are computed and stored in."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Precision = Literal["complex128", "complex64"]
Complexes = NDArray[np.complexfloating[Any, Any]]


def item_bytes(precision: Precision) -> int:
    """Bytes of one sample of a field."""
    return 16 if precision == "complex128" else 8
