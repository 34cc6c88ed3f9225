"""Prediction of the error of quadrature, and the loosest tolerance that keeps it small.

The prediction for a mesh adds up the errors of the rules on typical triangles of its sizes. On fine meshes it
was measured to be one to ten times the true error, on coarse ones down to a fifth of it.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.lattice import FrequencyLattice
from sobolev_batch.spectral.quadrature.meshes import choose_rules
from sobolev_batch.spectral.quadrature.rules import FINEST_TOLERANCE, TriangleRule, rule_ranges, typical_errors
from sobolev_batch.surfaces.shapes.mesh import Mesh

Reals = NDArray[np.float64]

# Fraction of the odd errors that was seen to remain between neighbouring triangles.
_ODD_REMAINDER = 0.2
_BINS = 48
_RADII = 32
_LOOSEST_TOLERANCE = 0.1
_STEPS_PER_DECADE = 4


def loosest_tolerance(mesh: Mesh, lattice: FrequencyLattice, orders: Sequence[float], norms: Reals) -> float:
    """Return the largest tolerance of the triangle rules whose error is predicted to have at most some norms.

    Args:
        mesh: Mesh in units of length.
        lattice: Lattice of the field.
        orders: Orders s.
        norms: Largest norm of the error at each order (orders,).
    """
    sizes = SizeHistogram.from_mesh(mesh)
    decades = math.log10(_LOOSEST_TOLERANCE / FINEST_TOLERANCE)
    tolerances = _LOOSEST_TOLERANCE * 10 ** -np.linspace(0, decades, round(decades * _STEPS_PER_DECADE) + 1)

    def suffices(tolerance: float) -> bool:
        return bool(np.all(sizes.quadrature_error(lattice, orders, float(tolerance)) <= norms))

    # The finest one where none suffices.
    return float(tolerances[bisect_left(tolerances[:-1], True, key=suffices)])


@dataclass(frozen=True, eq=False)
class SizeHistogram:
    """Triangles of a mesh, counted in classes of similar size.

    Attributes:
        smallest: Least centroid radius of each class, in units of length.
        largest: Greatest centroid radius of each class.
        areas: Sum of the areas in each class.
        squares: Sum of the squared areas in each class.
    """

    smallest: Reals
    largest: Reals
    areas: Reals
    squares: Reals

    @classmethod
    def from_mesh(cls, mesh: Mesh) -> SizeHistogram:
        """Return the histogram of a mesh."""
        radii, areas = mesh.centroid_radii, mesh.areas
        largest = float(radii.max())
        smallest = max(float(radii.min()), 1e-6 * largest)
        count = max(1, min(_BINS, math.ceil(8 * math.log(largest / smallest))))
        edges = np.geomspace(smallest, largest, count + 1)
        classes = np.clip(np.searchsorted(edges, radii) - 1, 0, count - 1)
        sums = [np.bincount(classes, values, count).astype(np.float64, copy=False) for values in (areas, areas * areas)]
        return cls(edges[:-1], edges[1:], *sums)

    def quadrature_error(self, lattice: FrequencyLattice, orders: Sequence[float], tolerance: float) -> Reals:
        """Predict the norm of the quadrature's part of a field's error (orders,).

        The even parts of the triangles' errors add up like the surface's transform itself, whose
        energy on |ξ| = r is area² near zero and area / (2π r²) on average far out. The odd parts add
        up like random numbers.
        """
        rules, ranges = rule_ranges(tolerance)
        # The rule for the smallest of a class, applied to the largest of it: never less than the truth.
        splits, choice = choose_rules(2 * np.pi * lattice.highest_frequency * self.smallest, ranges)
        radii = _radii(lattice)
        phases = 2 * np.pi * radii[:, None] * (self.largest / 2.0**splits)
        even, odd = np.empty_like(phases), np.empty_like(phases)
        for rule in np.unique(choice):
            members = choice == rule
            even[:, members], odd[:, members] = _interpolated_errors(rules[rule], phases[:, members])
        area = self.areas.sum()
        coherence = np.minimum(1.0, 1 / (2 * np.pi * radii**2 * area))
        energy = (even @ self.areas) ** 2 * coherence
        energy += (even**2 + (_ODD_REMAINDER * odd) ** 2) @ (self.squares / 4.0**splits)
        return np.asarray(np.sqrt(radial_integrals(energy, radii, orders)))


def _interpolated_errors(rule: TriangleRule, phases: Reals) -> tuple[Reals, Reals]:
    """Return the typical even and odd errors of a rule at some phases."""
    sizes, even, odd = typical_errors(rule)
    logs, grid = np.log(np.maximum(phases, sizes[0])), np.log(sizes)
    first, second = (np.exp(np.interp(logs, grid, np.log(errors + 1e-17))) for errors in (even, odd))
    return first, second


def _radii(lattice: FrequencyLattice) -> Reals:
    low, high = lattice.radial_range
    radii: Reals = low + (np.arange(_RADII) + 0.5) / _RADII * (high - low)
    return radii


def weight_masses(lattice: FrequencyLattice, orders: Sequence[float]) -> Reals:
    """Return ∫ (1+|ξ|²)^s over the range of a lattice (orders,)."""
    return radial_integrals(np.ones(_RADII), _radii(lattice), orders)


def radial_integrals(energy: Reals, radii: Reals, orders: Sequence[float]) -> Reals:
    """Return ∫ (1+r²)^s energy(r) 4πr² dr by the midpoint rule (orders,)."""
    step = radii[1] - radii[0]
    return np.array([np.sum((1 + radii**2) ** order * energy * 4 * np.pi * radii**2) * step for order in orders])
