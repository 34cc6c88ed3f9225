"""The octaves beyond a lattice as all surfaces of a study sample them: one axis of frequencies, and one of weights."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.lattice import OctaveLattice
from sobolev_batch.spectral.octaves.normals import FaceNormals
from sobolev_batch.spectral.octaves.partition import Octave
from sobolev_batch.spectral.octaves.quadrature import OctaveQuadrature
from sobolev_batch.spectral.octaves.sampling import DrawnFrequencies, OctaveSampling
from sobolev_batch.spectral.octaves.sums import OctaveSums, OctaveWeights
from sobolev_batch.spectral.octaves.values import SampledOctave
from sobolev_batch.surfaces.shapes.surface import Surface

Reals = NDArray[np.float64]

# Samples along an axis of the lattice of each octave, and draws beside it where surfaces have flat faces.
USUAL_M, _USUAL_DRAWS, _USUAL_UNIFORM = 64, 20_000, 0.1
_SUBLATTICES = 8


@dataclass(frozen=True, eq=False)
class TailSampling:
    """Samplings of the octaves beyond a cutoff, from the inside out.

    Attributes:
        cutoff: Radius |ξ| at which the step of the innermost frequencies ends, in cycles per unit length.
        octaves: Samplings of the octaves.
    """

    cutoff: float
    octaves: tuple[OctaveSampling, ...]

    @classmethod
    def usual(cls, cutoff: float, count: int, surfaces: Sequence[Surface], seed: int = 0) -> Self:
        """Return a sampling of some octaves by one lattice each, and by draws where surfaces have flat faces."""
        rng = np.random.default_rng(seed)
        normals = FaceNormals.from_surfaces(surfaces)
        samplings = []
        for octave in (Octave(cutoff, index) for index in range(1, count + 1)):
            lattice = OctaveLattice.random(octave.lowest, octave.highest, USUAL_M, rng)
            draws = _USUAL_DRAWS if normals else 0
            drawn = DrawnFrequencies(octave, draws, int(rng.integers(2**53)), normals, _USUAL_UNIFORM)
            samplings.append(OctaveSampling(octave, (lattice,), drawn))
        return cls(cutoff, tuple(samplings))

    @classmethod
    def joined(cls, cutoff: float, several: Sequence[Sequence[OctaveSampling]], normals: FaceNormals) -> Self:
        """Return a sampling that serves all of several: of each octave the largest lattices, and the most draws."""
        octaves = []
        for index in range(max((len(samplings) for samplings in several), default=0)):
            candidates = [samplings[index] for samplings in several if len(samplings) > index]
            lattices = max((one.lattices for one in candidates), key=lambda found: sum(one.M**3 for one in found))
            drawn = max((one.drawn for one in candidates), key=len)
            uniform = drawn.uniform_fraction
            octaves.append(
                OctaveSampling(
                    drawn.octave,
                    lattices,
                    DrawnFrequencies(drawn.octave, drawn.count, drawn.seed, normals, uniform),
                )
            )
        return cls(cutoff, tuple(octaves))

    def __getstate__(self) -> dict[str, Any]:
        # Tasks make the samples anew: it is cheaper than sending them.
        return {"cutoff": self.cutoff, "octaves": self.octaves}

    def to_table(self) -> dict[str, Any]:
        """Return the sampling as a table, from which `from_table` makes it again."""
        normals = self.octaves[0].drawn.normals
        return {
            "cutoff": self.cutoff,
            "normals": {name: getattr(normals, name).tolist() for name in ("directions", "shares", "sizes")},
            "octaves": [sampling.to_table() for sampling in self.octaves],
        }

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Self:
        """Return the sampling that a table holds."""
        arrays = {name: np.array(values, dtype=np.float64) for name, values in table["normals"].items()}
        normals = FaceNormals(arrays["directions"].reshape(-1, 3), arrays["shares"], arrays["sizes"])
        samplings = (
            OctaveSampling.from_table(Octave(table["cutoff"], index), normals, octave)
            for index, octave in enumerate(table["octaves"], 1)
        )
        return cls(table["cutoff"], tuple(samplings))

    @property
    def digest(self) -> str:
        """SHA-256 of all that the samples follow from."""
        return hashlib.sha256(json.dumps(self.to_table(), sort_keys=True).encode()).hexdigest()

    @cached_property
    def sampled(self) -> tuple[SampledOctave, ...]:
        """The octaves with their samples."""
        return tuple(SampledOctave.from_sampling(sampling) for sampling in self.octaves)

    @property
    def quadratures(self) -> tuple[OctaveQuadrature, ...]:
        """Samples of each octave."""
        return tuple(octave.quadrature for octave in self.sampled)

    @property
    def size(self) -> int:
        """Number of samples."""
        return sum(map(len, self.quadratures))

    @property
    def highest_frequency(self) -> float:
        """Largest |ξ| of the last octave, in cycles per unit length."""
        return self.octaves[-1].octave.highest

    @property
    def slices(self) -> Iterator[slice]:
        """Place of each octave among all samples."""
        first = 0
        for quadrature in self.quadratures:
            yield slice(first, first + len(quadrature))
            first += len(quadrature)

    @property
    def frequencies(self) -> Reals:
        """ξ of all samples, float64 (n, 3), in cycles per unit length."""
        return np.concatenate([quadrature.frequencies for quadrature in self.quadratures])

    @property
    def weights(self) -> Reals:
        """Weight of each sample in the integral over all of frequency space (n,)."""
        return np.concatenate([quadrature.weights for quadrature in self.quadratures])

    def labels(self) -> dict[str, NDArray[np.int64]]:
        """Return the octave of each sample, the number of its lattice in it and of its sublattice; -1 if drawn."""
        octaves, lattices, sublattices = [], [], []
        for number, quadrature in enumerate(self.quadratures, 1):
            octaves.append(np.full(len(quadrature), number))
            for lattice, part in enumerate(quadrature.parts):
                count = part.samples.stop - part.samples.start
                lattices.append(np.full(count, -1 if part.starts is None else lattice))
                counts = [count] if part.starts is None else np.diff([*part.starts, count])
                names = [-1] if part.starts is None else range(_SUBLATTICES)
                sublattices.append(np.repeat(names, counts))
        columns = {"octave": octaves, "lattice": lattices, "sublattice": sublattices}
        return {name: np.concatenate(values).astype(np.int64) for name, values in columns.items()}

    def weights_for(self, orders: Sequence[float]) -> TailWeights:
        """Return the weights of all samples for some orders."""
        octaves = tuple(OctaveWeights(quadrature, tuple(orders)) for quadrature in self.quadratures)
        return TailWeights(octaves, tuple(self.slices))

    def refined(self, factor: float, more_octaves: int, largest: int, seed: int) -> TailSampling:
        """Return a sampling with about ``factor`` times as many samples in each octave, and further octaves.

        No lattice gets an M above ``largest``.
        """
        rng = np.random.default_rng(seed)
        first = self.octaves[0].drawn
        samplings = [_refined(sampling, factor, largest, rng) for sampling in self.octaves]
        for index in range(len(samplings) + 1, len(samplings) + 1 + more_octaves):
            octave, last = Octave(self.cutoff, index), samplings[-1]
            lattices = tuple(OctaveLattice.random(octave.lowest, octave.highest, one.M, rng) for one in last.lattices)
            seed_of_draws = int(rng.integers(2**53))
            drawn = DrawnFrequencies(
                octave, last.drawn.count, seed_of_draws, first.normals, last.drawn.uniform_fraction
            )
            samplings.append(OctaveSampling(octave, lattices, drawn))
        return TailSampling(self.cutoff, tuple(samplings))


def _refined(sampling: OctaveSampling, factor: float, largest: int, rng: np.random.Generator) -> OctaveSampling:
    octave, drawn = sampling.octave, sampling.drawn
    sizes = [min(2 * round(one.M * factor ** (1 / 3) / 2), max(largest, one.M)) for one in sampling.lattices]
    lattices = tuple(OctaveLattice.random(octave.lowest, octave.highest, M, rng) for M in sizes)
    count = round(factor * drawn.count)
    more = DrawnFrequencies(octave, count, int(rng.integers(2**53)), drawn.normals, drawn.uniform_fraction)
    return OctaveSampling(octave, lattices, more)


@dataclass(frozen=True, eq=False)
class TailWeights:
    """Weights of the samples of all octaves for some orders.

    Attributes:
        octaves: Weights of each octave.
        slices: Place of each octave among all samples.
    """

    octaves: tuple[OctaveWeights, ...]
    slices: tuple[slice, ...]

    @property
    def partition(self) -> list[Octave]:
        """The octaves."""
        return [weights.quadrature.octave for weights in self.octaves]

    def sums(self, squares: Reals) -> list[OctaveSums]:
        """Return the integrals of |field|² over each octave, from its values at all samples (n,)."""
        return [weights.sums(squares[samples]) for weights, samples in zip(self.octaves, self.slices, strict=True)]

    def integrals(self, products: Reals) -> Reals:
        """Return the integrals of products over all octaves (orders,), from their values at all samples (n,)."""
        return np.asarray(
            np.sum(
                [
                    weights.integrals(products[samples])
                    for weights, samples in zip(self.octaves, self.slices, strict=True)
                ],
                axis=0,
            )
        )
