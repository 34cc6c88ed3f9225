"""Norms and distances that were computed to an accuracy, with the fields and settings that they come from."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import AccuracyError
from sobolev_batch.norms.estimate import NormEstimate, change_of_root
from sobolev_batch.norms.fields import Field
from sobolev_batch.norms.tail.remainder import Remainder
from sobolev_batch.norms.tail.sampling import OctaveSampling
from sobolev_batch.norms.tail.values import OctaveValues
from sobolev_batch.transform.lattice import Lattice, SobolevWeights

# Settings that each field has.
_OF_FIELDS = ("eps", "quadrature_eps", "points")


@dataclass(frozen=True, eq=False)
class SurfaceValues:
    """Values of a surface at some frequencies: its field on a lattice, and in the octaves beyond it."""

    field: Field
    octaves: tuple[OctaveValues, ...] = ()

    def error_norms(self, weights: SobolevWeights) -> Reals:
        """Return the norms of the values' own errors (orders,)."""
        on_lattice = self.field.quality.probe.norms(weights)
        return np.asarray(np.hypot.reduce([on_lattice, *(one.error_norms(weights.orders) for one in self.octaves)]))


@dataclass(frozen=True, eq=False)
class Solution:
    """Norms or distances, and how they were computed.

    Attributes:
        estimate: Numbers with their errors, each (orders,).
        lattice: Lattice of the fields; None where nothing had to be computed.
        values: Values of each surface on the lattice and in octaves beyond it.
        shortfall: Why the numbers miss the accuracy; None if they do not.
        remainders: What lies beyond the lattice, which ends in a step then, and beyond each octave; empty where that
            was not measured.
        alone: Norms that a distance of surfaces far apart consists of, each with a lattice of its own.
    """

    estimate: NormEstimate
    lattice: Lattice | None = None
    values: tuple[SurfaceValues, ...] = ()
    shortfall: AccuracyError | None = None
    remainders: tuple[Remainder, ...] = ()
    alone: tuple[Self, ...] = ()

    @classmethod
    def zero(cls, orders: Sequence[float], moved: Reals | float = 0.0) -> Self:
        """Return the distance of surfaces that are equal, but for some moves, for which nothing is computed."""
        zeros = np.zeros(len(orders))
        return cls(NormEstimate(zeros, zeros, zeros, zeros + moved))

    @classmethod
    def of_apart(cls, apart: Reals, alone: Sequence[Self]) -> Self:
        """Return the distance of surfaces far apart from their norms: its square is the sum of both squares.

        The product of both surfaces does not exceed `apart` (orders,); what it may change is an error by images.
        """
        norms, errors = np.stack([(one.estimate.values, one.estimate.errors) for one in alone], axis=1)
        values, highest = np.hypot(*norms), np.hypot(*(norms + errors))
        # Each error is weighted such that all of them together lead from the values to the highest ones.
        weights = (2 * norms + errors) / (highest + values)
        parts = np.sum([w * one.estimate.stacked[1:] for w, one in zip(weights, alone, strict=True)], axis=0)
        found = NormEstimate(values, *parts)
        product = change_of_root(values**2, 2 * apart)
        shortfall = next((one.shortfall for one in alone if one.shortfall is not None), None)
        return cls(replace(found, aliasing=found.aliasing + product), shortfall=shortfall, alone=tuple(alone))

    @property
    def octaves(self) -> tuple[OctaveSampling, ...]:
        """Octaves that were measured beyond the lattice."""
        return tuple(one.sampling for one in self.values[0].octaves) if self.values else ()

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that the numbers were computed with, as attributes."""
        if self.alone:
            # Those of the larger lattice, and of the fields of both.
            both = [one.settings for one in self.alone]
            lists = {name: [value for one in both for value in one[name]] for name in _OF_FIELDS}
            return {**max(both, key=lambda one: one["M"]), **lists}
        if self.lattice is None:
            return {}
        fields = [one.field for one in self.values]
        settings = [field.settings for field in fields]
        return {
            "xi_max": self.lattice.xi_max,
            "M": self.lattice.M,
            "octaves": len(self.octaves),
            "highest_frequency": max([self.lattice.xi_max, *(one.octave.highest for one in self.octaves)]),
            "dtype": settings[0].dtype,
            "eps": [setting.eps for setting in settings],
            "quadrature_eps": [setting.tolerance or setting.eps for setting in settings],
            "points": [field.points for field in fields],
        }
