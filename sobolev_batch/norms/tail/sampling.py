"""Frequencies at which octaves of |ξ| are sampled: random lattices, and draws around the normals of flat faces.

An innermost ball and the octaves around it are a smooth partition of frequency space. All samples of an octave are
pooled by the balance heuristic (E. Veach, L. J. Guibas 1995, doi:10.1145/218380.218498): a sample counts for the
inverse of the density with which all lattices and draws together put samples there. The sum of weight · f then has
the integral of f as its expectation, and no sample weighs more than under the best method for its frequency.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.norms.tail.face_normals import FaceNormals
from sobolev_batch.transform.lattice import STEP_START, OctaveLattice, smooth_step

# Samples along an axis of the lattice of each octave, and draws beside it where surfaces have flat faces.
USUAL_M, _USUAL_DRAWS, _USUAL_UNIFORM = 64, 20_000, 0.1
_SUBLATTICES = 8
_ONE_GROUP: Indices = np.zeros(1, dtype=np.int64)


@dataclass(frozen=True)
class Octave:
    """A smooth shell of frequencies around an innermost ball, whose `smooth_step` ends at a cutoff; counted from 1."""

    cutoff: float
    index: int

    @property
    def lowest(self) -> float:
        """Least |ξ| of the octave, in cycles per unit length."""
        return STEP_START * self.highest / 2

    @property
    def highest(self) -> float:
        """Largest |ξ| of the octave."""
        return self.cutoff * 2.0**self.index

    def window(self, radii: Reals) -> Reals:
        """Return the weight of this octave at some |ξ|; the ball and all octaves add up to one."""
        return smooth_step(radii, self.highest) - smooth_step(radii, self.highest / 2)

    def integral(self, order: float) -> float:
        """Return ∫ window(r) (1+r²)^s dr over the octave."""
        from scipy.integrate import quad

        def integrand(radius: float) -> float:
            return float(self.window(np.array(radius)) * (1 + radius**2) ** order)

        middle = self.highest / 2
        return float(quad(integrand, self.lowest, middle)[0] + quad(integrand, middle, self.highest)[0])


@dataclass(frozen=True, eq=False)
class SampleSet:
    """Neighbouring samples of an octave: those of one lattice, or the drawn ones.

    Attributes:
        samples: Place of the samples in the octave.
        starts: First sample of each of the eight sublattices, counted from the set's first, int64 (8,). Sums over
            sublattices are nearly independent. Drawn samples, which are all independent, are one group.
        places: Indices of the samples in the lattice's block, flattened, int64 (n,); empty for drawn ones.
    """

    samples: slice
    starts: Indices
    places: Indices
    is_drawn: bool = False


@dataclass(frozen=True, eq=False)
class OctaveSampling:
    """All frequencies at which an octave is sampled, with their weights.

    One drawn frequency lies in each of equally likely ranges of |ξ|. Their lengths follow |ξ|^-2. Their directions are
    uniform for a fraction, and follow the normals of flat faces for the others.

    Attributes:
        lattices: Random lattices, which may be none.
        draws: Number of drawn frequencies, which may be zero.
        uniform_fraction: Fraction of uniform directions, which counts if there are normals.
    """

    octave: Octave
    lattices: tuple[OctaveLattice, ...]
    draws: int
    seed: int
    normals: FaceNormals
    uniform_fraction: float = 1.0

    def redrawn(self, octave: Octave, sizes: Sequence[int], draws: int, rng: np.random.Generator) -> Self:
        """Draw lattices with some numbers M of samples along an axis, and a seed, for an octave; directions stay."""
        lattices = tuple(OctaveLattice.random(octave.lowest, octave.highest, M, rng) for M in sizes)
        return replace(self, octave=octave, lattices=lattices, draws=draws, seed=int(rng.integers(2**53)))

    def __len__(self) -> int:
        return len(self.weights)

    def __getstate__(self) -> dict[str, Any]:
        # Tasks make the samples anew: it is cheaper than sending them.
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def sample_sets(self) -> tuple[SampleSet, ...]:
        """The samples of each lattice, and the drawn ones last."""
        sets, first = [], 0
        for places, starts in map(_places_and_starts, self.lattices):
            sets.append(SampleSet(slice(first, first + len(places)), starts, places))
            first += len(places)
        return (*sets, SampleSet(slice(first, first + self.draws), _ONE_GROUP, _ONE_GROUP[:0], is_drawn=True))

    @cached_property
    def frequencies(self) -> Reals:
        """ξ along the axes of the surfaces, float64 (n, 3), in cycles per unit length; drawn ones come last."""
        on_lattices = zip(self.lattices, self.sample_sets, strict=False)
        return np.concatenate([*(one.points(one.half)[its.places] for one, its in on_lattices), self._drawn()])

    @cached_property
    def radii(self) -> Reals:
        """|ξ| of each sample (n,)."""
        # NumPy's own norm of short rows takes three times as long.
        return np.asarray(np.sqrt(sum(np.square(self.frequencies[:, axis]) for axis in range(3))))

    @cached_property
    def weights(self) -> Reals:
        """Weight of each sample in the integral over all of frequency space (n,), the octave's window included."""
        weights = self.octave.window(self.radii)
        for lattice, sample_set in zip(self.lattices, self.sample_sets, strict=False):
            weights[sample_set.samples] *= lattice.half_weights()[sample_set.places % lattice.half.shape[2]]
        density = sum(lattice.spacing**-3 for lattice in self.lattices) + self._density(self.frequencies, self.radii)
        return np.asarray(weights / density)

    def _drawn(self) -> Reals:
        """Draw frequencies, float64 (draws, 3)."""
        rng = np.random.default_rng(self.seed)
        low, high = self.octave.lowest, self.octave.highest
        levels = (rng.permutation(self.draws) + rng.random(self.draws)) / max(self.draws, 1)
        radii = 1 / (1 / low - levels * (1 / low - 1 / high))
        directions = rng.normal(size=(self.draws, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        if self.normals:
            along = rng.random(self.draws) >= self.uniform_fraction
            directions[along] = self.normals.draw(radii[along], rng)
        return np.asarray(radii[:, None] * directions)

    def _density(self, frequencies: Reals, radii: Reals) -> Reals:
        """Return the expected number of draws per volume (n,) at frequencies (n, 3) of the octave, and their |ξ|."""
        if not self.draws:
            return np.zeros(len(frequencies))
        radial = 1 / (radii**2 * (1 / self.octave.lowest - 1 / self.octave.highest))
        uniform = self.uniform_fraction if self.normals else 1.0
        directional = np.full(len(radii), uniform / (4 * np.pi))
        if self.normals:
            directional += (1 - uniform) * self.normals.density(frequencies / radii[:, None], radii)
        return np.asarray(self.draws * radial * directional / radii**2)

    @property
    def drawn_by(self) -> dict[str, Any]:
        """All that the drawn frequencies follow from, besides the octave and the normals."""
        return {"draws": self.draws, "seed": self.seed, "uniform_fraction": self.uniform_fraction}


def _places_and_starts(lattice: OctaveLattice) -> tuple[Indices, Indices]:
    """Return the places of the samples in a lattice's range, by sublattice, and the first sample of each of these."""
    x, y, z = lattice.frequencies(lattice.half)
    squares = (x**2)[:, None, None] + (y**2)[:, None] + z**2
    indices = np.nonzero((squares > lattice.lowest**2) & (squares < lattice.highest**2))
    i, j, k = indices
    sublattices = (4 * (i % 2) + 2 * (j % 2) + k % 2).astype(np.int8)
    order = np.argsort(sublattices, kind="stable")
    starts = np.searchsorted(sublattices[order], np.arange(_SUBLATTICES)).astype(np.int64)
    return np.ravel_multi_index(indices, lattice.half.shape)[order].astype(np.int64), starts


@dataclass(frozen=True, eq=False)
class TailSampling:
    """The octaves beyond a cutoff as all surfaces of a study sample them, from the inside out.

    Attributes:
        cutoff: Radius |ξ| at which the step of the innermost frequencies ends, in cycles per unit length.
        octaves: Samplings of the octaves, whose samples follow each other on one axis.
    """

    cutoff: float
    octaves: tuple[OctaveSampling, ...]

    @classmethod
    def usual(cls, cutoff: float, count: int, surfaces: Sequence[Surface], seed: int = 0) -> Self:
        """Return a sampling of some octaves by one lattice each, and by draws where surfaces have flat faces."""
        rng, normals = np.random.default_rng(seed), FaceNormals.from_surfaces(surfaces)
        octaves, draws = (Octave(cutoff, index) for index in range(1, count + 1)), _USUAL_DRAWS if normals else 0
        usual = OctaveSampling(Octave(cutoff, 1), (), draws, seed, normals, _USUAL_UNIFORM)
        return cls(cutoff, tuple(usual.redrawn(one, [USUAL_M], draws, rng) for one in octaves))

    @classmethod
    def joined(cls, cutoff: float, several: Sequence[Sequence[OctaveSampling]], normals: FaceNormals) -> Self:
        """Return a sampling that serves all of several: of each octave the largest lattices, and the most draws."""
        octaves = []
        for index in range(max((len(samplings) for samplings in several), default=0)):
            candidates = [samplings[index] for samplings in several if len(samplings) > index]
            lattices = max((one.lattices for one in candidates), key=lambda found: sum(one.M**3 for one in found))
            most = max(candidates, key=lambda one: one.draws)
            octaves.append(OctaveSampling(most.octave, lattices, most.draws, most.seed, normals, most.uniform_fraction))
        return cls(cutoff, tuple(octaves))

    def refined(self, factor: float, more_octaves: int, largest: int, seed: int) -> Self:
        """Return a sampling with about ``factor`` times the samples, and further octaves; no M is above ``largest``."""
        rng, samplings = np.random.default_rng(seed), []
        for one in self.octaves:
            sizes = [min(2 * round(it.M * factor ** (1 / 3) / 2), max(largest, it.M)) for it in one.lattices]
            samplings.append(one.redrawn(one.octave, sizes, round(factor * one.draws), rng))
        last = samplings[-1]
        for index in range(last.octave.index + 1, last.octave.index + 1 + more_octaves):
            sizes = [lattice.M for lattice in last.lattices]
            samplings.append(last.redrawn(Octave(self.cutoff, index), sizes, last.draws, rng))
        return replace(self, octaves=tuple(samplings))

    def to_dict(self) -> dict[str, Any]:
        """Return the sampling as a dictionary for JSON, from which `from_dict` makes it again."""
        octaves = []
        for one in self.octaves:
            lattices = [{"M": it.M, "quaternion": [*it.quaternion], "offset": [*it.offset]} for it in one.lattices]
            octaves.append({"lattices": lattices, **one.drawn_by})
        normals = {name: values.tolist() for name, values in vars(self.octaves[0].normals).items()}
        return {"cutoff": self.cutoff, "normals": normals, "octaves": octaves}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Return the sampling that a dictionary holds."""
        arrays = {name: np.array(normals, dtype=np.float64) for name, normals in values["normals"].items()}
        normals = FaceNormals(arrays["directions"].reshape(-1, 3), arrays["shares"], arrays["sizes"])
        samplings = []
        for index, one in enumerate(values["octaves"], 1):
            octave = Octave(values["cutoff"], index)
            found = ((it["M"], tuple(it["quaternion"]), tuple(it["offset"])) for it in one["lattices"])
            lattices = tuple(OctaveLattice(octave.lowest, octave.highest, *it) for it in found)
            samplings.append(OctaveSampling(octave, normals=normals, **{**one, "lattices": lattices}))
        return cls(values["cutoff"], tuple(samplings))

    @property
    def digest(self) -> str:
        """SHA-256 of all that the samples follow from."""
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()

    @property
    def size(self) -> int:
        """Number of samples."""
        return sum(map(len, self.octaves))

    @property
    def highest_frequency(self) -> float:
        """Largest |ξ| of the last octave, in cycles per unit length."""
        return self.octaves[-1].octave.highest

    @property
    def frequencies(self) -> Reals:
        """ξ of all samples, float64 (n, 3), in cycles per unit length."""
        return np.concatenate([octave.frequencies for octave in self.octaves])

    def split(self, values: NDArray[Any]) -> Iterator[NDArray[Any]]:
        """Yield the values of each octave, from those at all samples (n,)."""
        yield from np.split(values, np.cumsum([len(octave) for octave in self.octaves])[:-1])

    def labels(self) -> dict[str, Indices]:
        """Return the octave of each sample, the number of its lattice in it and of its sublattice; -1 if drawn."""
        columns = []
        for octave in self.octaves:
            for number, sample_set in enumerate(octave.sample_sets):
                count = sample_set.samples.stop - sample_set.samples.start
                labels = np.full((3, count), -1, dtype=np.int64)
                labels[0] = octave.octave.index
                if not sample_set.is_drawn:
                    labels[1] = number
                    labels[2] = np.repeat(np.arange(_SUBLATTICES), np.diff([*sample_set.starts, count]))
                columns.append(labels)
        return dict(zip(("octave", "lattice", "sublattice"), np.concatenate(columns, axis=1), strict=True))
