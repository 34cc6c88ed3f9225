"""Independent values of distances, each with its own uncertainty.

Two spheres have a closed form. Meshes of few triangles are integrated in real space, the inner
integral in closed form up to the sides of the faces, the outer with two rules. Others are summed in
real space on triangles that are cut finer and finer, or taken from a far finer lattice, whichever
is more certain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sobolev_batch import Lattice, Mesh, Sphere, distance, fourier_transform
from sobolev_batch.spectral.spheres import sphere_inner_product
from sobolev_batch.surfaces.similarity import Surface
from tests.coverage.matern import (
    Sides,
    divided_points,
    double_sum,
    graded_points,
    mesh_potentials,
    sphere_potential,
)

Reals = NDArray[np.float64]

# Triangles of both meshes together for which the inner integral is done in closed form.
_FEW = 24
# Nodes per direction of the two outer rules.
_OUTER = (8, 12)
# Points of the double sum.
_MOST_POINTS = 32_000
# Lattices far finer than those under test, by the highest order that they serve. Surfaces within
# the unit ball: periods of 5 and 6 keep their images away.
_FINE = {-2.0: Lattice(16.0, 160), -4.0: Lattice(10.0, 120)}
# Rounding of sums of some thousand terms, relative to the squared norms.
_ROUNDING = 1e-14


@dataclass(frozen=True)
class Truth:
    """An independent value of a distance, and how far from the true one it may be."""

    value: float
    uncertainty: float

    @classmethod
    def of_square(cls, square: float, slack: float) -> Truth:
        """From the squared distance and its uncertainty."""
        value = np.sqrt(max(square, 0.0))
        low, high = np.sqrt(max(square - slack, 0.0)), np.sqrt(max(square + slack, 0.0))
        return cls(float(value), float(max(high - value, value - low)))


def truths(a: Surface, b: Surface, orders: Sequence[float]) -> tuple[Truth, ...]:
    """The distance of two surfaces within about the unit ball, for each of some whole orders."""
    meshes = [surface for surface in (a, b) if isinstance(surface, Mesh)]
    if not meshes:
        closed = distance(a, b, orders)
        pairs = zip(closed["distance"].values, closed["error"].values, strict=True)
        return tuple(Truth(float(value), float(error)) for value, error in pairs)
    triangles = sum(len(mesh.triangles) for mesh in meshes)
    found = [(closed_within if triangles <= _FEW else on_fine_lattice)(a, b, orders)]
    # An extrapolation needs two levels at least.
    if 24 * triangles <= _MOST_POINTS:
        found.append(summed_in_real_space(a, b, orders))
    return tuple(min(known, key=lambda truth: truth.uncertainty) for known in zip(*found, strict=True))


def closed_within(a: Surface, b: Surface, orders: Sequence[float]) -> tuple[Truth, ...]:
    """By the potentials of the faces; the uncertainty is the change from one outer rule to a finer one."""
    powers = [round(-order) for order in orders]
    signed = ((a, 1.0), (b, -1.0))
    meshes = [(Sides.of(surface), sign) for surface, sign in signed if isinstance(surface, Mesh)]
    found = []
    for count in _OUTER:
        squares, norms = _spheres_alone(a, b, orders)
        for surface, sign in signed:
            if not isinstance(surface, Mesh):
                continue
            points, weights = graded_points(surface, count)
            potentials = sum((other * mesh_potentials(sides, points, powers) for sides, other in meshes), 0.0)
            squares = squares + sign * (potentials @ weights)
            norms = norms + np.abs(potentials) @ weights
            # The mesh against a sphere, and the sphere against the mesh.
            squares = squares + 2 * sign * (_of_spheres(signed, points, powers) @ weights)
        found.append(squares)
    coarse, fine = found
    slack = np.abs(fine - coarse) + _ROUNDING * norms
    return tuple(map(Truth.of_square, fine.tolist(), slack.tolist()))


def summed_in_real_space(a: Surface, b: Surface, orders: Sequence[float]) -> tuple[Truth, ...]:
    """By double sums over points, extrapolated; the uncertainty is what the last extrapolation changed.

    The kernel of a = -s has the term r^(2a-3), which leaves an error of h^(2a-1) beside the rule's h^6.
    """
    powers = [round(-order) for order in orders]
    signed = ((a, 1.0), (b, -1.0))
    triangles = sum(len(surface.triangles) for surface, _ in signed if isinstance(surface, Mesh))
    levels = [level for level in range(6) if 6 * triangles * 4**level <= _MOST_POINTS][-3:]
    rows = []
    for level in levels:
        squares, norms = _spheres_alone(a, b, orders)
        sets = [(divided_points(surface, level), sign) for surface, sign in signed if isinstance(surface, Mesh)]
        points = np.concatenate([points for (points, _), _ in sets])
        weights = np.concatenate([sign * weights for (_, weights), sign in sets])
        squares = squares + double_sum(points, weights, powers)
        squares = squares + 2 * (_of_spheres(signed, points, powers) @ weights)
        rows.append(squares)
    scale = norms + np.abs(weights).sum() ** 2
    rates = np.array([[2.0 ** min(2 * a - 1, 6), 2.0 ** min(2 * a, 6)] for a in powers]).T
    table = [rows]
    for rate in rates[: len(levels) - 1]:
        last = table[-1]
        table.append([fine + (fine - coarse) / (rate - 1) for coarse, fine in pairwise(last)])
    best, before = table[-1][-1], table[-2][-1]
    slack = np.abs(best - before) + _ROUNDING * scale
    return tuple(map(Truth.of_square, best.tolist(), slack.tolist()))


def on_fine_lattice(a: Surface, b: Surface, orders: Sequence[float]) -> tuple[Truth, ...]:
    """On a lattice far finer than those under test; the uncertainty is the error reported there.

    Not independent of the way that errors are found, but of how well that works where they are large.
    """
    found: dict[float, Truth] = {}
    for order in orders:
        if order in found:
            continue
        highest = -2.0 if order > -4 else -4.0
        shared = [s for s in orders if (s > -4) == (order > -4)]
        lattice = _FINE[highest]
        first, second = (fourier_transform(surface, lattice, 1e-13, orders=shared) for surface in (a, b))
        fine = distance(first, second, shared)
        for s, value, error in zip(shared, fine["distance"].values, fine["error"].values, strict=True):
            found[s] = Truth(float(value), float(error))
    return tuple(found[order] for order in orders)


def _spheres_alone(a: Surface, b: Surface, orders: Sequence[float]) -> tuple[Reals, Reals]:
    """What spheres add to the squared distance by themselves, and the size of that."""
    spheres = [surface for surface in (a, b) if isinstance(surface, Sphere)]
    alone = np.array([sum(sphere_inner_product(sphere, sphere, order) for sphere in spheres) for order in orders])
    return alone, alone


def _of_spheres(signed: Sequence[tuple[Surface, float]], points: Reals, powers: Sequence[int]) -> Reals:
    """The potential of the spheres among the surfaces, with their signs: (len(powers), n)."""
    total = np.zeros((len(powers), len(points)))
    for surface, sign in signed:
        if isinstance(surface, Sphere):
            total += sign * np.stack([sphere_potential(surface, points, power) for power in powers])
    return total
