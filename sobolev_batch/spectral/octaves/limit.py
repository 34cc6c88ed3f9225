"""The energy beyond all octaves: its limit is known from the areas, and from the parts of surfaces that coincide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import beta, betainc

from sobolev_batch.spectral.octaves.normals import without_sign
from sobolev_batch.spectral.octaves.partition import Octave
from sobolev_batch.spectral.octaves.sums import OctaveSums
from sobolev_batch.spectral.shells import smooth_step
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.surface import Surface

Reals = NDArray[np.float64]

# Points that are looked up among all triangles: at most so many of each mesh, and pairs of a point and a triangle.
_MOST_POINTS, _FEWEST_POINTS, _PAIRS = 2000, 200, 50_000_000
_TRIANGLES = 2000
# Triangles whose planes are computed at a time.
_BATCH = 1 << 17
# Surfaces coincide where they are closer than this fraction of their size, and a point is within a triangle if it is
# outside by no more than this fraction of it.
_CLOSENESS, _MARGIN = 1e-8, 1e-9
# A plane is one number, a combination of its normal and offset; those of surfaces that coincide differ by no more.
_OF_NORMAL, _OF_OFFSET, _PLANE_CLOSENESS = np.array([0.7346, -0.5178, 0.9571]), 0.6294, 3e-8
# Octaves in which the energy's distances from its limit must fall regularly; the least ratio of two of them, and the
# least ratio of two such ratios; the fraction of the next distance by which the energy may exceed the limit.
_REGULAR, _FASTEST_FALL, _LEAST_STEADINESS, _OVERSHOOT = 3, 0.25, 0.6, 0.4
# From octave to octave the bound on an irregular distance falls by no more than this.
_SLOWEST_FALL = 0.5
# Later swings were measured to exceed the bound by a sixth.
_CAUTION = 1.25
# If the energy grows by more than this from octave to octave, it may swing by this fraction of the limit.
_STEEPEST_GROWTH, _SWING = 2.5, 0.9


@dataclass(frozen=True)
class EnergyLimit:
    """Limit of the energy ∫_{|ξ|=r} |Σ ± μ^|² dS for large r: twice the integral of the squared multiplicity.

    Where no parts coincide, that is twice the area of all surfaces. Parts that two measures share cancel if the
    measures are subtracted, and count twice as much if they are added.

    Attributes:
        value: The limit.
        deviation: Standard error of the limit, from random points.
        spread: How far the limit may be from the value beyond that; zero where the surfaces were compared.
    """

    value: float
    deviation: float = 0.0
    spread: float = 0.0

    @classmethod
    def between(cls, lowest: float, highest: float) -> EnergyLimit:
        """Return a limit of which only bounds are known."""
        lowest = min(lowest, highest)
        return cls((lowest + highest) / 2, 0.0, (highest - lowest) / 2)

    @classmethod
    def from_surfaces(cls, surfaces: Sequence[Surface], signs: Sequence[int], seed: int = 0) -> EnergyLimit:
        """Return the limit for the sum of some surfaces' measures, each with a sign."""
        rng = np.random.default_rng(seed)
        meshes = [(surface, sign) for surface, sign in zip(surfaces, signs, strict=True) if isinstance(surface, Mesh)]
        value, variance = 2 * sum(surface.area for surface in surfaces), 0.0
        size = max((float(np.ptp(mesh.used_coordinates, axis=1).max()) for mesh, _ in meshes), default=0.0)
        candidates = _in_common_planes([mesh for mesh, _ in meshes], size)
        shared = [(mesh, sign) for mesh, (_, sign) in zip(candidates, meshes, strict=True) if mesh is not None]
        pairs = sum(len(mesh.triangles) for mesh, _ in shared) * max(len(shared), 1)
        count = int(np.clip(_PAIRS // max(pairs, 1), _FEWEST_POINTS, _MOST_POINTS))
        for mesh, sign in shared:
            points = _random_points(mesh, count, rng)
            multiplicities = sum(other * _covering(points, candidate, _CLOSENESS * size) for candidate, other in shared)
            terms = sign * np.asarray(multiplicities)
            value += 2 * mesh.area * (float(terms.mean()) - 1)
            variance += (2 * mesh.area) ** 2 * float(terms.var()) / count
        return cls(max(value, 0.0), variance**0.5)


def beyond(
    octaves: Sequence[Octave],
    sums: Sequence[OctaveSums],
    limit: EnergyLimit,
    orders: Sequence[float],
    inner: Sequence[float] = (),
) -> tuple[Reals, Reals]:
    """Return the integrals beyond the last octave (orders,), and how far off they may be.

    Args:
        octaves: Octaves that were measured.
        sums: Integrals over them.
        limit: Limit of the energy.
        orders: Orders s.
        inner: Energies in the last octaves before the measured ones, from the inside out.
    """
    if not octaves:
        return np.zeros(len(orders)), np.full(len(orders), np.inf)
    tails = np.array([tail_integral(octaves[-1].highest, order) for order in orders])
    energies = np.array([*inner, *(one.energy for one in sums)])
    deviations = np.array([*(0.0 for _ in inner), *(one.energy_deviation for one in sums)])
    mean, uncertain = _approach(limit.value, energies, deviations)
    return mean * tails, (uncertain + 3 * limit.deviation + limit.spread) * tails


def _approach(limit: float, energies: Reals, deviations: Reals) -> tuple[float, float]:
    """Return the mean energy beyond the last octave, and how far off it may be.

    Where the energy approaches its limit in a regular way, it goes on to do so. Else it may oscillate: between parallel
    surfaces it grows like |ξ|², rises through the limit to twice it, and swings about it until |ξ| is several times the
    inverse of their distance. Then the larger of its last two distances from the limit bounds the next ones. What was
    foreseen after an earlier octave holds on if the later ones agree with it.
    """
    gaps = limit - energies
    # Noise does not make a distance.
    sizes = np.maximum(np.abs(gaps) - 2 * deviations, 0.0)
    envelope, mean, uncertain = sizes[0], limit, np.inf
    for last, energy in enumerate(energies):
        before, envelope = envelope, max(_SLOWEST_FALL * envelope, sizes[last])
        expected, spread = limit, _CAUTION * max(before, envelope)
        fall = _regular_fall(limit, gaps[: last + 1])
        if last and _STEEPEST_GROWTH * energies[last - 1] < energy < limit:
            spread = max(spread, _SWING * limit)
        elif fall is not None:
            expected = limit - fall * gaps[last] / 2
            spread = (0.5 + _OVERSHOOT) * fall * gaps[last] + 3 * deviations[last]
        if spread <= uncertain or abs(energy - mean) > uncertain + 2 * deviations[last]:
            mean, uncertain = expected, spread
    return float(mean), float(uncertain)


def _regular_fall(limit: float, gaps: Reals) -> float | None:
    """Return the ratio of the energy's last two distances from its limit, or None unless they fall regularly.

    Energies that have just grown like |ξ|² may be about to swing.
    """
    if len(gaps) < _REGULAR or not np.all(gaps[-_REGULAR:] > 0):
        return None
    energies = limit - gaps[-_REGULAR:]
    if np.any(energies[1:] > _STEEPEST_GROWTH * energies[:-1]):
        return None
    falls = gaps[1 - _REGULAR :] / gaps[-_REGULAR:-1]
    is_regular = falls[-1] >= _FASTEST_FALL and falls[-1] >= _LEAST_STEADINESS * falls[-2]
    return float(min(falls[-1], 1.0)) if is_regular else None


@lru_cache(maxsize=1024)
def tail_integral(cutoff: float, order: float) -> float:
    """Return ∫ (1 - step(r)) (1+r²)^s dr over all r, for the smooth step that ends at a cutoff."""
    from scipy.integrate import quad

    def integrand(radius: float) -> float:
        return float((1 - smooth_step(np.array(radius), cutoff)) * (1 + radius**2) ** order)

    exponent = -order - 0.5
    # With q = 1/(1+r²), ∫_R^∞ (1+r²)^s dr is half an incomplete beta integral.
    rest = 0.5 * beta(exponent, 0.5) * betainc(exponent, 0.5, 1 / (1 + cutoff**2))
    return float(rest + quad(integrand, cutoff / 2, cutoff)[0])


def _in_common_planes(meshes: Sequence[Mesh], size: float) -> list[Mesh | None]:
    """Return of each mesh the triangles whose plane is that of another triangle, of any mesh; None for none."""
    planes = [_planes(mesh, size) for mesh in meshes]
    together = np.sort(np.concatenate([np.zeros(0), *planes]))
    chosen = []
    for mesh, own in zip(meshes, planes, strict=True):
        first = np.searchsorted(together, own - _PLANE_CLOSENESS, "left")
        last = np.searchsorted(together, own + _PLANE_CLOSENESS, "right")
        triangles = mesh.triangles[(last - first > 1) & np.isfinite(own)]
        has_area = len(triangles) > 0 and Mesh.from_checked(mesh.vertices, triangles).area > 0
        chosen.append(Mesh.from_checked(mesh.vertices, triangles) if has_area else None)
    return chosen


def _planes(mesh: Mesh, size: float) -> Reals:
    """Return a number for the plane of each triangle, the same in coinciding planes; NaN without an area."""
    planes = np.empty(len(mesh.triangles))
    for first in range(0, len(planes), _BATCH):
        batch = slice(first, first + _BATCH)
        a, b, c = mesh.corners(batch)
        normals = np.cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        # Either side of a triangle may be its front.
        normals = without_sign(normals)
        offsets = np.einsum("ij,ij->i", normals, a) / max(size, np.finfo(np.float64).tiny)
        planes[batch] = normals @ _OF_NORMAL + _OF_OFFSET * offsets
    return planes


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
