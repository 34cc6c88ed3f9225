"""Radial spectra: a field as sums over frequencies of equal length, from which its norm of every order follows.

Within a lattice these are the sums over its shells |k|². An octave has a sample at almost every |ξ|. Its sums are moved
to a few radii, such that the sum of each weight (1 + |ξ|²)^s stays what it is: in log(1 + |ξ|²) the weights are
exponentials, which a polynomial of a low degree interpolates to all digits (J.-P. Berrut, L. N. Trefethen 2004,
doi:10.1137/S0036144502417715).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Self

import numpy as np

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.norms.images import IMAGE_ORDERS, by_chords, images_at
from sobolev_batch.norms.tail.integrals import Scatter, deviations_by_images, error_of_sum, pooled
from sobolev_batch.norms.tail.sampling import OctaveSampling, SampleSet, TailSampling
from sobolev_batch.transform.lattice import Lattice, smooth_step

# Radii for a group of samples of an octave: the weights of orders down to -12 are exact to 1e-13 of the largest one.
_NODES = 40
# Chebyshev points and their barycentric weights.
_ANGLES = np.pi * (np.arange(_NODES) + 0.5) / _NODES
_POINTS, _POINT_WEIGHTS = -np.cos(_ANGLES), np.where(np.arange(_NODES) % 2, -1.0, 1.0) * np.sin(_ANGLES)
# Orders at which peaks are known. Between them the largest sample's logarithm is convex in the order, below the chord.
_PEAK_ORDERS = np.array([-0.5, -1, -1.5, -2, -2.5, -3, -3.5, -4, -5, -6, -8, -10, -14, -20, -100])


@dataclass(frozen=True, eq=False)
class Spectra:
    """Radial spectra of several fields, over the axis of a `RadialAxis`.

    Attributes:
        sums: Integrals of |field|² over the frequencies of each radius, float64 (fields, radii).
        moments: Sums of drawn samples' squared terms, moved likewise, for squared weights, float64 (fields, moments).
        peaks: Deviation of each part of an octave that the scatter of its groups does not show, at some orders, float64
            (fields, peaks): the largest term, and images that all groups have.
        images: What images at the period add, float64 (fields, `IMAGE_ORDERS`); no columns where there are octaves.
    """

    sums: Reals
    moments: Reals
    peaks: Reals
    images: Reals

    def named(self, name: str) -> dict[str, Reals]:
        """Return the arrays by the names that `RadialAxis.arrays` describes; those without entries are left out."""
        parts = {"moments": self.moments, "peaks": self.peaks, "images": self.images}
        return {name: self.sums} | {f"{name}_{part}": values for part, values in parts.items() if values.shape[1]}

    def images_at(self, orders: Sequence[float]) -> Reals:
        """Return what images add to the squared norms (orders, fields); NaN where that is not measured."""
        return images_at(self.images, orders) if self.images.shape[1] else np.full((len(orders), 1), np.nan)


@dataclass(frozen=True, eq=False)
class ComparedSpectra:
    """Radial spectra of some fields: of their norms, their distances from a reference b, and products <a - b, b>.

    Attributes:
        arrays: Arrays by the names that `RadialAxis.arrays` describes, each (fields, ...).
    """

    arrays: Mapping[str, Reals]

    @classmethod
    def joined(cls, several: Sequence[Self]) -> Self:
        """Return several of these as one, field by field."""
        return cls({name: np.concatenate([one.arrays[name] for one in several]) for name in several[0].arrays})

    def __getitem__(self, chosen: Any) -> Self:
        """Return the spectra of some fields."""
        return replace(self, arrays={name: values[chosen] for name, values in self.arrays.items()})

    @property
    def norm(self) -> Spectra:
        """Spectra of the norms."""
        return self._spectra("norm")

    @property
    def distance(self) -> Spectra:
        """Spectra of the distances from the reference."""
        return self._spectra("distance")

    def product(self, reference: Spectra) -> Spectra:
        """Return the spectra of the products, whose moments and peaks are bounded by Schwarz's inequality."""
        bounds = ([np.maximum(one.moments, 0.0), np.maximum(one.peaks, 0.0)] for one in (self.distance, reference))
        moments, peaks = (np.sqrt(own * other) for own, other in zip(*bounds, strict=True))
        return replace(self._spectra("product"), moments=moments, peaks=peaks)

    def _spectra(self, name: str) -> Spectra:
        sums = self.arrays[name]
        none = np.zeros((len(sums), 0))
        return Spectra(sums, *(self.arrays.get(f"{name}_{part}", none) for part in ("moments", "peaks", "images")))


@dataclass(frozen=True, eq=False)
class _Segment:
    """The radii for a set of an octave's samples: one lattice in eight groups, or all drawn samples.

    `number` counts the sets of an octave. `samples` is the place of the set among all samples, `first` that of its
    radii on the axis.
    """

    sampling: OctaveSampling
    sample_set: SampleSet
    number: int
    samples: slice
    first: int

    @property
    def count(self) -> int:
        return int(self.samples.stop - self.samples.start)

    @property
    def place(self) -> slice:
        return slice(self.first, self.first + len(self.sample_set.starts) * _NODES)

    @cached_property
    def node_lengths(self) -> Reals:
        """1 + r² of the radii r of one group (_NODES,): Chebyshev points in the logarithm."""
        low, high = np.log1p(np.array([self.sampling.octave.lowest, self.sampling.octave.highest]) ** 2)
        return np.asarray(np.exp((low + high) / 2 + (high - low) / 2 * _POINTS))

    @cached_property
    def lengths(self) -> Reals:
        """1 + |ξ|² of each sample."""
        return np.asarray(1 + self.sampling.radii[self.sample_set.samples] ** 2)

    def moved(self, terms: Reals) -> Reals:
        """Move terms (fields, n) to the radii of each group, (fields, groups · _NODES)."""
        groups = (slice(*ends) for ends in pairwise([*self.sample_set.starts, self.count]))
        return np.concatenate([terms[:, group] @ self._interpolation(group) for group in groups], axis=1)

    def _interpolation(self, samples: slice) -> Reals:
        """Return the matrix (n, _NODES) that interpolates from the nodes to samples, in the logarithm of 1 + |ξ|²."""
        first, last = np.log(self.node_lengths[[0, -1]])
        places = np.log(self.lengths[samples])
        positions = _POINTS[0] + (places - first) * (_POINTS[-1] - _POINTS[0]) / (last - first)
        differences = positions[:, None] - _POINTS
        # A sample on a node takes that node's value: any tiny difference says so.
        differences[differences == 0] = np.finfo(np.float64).tiny
        matrix = _POINT_WEIGHTS / differences
        return np.asarray(matrix / matrix.sum(axis=1, keepdims=True))

    @cached_property
    def peak_weights(self) -> Reals:
        """((1 + |ξ|²) / least)^s of each sample for the orders at which peaks are known (orders, n)."""
        return np.stack([(self.lengths / self.least_length) ** order for order in _PEAK_ORDERS])

    @property
    def least_length(self) -> float:
        """1 + r² of the least |ξ| of the octave."""
        return float(1 + self.sampling.octave.lowest**2)

    def scatter(self, sums: Reals, moments: Reals, peaks: Reals, orders: Sequence[float]) -> Scatter:
        """Return how sums over these samples vary (orders, fields), from the segment's columns of `Spectra`.

        A lattice's eight groups of samples vary as independent ones do, and so do single drawn samples.
        """
        weights, count = np.stack([self.node_lengths**order for order in orders]), self.count
        groups = np.einsum("oj,fgj->gof", weights, sums.reshape(len(sums), -1, _NODES))
        largest = by_chords(peaks, _PEAK_ORDERS, orders) * self.least_length ** np.array(orders)[:, None]
        if not self.sample_set.is_drawn:
            return Scatter(False, len(groups) * groups.var(axis=0, ddof=1), largest, len(groups) - 1)
        spread = np.maximum((weights**2 @ moments.T) - groups[0] ** 2 / count, 0.0)
        return Scatter(True, spread * count / max(count - 1, 1), largest, count - 1)


@dataclass(frozen=True, eq=False)
class RadialAxis:
    """The radii over which spectra of fields on a lattice, and in the octaves beyond it, are given.

    The shells |k|² = 0, 1, ... of the lattice come first, then the radii of each group of samples of each octave.
    """

    lattice: Lattice
    sampling: TailSampling | None = None

    def __getstate__(self) -> dict[str, Any]:
        # Tasks make the rest anew: it is cheaper than sending it.
        return {"lattice": self.lattice, "sampling": self.sampling}

    @cached_property
    def segments(self) -> tuple[_Segment, ...]:
        """Segments of the axis beyond the lattice: one for each set of samples of each octave, in their order."""
        segments: list[_Segment] = []
        start, first = 0, self.lattice.shell_count
        for sampling in () if self.sampling is None else self.sampling.octaves:
            for number, sample_set in enumerate(sampling.sample_sets):
                samples = slice(start + sample_set.samples.start, start + sample_set.samples.stop)
                if samples.stop > samples.start:
                    segments.append(_Segment(sampling, sample_set, number, samples, first))
                    first = segments[-1].place.stop
            start += len(sampling)
        return tuple(segments)

    def __len__(self) -> int:
        return self.segments[-1].place.stop if self.segments else self.lattice.shell_count

    def arrays(self) -> dict[str, tuple[int, str, str]]:
        """Return for each array of `ComparedSpectra` its length, and what it goes over and means."""
        moments = _NODES * sum(segment.sample_set.is_drawn for segment in self.segments)
        peaks, images = len(_PEAK_ORDERS) * len(self.segments), len(IMAGE_ORDERS) * (self.sampling is None)
        arrays = {"product": (len(self), "shell", "radial spectrum of the product <a - b, b> with the reference b")}
        for name, meaning in (("norm", "norm"), ("distance", "distance to the reference")):
            arrays |= {
                name: (len(self), "shell", f"radial spectrum of the {meaning}"),
                f"{name}_moments": (moments, "moment", "squared terms of drawn samples, by radius"),
                f"{name}_peaks": (peaks, "peak", "largest term of each part of an octave, and images, at some orders"),
                f"{name}_images": (images, "image_order", "what images at the period add, at some orders"),
            }
        return {name: array for name, array in arrays.items() if array[0]}

    @cached_property
    def radii(self) -> Reals:
        """|ξ| of each entry, in cycles per unit length (radii,)."""
        shells = self.lattice.spacing * np.sqrt(np.arange(self.lattice.shell_count))
        groups = (np.tile(np.sqrt(one.node_lengths - 1), len(one.sample_set.starts)) for one in self.segments)
        return np.concatenate([shells, *groups])

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
        for segment in self.segments:
            octaves[segment.place] = segment.sampling.octave.index
            lattices[segment.place] = -1 if segment.sample_set.is_drawn else segment.number
        return {"octave": octaves, "lattice": lattices}

    def spectra(
        self, shell_sums: Reals, octaves: Reals, images: Reals | None = None, *, is_square: bool = True
    ) -> Spectra:
        """Return the spectra of fields from sums over the shells of the lattice (fields, shells).

        At all samples of octaves they have |field|² (fields, samples), or a product of two fields, which needs no
        errors, and has no moments, peaks and images.
        """
        none = np.zeros((len(shell_sums), 0))
        sums, moments, peaks = [shell_sums], [none], [none]
        for segment in self.segments:
            terms = segment.sampling.weights[segment.sample_set.samples] * octaves[:, segment.samples]
            sums.append(segment.moved(terms))
            if is_square:
                if segment.sample_set.is_drawn:
                    moments.append(segment.moved(terms**2))
                sizes = np.abs(terms)
                largest = np.stack([(sizes * weights).max(axis=1) for weights in segment.peak_weights])
                if not segment.sample_set.is_drawn:
                    sampling, number = segment.sampling, segment.number
                    alike = deviations_by_images(sampling, number, terms, _PEAK_ORDERS, segment.least_length)
                    largest = np.hypot(largest, alike)
                peaks.append(largest.T)
        columns = sums, moments, peaks, [none if images is None else images]
        return Spectra(*(np.concatenate(arrays, axis=1) for arrays in columns))

    def energies(self, spectra: Spectra) -> Reals:
        """Return the mean of ∫_{|ξ|=r} |field|² dS over each octave (fields, octaves)."""
        octaves = () if self.sampling is None else self.sampling.octaves
        energies = np.zeros((len(spectra.sums), len(octaves)))
        for segment in self.segments:
            octave = segment.sampling.octave
            energies[:, octave.index - 1] += spectra.sums[:, segment.place].sum(axis=1) / octave.integral(0.0)
        return energies

    def octave_integrals(self, spectra: Spectra, orders: Sequence[float]) -> tuple[Reals, Reals]:
        """Return ∫ window (1+|ξ|²)^s |field|² over all octaves, and how far off it may be at 99 % (orders, fields)."""
        scatters: dict[int, list[Scatter]] = {}
        count, drawn = len(_PEAK_ORDERS), 0
        for number, segment in enumerate(self.segments):
            peaks, moments = spectra.peaks[:, number * count :][:, :count], spectra.moments[:, drawn:][:, :_NODES]
            drawn += _NODES * segment.sample_set.is_drawn
            found = segment.scatter(spectra.sums[:, segment.place], moments, peaks, orders)
            scatters.setdefault(segment.sampling.octave.index, []).append(found)
        beyond = slice(self.lattice.shell_count, len(self))
        weights = np.stack([(1 + self.radii[beyond] ** 2) ** order for order in orders])
        integrals = np.asarray(weights @ spectra.sums[:, beyond].T)
        return integrals, error_of_sum([pooled(octave) for octave in scatters.values()])
