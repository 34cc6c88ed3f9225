"""Values of surfaces at common frequencies, on a lattice and in octaves beyond it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.fields import Field
from sobolev_batch.spectral.octaves.values import OctaveValues
from sobolev_batch.spectral.shells import SobolevWeights

Reals = NDArray[np.float64]
Complexes = NDArray[np.complexfloating]


@dataclass(frozen=True, eq=False)
class SurfaceValues:
    """Values of a surface at some frequencies.

    Attributes:
        field: Field on the lattice.
        octaves: Values in the octaves beyond it.
    """

    field: Field
    octaves: tuple[OctaveValues, ...] = ()

    def error_norms(self, weights: SobolevWeights) -> Reals:
        """Return the norms of the values' own errors (orders,)."""
        on_lattice = self.field.quality.probe.norms(weights)
        return np.asarray(np.hypot.reduce([on_lattice, *(one.error_norms(weights.orders) for one in self.octaves)]))


@dataclass(frozen=True, eq=False)
class Measure:
    """Values of a signed sum of surfaces.

    Attributes:
        lattice: Values on the half lattice, complex.
        octaves: Values at the samples of each octave, complex.
    """

    lattice: Complexes
    octaves: tuple[Complexes, ...]

    @classmethod
    def from_values(cls, surfaces: Sequence[SurfaceValues], signs: Sequence[int]) -> Self:
        """Return the sum of some surfaces, each with its sign."""
        signed = list(zip(surfaces, signs, strict=True))
        lattice = sum(sign * one.field.values for one, sign in signed)
        octaves = (
            sum(sign * one.octaves[number].values for one, sign in signed) for number in range(len(surfaces[0].octaves))
        )
        return cls(np.asarray(lattice), tuple(map(np.asarray, octaves)))

    def __add__(self, other: Measure) -> Measure:
        octaves = (a + b for a, b in zip(self.octaves, other.octaves, strict=True))
        return Measure(self.lattice + other.lattice, tuple(octaves))
