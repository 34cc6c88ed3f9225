"""Double-double arithmetic: sums and products of doubles with their rounding errors.

Sources: T. J. Dekker, "A floating-point technique for extending the available precision" (1971),
doi:10.1007/BF01397083; T. Ogita, S. M. Rump, S. Oishi, "Accurate sum and dot product" (2005),
doi:10.1137/030601818. Valid without over- and underflow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_SPLITTER = 2.0**27 + 1

Reals = NDArray[np.float64]
Pair = tuple[Reals, Reals]


def two_sum(a: Reals, b: Reals) -> Pair:
    """Return the rounded sum and its rounding error: a + b = high + low exactly."""
    high = a + b
    shadow = high - a
    return high, (a - (high - shadow)) + (b - shadow)


def two_product(a: Reals, b: Reals) -> Pair:
    """Return the rounded product and its rounding error: a * b = high + low exactly."""
    high = a * b
    a_high, a_low = _split(a)
    b_high, b_low = _split(b)
    return high, a_low * b_low - (((high - a_high * b_high) - a_low * b_high) - a_high * b_low)


def multiply(a: Pair, b: Pair) -> Pair:
    """Return the product of two double-double numbers, to about twice double precision."""
    high, low = two_product(a[0], b[0])
    return two_sum(high, low + (a[0] * b[1] + a[1] * b[0]))


def subtract(a: Pair, b: Pair) -> Pair:
    """Return the difference of two double-double numbers, to about twice double precision of the larger one."""
    high, low = two_sum(a[0], -b[0])
    return two_sum(high, low + (a[1] - b[1]))


def _split(a: Reals) -> Pair:
    shifted = _SPLITTER * a
    high = shifted - (shifted - a)
    return high, a - high
