"""Distance of a computed field from the exact transform, measured at a few random frequencies.

The mean of weight · |computed - exact|² / p over frequencies drawn with probability p estimates the squared norm of a
field's error without bias (importance sampling). The exact values of a mesh are the closed form of its triangles, which
shares neither quadrature nor NUFFT with the field; those of a parametrised surface are a sum over more nodes.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from functools import lru_cache
from itertools import chain
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Complexes, Indices, Reals, slices
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.transform.fourier import ON_CPU, Execution, TransformSettings
from sobolev_batch.transform.kinds import kind_of
from sobolev_batch.transform.lattice import Block, Lattice, SobolevWeights, shell_volumes

# Draws of a small mesh, of a huge one, and pairs of a triangle (or point) and a frequency in between.
_MOST_DRAWS, _FEWEST_DRAWS, _PAIRS = 32, 8, 400_000
# Standard errors by which the mean of few draws is raised, as some may carry it. Of 720 errors of NUFFTs of
# smooth surfaces, five exceeded the mean by six of them, two by eight.
_CAUTION = 8.0
# Points of a quarter of the lattice's x and y that are looked at together for some shells.
_CANDIDATES = 1 << 20
# Drawn for -20 alone, errors of -2 were up to a thousand times too small, and the other way round.
_OTHER_ORDERS = (-2.0, -30.0)
# Ranges of |ξ| that represent an error of the same size at every frequency.
_BANDS = 8
_TINY = np.finfo(np.float64).tiny
# The fraction of draws that are made before a field is known, and how many follow its values for each of them; fewer
# where the exact values at the former are known already, and only the latter take time.
COMMON, _OWN, _OWN_BESIDE_SAMPLE = 2 / 3, 0.5, 1.0
# Values among which those are drawn: to look at more takes longer than the rest of the probe.
_LOOKED_AT = 1 << 18


@dataclass(frozen=True)
class Draws:
    """Random frequencies ξ = h k of the half lattice, float64 (P, 3), and the lattice indices k, int64 (P, 3).

    The scales (P,) are trapezoidal weight / (P p), the factor of a squared error. They follow from the orders, the
    degree and the count of all draws, of which these may be some.
    """

    indices: Indices
    frequencies: Reals
    scales: Reals
    orders: tuple[float, ...]
    degree: int
    count: int
    seed: int

    def inside(self, block: Block) -> NDArray[np.bool_]:
        """Return which draws fall into a block (P,)."""
        offsets = self.indices - block.start
        return np.asarray(np.all((offsets >= 0) & (offsets < block.shape), axis=1))


@dataclass(frozen=True)
class Probe:
    """Estimate of the sums of |computed - exact|² over the shells |k|² of the half lattice: the share of each draw."""

    shells: tuple[int, ...] = ()
    sums: tuple[float, ...] = ()

    def norms(self, weights: SobolevWeights) -> Reals:
        """Return norms of the field's error (orders,), raised for the small sample; zero without one."""
        return norms_of_draws(weights.per_shell[:, list(self.shells)] * np.array(self.sums))


def norms_of_draws(parts: Reals) -> Reals:
    """Return norms of an error (orders,) from the contributions of draws to their squares (orders, P), raised.

    The fewer draws carry the sum, the less it tells, and the more it is raised.
    """
    squares = parts.sum(axis=1)
    shares = parts / np.maximum(squares, _TINY)[:, None]
    return np.asarray(np.sqrt(squares * (1 + _CAUTION * np.sqrt(np.sum(shares**2, axis=1)))))


def norms_of_checks(radii: Reals, squares: Reals, orders: Sequence[float]) -> Reals:
    """Return norms of an error (orders,) from checks at some |ξ| (P,), not weighted by an order yet, raised."""
    return norms_of_draws(np.array([(1 + radii**2) ** order for order in orders]) * squares)


def draw(lattice: Lattice, orders: Sequence[float], degree: int, count: int, seed: int) -> Draws:
    """Draw P random frequencies of a lattice where the error of a rule of some degree weighs most, by a seed.

    Half of them follow weight · |ξ|^(2(degree+1)), as the error of the triangle rule does, and half follow the weight
    alone, as the error of the NUFFT does. The weights of all orders are mixed evenly.
    """
    rng = np.random.default_rng(seed)
    chances = _shell_chances(lattice, orders, degree, shell_volumes(lattice))
    # One draw in each of P equal intervals of the distribution: fewer gaps than independent draws leave.
    levels = (np.arange(count) + rng.random(count)) / count
    # Less than one in the end where weights of very negative orders underflow.
    cumulative = np.cumsum(chances * shell_volumes(lattice))
    shells = np.searchsorted(cumulative, levels * (1 - 1e-12) * cumulative[-1])
    indices = _draw_points(lattice, shells, rng)
    frequencies, scales = lattice.spacing * indices.astype(np.float64), 1 / (count * chances[shells])
    return Draws(indices, frequencies, scales, tuple(orders), degree, count, seed)


def measure(draws: Draws, computed: Complexes, exact: Complexes) -> Probe:
    """Return the probe from a field's values at the drawn frequencies (P,) and the exact ones."""
    sums = draws.scales * np.abs(computed - exact) ** 2
    return Probe(tuple(np.sum(draws.indices**2, axis=1).tolist()), tuple(sums.tolist()))


def with_own(draws: Draws, count: float, lattice: Lattice, block: Block, values: Complexes) -> Draws:
    """Add draws in proportion to |value|² and to the densities of `draw` to those that fall into a block of a field.

    The error of quadrature peaks where the field does, as in arrays, and few draws meet peaks by chance. Both kinds are
    pooled by the balance heuristic, without bias (E. Veach, L. J. Guibas 1995, doi:10.1145/218380.218498). The count is
    that of the whole field; a block gets its share.
    """
    rng = np.random.default_rng([draws.seed, *np.add(block.start, lattice.M)])
    candidates = block.split(_LOOKED_AT)
    part = candidates[rng.integers(len(candidates))]
    seen = values[part.place_in(block)]
    energies, (shells, weights) = (seen.real**2 + seen.imag**2).ravel(), _shells_and_weights(lattice, part)
    masses = energies * weights
    per_shell = np.bincount(shells, masses, lattice.shell_count).astype(np.float64)
    own_density = _shell_chances(lattice, draws.orders, draws.degree, per_shell)
    cumulative = np.cumsum(masses * own_density[shells])
    expected = count * block.size / lattice.half.size
    added = int(expected + rng.random())
    drawn = np.searchsorted(cumulative, (np.arange(added) + rng.random(added)) / max(added, 1) * cumulative[-1])
    own = np.stack(np.unravel_index(np.minimum(drawn, len(shells) - 1), part.shape), axis=1) + np.array(part.start)
    indices = np.concatenate([draws.indices[draws.inside(block)], own])
    pooled = replace(draws, indices=indices, frequencies=lattice.spacing * indices.astype(np.float64))
    numbers, inside = np.sum(indices**2, axis=1), pooled.inside(part)
    density = draws.count * _shell_chances(lattice, draws.orders, draws.degree, shell_volumes(lattice))[numbers]
    places = np.ravel_multi_index(tuple((indices[inside] - part.start).T), part.shape)
    density[inside] += expected * energies[places] * own_density[numbers[inside]]
    return replace(pooled, scales=1 / density)


def uniform_probe(lattice: Lattice, error: float) -> Probe:
    """Return the probe of a field with the same error at every frequency, raised a little at the lower ones."""
    volumes = shell_volumes(lattice)
    edges = np.unique((np.linspace(0, 1, _BANDS + 1)[:-1] ** 2 * len(volumes)).astype(np.int64))
    return Probe(tuple(edges.tolist()), tuple((error**2 * np.add.reduceat(volumes, edges)).tolist()))


def join(probes: Sequence[Probe]) -> Probe:
    """Join the probes of disjoint sets of draws."""
    return Probe(*(tuple(chain(*parts)) for parts in zip(*map(astuple, probes), strict=True)))


@lru_cache(maxsize=2)
def _shells_and_weights(lattice: Lattice, part: Block) -> tuple[Indices, Reals]:
    """Return the shell and the trapezoidal weight of each sample of a part of the lattice (part.size,)."""
    return lattice.shells(part).ravel().astype(np.intp), lattice.trapezoid_weights(part).ravel()


def _shell_chances(lattice: Lattice, orders: Sequence[float], degree: int, masses: Reals) -> Reals:
    """Return the probability of a point over its mass for each shell, from the masses of the shells (shell_count,)."""
    chances = np.zeros(lattice.shell_count)
    for density in _shell_densities(lattice, tuple(orders), degree):
        chances += density / max(float(masses @ density), _TINY)
    return chances / (2 * len(orders))


@lru_cache(maxsize=64)
def _shell_densities(lattice: Lattice, orders: tuple[float, ...], degree: int) -> Reals:
    """Return the weights of some orders by shell, and these as the error of the triangle rule (2 · orders, shells)."""
    # Relative to the highest frequency, so that high powers neither over- nor underflow.
    growth = (np.arange(lattice.shell_count) / lattice.shell_count) ** (degree + 1)
    weights = SobolevWeights(lattice, orders).per_shell
    return np.concatenate([weights, weights * growth])


def _draw_points(lattice: Lattice, shells: Indices, rng: np.random.Generator) -> Indices:
    """Draw a point of each shell (P,), with probabilities in proportion to its trapezoidal weights."""
    axis = np.arange(lattice.M // 2 + 1)
    x, _, z = lattice.axis_weights(lattice.half)
    # Points with x and y below zero have the weights of those above.
    x = x[lattice.M // 2 :] * np.where(axis > 0, 2, 1)
    drawn = []
    step = max(1, _CANDIDATES // len(axis) ** 2)
    for part in slices(len(shells), step):
        rest = shells[part, None, None] - (axis[:, None] ** 2 + axis**2)
        k = np.sqrt(np.maximum(rest, 0)).round().astype(np.int64)
        numbers, i, j = np.nonzero((rest >= 0) & (k * k == rest) & (k <= axis[-1]))
        points = np.stack([i, j, k[numbers, i, j]], axis=1)
        sums = np.cumsum(x[i] * x[j] * z[points[:, 2]])
        ends = np.searchsorted(numbers, np.arange(len(rest)), side="right") - 1
        starts = np.concatenate([[0.0], sums[ends[:-1]]])
        levels = starts + rng.random(len(rest)) * (sums[ends] - starts)
        drawn.append(points[np.minimum(np.searchsorted(sums, levels, side="right"), ends)])
    signs = rng.choice([-1, 1], size=(len(shells), 3))
    signs[:, 2] = 1
    return np.asarray(signs * np.concatenate(drawn))


@dataclass(frozen=True, eq=False)
class Sample:
    """Exact transform of a surface at drawn frequencies, complex128 (P,)."""

    draws: Draws
    exact: Complexes

    @classmethod
    def from_surface(cls, surface: Surface, draws: Draws, execution: Execution = ON_CPU) -> Self:
        """Return the sample of a surface at given draws."""
        return cls(draws, kind_of(surface).exact_values(draws.frequencies, execution.threads, execution.backend))


def draws_for(
    surfaces: Sequence[Surface],
    lattice: Lattice,
    orders: Sequence[float],
    degree: int,
    fraction: float = 1.0,
    *,
    lasting: bool = False,
) -> Draws:
    """Draw the frequencies to probe fields of surfaces at, by their lowest degree: fewer where each costs more.

    The fraction is `COMMON` where the draws serve one field alone, which adds some of its own. A lasting field may be
    compared at other orders later: its draws serve orders far from these too.
    """
    terms = max(max(kind_of(surface).triangles, 1) for surface in surfaces)
    others = [one for one in _OTHER_ORDERS if lasting and not min(orders) <= one <= max(orders)]
    # Each order keeps its draws.
    share = fraction * (len(orders) + len(others)) / len(orders)
    count = int(share * np.clip(_PAIRS // terms, _FEWEST_DRAWS, _MOST_DRAWS))
    seed = int(np.float64(sum(surface.area for surface in surfaces)).view(np.uint64))
    return draw(lattice, [*orders, *others], degree, count, seed)


def probe_block(
    surface: Surface,
    lattice: Lattice,
    settings: TransformSettings,
    block: Block,
    values: Complexes,
    draws: Draws,
    execution: Execution = ON_CPU,
    sample: Sample | None = None,
) -> Probe:
    """Compare one block of a field with the exact transform, at the draws that fall into the block and some of its own.

    A sample at these draws saves time. The exact values of a parametrised surface come from nodes too, so its
    probe also holds the change that the last doubling made, once for the whole field.
    """
    if not needs_probe(surface, settings):
        return Probe()
    count = (_OWN if sample is None else _OWN_BESIDE_SAMPLE) * draws.count
    pooled = with_own(draws, count, lattice, block, values)
    known = np.zeros(0, np.complex128) if sample is None else sample.exact[draws.inside(block)]
    own = kind_of(surface).exact_values(pooled.frequencies[len(known) :], execution.threads, execution.backend)
    probe = measure(pooled, values[tuple((pooled.indices - block.start).T)], np.concatenate([known, own]))
    change = settings.kind_for(surface, lattice).change
    if change and block.start == lattice.half.start:
        return join([probe, uniform_probe(lattice, change * surface.area)])
    return probe


def needs_probe(surface: Surface, settings: TransformSettings) -> bool:
    """Tell whether a field can differ noticeably from the exact transform; closed forms in double precision cannot."""
    return not kind_of(surface).is_closed_form or settings.stored == "complex64"


def estimate(samples: Sequence[Sample], orders: Sequence[float]) -> Reals:
    """Estimate the norm of a surface, or the distance of two, without bias from samples of the same draws (orders,)."""
    draws = samples[0].draws
    difference = samples[0].exact - (samples[1].exact if len(samples) > 1 else 0.0)
    squares = draws.scales * np.abs(difference) ** 2
    lengths = 1 + np.sum(draws.frequencies**2, axis=1)
    return np.asarray(np.sqrt([np.sum(squares * lengths**order) for order in orders]))
