"""Observed rates of convergence between the levels of a family."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]


def observed_rates(distances: Reals, errors: Reals, sizes: Reals) -> tuple[Reals, Reals]:
    """The exponent p in distance ~ size^p between each mesh and the next coarser one, with its error.

    Args:
        distances: (n,) to the reference; NaN where missing.
        errors: (n,) of the distances.
        sizes: (n,) mean edge lengths, in units of length; NaN where missing.

    Returns:
        (n,) log(d_coarse/d)/log(h_coarse/h) and its error, in the order of the arguments; NaN for the
        coarsest, for meshes without a distance or size, for those whose distance has sunk below its
        error and carries no rate, and where neighbours have the same size.
    """
    rates, uncertainties = np.full(len(distances), np.nan), np.full(len(distances), np.nan)
    usable = np.flatnonzero(np.isfinite(sizes) & (sizes > 0) & (distances > 0) & (errors < distances))
    ordered = usable[np.argsort(-sizes[usable], kind="stable")]
    for coarse, fine in pairwise(ordered):
        if sizes[coarse] > sizes[fine]:
            span = np.log(sizes[coarse] / sizes[fine])
            rates[fine] = np.log(distances[coarse] / distances[fine]) / span
            # The widest that both distances allow.
            widest = sum(-np.log1p(-errors[i] / distances[i]) for i in (coarse, fine))
            uncertainties[fine] = widest / span
    return rates, uncertainties
