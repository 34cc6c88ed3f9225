"""What error a field is going to have, before it is computed, and the settings that keep it small.

The forecast adds up what the rules err on typical triangles of the mesh's sizes. On fine meshes it
was measured to lie between once and ten times the true error, on coarse ones down to a fifth of it:
good enough to choose settings by, while the probe says what the error became.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.quadrature.meshes import choose_rules
from sobolev_batch.spectral.quadrature.rules import FINEST_TOLERANCE, TriangleRule, rule_ranges, typical_errors
from sobolev_batch.spectral.transform.settings import COARSEST_EPS, FINEST_EPS, TransformSettings
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.smooth import Smooth
from sobolev_batch.surfaces.shapes.surface import Surface

Reals = NDArray[np.float64]

# Of what a field may err, this part is left to the NUFFT.
_NUFFT_SHARE = 0.4
# The rms error of a field of many points at one frequency over eps · area: measured 0.003 to 0.006.
_NUFFT_ERROR = 0.005
# The same of single precision over the area, however small its eps; measured 1e-7 at most.
_SINGLE_ROUNDING = 3e-7
# Between neighbouring triangles about this much of the odd errors was seen to remain.
_ODD_REMAINDER = 0.2
# A parametrised surface has at least so many nodes.
_FEWEST_NODES = 500
_BINS = 48
_RADII = 32
_LOOSEST_TOLERANCE = 0.1
_STEPS_PER_DECADE = 4
# The cube's volume is that of a ball of this radius, in units of half its side.
_BALL = (6 / np.pi) ** (1 / 3)


@dataclass(frozen=True)
class Goal:
    """How large the norm of a field's own error may become.

    Attributes:
        orders: s, each.
        norms: the largest ||computed - exact||_s for each of them.
    """

    orders: tuple[float, ...]
    norms: tuple[float, ...]

    def tightened(self, factor: float) -> Goal:
        """A goal so many times smaller."""
        return Goal(self.orders, tuple(norm / factor for norm in self.norms))


def permits_single(surface: Surface, lattice: Lattice, goal: Goal) -> bool:
    """Whether single precision is enough for a goal: its rounding is 1e-7 of the area at every frequency."""
    rounding = _SINGLE_ROUNDING * surface.area * np.sqrt(_weight_masses(lattice, goal.orders))
    return bool(np.all(rounding <= _NUFFT_SHARE * np.array(goal.norms)))


def settle(surface: Mesh | Smooth, lattice: Lattice, goal: Goal, transform: TransformSettings) -> TransformSettings:
    """The cheapest settings that are forecast to meet a goal, or the finest there are.

    Args:
        surface: whose field is to be computed.
        lattice: where.
        goal: what its error may be.
        transform: whose precision and quadrature are kept.

    Returns:
        ``transform`` with eps and tolerance set.
    """
    norms = np.array(goal.norms)
    masses = _weight_masses(lattice, goal.orders)
    spread = _NUFFT_ERROR + 1 / math.sqrt(len(surface.triangles) if isinstance(surface, Mesh) else _FEWEST_NODES)
    eps = float(np.min(_NUFFT_SHARE * norms / (surface.area * spread * np.sqrt(masses))))
    eps = min(max(eps, FINEST_EPS[transform.dtype]), COARSEST_EPS)
    rest = (1 - _NUFFT_SHARE) * norms
    if isinstance(surface, Smooth):
        # What it promises at every frequency, at all of them.
        tolerance = float(np.min(rest / (surface.area * np.sqrt(masses))))
    else:
        tolerance = loosest_tolerance(surface, lattice, Goal(goal.orders, tuple(rest)))
    return replace(transform, eps=eps, tolerance=tolerance)


def loosest_tolerance(mesh: Mesh, lattice: Lattice, goal: Goal) -> float:
    """The largest tolerance of the triangle rules whose error is forecast to keep a goal."""
    census = Census.of(mesh)
    decades = math.log10(_LOOSEST_TOLERANCE / FINEST_TOLERANCE)
    tolerances = _LOOSEST_TOLERANCE * 10 ** -np.linspace(0, decades, round(decades * _STEPS_PER_DECADE) + 1)
    low, high = 0, len(tolerances) - 1
    while low < high:
        middle = (low + high) // 2
        if np.all(census.quadrature_error(lattice, goal.orders, float(tolerances[middle])) <= goal.norms):
            high = middle
        else:
            low = middle + 1
    return float(tolerances[low])


@dataclass(frozen=True, eq=False)
class Census:
    """The triangles of a mesh by size: centroid radii of each class, sum of areas and of their squares."""

    smallest: Reals
    largest: Reals
    areas: Reals
    squares: Reals

    @classmethod
    def of(cls, mesh: Mesh) -> Census:
        """The census of a mesh."""
        radii, areas = mesh.centroid_radii, mesh.areas
        largest = float(radii.max())
        smallest = max(float(radii.min()), 1e-6 * largest)
        count = max(1, min(_BINS, math.ceil(8 * math.log(largest / smallest))))
        edges = np.geomspace(smallest, largest, count + 1)
        where = np.clip(np.searchsorted(edges, radii) - 1, 0, count - 1)
        sums = [np.bincount(where, part, count).astype(np.float64, copy=False) for part in (areas, areas * areas)]
        return cls(edges[:-1], edges[1:], *sums)

    def quadrature_error(self, lattice: Lattice, orders: Sequence[float], tolerance: float) -> Reals:
        """The norm of the quadrature's part of a field's error that is to be expected (orders,).

        The even parts of the triangles' errors add up like the surface's transform itself, whose
        energy on |ξ| = r is area² near zero and area / (2π r²) on average far out; the odd parts add
        up like random numbers.
        """
        rules, ranges = rule_ranges(tolerance)
        # The rule that the smallest of a class gets, on the largest of it: never less than the truth.
        splits, choice = choose_rules(2 * np.pi * lattice.highest_frequency * self.smallest, ranges)
        radii = (np.arange(_RADII) + 0.5) / _RADII * _BALL * lattice.xi_max
        phases = 2 * np.pi * radii[:, None] * (self.largest / 2.0**splits)
        even, odd = np.empty_like(phases), np.empty_like(phases)
        for rule in np.unique(choice):
            members = choice == rule
            even[:, members], odd[:, members] = _typical(rules[rule], phases[:, members])
        pieces = 4.0**splits
        area = self.areas.sum()
        coherence = np.minimum(1.0, 1 / (2 * np.pi * radii**2 * area))
        energy = (even @ self.areas) ** 2 * coherence
        energy += (even**2 + (_ODD_REMAINDER * odd) ** 2) @ (self.squares / pieces)
        return np.sqrt(_radial_integrals(energy, radii, orders))


def _typical(rule: TriangleRule, phases: Reals) -> tuple[Reals, Reals]:
    sizes, even, odd = typical_errors(rule)
    logs = np.log(np.maximum(phases, sizes[0]))
    grid = np.log(sizes)
    first, second = (np.exp(np.interp(logs, grid, np.log(part + 1e-17))) for part in (even, odd))
    return first, second


def _weight_masses(lattice: Lattice, orders: Sequence[float]) -> Reals:
    """∫ (1+|ξ|²)^s over the lattice's cube (orders,)."""
    radii = (np.arange(_RADII) + 0.5) / _RADII * _BALL * lattice.xi_max
    return _radial_integrals(np.ones(_RADII), radii, orders)


def _radial_integrals(energy: Reals, radii: Reals, orders: Sequence[float]) -> Reals:
    """∫ (1+r²)^s energy(r) 4πr² dr by the midpoint rule (orders,)."""
    step = radii[1] - radii[0]
    return np.array([np.sum((1 + radii**2) ** order * energy * 4 * np.pi * radii**2) * step for order in orders])
