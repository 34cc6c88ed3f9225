"""The tail of a norm or distance: its measured octaves, and what lies beyond them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.errors.budget import NormEstimate, change_of_root
from sobolev_batch.spectral.octaves.limit import EnergyLimit, beyond
from sobolev_batch.spectral.octaves.partition import Octave
from sobolev_batch.spectral.octaves.sums import OctaveSums, statistical_errors

Reals = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Tail:
    """Squared norm of a field beyond the innermost frequencies, for each order (orders,).

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
    def of(
        cls,
        octaves: Sequence[Octave],
        sums: Sequence[OctaveSums],
        limit: EnergyLimit,
        orders: Sequence[float],
        inner: Sequence[float],
    ) -> Self:
        """Return the tail by the sums over octaves and the limit of the energy; see `beyond`. None has no octaves."""
        if not octaves:
            return cls(*np.zeros((4, len(orders))))
        measured = np.sum([one.squares for one in sums], axis=0)
        return cls(measured, statistical_errors(sums), *beyond(octaves, sums, limit, orders, inner))

    @property
    def squares(self) -> Reals:
        """The whole tail."""
        return self.octaves + self.beyond

    def estimate(self, core: Reals, images: Reals, discretisation: Reals) -> NormEstimate:
        """Return norms with their errors, each (orders,).

        Args:
            core: Squared norm of the innermost frequencies.
            images: Bound on its change by the lattice's spacing.
            discretisation: Norms of the errors of all values.
        """
        squares = np.maximum(core, 0.0) + self.squares
        return NormEstimate(
            np.sqrt(squares),
            change_of_root(squares, self.uncertainty),
            change_of_root(squares, images),
            discretisation,
            change_of_root(squares, self.statistical),
        )
