"""Observed orders of convergence between the meshes of a family."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]

# Of the sizes of two meshes between which a rate is formed.
_LEAST_RATIO = 1.1


def observed_rates(distances: Reals, errors: Reals, sizes: Reals) -> tuple[Reals, Reals]:
    """Return the observed order p in distance ~ size^p between each mesh and a coarser one, with its error.

    The coarser one is the next whose size is larger by a tenth at least: between nearly equal sizes chance decides.

    Args:
        distances: Distances to the reference (n,), NaN where missing.
        errors: Errors of the distances (n,).
        sizes: Mean edge lengths (n,), in units of length, NaN where missing.

    Returns:
        log(d_coarse/d)/log(h_coarse/h) and its error, (n,) each, in the order of the arguments. NaN for the
        coarsest meshes, for meshes without a distance or size, and for distances below their error.

    >>> sizes = np.array([0.4, 0.2, 0.1])
    >>> observed_rates(3 * sizes**2, np.zeros(3), sizes)[0].round(6)
    array([nan,  2.,  2.])
    """
    rates, uncertainties = np.full(len(distances), np.nan), np.full(len(distances), np.nan)
    usable = np.flatnonzero(np.isfinite(sizes) & (sizes > 0) & (distances > 0) & (errors < distances))
    by_size = usable[np.argsort(-sizes[usable], kind="stable")]
    coarser_counts = np.searchsorted(-sizes[by_size], -_LEAST_RATIO * sizes[by_size], side="right")
    for fine, count in zip(by_size, coarser_counts, strict=True):
        if count:
            coarse = by_size[count - 1]
            span = np.log(sizes[coarse] / sizes[fine])
            rates[fine] = np.log(distances[coarse] / distances[fine]) / span
            # The widest that both distances allow.
            widest = sum(-np.log1p(-errors[i] / distances[i]) for i in (coarse, fine))
            uncertainties[fine] = widest / span
    return rates, uncertainties
