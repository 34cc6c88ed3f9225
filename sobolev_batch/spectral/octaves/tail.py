"""The tail of a norm or distance: its measured octaves, and what lies beyond them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.budget import NormEstimate, change_of_root
from sobolev_batch.spectral.octaves.sums import OctaveSums, statistical_errors

Reals = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Tail:
    """Squared norms of fields beyond the innermost frequencies, each (orders, ...).

    Attributes:
        octaves: Part of the octaves.
        statistical: How far off that may be, at 99 %.
        beyond: Part beyond the last octave.
        uncertainty: How far off that may be.
    """

    octaves: Reals
    statistical: Reals
    beyond: Reals
    uncertainty: Reals

    @classmethod
    def from_sums(cls, sums: Sequence[OctaveSums], beyond: Reals, uncertainty: Reals) -> Self:
        """Return the tail by the sums over octaves, and what lies beyond them (orders,)."""
        none = np.zeros(len(beyond))
        measured = np.sum([octave.squares for octave in sums], axis=0) if sums else none
        return cls(measured, statistical_errors(sums) if sums else none, beyond, uncertainty)

    @classmethod
    def stacked(cls, tails: Sequence[Tail]) -> Self:
        """Return the tails of several fields as one, (orders, fields)."""
        parts = ([getattr(tail, field.name) for tail in tails] for field in fields(cls))
        return cls(*(np.stack(arrays, axis=-1) for arrays in parts))

    def scaled(self, factors: Reals) -> Tail:
        """Return the tails of several fields, (orders, fields), each times a factor."""
        parts = (getattr(self, field.name) for field in fields(self))
        return Tail(*(part * factors for part in parts))

    @property
    def squares(self) -> Reals:
        """The whole tail."""
        return self.octaves + self.beyond

    def estimate(self, core: Reals, images: Reals, discretisation: Reals) -> NormEstimate:
        """Return norms with their errors, each (orders, ...).

        Args:
            core: Squared norm of the innermost frequencies.
            images: Bound on its change by the lattice's spacing.
            discretisation: Norms of the errors of all values.
        """
        squares = np.maximum(np.maximum(core, 0.0) + self.squares, 0.0)
        return NormEstimate(
            np.sqrt(squares),
            change_of_root(squares, self.uncertainty),
            change_of_root(squares, images),
            discretisation,
            change_of_root(squares, self.statistical),
        )
