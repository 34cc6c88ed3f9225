"""How many quadrature nodes a parametrised surface takes, and its transform summed directly over nodes.

The rules converge spectrally: beyond some number of nodes every further one multiplies the error by a
factor, so the change on doubling them is the error of the fewer ones to all its digits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.spectral.backends.phases import cosine_and_sine
from sobolev_batch.surfaces.shapes.extent import DIRECTIONS
from sobolev_batch.surfaces.shapes.smooth import MOST_GAUSS_NODES, MOST_NODES, Counts, Smooth, doubled

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Less is rounding: of the transform, and of derivatives that come from an interpolant.
FINEST_CHANGE = 1e-13
# Random sums of few nodes may agree to a few percent by chance.
COARSEST_CHANGE = 1e-4
# The nodes that the spacing on a surface is measured with, and what is needed beyond two nodes a wavelength.
_MEASURING, _MARGIN, _EXTRA = 31, 1.1, 12
# Directions of the probe frequencies that are neither axes nor diagonals, and shorter ones that are tried too.
_RANDOM_DIRECTIONS, _FRACTIONS = 9, (0.0, 0.3, 0.7)
# Pairs of a node and a frequency at a time: their temporaries stay in cache.
_PAIRS = 1 << 18
# What exact values are resolved to, and the nodes that may be spent on them.
_EXACT_CHANGE, _MOST_EXACT_NODES = 1e-12, 1 << 19


@dataclass(frozen=True)
class Resolution:
    """The nodes of a quadrature rule and how good it is.

    Attributes:
        counts: nodes along u and v.
        change: of the transform when they are doubled along each, both added, over the area: the largest over
            the probe frequencies.
        settled: whether that is as small as was asked for.
    """

    counts: Counts
    change: float
    settled: bool

    @property
    def size(self) -> int:
        """Number of nodes."""
        return math.prod(self.counts)


@lru_cache(maxsize=16)
def resolve(surface: Smooth, highest_frequency: float, tolerance: float) -> Resolution:
    """The nodes that a surface takes for its transform up to a frequency.

    Args:
        surface: in units of length.
        highest_frequency: the largest |ξ|, in cycles per unit length.
        tolerance: largest change when the nodes are doubled, relative to the area, held between 1e-13 and 1e-4.

    Raises:
        InputError: more than 4,194,304 nodes would be needed, or 2,048 along a parameter that is not
            periodic: the parametrisation is not smooth, or the surface large or thin beside the wavelength.
    """
    allowed = min(max(tolerance, FINEST_CHANGE), COARSEST_CHANGE)
    found = _refined(surface, highest_frequency, allowed, MOST_NODES)
    if not found.settled:
        so_far = "it would take more to begin with"
        if math.isfinite(found.change):
            so_far = f"with {found.counts[0]} x {found.counts[1]} it still changes by {found.change:.2g} of the area"
        raise InputError(
            f"the transform of the parametrised surface up to |xi| = {highest_frequency:.4g} is not settled to "
            f"{allowed:.2g} of its area with {MOST_NODES} nodes, the most that are tried ({MOST_GAUSS_NODES} along a "
            f"parameter that is not periodic); {so_far}. Its parametrisation is not smooth (a kink, a corner, an "
            "unmarked period), or the surface is large or thin beside the shortest wavelength; lower xi_max, or allow "
            "a larger eps"
        )
    return found


def direct_transform(surface: Smooth, counts: Counts, frequencies: Reals) -> Complexes:
    """The transform Σ w exp(-2πi ξ·x) over the nodes of a rule, summed one by one.

    Args:
        surface: in units of length.
        counts: nodes along u and v.
        frequencies: ξ, (P, 3) float64, in cycles per unit length.

    Returns:
        complex128 (P,), to a few rounding errors of the area.
    """
    turns = -2 * np.pi * np.asarray(frequencies, dtype=np.float64)
    values = np.zeros(len(turns), dtype=np.complex128)
    for points, weights in surface.nodes(counts, max(1, _PAIRS // max(len(turns), 1))):
        cosines, sines = cosine_and_sine(turns @ points)
        values += cosines @ weights + 1j * (sines @ weights)
    return values


def exact_values(surface: Smooth, frequencies: Reals) -> Complexes:
    """The transform of a surface (P,) at a few frequencies, with twice the nodes along each parameter that settle it.

    On a smooth surface it is good to about 1e-14 of the area. On one that half a million nodes do not
    settle it is what twice as many along each say, and differs from the transform accordingly.

    Args:
        surface: in units of length.
        frequencies: (P, 3) float64, in cycles per unit length.
    """
    if not len(frequencies):
        return np.zeros(0, dtype=np.complex128)
    highest = float(np.linalg.norm(frequencies, axis=1).max())
    return direct_transform(surface, _exact_counts(surface, highest), frequencies)


@lru_cache(maxsize=16)
def _exact_counts(surface: Smooth, highest: float) -> Counts:
    return doubled(_refined(surface, highest, _EXACT_CHANGE, _MOST_EXACT_NODES).counts)


def _refined(surface: Smooth, highest: float, allowed: float, most: int) -> Resolution:
    """Nodes that are doubled along whichever parameter needs it, until the change is small or there are too many."""
    counts = _first_counts(surface, highest)
    if _too_many(surface, counts, most):
        return Resolution(counts, math.inf, False)
    frequencies = _probe_frequencies(highest)
    values = direct_transform(surface, counts, frequencies)
    while True:
        finer = [direct_transform(surface, more, frequencies) for more in _finer(counts)]
        changes = [float(np.abs(more - values).max()) / surface.area for more in finer]
        if sum(changes) <= allowed:
            return Resolution(counts, sum(changes), True)
        short = [change > allowed / 2 for change in changes]
        wanted = doubled(counts)
        larger = (wanted[0] if short[0] else counts[0], wanted[1] if short[1] else counts[1])
        if _too_many(surface, larger, most):
            return Resolution(counts, sum(changes), False)
        counts = larger
        values = finer[short.index(True)] if sum(short) == 1 else direct_transform(surface, counts, frequencies)


def _too_many(surface: Smooth, counts: Counts, most: int) -> bool:
    along = zip(surface.intervals, counts, strict=True)
    return math.prod(counts) > most or any(n > MOST_GAUSS_NODES and not interval.periodic for interval, n in along)


def _finer(counts: Counts) -> Iterator[Counts]:
    more = doubled(counts)
    yield more[0], counts[1]
    yield counts[0], more[1]


def _first_counts(surface: Smooth, highest: float) -> Counts:
    """Two nodes a wavelength where they are farthest apart, and some more; odd numbers."""
    points = np.concatenate([part for part, _ in surface.nodes((_MEASURING, _MEASURING))], axis=1)
    grid = points.reshape(3, _MEASURING, _MEASURING)
    counts = []
    for axis in (1, 2):
        widest = float(np.linalg.norm(np.diff(grid, axis=axis), axis=0).max())
        # As a number of nodes it may be beyond all bounds, and is then refused.
        needed = min(_MARGIN * _MEASURING * widest * 2 * highest, float(MOST_NODES))
        counts.append(math.ceil(needed) + _EXTRA | 1)
    return counts[0], counts[1]


@lru_cache(maxsize=4)
def _unit_frequencies() -> Reals:
    rng = np.random.default_rng(20)
    random = rng.normal(size=(_RANDOM_DIRECTIONS, 3))
    random /= np.linalg.norm(random, axis=1, keepdims=True)
    return np.concatenate([DIRECTIONS, random, *(part * random[:1] for part in _FRACTIONS)])


def _probe_frequencies(highest: float) -> Reals:
    """Frequencies (25, 3) of the largest length in all directions, and a few shorter ones."""
    return highest * _unit_frequencies()
