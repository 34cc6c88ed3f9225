"""Quadrature over an octave: the samples of its lattices and its draws, with one weight each.

All samples are pooled by the balance heuristic (E. Veach, L. J. Guibas 1995, doi:10.1145/218380.218498): a sample
counts for the inverse of the density with which all lattices and draws together put samples there. The sum of
weight · f then has the integral of f as its expectation, and no sample weighs more than the method that serves its
frequency best would let it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.lattice import OctaveLattice
from sobolev_batch.spectral.octaves.partition import Octave
from sobolev_batch.spectral.octaves.sampling import OctaveSampling

Reals = NDArray[np.float64]
Indices = NDArray[np.int64]

_NOWHERE: Indices = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class SamplePart:
    """Neighbouring samples of a quadrature: those of one lattice, or the drawn ones.

    Attributes:
        samples: Place of the samples in the quadrature.
        starts: First sample of each of the eight sublattices, counted from the part's first, int64 (8,). Sums over
            sublattices are nearly independent. None for drawn samples, which are all independent.
        places: Indices of the samples in the lattice's block, flattened, int64 (n,); empty for drawn ones.
    """

    samples: slice
    starts: Indices | None
    places: Indices

    @property
    def is_drawn(self) -> bool:
        """True for drawn samples."""
        return self.starts is None


@dataclass(frozen=True, eq=False)
class OctaveQuadrature:
    """Samples of an octave with their weights.

    Attributes:
        octave: The octave.
        frequencies: ξ along the axes of the surfaces, float64 (n, 3), in cycles per unit length.
        weights: Weight of each sample in the integral over all of frequency space, the octave's window included.
        parts: The samples of each lattice, and the drawn ones last.
    """

    octave: Octave
    frequencies: Reals
    weights: Reals
    parts: tuple[SamplePart, ...]

    @classmethod
    def from_sampling(cls, sampling: OctaveSampling) -> Self:
        """Return the quadrature of a sampling."""
        found = [_lattice_samples(lattice) for lattice in sampling.lattices]
        frequencies = np.concatenate([*(samples[0] for samples in found), sampling.drawn.frequencies])
        multiples = np.concatenate([*(samples[1] for samples in found), np.ones(len(sampling.drawn))])
        density = sum(lattice.spacing**-3 for lattice in sampling.lattices) + sampling.drawn.density(frequencies)
        weights = multiples * sampling.octave.window(np.linalg.norm(frequencies, axis=1)) / density
        parts, first = [], 0
        for places, starts in (samples[2:] for samples in found):
            parts.append(SamplePart(slice(first, first + len(places)), starts, places))
            first += len(places)
        parts.append(SamplePart(slice(first, len(weights)), None, _NOWHERE))
        return cls(sampling.octave, frequencies, weights, tuple(parts))

    def __len__(self) -> int:
        return len(self.weights)

    @cached_property
    def radii(self) -> Reals:
        """|ξ| of each sample (n,)."""
        return np.asarray(np.linalg.norm(self.frequencies, axis=1))


def _lattice_samples(lattice: OctaveLattice) -> tuple[Reals, Reals, Indices, Indices]:
    """Return the frequencies in the lattice's range by sublattice, how often each counts, places, and starts."""
    block = lattice.half
    x, y, z = lattice.frequencies(block)
    squares = (x**2)[:, None, None] + (y**2)[:, None] + z**2
    i, j, k = np.nonzero((squares > lattice.lowest**2) & (squares < lattice.highest**2))
    sublattices = (4 * (i % 2) + 2 * (j % 2) + k % 2).astype(np.int8)
    order = np.argsort(sublattices, kind="stable")
    i, j, k = i[order], j[order], k[order]
    starts = np.searchsorted(sublattices[order], np.arange(8)).astype(np.int64)
    own = np.stack([x[i], y[j], z[k]], axis=1)
    places = np.ravel_multi_index((i, j, k), block.shape).astype(np.int64)
    return own @ lattice.rotation, lattice.half_weights()[k], places, starts
