"""Independent values of distances, each with its own uncertainty.

Two spheres have a closed form. Meshes of few triangles are integrated in real space, the inner
integral in closed form up to the sides of the faces, the outer with two rules. Others are summed in
real space on triangles that are cut finer and finer, as long as that does not take too many points.
The rest, and what such sums find hard (surfaces nearer to each other than the points), is taken
from a far finer lattice. Whatever is most certain counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sobolev_batch import Lattice, Mesh, Sphere, distance, fourier_transform
from sobolev_batch.spectral.exact.spheres import sphere_inner_product
from sobolev_batch.surfaces.shapes.surface import Surface
from tests.coverage.matern import (
    Sides,
    divided_points,
    double_sum,
    graded_points,
    mesh_potentials,
    sphere_potential,
)

Reals = NDArray[np.float64]

# Kernels of orders above this have a strong kink at zero, those of others hardly any.
_SMOOTH = -4.0
# Triangles of both meshes together for which the inner integral is done in closed form.
_FEW = 90
# Nodes per direction of the two outer rules.
_OUTER = (8, 11)
# Points of the double sum at most.
_POINTS_ROUGH, _POINTS_SMOOTH = 40_000, 10_000
# Lattices far finer than those under test. Surfaces within the unit ball: periods of 5 and 6 keep
# their images away.
_FINE_ROUGH, _FINE_SMOOTH = Lattice(16.0, 160), Lattice(10.0, 120)
# The last change of an extrapolation was seen to be half of its error where levels are few.
_EXTRAPOLATION_CAUTION = 3.0
# Rounding of sums of some thousand terms, relative to the squared norms.
_ROUNDING = 1e-14


@dataclass(frozen=True)
class Truth:
    """An independent value of a distance, with its uncertainty."""

    value: float
    uncertainty: float

    @classmethod
    def of_square(cls, square: float, slack: float) -> Truth:
        """Return the truth from the squared distance and its uncertainty."""
        value = np.sqrt(max(square, 0.0))
        low, high = np.sqrt(max(square - slack, 0.0)), np.sqrt(max(square + slack, 0.0))
        return cls(float(value), float(max(high - value, value - low)))


def truths(a: Surface, b: Surface, orders: Sequence[float]) -> tuple[Truth, ...]:
    """Return the distance of two surfaces within about the unit ball for each of some whole orders."""
    meshes = [surface for surface in (a, b) if isinstance(surface, Mesh)]
    if not meshes:
        closed = distance(a, b, orders)
        pairs = zip(closed["distance"].values, closed["error"].values, strict=True)
        return tuple(Truth(float(value), float(error)) for value, error in pairs)
    rough, smooth = ([order for order in orders if (order > _SMOOTH) == side] for side in (True, False))
    by_order: dict[float, Truth] = {}
    for chosen, points in ((rough, _POINTS_ROUGH), (smooth, _POINTS_SMOOTH)):
        if chosen:
            by_order |= dict(zip(chosen, _most_certain(a, b, chosen, points), strict=True))
    return tuple(by_order[order] for order in orders)


def _most_certain(a: Surface, b: Surface, orders: Sequence[float], points: int) -> list[Truth]:
    triangles = sum(len(surface.triangles) for surface in (a, b) if isinstance(surface, Mesh))
    # An extrapolation needs two levels at least.
    summable = 24 * triangles <= points
    candidates = []
    if triangles <= _FEW and orders[0] > _SMOOTH:
        candidates.append(closed_within(a, b, orders))
        # Still useful against spheres, whose potential has a kink where they cross a face.
        points = _POINTS_SMOOTH
    elif not summable or orders[0] > _SMOOTH:
        candidates.append(on_fine_lattice(a, b, orders))
    if summable:
        candidates.append(summed_in_real_space(a, b, orders, points))
    return [min(alternatives, key=lambda truth: truth.uncertainty) for alternatives in zip(*candidates, strict=True)]


def closed_within(a: Surface, b: Surface, orders: Sequence[float]) -> tuple[Truth, ...]:
    """Integrate the potentials of the faces; the uncertainty is the change from one outer rule to a finer one."""
    powers = [round(-order) for order in orders]
    signed = ((a, 1.0), (b, -1.0))
    meshes = [(Sides.of(surface), sign) for surface, sign in signed if isinstance(surface, Mesh)]
    candidates = []
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
        candidates.append(squares)
    coarse, fine = candidates
    slack = np.abs(fine - coarse) + _ROUNDING * norms
    return tuple(map(Truth.of_square, fine.tolist(), slack.tolist()))


def summed_in_real_space(
    a: Surface, b: Surface, orders: Sequence[float], most: int = _POINTS_SMOOTH
) -> tuple[Truth, ...]:
    """Extrapolate double sums over points; the uncertainty is a multiple of the last extrapolation's change.

    The kernel of a = -s has the term r^(2a-3), which leaves an error of h^(2a-1) beside the rule's h^6.
    """
    powers = [round(-order) for order in orders]
    signed = ((a, 1.0), (b, -1.0))
    triangles = sum(len(surface.triangles) for surface, _ in signed if isinstance(surface, Mesh))
    levels = [level for level in range(6) if 6 * triangles * 4**level <= most][-3:]
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
    slack = _EXTRAPOLATION_CAUTION * np.abs(best - before) + _ROUNDING * scale
    return tuple(map(Truth.of_square, best.tolist(), slack.tolist()))


def on_fine_lattice(a: Surface, b: Surface, orders: Sequence[float]) -> tuple[Truth, ...]:
    """Compute on a lattice far finer than those under test; the uncertainty is the error reported there.

    This relies on the reported errors, but only where they are small.
    """
    lattice = _FINE_ROUGH if max(orders) > _SMOOTH else _FINE_SMOOTH
    first, second = (fourier_transform(surface, lattice, 1e-13, order=orders) for surface in (a, b))
    fine = distance(first, second, orders)
    pairs = zip(fine["distance"].values, fine["error"].values, strict=True)
    return tuple(Truth(float(value), float(error)) for value, error in pairs)


def _spheres_alone(a: Surface, b: Surface, orders: Sequence[float]) -> tuple[Reals, Reals]:
    """Return the contribution of the spheres alone to the squared distance, and its size."""
    spheres = [surface for surface in (a, b) if isinstance(surface, Sphere)]
    alone = np.array([sum(sphere_inner_product(sphere, sphere, order) for sphere in spheres) for order in orders])
    return alone, alone


def _of_spheres(signed: Sequence[tuple[Surface, float]], points: Reals, powers: Sequence[int]) -> Reals:
    """Return the signed potential of the spheres among the surfaces, (len(powers), n)."""
    total = np.zeros((len(powers), len(points)))
    for surface, sign in signed:
        if isinstance(surface, Sphere):
            total += sign * np.stack([sphere_potential(surface, points, power) for power in powers])
    return total
