"""Triangle meshes: the vertices and triangles of a surface, checked once and then frozen."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sobolev_batch.errors import MeshError

Corners = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
# From the first corner to the second and to the third, (3, k) each: one row an axis.
_Edges = tuple[NDArray[np.float64], NDArray[np.float64]]
_Scalar = TypeVar("_Scalar", bound=np.generic)

_EVERYTHING = slice(None)
# Triangles that are measured at a time: their edges and temporaries stay in cache.
_SLICE = 1 << 14

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

    Both are copied, converted to float64 and int64 and made read-only. Zero-area triangles,
    duplicates, open boundaries and non-manifold edges are kept; `counts` reports them.

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
        if not np.isfinite(self.area):
            raise MeshError(
                "the mesh has coordinates so large that its area overflows double precision: "
                f"largest absolute coordinate {np.abs(checked_vertices).max():.3g}; rescale it"
            )
        if not np.any(self.areas > self._smallest_areas()):
            raise MeshError(
                f"the total area of the {len(checked_triangles)} triangles is zero: every one is "
                "degenerate, so there is no surface measure to compare"
            )

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
        return float(self.areas.sum())

    @cached_property
    def edge_lengths(self) -> NDArray[np.float64]:
        """Lengths of the three sides of each triangle (m, 3); an inner edge appears twice."""
        return self._per_triangle(_side_lengths)

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
        ordered = np.sort(self.triangles, axis=1)
        low, middle, high = ordered.T
        order = np.lexsort((high, middle, low))
        duplicate = np.ones(len(order) - 1, dtype=bool)
        for column in (low, middle, high):
            duplicate &= np.diff(column[order]) == 0
        del order
        count = len(self.vertices)
        # A triangle that repeats a vertex has fewer than three edges, each once.
        edges = np.concatenate(
            [
                (low * count + middle)[low != middle],
                (middle * count + high)[middle != high],
                (low * count + high)[(low != middle) & (middle != high)],
            ]
        )
        edges.sort()
        starts = np.flatnonzero(np.diff(edges, prepend=-1))
        sharing = np.diff(starts, append=len(edges))
        return MeshCounts(
            zero_area=int(np.count_nonzero(self.areas <= self._smallest_areas())),
            duplicate=int(np.count_nonzero(duplicate)),
            boundary_edges=int(np.count_nonzero(sharing == 1)),
            nonmanifold_edges=int(np.count_nonzero(sharing > 2)),
        )

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the vertices and triangles, in hexadecimal."""
        digest = hashlib.sha256()
        for array in (self.vertices, self.triangles):
            digest.update(str(array.shape).encode())
            digest.update(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).data)
        return digest.hexdigest()

    def _smallest_areas(self) -> NDArray[np.float64]:
        """The area of each triangle (m,) that could as well be zero, given the rounding of its sides."""
        with np.errstate(over="ignore"):
            longest: NDArray[np.float64] = self._per_triangle(_longest_sides)
            return np.asarray(_AREA_RESOLUTION * longest**2)

    def _per_triangle(self, measure: Callable[[_Edges], NDArray[np.float64]]) -> NDArray[np.float64]:
        """A measure of all triangles, taken slice by slice: edges of millions at once take gigabytes."""
        columns = [np.ascontiguousarray(column) for column in self.vertices.T]
        parts = []
        for start in range(0, len(self.triangles), _SLICE):
            a, b, c = np.ascontiguousarray(self.triangles[start : start + _SLICE].T)
            first, second = np.empty((3, len(a))), np.empty((3, len(a)))
            for axis, column in enumerate(columns):
                origins = column[a]
                np.subtract(column[b], origins, out=first[axis])
                np.subtract(column[c], origins, out=second[axis])
            parts.append(measure((first, second)))
        return _frozen(np.concatenate(parts))

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


def _longest_sides(edges: _Edges) -> NDArray[np.float64]:
    longest: NDArray[np.float64] = _side_lengths(edges).max(axis=1)
    return longest


def _centroid_radii(edges: _Edges) -> NDArray[np.float64]:
    first, second = edges
    centroid = (first + second) / 3
    squares = [np.einsum("ij,ij->j", arm, arm) for arm in (centroid, first - centroid, second - centroid)]
    return np.asarray(np.sqrt(np.maximum.reduce(squares)))


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
        converted = np.array(found, dtype=np.float64, order="C")
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
    bad = np.flatnonzero(((found < 0) | (found >= vertex_count)).any(axis=1))
    if bad.size:
        raise MeshError(
            f"{bad.size} of {len(found)} triangles have indices outside 0..{vertex_count - 1}: {_listed(bad, found)}"
        )
    return _frozen(np.array(found, dtype=np.int64, order="C"))


def _listed(rows: NDArray[np.intp], values: NDArray[np.generic], limit: int = 3) -> str:
    shown = ", ".join(f"#{row} = {values[row].tolist()}" for row in rows[:limit])
    return shown + (", ..." if len(rows) > limit else "")


def _frozen(array: NDArray[_Scalar]) -> NDArray[_Scalar]:
    array.setflags(write=False)
    return array
