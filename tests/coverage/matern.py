"""Sobolev norms in real space: a Matérn kernel, integrated over spheres and triangles.

With a = -s > 1/2, ||m||_s² = ∬ K_a(|x-y|) dm dm, where K_a(r) = 2 π^a / Γ(a) · r^(a-3/2) · K_{a-3/2}(2πr).
If a is a whole number of at least 2, the kernel is exp(-2πr) times a polynomial (DLMF 10.49.12). For a <= 3/2 it
is infinite at r = 0, but its integrals over surfaces are not.
This module uses no frequencies, lattices or fields, and none of the package's rules.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations_with_replacement

import numpy as np
import trimesh
from scipy.spatial.distance import cdist
from scipy.special import gamma, k0, k1, kv

from sobolev_batch import Mesh
from sobolev_batch.arrays import Reals
from sobolev_batch.shapes import Sphere

# Points per side of a tile of the double sum: its temporaries stay in the processor's cache.
_TILE = 384
# Pairs of a point and a node on an edge that are held at a time.
_HELD = 1 << 17
# Nodes on either side of a point's foot on an edge.
_EDGE_NODES = 16
# Powers up to which the kernel is infinite at zero.
_SINGULAR = 1.5
# Places that differ by no more than rounding.
_SAME_PLACE = 1e-12


def kernel(distances: Reals, power: float, decay: Reals | None = None) -> Reals:
    """Return K_a at some distances; `decay` is exp(-2πr) if that was computed before."""
    z = 2 * np.pi * distances
    if power < 2 or power != round(power):
        return _bessel_kernel(z, power)
    power = round(power)
    decay = np.exp(-z) if decay is None else decay
    first, *rest = _coefficients(power)
    value = np.full_like(z, first)
    for coefficient in rest:
        value *= z
        value += coefficient
    value *= decay
    return np.asarray(value)


def _bessel_kernel(z: Reals, power: float) -> Reals:
    """Return K_a where it is no polynomial, z = 2πr; at zero its limit, which may be infinite."""
    nu = power - 1.5
    factor = 2 * np.pi**power / gamma(power) * (2 * np.pi) ** -nu
    limit = factor * 2.0 ** (nu - 1) * gamma(nu) if nu > 0 else np.inf
    with np.errstate(divide="ignore", invalid="ignore"):
        if nu == -0.5:
            value = factor * np.sqrt(np.pi / 2) * np.exp(-z) / z
        elif nu in (0.0, 1.0):
            value = factor * (k1(z) * z if nu else k0(z))
        else:
            value = factor * z**nu * kv(nu, z)
    return np.where(z > 0, value, limit)


def radial_integral(distances: Reals, power: float, decay: Reals | None = None) -> Reals:
    """Return ∫_r^∞ K_a(t) t dt = a K_{a+1}(r) / (2π²); `decay` as for `kernel`."""
    return power / (2 * np.pi**2) * kernel(distances, power + 1, decay)


def sphere_potential(sphere: Sphere, points: Reals, power: float) -> Reals:
    """Return ∫ K_a(|x-y|) dσ(y) over a sphere, at points (n, 3)."""
    apart = np.maximum(np.linalg.norm(points - np.asarray(sphere.center), axis=1), 1e-7)
    shorter, longer = np.abs(apart - sphere.radius), apart + sphere.radius
    return np.asarray(
        2 * np.pi * sphere.radius / apart * (radial_integral(shorter, power) - radial_integral(longer, power))
    )


def double_sum(points: Reals, weights: Reals, powers: Sequence[float]) -> Reals:
    """Return Σ w_i w_j K_a(|x_i - x_j|) for each a; points (n, 3), weights (n,).

    Where a kernel is infinite, points of one place count as far apart as their cells are wide: the error then
    falls by a power of the cells' width, as that of the other pairs does.
    """
    singular = min(powers) <= _SINGULAR
    starts = range(0, len(points), _TILE)

    def tile(pair: tuple[int, int]) -> Reals:
        rows, columns = (slice(start, start + _TILE) for start in pair)
        distances = cdist(points[rows], points[columns])
        if singular:
            i, j = np.nonzero(distances < _SAME_PLACE)
            distances[i, j] = np.abs(weights[rows][i] * weights[columns][j]) ** 0.25
        decay = np.exp(-2 * np.pi * distances)
        count = 1 if rows == columns else 2
        return np.array([count * (weights[rows] @ kernel(distances, a, decay) @ weights[columns]) for a in powers])

    with ThreadPoolExecutor(2) as pool:
        return np.asarray(np.sum(list(pool.map(tile, combinations_with_replacement(starts, 2))), axis=0))


@dataclass(frozen=True)
class Sides:
    """Directed sides of flat faces, by their first ends and lengths, with unit vectors (E, 3).

    Tangents go along the sides, outward vectors away from the face in its plane, and normals out of the plane.
    """

    starts: Reals
    tangents: Reals
    lengths: Reals
    outwards: Reals
    normals: Reals

    @classmethod
    def from_mesh(cls, mesh: Mesh) -> Sides:
        """Return the sides of a mesh's triangles, without those between two triangles of one plane, which cancel."""
        corners = mesh.vertices[mesh.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        starts = corners.reshape(-1, 3)
        ends = np.roll(corners, -1, axis=1).reshape(-1, 3)
        lengths = np.linalg.norm(ends - starts, axis=1)
        tangents = (ends - starts) / lengths[:, None]
        across = np.repeat(normals, 3, axis=0)
        outwards = np.cross(tangents, across)
        keys = np.sort(np.stack([mesh.triangles, np.roll(mesh.triangles, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        same = (keys[:, None] == keys).all(axis=2) & (outwards @ outwards.T < -1 + 1e-13)
        kept = ~same.any(axis=1)
        return cls(starts[kept], tangents[kept], lengths[kept], outwards[kept], across[kept])


def mesh_potentials(sides: Sides, points: Reals, powers: Sequence[float]) -> Reals:
    """Return ∫ K_a(|x-y|) dy over the faces, at points (n, 3), for each a: (len(powers), n).

    In polar coordinates around the foot of x on a face's plane, at the height d over it, the radial
    integral is closed, which leaves one over each side: p ∫ [G(d) - G(r)] / (r² - d²) dt, with p the
    side's distance from the foot and t the place on it. t = √(p²+d²) sinh u gathers nodes near x.
    """
    step = max(1, _HELD // (2 * _EDGE_NODES * len(sides.lengths)))
    parts = [points[first : first + step] for first in range(0, len(points), step)]
    with ThreadPoolExecutor(2) as pool:
        return np.concatenate(list(pool.map(lambda part: _potentials_of_part(sides, part, powers), parts)), axis=1)


def _potentials_of_part(sides: Sides, points: Reals, powers: Sequence[float]) -> Reals:
    relative = sides.starts - points[:, None]
    p, d, t = (np.einsum("xei,ei->xe", relative, along) for along in (sides.outwards, sides.normals, sides.tangents))
    # At low orders a point must not seem to lie off its own face.
    d = np.where(np.abs(d) < _SAME_PLACE, 0.0, d)
    closest = np.maximum(np.hypot(p, d), 1e-12)
    low, high = np.arcsinh(t / closest), np.arcsinh((t + sides.lengths) / closest)
    middle = np.where((low < 0) & (high > 0), 0.0, (low + high) / 2)
    nodes, weights = _gauss(_EDGE_NODES)
    halves = [(low, middle - low), (middle, high - middle)]
    u = np.concatenate([start[..., None] + width[..., None] * nodes for start, width in halves], axis=2)
    du = np.concatenate([width[..., None] * weights for _, width in halves], axis=2)
    r = closest[..., None] * np.cosh(u)
    squared = np.maximum(p[..., None] ** 2 + (closest[..., None] * np.sinh(u)) ** 2, 1e-28)
    factor = p[..., None] * r * du / squared
    decay = np.exp(-2 * np.pi * r)
    falls = (radial_integral(np.abs(d), a)[..., None] - radial_integral(r, a, decay) for a in powers)
    return np.stack([np.einsum("xeq,xeq->x", factor, fall) for fall in falls])


def graded_points(mesh: Mesh, count: int) -> tuple[Reals, Reals]:
    """Return points (n, 3) and weights (n,) on a mesh that gather at the edges and corners of its triangles.

    Each triangle is split into six along its medians. Each of these gets `count` nodes in either direction,
    which gather by a third power towards the corner and the side. Potentials have weak singularities there.
    """
    nodes, weights = _gauss(count)
    graded, slopes = nodes**3, 3 * nodes**2 * weights
    s, t = graded[:, None], graded[None, :]
    reference = (2 * s * slopes[:, None] * slopes[None, :] / 6).ravel()
    corner = [(1 - s / 2 + 0 * t - s * t / 6), (s / 2 - s * t / 6), (s * t / 3)]
    barycentric = np.stack([np.broadcast_to(part, (count, count)).ravel() for part in corner], axis=1)
    triangles = mesh.vertices[mesh.triangles]
    turned = [triangles[:, order] for order in _ORDERS]
    points = np.concatenate([np.einsum("qc,tci->tqi", barycentric, each).reshape(-1, 3) for each in turned])
    return points, np.tile(np.outer(mesh.areas, reference).ravel(), 6)


_ORDERS = ([0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0])

# A symmetric rule of degree 4 with six points (G. R. Cowper 1973, doi:10.1002/nme.1620070316).
_COWPER = ((0.445948490915965, 0.223381589678011), (0.091576213509771, 0.109951743655322))


def divided_points(mesh: Mesh, level: int) -> tuple[Reals, Reals]:
    """Return points (n, 3) and weights (n,) of a rule of degree 4 on a mesh's triangles cut into 4^level."""
    vertices, triangles = mesh.vertices, mesh.triangles
    for _ in range(level):
        vertices, triangles = trimesh.remesh.subdivide(vertices, triangles)
    barycentric = np.array([np.roll([1 - 2 * at, at, at], turn) for at, _ in _COWPER for turn in range(3)])
    weights = np.repeat([weight for _, weight in _COWPER], 3)
    points = np.einsum("qc,tci->tqi", barycentric, vertices[triangles]).reshape(-1, 3)
    return points, np.outer(Mesh(vertices, triangles).areas, weights / weights.sum()).ravel()


@lru_cache
def _gauss(count: int) -> tuple[Reals, Reals]:
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (nodes + 1) / 2, weights / 2


@lru_cache
def _coefficients(power: int) -> tuple[float, ...]:
    """Return c_k of K_a = exp(-z) Σ c_k z^(n-k), z = 2πr, n = a - 2; from the highest power of z to the lowest."""
    n = power - 2
    scale = 2 * math.pi**power / math.factorial(power - 1) * (2 * math.pi) ** (1.5 - power) * math.sqrt(math.pi / 2)
    return tuple(
        scale * math.factorial(n + k) / (math.factorial(n - k) * math.factorial(k) * 2**k) for k in range(n + 1)
    )
