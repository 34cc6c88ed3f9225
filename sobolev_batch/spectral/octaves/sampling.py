"""Frequencies at which an octave is sampled: random lattices, and frequencies drawn around the normals of flat faces.

All samples of an octave are pooled by the balance heuristic (E. Veach, L. J. Guibas 1995, doi:10.1145/218380.218498):
a sample counts for the inverse of the density with which all lattices and draws together put samples there. The sum of
weight · f then has the integral of f as its expectation, and no sample weighs more than the method that serves its
frequency best would let it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.lattice import OctaveLattice
from sobolev_batch.spectral.octaves.normals import FaceNormals
from sobolev_batch.spectral.octaves.partition import Octave

Reals = NDArray[np.float64]
Places = tuple[NDArray[np.intp], ...]


@dataclass(frozen=True, eq=False)
class DrawnFrequencies:
    """Random frequencies in an octave.

    Their lengths follow |ξ|^-2. Their directions are uniform for a fraction, and follow the normals of flat faces for
    the others.

    Attributes:
        octave: Octave that they lie in.
        frequencies: ξ, float64 (n, 3), in cycles per unit length.
        normals: Normals of flat faces.
        uniform_fraction: Fraction of uniform directions; 1 without flat faces.
    """

    octave: Octave
    frequencies: Reals
    normals: FaceNormals
    uniform_fraction: float

    @classmethod
    def random(
        cls, octave: Octave, count: int, normals: FaceNormals, uniform_fraction: float, rng: np.random.Generator
    ) -> Self:
        """Draw frequencies, one in each of ``count`` ranges of |ξ| that are equally likely."""
        low, high = octave.lowest, octave.highest
        levels = (rng.permutation(count) + rng.random(count)) / max(count, 1)
        radii = 1 / (1 / low - levels * (1 / low - 1 / high))
        directions = rng.normal(size=(count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        if normals:
            along = rng.random(count) >= uniform_fraction
            directions[along] = normals.draw(radii[along], rng)
        return cls(octave, radii[:, None] * directions, normals, uniform_fraction if normals else 1.0)

    def __len__(self) -> int:
        return len(self.frequencies)

    def density(self, frequencies: Reals) -> Reals:
        """Return the expected number of draws per volume (n,) at frequencies (n, 3) of the octave."""
        if not len(self):
            return np.zeros(len(frequencies))
        radii = np.linalg.norm(frequencies, axis=1)
        radial = 1 / (radii**2 * (1 / self.octave.lowest - 1 / self.octave.highest))
        directional = np.full(len(radii), self.uniform_fraction / (4 * np.pi))
        if self.normals:
            directional += (1 - self.uniform_fraction) * self.normals.density(frequencies / radii[:, None], radii)
        return np.asarray(len(self) * radial * directional / radii**2)


@dataclass(frozen=True, eq=False)
class OctaveSampling:
    """All frequencies at which an octave is sampled.

    Attributes:
        octave: The octave.
        lattices: Random lattices, which may be none.
        drawn: Drawn frequencies, which may be none.
    """

    octave: Octave
    lattices: tuple[OctaveLattice, ...]
    drawn: DrawnFrequencies

    def parts(self) -> Iterator[SamplePart]:
        """Yield the samples of each lattice, and the drawn ones last; made anew, as they take much memory."""
        density = sum(lattice.spacing**-3 for lattice in self.lattices)
        for lattice in self.lattices:
            yield self._weighted(density, *_lattice_samples(lattice))
        frequencies, count = self.drawn.frequencies, len(self.drawn)
        yield self._weighted(density, frequencies, np.ones(count), np.arange(count), ())

    def _weighted(
        self, density: float, frequencies: Reals, multiples: Reals, groups: NDArray[np.int64], places: Places
    ) -> SamplePart:
        radii = np.linalg.norm(frequencies, axis=1)
        weights = multiples * self.octave.window(radii) / (density + self.drawn.density(frequencies))
        return SamplePart(frequencies, radii, weights, groups, places)


@dataclass(frozen=True, eq=False)
class SamplePart:
    """The samples of one lattice, or the drawn ones.

    Attributes:
        frequencies: ξ along the axes of the surfaces, float64 (n, 3), in cycles per unit length.
        radii: |ξ|, float64 (n,).
        weights: Weight of each sample in the integral over all of frequency space, the octave's window included.
        groups: Group of each sample, int64 (n,): the eight sublattices of a lattice, or one group for each draw. Sums
            over groups are nearly independent.
        places: Indices of the samples in the lattice's block; empty for drawn ones.
    """

    frequencies: Reals
    radii: Reals
    weights: Reals
    groups: NDArray[np.int64]
    places: Places


def _lattice_samples(lattice: OctaveLattice) -> tuple[Reals, Reals, NDArray[np.int64], Places]:
    x, y, z = lattice.frequencies(lattice.half)
    squares = (x**2)[:, None, None] + (y**2)[:, None] + z**2
    places = np.nonzero((squares > lattice.lowest**2) & (squares < lattice.highest**2))
    own = np.stack([axis[place] for axis, place in zip((x, y, z), places, strict=True)], axis=1)
    groups = 4 * (places[0] % 2) + 2 * (places[1] % 2) + places[2] % 2
    return own @ lattice.rotation, lattice.half_weights()[places[2]], groups, places
