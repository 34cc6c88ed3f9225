"""Radial spectra: a field as sums over frequencies of equal length, from which its norm of every order follows.

Within a lattice these are the sums over its shells |k|². An octave has a sample at almost every |ξ|. Its sums are moved
to a few radii, such that the sum of each weight (1 + |ξ|²)^s stays what it is: in log(1 + |ξ|²) the weights are
exponentials, which a polynomial of a low degree interpolates to all digits (J.-P. Berrut, L. N. Trefethen 2004,
doi:10.1137/S0036144502417715).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise
from typing import Any, Self

import numpy as np

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.norms.tail.sampling import OctaveSampling, SamplePart, TailSampling
from sobolev_batch.norms.tail.values import quantile_of_sum
from sobolev_batch.transform.lattice import Lattice, smooth_step

# Radii for a group of samples of an octave: the weights of orders down to -12 are exact to 1e-13 of the largest one.
_NODES = 40
# Orders at which the largest sample is known. Between them its logarithm is convex in the order, and below the chord.
_PEAK_ORDERS = np.array([-0.5, -1, -1.5, -2, -2.5, -3, -3.5, -4, -5, -6, -8, -10, -14, -20, -100])


@dataclass(frozen=True, eq=False)
class Spectra:
    """Radial spectra of several fields, over the axis of a `RadialAxis`.

    Attributes:
        sums: Integrals of |field|² over the frequencies of each radius, float64 (fields, radii).
        moments: Sums of the squared terms of drawn samples, moved to radii likewise, float64 (fields, moments); their
            weights are the squared ones.
        peaks: Largest term of each part of an octave at some orders, float64 (fields, peaks).
    """

    sums: Reals
    moments: Reals
    peaks: Reals

    @classmethod
    def joined(cls, several: Sequence[Self]) -> Self:
        """Return several spectra as one, field by field."""
        return cls(*(np.concatenate([getattr(one, field.name) for one in several]) for field in fields(cls)))

    def __getitem__(self, chosen: Any) -> Spectra:
        """Return the spectra of some fields."""
        return Spectra(self.sums[chosen], self.moments[chosen], self.peaks[chosen])


@dataclass(frozen=True, eq=False)
class ComparedSpectra:
    """Radial spectra of some fields: of their norms, their distances from a reference b, and products <a - b, b>."""

    norm: Spectra
    distance: Spectra
    product: Spectra

    @classmethod
    def joined(cls, several: Sequence[Self]) -> Self:
        """Return several of these as one, field by field."""
        return cls(*(Spectra.joined([getattr(one, field.name) for one in several]) for field in fields(cls)))

    def __getitem__(self, chosen: Any) -> ComparedSpectra:
        """Return the spectra of some fields."""
        return ComparedSpectra(self.norm[chosen], self.distance[chosen], self.product[chosen])

    def bounded_product(self, reference: Spectra) -> Spectra:
        """Return the spectra of products with moments and peaks that theirs do not exceed, by Schwarz's inequality."""
        moments, peaks = (
            np.sqrt(np.maximum(getattr(self.distance, name), 0.0) * np.maximum(getattr(reference, name), 0.0))
            for name in ("moments", "peaks")
        )
        return Spectra(self.product.sums, moments, peaks)

    def to_arrays(self) -> dict[str, Reals]:
        """Return the arrays by the names that `RadialAxis.arrays` describes."""
        arrays = {
            _array_name(of.name, part.name): getattr(getattr(self, of.name), part.name)
            for of in fields(self)
            for part in fields(Spectra)
        }
        return {name: values for name, values in arrays.items() if values.shape[1]}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Reals]) -> Self:
        """Return the spectra that arrays hold, each (fields, ...)."""
        none = np.zeros((len(arrays["norm"]), 0))
        spectra = (
            Spectra(*(arrays.get(_array_name(of.name, part.name), none) for part in fields(Spectra)))
            for of in fields(cls)
        )
        return cls(*spectra)


def _array_name(of: str, part: str) -> str:
    return of if part == "sums" else f"{of}_{part}"


@dataclass(frozen=True, eq=False)
class _Part:
    """A part of an octave's samples: one lattice in eight groups, or all drawn samples.

    `number` counts the parts of an octave. `samples` is its place among all samples, `first` that on the axis.
    """

    sampling: OctaveSampling
    part: SamplePart
    number: int
    samples: slice
    first: int

    @property
    def starts(self) -> list[int]:
        """First sample of each group, counted from the part's first."""
        return [0] if self.part.starts is None else [int(start) for start in self.part.starts]

    @property
    def count(self) -> int:
        """Number of samples."""
        return int(self.samples.stop - self.samples.start)

    @property
    def place(self) -> slice:
        """Place of the part's radii on the axis."""
        return slice(self.first, self.first + len(self.starts) * _NODES)

    @cached_property
    def node_lengths(self) -> Reals:
        """1 + r² of the radii r of one group (_NODES,): Chebyshev points in the logarithm."""
        low, high = np.log1p(np.array([self.sampling.octave.lowest, self.sampling.octave.highest]) ** 2)
        return np.asarray(np.exp((low + high) / 2 + (high - low) / 2 * _chebyshev_points()))

    @cached_property
    def lengths(self) -> Reals:
        """1 + |ξ|² of each sample."""
        return np.asarray(1 + self.sampling.radii[self.part.samples] ** 2)

    def moved(self, terms: Reals) -> Reals:
        """Move terms (fields, n) to the radii of each group, (fields, groups · _NODES)."""
        groups = [
            terms[:, first:last] @ self._interpolation(slice(first, last))
            for first, last in pairwise([*self.starts, self.count])
        ]
        return np.concatenate(groups, axis=1)

    def _interpolation(self, samples: slice) -> Reals:
        """Return the matrix (n, _NODES) that interpolates from the nodes to samples, in the logarithm of 1 + |ξ|²."""
        nodes, scale = np.log(self.node_lengths[[0, -1]]), _chebyshev_points()
        places = np.log(self.lengths[samples])
        positions = scale[0] + (places - nodes[0]) * (scale[-1] - scale[0]) / (nodes[1] - nodes[0])
        differences = positions[:, None] - scale
        # A sample on a node takes that node's value: any tiny difference says so.
        differences[differences == 0] = np.finfo(np.float64).tiny
        signs = np.where(np.arange(_NODES) % 2, -1.0, 1.0)
        matrix = signs * np.sin(np.pi * (np.arange(_NODES) + 0.5) / _NODES) / differences
        matrix /= matrix.sum(axis=1, keepdims=True)
        return np.asarray(matrix)

    @cached_property
    def peak_weights(self) -> Reals:
        """((1 + |ξ|²) / least)^s of each sample for the orders at which peaks are known (orders, n)."""
        return np.stack([(self.lengths / self.least_length) ** order for order in _PEAK_ORDERS])

    @property
    def least_length(self) -> float:
        """1 + r² of the least |ξ| of the octave."""
        return float(1 + self.sampling.octave.lowest**2)

    def peaks_at(self, peaks: Reals, orders: Sequence[float]) -> Reals:
        """Return bounds on the largest terms (orders, fields) from peaks (fields, orders of peaks)."""
        logarithms = np.log(np.maximum(peaks, np.finfo(np.float64).tiny))
        found = []
        for order in orders:
            after = max(int(np.searchsorted(-_PEAK_ORDERS, -order)), 1)
            first, last = _PEAK_ORDERS[after - 1 : after + 1]
            low, high = logarithms[:, after - 1], logarithms[:, after]
            chord = low + (order - first) / (last - first) * (high - low)
            found.append(np.exp(chord + order * np.log(self.least_length)))
        return np.stack(found)


def _chebyshev_points() -> Reals:
    return -np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)


@dataclass(frozen=True, eq=False)
class RadialAxis:
    """The radii over which spectra of fields on a lattice, and in the octaves beyond it, are given.

    The shells |k|² = 0, 1, ... of the lattice come first, then the radii of each group of samples of each octave.

    Attributes:
        sampling: Samples of the octaves; None without any.
    """

    lattice: Lattice
    sampling: TailSampling | None = None

    def __getstate__(self) -> dict[str, Any]:
        # Tasks make the rest anew: it is cheaper than sending it.
        return {"lattice": self.lattice, "sampling": self.sampling}

    @cached_property
    def parts(self) -> tuple[_Part, ...]:
        """Parts of all octaves that have samples, in their order on the axis."""
        parts: list[_Part] = []
        start, first = 0, self.lattice.shell_count
        for sampling in () if self.sampling is None else self.sampling.octaves:
            for number, part in enumerate(sampling.parts):
                samples = slice(start + part.samples.start, start + part.samples.stop)
                if samples.stop > samples.start:
                    parts.append(_Part(sampling, part, number, samples, first))
                    first = parts[-1].place.stop
            start += len(sampling)
        return tuple(parts)

    def __len__(self) -> int:
        return self.parts[-1].place.stop if self.parts else self.lattice.shell_count

    def arrays(self) -> dict[str, tuple[int, str, str]]:
        """Return for each array of `ComparedSpectra` its length, and what it goes over and means."""
        moments = _NODES * sum(part.part.is_drawn for part in self.parts)
        peaks = len(_PEAK_ORDERS) * len(self.parts)
        arrays = {"product": (len(self), "shell", "radial spectrum of the product <a - b, b> with the reference b")}
        for name, meaning in (("norm", "norm"), ("distance", "distance to the reference")):
            arrays |= {
                name: (len(self), "shell", f"radial spectrum of the {meaning}"),
                f"{name}_moments": (moments, "moment", "squared terms of drawn samples, by radius"),
                f"{name}_peaks": (peaks, "peak", "largest term of each part of an octave, at some orders"),
            }
        return {name: array for name, array in arrays.items() if array[0]}

    @cached_property
    def radii(self) -> Reals:
        """|ξ| of each entry, in cycles per unit length (radii,)."""
        shells = self.lattice.spacing * np.sqrt(np.arange(self.lattice.shell_count))
        return np.concatenate(
            [shells, *(np.tile(np.sqrt(part.node_lengths - 1), len(part.starts)) for part in self.parts)]
        )

    @cached_property
    def weights(self) -> Reals:
        """Factor of each entry (radii,): the step at which octaves take over from the lattice, else one."""
        weights = np.ones(len(self))
        if self.sampling is not None:
            shells = slice(0, self.lattice.shell_count)
            weights[shells] = smooth_step(self.radii[shells], self.sampling.cutoff)
        return weights

    def labels(self) -> dict[str, Indices]:
        """Return the octave of each entry, 0 for the lattice; the number of its lattice in it, -1 for drawn samples."""
        octaves, lattices = np.zeros(len(self), dtype=np.int64), np.zeros(len(self), dtype=np.int64)
        for part in self.parts:
            octaves[part.place] = part.sampling.octave.index
            lattices[part.place] = -1 if part.part.is_drawn else part.number
        return {"octave": octaves, "lattice": lattices}

    def spectra(self, shell_sums: Reals, octaves: Reals, *, is_square: bool = True) -> Spectra:
        """Return the spectra of fields from sums over the shells of the lattice (fields, shells).

        At all samples of octaves they have |field|² (fields, samples), or a product of two fields, which needs no
        errors, and has no moments and peaks.
        """
        sums, moments, peaks = [shell_sums], [np.zeros((len(shell_sums), 0))], [np.zeros((len(shell_sums), 0))]
        for part in self.parts:
            terms = part.sampling.weights[part.part.samples] * octaves[:, part.samples]
            sums.append(part.moved(terms))
            if is_square:
                if part.part.is_drawn:
                    moments.append(part.moved(terms**2))
                sizes = np.abs(terms)
                peaks.append(np.stack([(sizes * weights).max(axis=1) for weights in part.peak_weights], axis=1))
        return Spectra(*(np.concatenate(parts, axis=1) for parts in (sums, moments, peaks)))

    def octave_integrals(self, spectra: Spectra, orders: Sequence[float]) -> Reals:
        """Return ∫ window (1+|ξ|²)^s |field|² over all octaves (orders, fields)."""
        beyond = slice(self.lattice.shell_count, len(self))
        weights = np.stack([(1 + self.radii[beyond] ** 2) ** order for order in orders])
        return np.asarray(weights @ spectra.sums[:, beyond].T)

    def energies(self, spectra: Spectra) -> Reals:
        """Return the mean of ∫_{|ξ|=r} |field|² dS over each octave (fields, octaves)."""
        octaves = () if self.sampling is None else self.sampling.octaves
        energies = np.zeros((len(spectra.sums), len(octaves)))
        for part in self.parts:
            octave = part.sampling.octave
            energies[:, octave.index - 1] += spectra.sums[:, part.place].sum(axis=1) / octave.integral(0.0)
        return energies

    def statistical_errors(self, spectra: Spectra, orders: Sequence[float]) -> Reals:
        """Return how far off the integrals over all octaves may be (orders, fields), at 99 %.

        A lattice's eight groups of samples vary as independent ones do, and so do single drawn samples. A sample may
        stand for others like it that were not met.
        """
        variances: dict[tuple[int, bool], Reals] = {}
        degrees: dict[tuple[int, bool], int] = {}
        drawn = 0
        for number, part in enumerate(self.parts):
            weights = np.stack([part.node_lengths**order for order in orders])
            grouped = spectra.sums[:, part.place].reshape(len(spectra.sums), -1, _NODES)
            groups = np.einsum("oj,fgj->gof", weights, grouped)
            if part.part.is_drawn:
                moments = spectra.moments[:, drawn : drawn + _NODES]
                drawn += _NODES
                spread = (weights**2 @ moments.T) - groups[0] ** 2 / part.count
                variance, degree = np.maximum(spread, 0.0) * part.count / max(part.count - 1, 1), part.count - 1
            else:
                variance, degree = len(groups) * groups.var(axis=0, ddof=1), len(groups) - 1
            count = len(_PEAK_ORDERS)
            peaks = part.peaks_at(spectra.peaks[:, number * count : (number + 1) * count], orders)
            # Draws are counted apart: few groups of lattices stay few beside many draws.
            key = part.sampling.octave.index, part.part.is_drawn
            variances[key] = variances.get(key, np.zeros(1)) + variance + peaks**2
            degrees[key] = degrees.get(key, 0) + degree
        return quantile_of_sum(np.stack(list(variances.values())), np.array(list(degrees.values())))
