"""Tails of norms and distances, from stored values in octaves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.batch.store.store import Store
from sobolev_batch.spectral.errors.quality import TailQuality
from sobolev_batch.spectral.octaves.limit import EnergyLimit
from sobolev_batch.spectral.octaves.sums import OctaveSums, squared_moduli
from sobolev_batch.spectral.octaves.tail import Tail
from sobolev_batch.spectral.octaves.tail_sampling import TailSampling, TailWeights

Reals = NDArray[np.float64]

# Of two surfaces that were not compared, the energy's limit is at least this fraction of the last measured energy.
_LEAST_LIMIT = 0.7
# Rows of a tile whose values are held at a time take this many bytes.
_HELD_BYTES = 128 << 20
# Of a sample: its frequency, weight and place, and values of three fields with their squares.
_SAMPLE_BYTES = 200.0


@dataclass(frozen=True, eq=False)
class TailReducer:
    """Tails from a store.

    Attributes:
        store: Store of the values.
        sampling: Samples of the octaves.
        orders: Sobolev orders s.
        reference: Row of the reference, or None if it has no values.
        qualities: Quality of each row's values.
        checksums: Checksum of each row's values.
    """

    store: Store
    sampling: TailSampling
    orders: tuple[float, ...]
    reference: int | None
    qualities: Mapping[int, TailQuality]
    checksums: Mapping[int, int]

    @cached_property
    def weights(self) -> TailWeights:
        """Weights of all samples."""
        return self.sampling.weights_for(self.orders)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "weights"}

    @property
    def task_bytes(self) -> float:
        """Memory that a task takes at most."""
        return _HELD_BYTES + (_SAMPLE_BYTES + 8 * len(self.orders)) * self.sampling.size

    def read(self, row: int) -> NDArray[np.complexfloating]:
        """Return the values of a row (n,), and check them against its record."""
        values: NDArray[np.complexfloating] = self.store.read_octaves([row], [self.checksums[row]])[0]
        return values

    def of_norm(self, row: int, values: NDArray[np.complexfloating], inner: Reals) -> Tail:
        """Return the tail of a squared norm; ``inner`` are the energies of the two octaves below (2,)."""
        quality = self.qualities[row]
        return self._tail(self.weights.sums(squared_moduli(values)), EnergyLimit(*quality.own_limit), inner)

    def of_pair(self, row: int, other: int, difference: NDArray[np.complexfloating], inner: Reals) -> Tail:
        """Return the tail of a squared distance; see `of_norm`."""
        sums = self.weights.sums(squared_moduli(difference))
        return self._tail(sums, self._limit(row, other, sums[-1].energy), inner)

    def of_pairs(self, rows: Sequence[int], others: Sequence[int], inner: Reals, shared: int) -> Tail:
        """Return the tails of the squared distances of rows to others, (orders, rows, others).

        Args:
            rows: Rows of one side.
            others: Rows of the other side.
            inner: Energies of the two octaves below, (2, rows, others).
            shared: Number of rows that the others begin with.
        """
        tails: dict[tuple[int, int], Tail] = {}
        size = max(1, _HELD_BYTES // (16 * self.sampling.size))
        for first in range(0, len(rows), size):
            held = {i: self.read(rows[i]) for i in range(first, min(first + size, len(rows)))}
            for j, other in enumerate(others):
                if j < first and j < shared:
                    continue
                values = held[j] if j < shared and j in held else self.read(other)
                for i, own in held.items():
                    if j < shared and (j, i) in tails:
                        tails[i, j] = tails[j, i]
                    elif rows[i] != other:
                        tails[i, j] = self.of_pair(rows[i], other, own - values, inner[:, i, j])
                    else:
                        tails[i, j] = Tail(*np.zeros((4, len(self.orders))))
        # Below the diagonal, where later rows meet earlier ones.
        flat = [tails[i, j] if (i, j) in tails else tails[j, i] for i in range(len(rows)) for j in range(len(others))]
        return Tail.stacked(flat).reshaped(len(rows), len(others))

    def _tail(self, sums: Sequence[OctaveSums], limit: EnergyLimit, inner: Reals) -> Tail:
        return Tail.from_sums(self.weights.partition, sums, limit, self.orders, inner.tolist())

    def _limit(self, row: int, other: int, last_energy: float) -> EnergyLimit:
        """Return the limit of a difference's energy: known to the reference, else between bounds."""
        for one, against in ((row, other), (other, row)):
            known = self.qualities[one].difference_limit
            if against == self.reference and known is not None:
                return EnergyLimit(*known)
        if not last_energy:
            # Equal meshes have equal values.
            return EnergyLimit(0.0)
        highest = self.qualities[row].own_limit[0] + self.qualities[other].own_limit[0]
        return EnergyLimit.between(_LEAST_LIMIT * last_energy, highest)
