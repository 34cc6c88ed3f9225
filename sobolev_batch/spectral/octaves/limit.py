"""The energy beyond all octaves: its limit is known from the areas, and from the parts of surfaces that coincide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.special import beta, betainc

from sobolev_batch.spectral.octaves.partition import Octave, smooth_step
from sobolev_batch.spectral.octaves.sums import OctaveSums
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.surface import Surface

Reals = NDArray[np.float64]

# Points that are looked up among all triangles: at most so many of each mesh, and pairs of a point and a triangle.
_MOST_POINTS, _FEWEST_POINTS, _PAIRS = 2000, 200, 50_000_000
_TRIANGLES = 2000
# Surfaces coincide where they are closer than this fraction of their size, and a point is within a triangle if it is
# outside by no more than this fraction of it.
_CLOSENESS, _MARGIN = 1e-8, 1e-9
# Least ratio of the energy's distances from its limit in neighbouring octaves, and the fraction of the next distance by
# which the energy may exceed the limit.
_FASTEST_FALL, _OVERSHOOT = 0.25, 0.3


@dataclass(frozen=True)
class EnergyLimit:
    """Limit of the energy ∫_{|ξ|=r} |Σ ± μ^|² dS for large r: twice the integral of the squared multiplicity.

    Where no parts coincide, that is twice the area of all surfaces. Parts that two measures share cancel if the
    measures are subtracted, and count twice as much if they are added.

    Attributes:
        value: The limit.
        deviation: Standard error of the limit, from random points.
    """

    value: float
    deviation: float

    @classmethod
    def of(cls, surfaces: Sequence[Surface], signs: Sequence[int], seed: int = 0) -> EnergyLimit:
        """Return the limit for the sum of some surfaces' measures, each with a sign."""
        rng = np.random.default_rng(seed)
        meshes = [(surface, sign) for surface, sign in zip(surfaces, signs, strict=True) if isinstance(surface, Mesh)]
        value = 2 * sum(surface.area for surface in surfaces if not isinstance(surface, Mesh))
        variance = 0.0
        size = max((float(np.ptp(mesh.vertices, axis=0).max()) for mesh, _ in meshes), default=0.0)
        pairs = sum(len(mesh.triangles) for mesh, _ in meshes) * max(len(meshes), 1)
        count = int(np.clip(_PAIRS // max(pairs, 1), _FEWEST_POINTS, _MOST_POINTS))
        for mesh, sign in meshes:
            points = _random_points(mesh, count, rng)
            multiplicities = sum(other * _covering(points, candidate, _CLOSENESS * size) for candidate, other in meshes)
            terms = sign * np.asarray(multiplicities)
            value += 2 * mesh.area * float(terms.mean())
            variance += (2 * mesh.area) ** 2 * float(terms.var()) / count
        return cls(max(value, 0.0), variance**0.5)


def beyond(
    octaves: Sequence[Octave], sums: Sequence[OctaveSums], limit: EnergyLimit, orders: Sequence[float]
) -> tuple[Reals, Reals]:
    """Return the integrals beyond the last octave (orders,), and how far off they may be.

    The energy there lies between that of the last octave and its limit, which it may exceed a little. The nearer it has
    come to the limit from one octave to the next, the nearer it comes beyond.
    """
    limit_value, last = limit.value, sums[-1]
    deficit, before = (limit_value - octave.energy for octave in (last, sums[-2] if len(sums) > 1 else last))
    # Where the energy happens to cross its limit, it was farther away before.
    gap = max(abs(deficit), _FASTEST_FALL * abs(before))
    fall = float(np.clip(abs(deficit / before), _FASTEST_FALL, 1.0)) if before else 1.0
    tails = np.array([tail_integral(octaves[-1].highest, order) for order in orders])
    noise = 3 * float(np.hypot(fall * last.energy_deviation, limit.deviation))
    return (limit_value - fall * deficit / 2) * tails, ((0.5 + _OVERSHOOT) * fall * gap + noise) * tails


def tail_integral(cutoff: float, order: float) -> float:
    """Return ∫ (1 - step(r)) (1+r²)^s dr over all r, for the smooth step that ends at a cutoff."""

    def integrand(radius: float) -> float:
        return float((1 - smooth_step(np.array(radius), cutoff)) * (1 + radius**2) ** order)

    exponent = -order - 0.5
    # With q = 1/(1+r²), ∫_R^∞ (1+r²)^s dr is half an incomplete beta integral.
    rest = 0.5 * beta(exponent, 0.5) * betainc(exponent, 0.5, 1 / (1 + cutoff**2))
    return float(rest + quad(integrand, cutoff / 2, cutoff)[0])


def _random_points(mesh: Mesh, count: int, rng: np.random.Generator) -> Reals:
    """Draw points (count, 3) on a mesh, uniformly by area."""
    chosen = rng.choice(len(mesh.triangles), count, p=mesh.areas / mesh.areas.sum())
    first, second = rng.random((2, count, 1))
    first = np.sqrt(first)
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles[chosen]], 1, 0)
    return np.asarray((1 - first) * a + first * (1 - second) * b + first * second * c)


def _covering(points: Reals, mesh: Mesh, closeness: float) -> NDArray[np.int64]:
    """Return the number of triangles of a mesh that each point (n, 3) lies on, int64 (n,)."""
    counts = np.zeros(len(points), dtype=np.int64)
    for first in range(0, len(mesh.triangles), _TRIANGLES):
        a, b, c = np.moveaxis(mesh.vertices[mesh.triangles[first : first + _TRIANGLES]], 1, 0)
        u, v = b - a, c - a
        normals = np.cross(u, v)
        doubled = np.linalg.norm(normals, axis=1)
        normals /= np.maximum(doubled, np.finfo(np.float64).tiny)[:, None]
        heights = points @ normals.T - np.einsum("ij,ij->i", normals, a)
        rows, columns = np.nonzero((np.abs(heights) <= closeness) & (doubled > 0))
        # Barycentric coordinates of the few that lie in the plane.
        offsets = points[rows] - a[columns]
        crossed_u = np.cross(offsets, v[columns])
        crossed_v = np.cross(u[columns], offsets)
        s = np.einsum("ij,ij->i", crossed_u, normals[columns]) / doubled[columns]
        t = np.einsum("ij,ij->i", crossed_v, normals[columns]) / doubled[columns]
        inside = (s >= -_MARGIN) & (t >= -_MARGIN) & (s + t <= 1 + _MARGIN)
        counts += np.bincount(rows[inside], minlength=len(points))
    return counts
