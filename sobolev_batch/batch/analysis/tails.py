"""Tails of norms and distances, from stored values in octaves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.batch.store.store import Store
from sobolev_batch.spectral.fields import TailQuality
from sobolev_batch.spectral.octaves.remainder import Remainder
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

    def of_norm(self, row: int, values: NDArray[np.complexfloating]) -> Tail:
        """Return the tail of a squared norm."""
        quality = self.qualities[row]
        return self._tail(self.weights.sums(squared_moduli(values)), quality.own)

    def of_pair(self, row: int, other: int, difference: NDArray[np.complexfloating]) -> Tail:
        """Return the tail of a squared distance; see `of_norm`."""
        sums = self.weights.sums(squared_moduli(difference))
        return self._tail(sums, self._remainder(row, other, sums[-1].energy))

    def of_pairs(self, rows: Sequence[int], others: Sequence[int], shared: int) -> Tail:
        """Return the tails of the squared distances of rows to others, (orders, rows, others).

        Args:
            rows: Rows of one side.
            others: Rows of the other side.
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
                        tails[i, j] = self.of_pair(rows[i], other, own - values)
                    else:
                        tails[i, j] = Tail(*np.zeros((4, len(self.orders))))
        # Below the diagonal, where later rows meet earlier ones.
        flat = [tails[i, j] if (i, j) in tails else tails[j, i] for i in range(len(rows)) for j in range(len(others))]
        return Tail.stacked(flat).reshaped(len(rows), len(others))

    def _tail(self, sums: Sequence[OctaveSums], beyond: Remainder) -> Tail:
        return Tail.from_sums(sums, *beyond.at(self.orders))

    def _remainder(self, row: int, other: int, last_energy: float) -> Remainder:
        """Return what lies beyond the octaves in a distance: known to the reference, else between bounds."""
        for first, second in ((row, other), (other, row)):
            known = self.qualities[first].difference
            if second == self.reference and known is not None:
                return known
        parts = [self.qualities[number].own for number in (row, other)]
        # Equal meshes have equal values.
        highest = sum(max(part.energies) for part in parts) if last_energy else 0.0
        return Remainder.between(min(_LEAST_LIMIT * last_energy, highest), highest, parts[0].cutoff)
