"""Triangle meshes: the vertices and triangles of a surface, checked once and then frozen."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.shapes.extent import DIRECTIONS, Extent

Corners = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
# From the first corner to the second and to the third, (3, k) each: one row an axis.
_Edges = tuple[NDArray[np.float64], NDArray[np.float64]]
_Scalar = TypeVar("_Scalar", bound=np.generic)

_EVERYTHING = slice(None)
# Triangles that are measured at a time: their edges and temporaries stay in cache.
_SLICE = 1 << 14

# The squared distance of two vertices further out may overflow.
_LARGEST_COORDINATE = 1e150

# Odd numbers without pattern, that spread three indices over 64 bits.
_MIXERS = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xC2B2AE3D27D4EB4F)

# Twice the rounding error of a cross product, relative to the squared longest edge: an area below
# this is not distinguishable from zero in double precision.
_AREA_RESOLUTION = 8 * np.finfo(np.float64).eps


@dataclass(frozen=True)
class MeshCounts:
    """What is unusual about a mesh. All of it is legitimate in a surface measure, none is repaired.

    Attributes:
        zero_area: triangles whose area is zero to double precision.
        duplicate: triangles that repeat the three vertices of an earlier one, in any orientation.
        boundary_edges: edges of exactly one triangle.
        nonmanifold_edges: edges of more than two triangles.
    """

    zero_area: int
    duplicate: int
    boundary_edges: int
    nonmanifold_edges: int


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in three-dimensional space, as a sum of flat area measures.

    Args:
        vertices: real array (n, 3), finite, in the user's unit of length.
        triangles: integer array (m, 3) of indices into ``vertices``, m > 0.

    Both are copied, converted to float64 and int64 and made read-only; arrays that are all of this
    already, and own their memory, are shared. Zero-area triangles, duplicates, open boundaries and
    non-manifold edges are kept; `counts` reports them.

    Raises:
        MeshError: coordinates that are not finite, indices that are negative, out of range or not
            integers, no triangles, or a total area of zero; the message names the entries.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]

    def __init__(self, vertices: ArrayLike, triangles: ArrayLike) -> None:
        checked_vertices = _check_vertices(vertices)
        checked_triangles = _check_triangles(triangles, len(checked_vertices))
        object.__setattr__(self, "vertices", checked_vertices)
        object.__setattr__(self, "triangles", checked_triangles)
        largest = float(np.abs(checked_vertices).max(initial=0.0))
        if largest > _LARGEST_COORDINATE or not np.isfinite(self.area):
            raise MeshError(
                "the mesh has coordinates so large that areas or squared lengths overflow double precision: "
                f"largest absolute coordinate {largest:.3g}; rescale it"
            )
        if not self._has_area():
            raise MeshError(
                f"the total area of the {len(checked_triangles)} triangles is zero: every one is "
                "degenerate, so there is no surface measure to compare"
            )

    @classmethod
    def of_checked(cls, vertices: NDArray[np.float64], triangles: NDArray[np.int64]) -> Mesh:
        """A mesh of arrays that were checked before, such as parts of a mesh; they become its own."""
        mesh = object.__new__(cls)
        object.__setattr__(mesh, "vertices", _frozen(vertices))
        object.__setattr__(mesh, "triangles", _frozen(triangles))
        return mesh

    def corners(self, part: slice | NDArray[np.int64] = _EVERYTHING) -> Corners:
        """The first, second and third corners of all or some triangles, each (k, 3)."""
        chosen = self.triangles[part]
        return self.vertices[chosen[:, 0]], self.vertices[chosen[:, 1]], self.vertices[chosen[:, 2]]

    @cached_property
    def areas(self) -> NDArray[np.float64]:
        """Area of each triangle (m,), in squared units of length."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self._per_triangle(_areas)

    @cached_property
    def area(self) -> float:
        """Total area, in squared units of length."""
        with np.errstate(over="ignore", invalid="ignore"):
            return float(self.areas.sum())

    @property
    def edge_lengths(self) -> NDArray[np.float64]:
        """Lengths of the three sides of each triangle (m, 3); an inner edge appears twice."""
        return self._per_triangle(_side_lengths)

    @cached_property
    def edge_length_range(self) -> tuple[float, float]:
        """Mean and maximum of the `edge_lengths`, which are not held for it."""
        total, longest = 0.0, 0.0
        for edges in self._edges():
            lengths = _side_lengths(edges)
            total += float(lengths.sum())
            longest = max(longest, float(lengths.max()))
        return total / (3 * len(self.triangles)), longest

    @cached_property
    def centroid_radii(self) -> NDArray[np.float64]:
        """Distance from each triangle's centroid to its farthest corner (m,)."""
        return self._per_triangle(_centroid_radii)

    @cached_property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner of the bounding box of the vertices that triangles use, (3,) each."""
        used = self.used_coordinates
        return _frozen(used.min(axis=1)), _frozen(used.max(axis=1))

    @cached_property
    def extent(self) -> Extent:
        """Extent of the vertices that triangles use along `DIRECTIONS`."""
        coordinates = self.used_coordinates
        lowest, highest = np.full(len(DIRECTIONS), np.inf), np.full(len(DIRECTIONS), -np.inf)
        for first in range(0, coordinates.shape[1], _SLICE):
            along = DIRECTIONS @ coordinates[:, first : first + _SLICE]
            np.minimum(lowest, along.min(axis=1), out=lowest)
            np.maximum(highest, along.max(axis=1), out=highest)
        return Extent(tuple(lowest.tolist()), tuple(highest.tolist()))

    @property
    def bounding_sphere(self) -> tuple[tuple[float, float, float], float]:
        """Centre of the bounding box, and the distance from there to the farthest vertex that a triangle uses.

        Flat meshes have one too, unlike a minimal sphere from a convex hull.
        """
        lower, upper = self.bounds
        center = lower + (upper - lower) / 2
        radius = float(np.linalg.norm(self.vertices[self.used_vertices] - center, axis=1).max())
        return (float(center[0]), float(center[1]), float(center[2])), radius

    def moved(self, scale: float, origin: tuple[float, float, float]) -> Mesh:
        """Return the mesh after x -> scale * (x - origin)."""
        vertices = self.vertices - np.asarray(origin)
        vertices *= scale
        # Read-only, so that the mesh takes it over: of huge meshes a copy would count.
        vertices.setflags(write=False)
        return Mesh(vertices, self.triangles)

    @cached_property
    def used_vertices(self) -> NDArray[np.int64]:
        """Indices of the vertices that triangles use, in ascending order."""
        used = np.zeros(len(self.vertices), dtype=bool)
        used[self.triangles] = True
        return _frozen(np.flatnonzero(used).astype(np.int64))

    @property
    def used_coordinates(self) -> NDArray[np.float64]:
        """The vertices that triangles use, one contiguous row an axis (3, n), in units of length."""
        return np.ascontiguousarray(self.vertices[self.used_vertices].T)

    @cached_property
    def counts(self) -> MeshCounts:
        """How many triangles and edges are degenerate, duplicate, open or non-manifold."""
        single, many = _edge_sharing(self.triangles, len(self.vertices))
        return MeshCounts(
            zero_area=sum(
                int(np.count_nonzero(self.areas[part] <= smallest)) for part, smallest in self._smallest_areas()
            ),
            duplicate=_duplicates(self.triangles),
            boundary_edges=single,
            nonmanifold_edges=many,
        )

    def parts(self, size: int) -> Iterator[tuple[int, Mesh]]:
        """The mesh in numbered parts of at most ``size`` triangles, each with the vertices that it uses alone.

        Parts without area are left out: what they would add to a transform is zero.
        """
        number = np.empty(len(self.vertices), dtype=np.int64)
        for part, start in enumerate(range(0, len(self.triangles), size)):
            triangles = self.triangles[start : start + size]
            if not np.any(self.areas[start : start + size] > 0):
                continue
            used = np.zeros(len(self.vertices), dtype=bool)
            used[triangles] = True
            there = np.flatnonzero(used)
            number[there] = np.arange(len(there))
            yield part, Mesh.of_checked(self.vertices[there], number[triangles])

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the vertices and triangles, in hexadecimal."""
        digest = hashlib.sha256()
        for array in (self.vertices, self.triangles):
            digest.update(str(array.shape).encode())
            digest.update(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).data)
        return digest.hexdigest()

    def _has_area(self) -> bool:
        return any(bool(np.any(self.areas[part] > smallest)) for part, smallest in self._smallest_areas())

    def _smallest_areas(self) -> Iterator[tuple[slice, NDArray[np.float64]]]:
        """The areas of triangles that could as well be zero, given the rounding of their sides, slice by slice."""
        for number, edges in enumerate(self._edges()):
            with np.errstate(over="ignore"):
                longest: NDArray[np.float64] = _side_lengths(edges).max(axis=1)
                yield slice(number * _SLICE, (number + 1) * _SLICE), _AREA_RESOLUTION * longest**2

    def _per_triangle(self, measure: Callable[[_Edges], NDArray[np.float64]]) -> NDArray[np.float64]:
        """A measure of all triangles, taken slice by slice: edges of millions at once take gigabytes."""
        parts = self._edges()
        first = measure(next(parts))
        values = np.empty((len(self.triangles), *first.shape[1:]))
        values[: len(first)] = first
        for number, edges in enumerate(parts, 1):
            values[number * _SLICE : (number + 1) * _SLICE] = measure(edges)
        return _frozen(values)

    def _edges(self) -> Iterator[_Edges]:
        """The edges of each slice of triangles."""
        columns = [np.ascontiguousarray(column) for column in self.vertices.T]
        for start in range(0, len(self.triangles), _SLICE):
            a, b, c = np.ascontiguousarray(self.triangles[start : start + _SLICE].T)
            first, second = np.empty((3, len(a))), np.empty((3, len(a)))
            for axis, column in enumerate(columns):
                origins = column[a]
                np.subtract(column[b], origins, out=first[axis])
                np.subtract(column[c], origins, out=second[axis])
            yield first, second

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices)} vertices, {len(self.triangles)} triangles)"

    def __reduce__(self) -> tuple[type[Mesh], tuple[NDArray[np.float64], NDArray[np.int64]]]:
        return Mesh, (self.vertices, self.triangles)


def _areas(edges: _Edges) -> NDArray[np.float64]:
    (ux, uy, uz), (vx, vy, vz) = edges
    return np.asarray(0.5 * np.sqrt((uy * vz - uz * vy) ** 2 + (uz * vx - ux * vz) ** 2 + (ux * vy - uy * vx) ** 2))


def _side_lengths(edges: _Edges) -> NDArray[np.float64]:
    first, second = edges
    return np.stack([np.sqrt(np.einsum("ij,ij->j", side, side)) for side in (first, second - first, second)], axis=1)


def _centroid_radii(edges: _Edges) -> NDArray[np.float64]:
    first, second = edges
    centroid = (first + second) / 3
    squares = [np.einsum("ij,ij->j", arm, arm) for arm in (centroid, first - centroid, second - centroid)]
    return np.asarray(np.sqrt(np.maximum.reduce(squares)))


def _edge_sharing(triangles: NDArray[np.int64], vertex_count: int) -> tuple[int, int]:
    """How many edges belong to exactly one triangle, and to more than two."""
    edges = np.empty(3 * len(triangles), dtype=np.int64)
    for start in range(0, len(triangles), _SLICE):
        low, middle, high = np.sort(triangles[start : start + _SLICE], axis=1).T
        found = edges[3 * start : 3 * (start + len(low))].reshape(3, -1)
        # A triangle that repeats a vertex has fewer than three edges, each once.
        found[0] = np.where(low == middle, -1, low * vertex_count + middle)
        found[1] = np.where(middle == high, -1, middle * vertex_count + high)
        found[2] = np.where((low == middle) | (middle == high), -1, low * vertex_count + high)
    edges.sort()
    edges = edges[np.searchsorted(edges, 0) :]
    if not edges.size:
        return 0, 0
    repeats = np.concatenate([[False], edges[1:] == edges[:-1], [False, False]])
    starts, again, third = ~repeats[:-2], repeats[1:-1], repeats[2:]
    return int(np.count_nonzero(starts & ~again)), int(np.count_nonzero(starts & again & third))


def _duplicates(triangles: NDArray[np.int64]) -> int:
    """How many triangles repeat the three vertices of an earlier one."""
    hashes = np.empty(len(triangles), dtype=np.uint64)
    for start in range(0, len(triangles), _SLICE):
        low, middle, high = np.sort(triangles[start : start + _SLICE], axis=1).astype(np.uint64).T
        hashes[start : start + len(low)] = (low * _MIXERS[0] + middle) * _MIXERS[1] + high
    ordered = np.sort(hashes)
    repeated = np.unique(ordered[1:][ordered[1:] == ordered[:-1]])
    if not repeated.size:
        return 0
    # Different triangles may have one hash, so those that share one are compared themselves.
    places = np.minimum(np.searchsorted(repeated, hashes), len(repeated) - 1)
    suspects = np.sort(triangles[repeated[places] == hashes], axis=1)
    return len(suspects) - len(np.unique(suspects, axis=0))


def _array(values: ArrayLike, name: str) -> NDArray[Any]:
    if np.ma.is_masked(values):
        raise MeshError(f"{name} have masked entries")
    try:
        return np.asarray(values)
    except ValueError as error:
        raise MeshError(f"{name} must be an array of rows of three, found rows of different lengths") from error


def _check_vertices(vertices: ArrayLike) -> NDArray[np.float64]:
    found = _array(vertices, "vertices")
    if found.dtype.kind not in "fiu":
        raise MeshError(f"vertices must be real numbers, found dtype {found.dtype}")
    if found.ndim != 2 or found.shape[1] != 3:
        raise MeshError(f"vertices must have shape (n, 3), found {found.shape}")
    with np.errstate(over="ignore"):
        converted = _owned(found, np.float64)
    bad = np.flatnonzero(~np.isfinite(converted).all(axis=1))
    if bad.size:
        raise MeshError(f"{bad.size} of {len(found)} vertices have NaN or infinite coordinates: {_listed(bad, found)}")
    return _frozen(converted)


def _check_triangles(triangles: ArrayLike, vertex_count: int) -> NDArray[np.int64]:
    found = _array(triangles, "triangles")
    if found.size == 0:
        raise MeshError("the mesh has no triangles")
    if found.dtype.kind not in "iu":
        raise MeshError(f"triangles must be integer indices, found dtype {found.dtype}")
    if found.ndim != 2 or found.shape[1] != 3:
        raise MeshError(f"triangles must have shape (m, 3), found {found.shape}")
    if found.min() < 0 or found.max() >= vertex_count:
        bad = np.flatnonzero(((found < 0) | (found >= vertex_count)).any(axis=1))
        raise MeshError(
            f"{bad.size} of {len(found)} triangles have indices outside 0..{vertex_count - 1}: {_listed(bad, found)}"
        )
    return _frozen(_owned(found, np.int64))


def _owned(array: NDArray[Any], dtype: type[_Scalar]) -> NDArray[_Scalar]:
    """The array itself where nobody can change it any more, else a copy."""
    settled = array.dtype == dtype and array.flags.c_contiguous and array.flags.owndata and not array.flags.writeable
    return array if settled else np.array(array, dtype=dtype, order="C")


def _listed(rows: NDArray[np.intp], values: NDArray[np.generic], limit: int = 3) -> str:
    shown = ", ".join(f"#{row} = {values[row].tolist()}" for row in rows[:limit])
    return shown + (", ..." if len(rows) > limit else "")


def _frozen(array: NDArray[_Scalar]) -> NDArray[_Scalar]:
    array.setflags(write=False)
    return array
