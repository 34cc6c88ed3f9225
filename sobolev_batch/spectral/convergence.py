"""Observed rates of convergence between the levels of a family."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]


def observed_rates(errors: Reals, sizes: Reals) -> Reals:
    """The exponent p in error ~ size^p between each mesh and the next coarser one.

    Args:
        errors: (n,) distances to the reference; NaN where missing.
        sizes: (n,) mean edge lengths, in units of length; NaN where missing.

    Returns:
        (n,) log(e_coarse/e)/log(h_coarse/h), in the order of the arguments; NaN for the coarsest,
        for meshes without a distance or size, and where neighbours have the same size or no error.
    """
    rates = np.full(len(errors), np.nan)
    usable = np.flatnonzero(np.isfinite(errors) & np.isfinite(sizes) & (errors > 0) & (sizes > 0))
    ordered = usable[np.argsort(-sizes[usable], kind="stable")]
    for coarse, fine in pairwise(ordered):
        if sizes[coarse] > sizes[fine]:
            rates[fine] = np.log(errors[coarse] / errors[fine]) / np.log(sizes[coarse] / sizes[fine])
    return rates
