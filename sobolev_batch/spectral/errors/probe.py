"""How far a computed field is from the exact transform, measured at a few random frequencies.

The mean of weight · |computed - exact|² / p over frequencies drawn with probability p estimates the
squared norm of a field's error without bias (importance sampling). The exact side is the closed
form of the triangles, which shares neither the quadrature nor the NUFFT with the computed one, so
every field is checked end to end. Of a parametrised surface it is a sum over twice the nodes, without
the NUFFT.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.shells import shell_weights

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Draws of a small mesh, of a huge one, and pairs of a triangle and a frequency in between.
_MOST_DRAWS, _FEWEST_DRAWS, _PAIRS = 32, 8, 400_000
# The estimate comes from few draws: it is raised by this over the root of their number.
_CAUTION = 3.0
# Ranges of |ξ| that an error of the same size everywhere is told by.
_BANDS = 8


@dataclass(frozen=True)
class Draws:
    """Random frequencies of the half lattice.

    Attributes:
        indices: (P, 3) int64, k.
        frequencies: (P, 3) float64, ξ = h k, in cycles per unit length.
        scales: (P,) float64, trapezoidal weight / (P p): what a squared error counts for.
    """

    indices: NDArray[np.int64]
    frequencies: Reals
    scales: Reals

    def within(self, block: Block) -> Draws:
        """Those that lie in a block."""
        offsets = self.indices - block.start
        inside = np.all((offsets >= 0) & (offsets < block.shape), axis=1)
        return Draws(self.indices[inside], self.frequencies[inside], self.scales[inside])

    def places(self, block: Block) -> tuple[NDArray[np.int64], ...]:
        """Where the draws lie in an array of a block that holds them all."""
        return tuple((self.indices - block.start).T)


@dataclass(frozen=True)
class Probe:
    """An estimate of the sums of |computed - exact|² over the shells |k|² of the half lattice.

    Attributes:
        shells: |k|² of each draw.
        sums: what each draw adds to the sum of its shell.
    """

    shells: tuple[int, ...] = ()
    sums: tuple[float, ...] = ()

    def norms(self, lattice: Lattice, orders: Sequence[float]) -> Reals:
        """The norm of the field's error for each order (orders,), raised for the small sample.

        Zero for a closed form, which has no draws.
        """
        if not self.shells:
            return np.zeros(len(orders))
        squares = shell_weights(lattice, orders)[:, list(self.shells)] @ np.array(self.sums)
        return np.asarray(np.sqrt(squares) * (1 + _CAUTION / np.sqrt(len(self.shells))))


def draw_count(triangles: int) -> int:
    """How many frequencies a mesh of so many triangles is probed at: fewer where each costs more."""
    return int(np.clip(_PAIRS // triangles, _FEWEST_DRAWS, _MOST_DRAWS))


def draw(lattice: Lattice, orders: Sequence[float], degree: int, count: int, seed: int) -> Draws:
    """Random frequencies where the error of a rule of some degree weighs most.

    Half of them follow weight · |ξ|^(2(degree+1)), as the error of the triangle rule does, and half
    the weight alone, as that of the NUFFT; the weights of all orders are mixed evenly.

    Args:
        lattice: where to draw.
        orders: s, each.
        degree: of the lowest rule in use.
        count: P.
        seed: of the generator; the same seed gives the same draws.
    """
    rng = np.random.default_rng(seed)
    masses = _shell_masses(lattice)
    chances = _shell_chances(lattice, tuple(orders), degree)
    # One draw in each of P equal parts of the distribution: fewer gaps than independent draws leave.
    levels = (np.arange(count) + rng.random(count)) / count
    shells = np.searchsorted(np.cumsum(chances * masses), levels * (1 - 1e-12))
    indices = np.stack([_point_of(lattice, int(shell), rng) for shell in shells])
    return Draws(indices, lattice.spacing * indices.astype(np.float64), 1 / (count * chances[shells]))


def measure(draws: Draws, computed: NDArray[np.complexfloating[Any, Any]], exact: Complexes) -> Probe:
    """The probe that a field's values at the drawn frequencies (P,) and the exact ones make."""
    sums = draws.scales * np.abs(computed - exact) ** 2
    shells = np.sum(draws.indices**2, axis=1)
    return Probe(tuple(shells.tolist()), tuple(sums.tolist()))


def even_probe(lattice: Lattice, error: float) -> Probe:
    """The probe of a field that errs by as much at every frequency, a little raised towards the lower ones."""
    masses = _shell_masses(lattice)
    edges = np.unique((np.linspace(0, 1, _BANDS + 1)[:-1] ** 2 * len(masses)).astype(np.int64))
    return Probe(tuple(edges.tolist()), tuple((error**2 * np.add.reduceat(masses, edges)).tolist()))


def join(probes: Sequence[Probe]) -> Probe:
    """One probe from those of disjoint sets of the same draws."""
    return Probe(
        tuple(shell for probe in probes for shell in probe.shells),
        tuple(sum_ for probe in probes for sum_ in probe.sums),
    )


@lru_cache(maxsize=16)
def _shell_masses(lattice: Lattice) -> Reals:
    """The sum of the trapezoidal weights of each shell (shell_count,)."""
    x, y, z = lattice.axis_weights(lattice.half)
    squares = lattice.half.indices(0) ** 2
    plane = np.bincount((squares[:, None] + squares).ravel(), weights=np.outer(x, y).ravel())
    masses = np.zeros(lattice.shell_count)
    for k, weight in enumerate(z):
        masses[k * k : k * k + len(plane)] += weight * plane
    return masses


@lru_cache(maxsize=64)
def _shell_chances(lattice: Lattice, orders: tuple[float, ...], degree: int) -> Reals:
    """The probability of a point over its trapezoidal weight, for each shell (shell_count,)."""
    masses = _shell_masses(lattice)
    # Relative to the highest frequency, so that high powers neither over- nor underflow.
    growth = (np.arange(lattice.shell_count) / lattice.shell_count) ** (degree + 1)
    weights = shell_weights(lattice, orders)
    chances = np.zeros(lattice.shell_count)
    for weight in weights:
        for part in (weight, weight * growth):
            chances += part / (masses @ part)
    return chances / (2 * len(orders))


def _point_of(lattice: Lattice, shell: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """A random point of a shell, with a probability in proportion to its trapezoidal weight."""
    indices = lattice.half.indices(0)
    rest = shell - (indices[:, None] ** 2 + indices**2)
    k = np.sqrt(np.maximum(rest, 0)).round().astype(np.int64)
    i, j = np.nonzero((rest >= 0) & (k * k == rest) & (k <= lattice.M // 2))
    x, y, z = lattice.axis_weights(lattice.half)
    weights = x[i] * y[j] * z[k[i, j]]
    chosen = rng.choice(len(i), p=weights / weights.sum())
    return np.array([indices[i[chosen]], indices[j[chosen]], k[i[chosen], j[chosen]]])
