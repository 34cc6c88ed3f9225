"""Frequencies at which an octave is sampled: random lattices, and draws around the normals of flat faces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.lattice import OctaveLattice
from sobolev_batch.spectral.octaves.normals import FaceNormals
from sobolev_batch.spectral.octaves.partition import Octave

Reals = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DrawnFrequencies:
    """Random frequencies in an octave, one in each of equally likely ranges of |ξ|.

    Their lengths follow |ξ|^-2. Their directions are uniform for a fraction, and follow the normals of flat faces for
    the others.

    Attributes:
        octave: Octave that they lie in.
        count: Number of frequencies.
        seed: Seed of the generator.
        normals: Normals of flat faces.
        uniform_fraction: Fraction of uniform directions, which counts if there are normals.
    """

    octave: Octave
    count: int
    seed: int
    normals: FaceNormals
    uniform_fraction: float = 1.0

    def __len__(self) -> int:
        return self.count

    def __getstate__(self) -> dict[str, Any]:
        # Tasks draw them anew: it is cheaper than sending them.
        return {name: value for name, value in self.__dict__.items() if name != "frequencies"}

    @cached_property
    def frequencies(self) -> Reals:
        """ξ, float64 (count, 3), in cycles per unit length."""
        rng = np.random.default_rng(self.seed)
        low, high = self.octave.lowest, self.octave.highest
        levels = (rng.permutation(self.count) + rng.random(self.count)) / max(self.count, 1)
        radii = 1 / (1 / low - levels * (1 / low - 1 / high))
        directions = rng.normal(size=(self.count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        if self.normals:
            along = rng.random(self.count) >= self.uniform_fraction
            directions[along] = self.normals.draw(radii[along], rng)
        return np.asarray(radii[:, None] * directions)

    def density(self, frequencies: Reals) -> Reals:
        """Return the expected number of draws per volume (n,) at frequencies (n, 3) of the octave."""
        if not self.count:
            return np.zeros(len(frequencies))
        radii = np.linalg.norm(frequencies, axis=1)
        radial = 1 / (radii**2 * (1 / self.octave.lowest - 1 / self.octave.highest))
        uniform = self.uniform_fraction if self.normals else 1.0
        directional = np.full(len(radii), uniform / (4 * np.pi))
        if self.normals:
            directional += (1 - uniform) * self.normals.density(frequencies / radii[:, None], radii)
        return np.asarray(self.count * radial * directional / radii**2)


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

    def to_table(self) -> dict[str, Any]:
        """Return the sampling as a table, without its octave and the normals."""
        return {
            "lattices": [
                {"M": one.M, "quaternion": list(one.quaternion), "offset": list(one.offset)} for one in self.lattices
            ],
            "draws": self.drawn.count,
            "seed": self.drawn.seed,
            "uniform_fraction": self.drawn.uniform_fraction,
        }

    @classmethod
    def from_table(cls, octave: Octave, normals: FaceNormals, table: Mapping[str, Any]) -> Self:
        """Return the sampling of an octave that a table holds."""
        lattices = tuple(
            OctaveLattice(octave.lowest, octave.highest, one["M"], tuple(one["quaternion"]), tuple(one["offset"]))
            for one in table["lattices"]
        )
        drawn = DrawnFrequencies(octave, table["draws"], table["seed"], normals, table["uniform_fraction"])
        return cls(octave, lattices, drawn)
