"""Nodes that the transform of a smooth surface takes: doubled until it changes by less than a tolerance."""

import math
from functools import lru_cache

import numpy as np

from sobolev_batch.arrays import Complexes, Reals
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.smooth import MOST_GAUSS_NODES, MOST_NODES, Counts, Smooth, doubled
from sobolev_batch.geometry.surface import DIRECTIONS
from sobolev_batch.transform.backends import cosine_and_sine

# Less is rounding: of the transform, and of derivatives that come from an interpolant.
FINEST_CHANGE = 1e-13
# Random sums over few nodes may agree to a few percent by chance.
COARSEST_CHANGE = 1e-4
# Nodes that the spacing on a surface is measured with; and nodes beyond one for each wavelength, which is the least: a
# part of them, and some for each digit. The change is to be this part of the tolerance, beside the errors of NUFFTs.
_SPACING_NODES, _MARGIN, _EXTRA, _FIRST_CHANGE = 31, 1.1, 3, 1e-3
# Probe frequencies (25, 3): of unit length along axes, diagonals and nine other directions, and a few shorter ones.
_OTHERS = np.random.default_rng(20).normal(size=(9, 3))
_OTHERS /= np.linalg.norm(_OTHERS, axis=1, keepdims=True)
_UNIT_FREQUENCIES = np.concatenate([DIRECTIONS, _OTHERS, *(fraction * _OTHERS[:1] for fraction in (0.0, 0.3, 0.7))])
# Pairs of a node and a frequency at a time: their temporaries stay in cache.
_PAIRS = 1 << 18
# Nodes along a parameter for one of those at which the other is looked at, and the fewest of these.
_ACROSS, _FEWEST_ACROSS = 8, 63
# The change that exact values are resolved to, the nodes that may be spent on that, and the part of them added then.
_EXACT_CHANGE, _MOST_EXACT_NODES, _MORE = 1e-12, 1 << 19, 4


@lru_cache(maxsize=16)
def resolution_of(surface: Smooth, highest_frequency: float, tolerance: float) -> tuple[Counts, float]:
    """Return the nodes along u and v that the transform of a surface takes up to a frequency, and how far it is off.

    That is the change of the transform when the nodes are doubled along u, plus that along v, over the area: the
    largest one over the probe frequencies. The tolerance of it is clipped to 1e-13 to 1e-4; frequencies are in cycles
    per unit length. InputError where more than 4,194,304 nodes would be needed, or 2,048 along a parameter that is not
    periodic: the parametrisation is not smooth, or the surface is large or thin compared with the wavelength.
    """
    tolerance = min(max(tolerance, FINEST_CHANGE), COARSEST_CHANGE)
    (u, v), change = _refined(surface, highest_frequency, tolerance, MOST_NODES)
    if change > tolerance:
        still = f"with {u} x {v} it still changes by {change:.2g} of the area"
        raise InputError(
            f"the transform of the parametrised surface up to |xi| = {highest_frequency:.4g} is not settled to "
            f"{tolerance:.2g} of its area with {MOST_NODES} nodes, {MOST_GAUSS_NODES} along a parameter that is not "
            f"periodic: {still if math.isfinite(change) else 'it would take more to begin with'}. It has a kink, a "
            "corner or an unmarked period, or is large or thin beside the wavelength; lower xi_max, or raise eps"
        )
    return (u, v), change


def direct_transform(surface: Smooth, counts: Counts, frequencies: Reals) -> Complexes:
    """Return Σ w exp(-2πi ξ·x) over the nodes of a rule at frequencies (P, 3), to a few rounding errors of the area."""
    wave_vectors = -2 * np.pi * np.asarray(frequencies, dtype=np.float64)
    values = np.zeros(len(wave_vectors), dtype=np.complex128)
    for points, weights in surface.nodes(counts, max(1, _PAIRS // max(len(wave_vectors), 1))):
        cosines, sines = cosine_and_sine(wave_vectors @ points)
        values += cosines @ weights + 1j * (sines @ weights)
    return values


@lru_cache(maxsize=16)
def exact_counts(surface: Smooth, highest: float) -> Counts:
    """Return more nodes along each parameter than the transform converges with up to a frequency; odd numbers."""
    u, v = _refined(surface, highest, _EXACT_CHANGE, _MOST_EXACT_NODES)[0]
    return u + u // _MORE + _MORE | 1, v + v // _MORE + _MORE | 1


def _refined(surface: Smooth, highest: float, tolerance: float, most: int) -> tuple[Counts, float]:
    """Double the nodes along each parameter that needs it, until the change is small or the nodes are too many."""
    counts = _first_counts(surface, highest, tolerance)
    if _too_many(surface, counts, most):  # even the first
        return counts, math.inf
    frequencies = highest * _UNIT_FREQUENCIES
    while True:
        twice = doubled(counts)
        # Errors along one parameter show at few of the nodes along the other.
        u, v = (min(count, max(count // _ACROSS | 1, _FEWEST_ACROSS)) for count in counts)
        pairs = ((counts[0], v), (twice[0], v)), ((u, counts[1]), (u, twice[1]))
        values = [[direct_transform(surface, nodes, frequencies) for nodes in pair] for pair in pairs]
        changes = [float(np.abs(finer - coarser).max()) / surface.area for coarser, finer in values]
        coarse = [change > tolerance / 2 for change in changes]
        larger = (twice[0] if coarse[0] else counts[0], twice[1] if coarse[1] else counts[1])
        if sum(changes) <= tolerance or _too_many(surface, larger, most):
            return counts, sum(changes)
        counts = larger


def _too_many(surface: Smooth, counts: Counts, most: int) -> bool:
    along = zip(surface.intervals, counts, strict=True)
    return math.prod(counts) > most or any(n > MOST_GAUSS_NODES and not interval.periodic for interval, n in along)


def _first_counts(surface: Smooth, highest: float, tolerance: float) -> Counts:
    """Return a node for each wavelength where nodes are farthest apart, and some more; odd numbers."""
    points = np.concatenate([batch for batch, _ in surface.nodes((_SPACING_NODES, _SPACING_NODES))], axis=1)
    grid = points.reshape(3, _SPACING_NODES, _SPACING_NODES)
    widest = (float(np.linalg.norm(np.diff(grid, axis=axis), axis=0).max()) for axis in (1, 2))
    # The numbers may exceed all bounds, and are refused then.
    counts = (min(_MARGIN * _SPACING_NODES * width * highest, float(MOST_NODES)) for width in widest)
    u, v = (math.ceil(count - _EXTRA * math.log10(_FIRST_CHANGE * tolerance)) | 1 for count in counts)
    return u, v
