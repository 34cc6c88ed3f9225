"""Points on surfaces that nothing escapes: evenly spread, no farther apart than a reach, or where much was seen."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from sobolev_batch.arrays import Indices, Reals, slices
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.closed_forms import Sphere
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.smooth import Interval, Smooth
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.norms.tail.potentials import SignedTriangles, centers_and_radii
from sobolev_batch.transform.resolution import resolution_of

# Cells along each parameter that a smooth surface is replaced by: the most, and how many for a node of its transform.
_MOST_CELLS, _CELLS_PER_NODE, _TRIANGULATION_TOLERANCE = 320, 7, 1e-4
# Triangles whose corners are held at a time, and the most pieces that long ones are cut into.
_HELD, _MOST_PIECES = 1 << 18, 2_000_000
# Triangles of a smaller fraction of a squared spacing stay whole.
_POINTLESS = 16
# Bits for the place of a cell along an axis.
_AXIS_BITS = 20
# Neighbours whose potentials tell how much there is around a point, the share of points that follow the area alone, and
# the fraction of the largest share of a triangle below which it gets next to none.
_NEIGHBOURS, _EVEN_SHARE, _UNSEEN = 8, 0.25, 1e-6


class Draw(NamedTuple):
    """Random points on a signed sum of surfaces.

    Attributes:
        points: Float64 (n, 3), or (2, n, 3) for pairs.
        weights: Inverse density times the sign of the surface of each point (n,) or (2, n): Σ weights · f is the
            integral of f over the signed sum, in expectation.
    """

    points: Reals
    weights: Reals


@dataclass(frozen=True, eq=False)
class Moved:
    """Two meshes with the same triangles, of opposite signs: a point on one has its counterpart on the other."""

    meshes: Sequence[tuple[Mesh, int]]

    @cached_property
    def areas(self) -> Reals:
        """Area of each triangle, of both meshes together (m,)."""
        return np.asarray(sum(mesh.areas for mesh, _ in self.meshes))

    def in_proportion(self, densities: Reals, count: int, rng: np.random.Generator) -> tuple[Draw, Reals, Indices]:
        """Draw pairs in proportion to densities (m,), most of them, and evenly by area for the others.

        Return also the squared distance of each point from the plane of the other's triangle (2, n), and these (n,).
        """
        shares = _shares(self.areas, densities)
        chosen, barycentric = _places(np.cumsum(shares), count, rng)
        corners = np.stack([mesh.vertices[mesh.triangles[chosen]] for mesh, _ in self.meshes])
        points = np.einsum("nk,snkd->snd", barycentric, corners)
        normals = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
        squares = np.maximum((normals**2).sum(axis=2), np.finfo(np.float64).tiny)
        heights = np.einsum("nd,snd->sn", points[1] - points[0], normals[::-1]) ** 2 / squares[::-1]
        weights = np.array([[sign / 2 / count] for _, sign in self.meshes]) * np.sqrt(squares) / shares[chosen]
        return Draw(points, weights), heights, chosen


@dataclass(frozen=True, eq=False)
class Sheets:
    """Surfaces as meshes and spheres with their signs, on which points are drawn in an order that follows space.

    Attributes:
        meshes: Meshes, and those that stand for smooth surfaces.
        spacing: Triangles are in the order of cells of this width, and long ones are cut into pieces no longer.
        lacking: Area that meshes which stand for smooth surfaces lack.
    """

    meshes: Sequence[tuple[Mesh, int]]
    spheres: Sequence[tuple[Sphere, int]]
    spacing: float = np.inf
    lacking: float = 0.0

    @classmethod
    def from_surfaces(cls, surfaces: Sequence[Surface], signs: Sequence[int], cutoff: float) -> Self:
        """Return the sheets of surfaces; smooth ones become meshes that are fine beside the wavelength at a cutoff."""
        replaced = [_triangulated(one, cutoff) if isinstance(one, Smooth) else one for one in surfaces]
        signed = list(zip(replaced, signs, strict=True))
        meshes = [(one, sign) for one, sign in signed if isinstance(one, Mesh)]
        spheres = [(one, sign) for one, sign in signed if isinstance(one, Sphere)]
        lacking = sum(surface.area - one.area for surface, one in zip(surfaces, replaced, strict=True))
        return cls(meshes, spheres, lacking=lacking)

    @property
    def cancel(self) -> bool:
        """True where the sum has differences."""
        return len(set(self._signs)) > 1

    @cached_property
    def moved(self) -> Moved | None:
        """The two meshes with the same triangles that the sheets are; None if they are others."""
        if self.spheres or len(self.meshes) != 2 or not self.cancel:
            return None
        (one, _), (other, _) = self.meshes
        is_same = len(one.vertices) == len(other.vertices) and np.array_equal(one.triangles, other.triangles)
        return Moved(self.meshes) if is_same else None

    @property
    def _signs(self) -> list[int]:
        return [sign for _, sign in (*self.meshes, *self.spheres)]

    @property
    def area(self) -> float:
        """Area of all surfaces together."""
        return sum(mesh.area for mesh, _ in self.meshes) + sum(sphere.area for sphere, _ in self.spheres)

    @cached_property
    def reach(self) -> float:
        """Largest |coordinate|."""
        reaches = [mesh.extent.reach for mesh, _ in self.meshes]
        return max([0.0, *reaches, *(sphere.extent.reach for sphere, _ in self.spheres)])

    def triangles(self) -> Iterator[SignedTriangles]:
        """Yield the triangles of the meshes, not too many at a time."""
        for mesh, sign in self.meshes:
            for part in slices(len(mesh.triangles), _HELD):
                yield SignedTriangles.with_area(mesh.vertices[mesh.triangles[part]], sign, self.reach)

    @cached_property
    def _parts(self) -> list[Mesh | Sphere]:
        """Meshes whose triangles follow space, the long ones in pieces, and spheres."""
        return [*(_ordered(mesh, self.spacing) for mesh, _ in self.meshes), *(sphere for sphere, _ in self.spheres)]

    @cached_property
    def _areas(self) -> list[Reals]:
        """Area of each triangle or piece of each mesh, and of each sphere."""
        return [part.areas if isinstance(part, Mesh) else np.array([part.area]) for part in self._parts]

    @cached_property
    def _levels(self) -> Reals:
        """Area up to the end of each triangle, piece or sphere (m,)."""
        return np.cumsum(np.concatenate(self._areas))

    @cached_property
    def centers(self) -> Reals:
        """Centroid of each triangle, piece or sphere (m, 3)."""
        corners = (part.vertices[part.triangles] for part in self._parts if isinstance(part, Mesh))
        of_spheres = ([sphere.center] for sphere, _ in self.spheres)
        return np.concatenate([*(centers_and_radii(one)[0] for one in corners), *of_spheres])

    def around(self, points: Reals, seen: Reals) -> Reals:
        """Return the most that points (n,) nearby saw, for each triangle, piece or sphere (m,)."""
        from scipy.spatial import KDTree

        _, near = KDTree(points).query(self.centers, k=min(_NEIGHBOURS, len(seen)))
        return np.asarray(seen[near.reshape(len(self.centers), -1)].max(axis=1))

    def largest(self, densities: Reals, count: int) -> Indices:
        """Return the triangles, pieces or spheres on which densities (m,) put the most points, at most a number."""
        shares = np.diff(self._levels, prepend=0.0) * densities
        return np.argsort(-shares)[: min(count, np.count_nonzero(shares > _UNSEEN * shares.max()))]

    def even(self, count: int, rng: np.random.Generator) -> Draw:
        """Draw points evenly by area, one on each of equal parts."""
        return self._drawn(count, self._levels, np.broadcast_to(self._levels[-1] / count, self._levels.shape), rng)

    def in_proportion(self, densities: Reals, count: int, rng: np.random.Generator) -> Draw:
        """Draw points in proportion to densities (m,), most of them, and evenly by area for the others."""
        areas = np.diff(self._levels, prepend=0.0)
        shares = _shares(areas, densities)
        weights = np.divide(areas, count * shares, out=np.zeros_like(areas), where=shares > 0)
        return self._drawn(count, np.cumsum(shares), weights, rng)

    def _drawn(self, count: int, levels: Reals, weights: Reals, rng: np.random.Generator) -> Draw:
        """Draw one point for each of equal parts of the cumulative shares (m,) of triangles, pieces and spheres.

        The weights (m,) are those of a point on each of them.
        """
        chosen, barycentric = _places(levels, count, rng)
        directions = rng.normal(size=(count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        points, signed, start = np.empty((count, 3)), weights[chosen], 0
        for part, areas, sign in zip(self._parts, self._areas, self._signs, strict=True):
            here = (chosen >= start) & (chosen < start + len(areas))
            signed[here] *= sign
            if isinstance(part, Sphere):
                points[here] = part.center + part.radius * directions[here]
            else:
                a, b, c = part.corners(chosen[here] - start)
                r, s, t = barycentric[here].T[..., None]
                points[here] = r * a + s * b + t * c
            start += len(areas)
        return Draw(points, signed)


def _shares(areas: Reals, densities: Reals) -> Reals:
    """Return the shares of points in proportion to densities, most of them, and by area alone."""
    return np.asarray(areas * (_EVEN_SHARE / areas.sum() + (1 - _EVEN_SHARE) * densities / (areas @ densities)))


def _places(levels: Reals, count: int, rng: np.random.Generator) -> tuple[Indices, Reals]:
    """Return a piece for each of equal parts of cumulative shares (m,), and barycentric coordinates (n, 3) there."""
    places = (np.arange(count) + rng.random(count)) / count * levels[-1]
    first, second = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    chosen = np.minimum(np.searchsorted(levels, places), len(levels) - 1)
    return chosen, np.concatenate([1 - first, first * (1 - second), first * second], axis=1)


def _ordered(mesh: Mesh, spacing: float) -> Mesh:
    """Return a mesh with its triangles in the order of cells of some width, and long ones cut at their longest edge."""
    vertices, triangles = mesh.vertices, mesh.triangles
    long, whole = _pieces_of_long(mesh, spacing)
    if len(long):
        triangles = np.concatenate([triangles[whole], len(vertices) + np.arange(3 * len(long)).reshape(-1, 3)])
        vertices = np.concatenate([vertices, long.reshape(-1, 3)])
    if spacing == np.inf:
        return mesh
    low, high = mesh.extent.box
    width = max(spacing, float(np.max(high - low)) / ((1 << _AXIS_BITS) - 1))
    keys = np.empty(len(triangles), dtype=np.int64)
    for part in slices(len(triangles), _HELD):
        a, b, c = triangles[part].T
        x, y, z = (((vertices[a] + vertices[b] + vertices[c]) / 3 - low) / width).astype(np.int64).T
        keys[part] = (((x << _AXIS_BITS) | y) << _AXIS_BITS) | z
    return Mesh.from_checked(vertices, np.ascontiguousarray(triangles[np.argsort(keys, kind="stable")]))


def _pieces_of_long(mesh: Mesh, spacing: float) -> tuple[Reals, Indices]:
    """Return pieces (n, 3, 3) of triangles with edges longer than a spacing, and the triangles that have none."""
    if mesh.edge_length_range[1] <= spacing:
        return np.zeros((0, 3, 3)), np.arange(len(mesh.triangles))
    # A triangle of less area than one in some points has would not get another point.
    is_long = (mesh.areas > spacing**2 / _POINTLESS) & (mesh.edge_lengths.max(axis=1) > spacing)
    done, pieces = [], mesh.vertices[mesh.triangles[is_long]]
    while len(pieces):
        # Of the edge behind each corner.
        lengths = np.linalg.norm(np.roll(pieces, -1, axis=1) - pieces, axis=2)
        short = lengths.max(axis=1) <= spacing
        done.append(pieces[short])
        pieces, longest = pieces[~short], lengths[~short].argmax(axis=1)
        if sum(map(len, done)) + 2 * len(pieces) > _MOST_PIECES:
            done.append(pieces)
            break
        turned = (longest[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(pieces[np.arange(len(pieces))[:, None], turned], 1, 0)
        middle = (a + b) / 2
        pieces = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    return np.concatenate([np.zeros((0, 3, 3)), *done]), np.flatnonzero(~is_long)


def _triangulated(surface: Smooth, cutoff: float) -> Mesh:
    """Return a mesh of a smooth surface that is fine beside it and beside the wavelength at a cutoff."""
    try:
        counts, _ = resolution_of(surface, cutoff, _TRIANGULATION_TOLERANCE)
    except InputError:
        counts = (_MOST_CELLS, _MOST_CELLS)
    cells = (min(_CELLS_PER_NODE * count, _MOST_CELLS) for count in counts)
    # With the middles of cells, which tell how far facets lie from the surface.
    fine = [_grid(interval, 2 * count) for interval, count in zip(surface.intervals, cells, strict=True)]
    positions = np.moveaxis(surface.positions(*np.meshgrid(*fine, indexing="ij", sparse=True)), 0, -1)
    corners = _facing_both_sides(positions)
    rows, columns, _ = corners.shape
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    across, both = first + columns, first + columns + 1
    triangles = np.concatenate([np.stack([first, across, both], 1), np.stack([first, both, first + 1], 1)])
    return Mesh.from_checked(corners.reshape(-1, 3), triangles)


def _facing_both_sides(positions: Reals) -> Reals:
    """Return corners of facets whose mean distance from a surface is next to zero, from its positions (2m+1, 2n+1, 3).

    Facets between positions lie within a ball, and its distance from a sphere of nearly the same size was off by 3 %.
    In the mean, one lies off the surface by a third of what the middles of its edges do together.
    """
    corners = positions[::2, ::2]
    moves = np.zeros_like(corners)
    for u, v in ((1, 0), (0, 1), (1, 1)):
        firsts, lasts = (slice(-u or None), slice(-v or None)), (slice(u, None), slice(v, None))
        offsets = positions[u::2, v::2] - (corners[firsts] + corners[lasts]) / 2
        sums, counts = np.zeros_like(corners), np.zeros((*corners.shape[:2], 1))
        for ends in (firsts, lasts):
            sums[ends] += offsets
            counts[ends] += 1
        moves += sums / np.maximum(counts, 1) / 3
    return np.asarray(corners + moves)


def _grid(interval: Interval, cells: int) -> Reals:
    """Return ends of cells along a parameter, denser at the ends of one that is not periodic: there may be a pole."""
    fractions = np.linspace(0, 1, cells + 1)
    if not interval.periodic:
        fractions = (1 - np.cos(np.pi * fractions)) / 2
    return np.asarray(interval.low + interval.length * fractions)
