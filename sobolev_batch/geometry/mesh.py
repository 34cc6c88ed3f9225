"""Triangle meshes, checked once and then frozen; and counts of what is unusual in them."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sobolev_batch.arrays import Array, Indices, Reals, slices
from sobolev_batch.errors import MeshError, from_extra
from sobolev_batch.geometry.surface import LARGEST_LENGTH, Extent, Point
from sobolev_batch.parameters import as_names

Corners = tuple[Reals, Reals, Reals]
# Vectors (3, ...), one row an axis.
Vectors = Reals | tuple[Reals, Reals, Reals]
# Vectors from the first corner to the second and to the third, (3, k) each: one row an axis.
_Edges = tuple[Reals, Reals]
_Scalar = TypeVar("_Scalar", bound=np.generic)

_ALL = slice(None)
# Triangles that are measured or sorted at a time: their edges and temporaries stay in cache.
_BATCH = 1 << 14
# For so many vertices a corner, marks on all of them take longer than one on each corner.
_MANY = 16
# Twice the rounding error of a cross product, relative to the squared longest edge: a smaller area is as good as zero.
_AREA_RESOLUTION = 8 * np.finfo(np.float64).eps
# Rounding to single precision along all axes, relative to the largest coordinate, with some margin.
_SINGLE_ROUNDING = 2.0**-22


class _Sizes(NamedTuple):
    """Areas and centroid radii of triangles, lengths of edges, and how many have no area to double precision."""

    areas: Reals
    radii: Reals
    mean_edge: float
    longest_edge: float
    without_area: int


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in three-dimensional space, as a sum of flat area measures.

    Both arrays are copied as float64 and int64 and made read-only; read-only ones of these types that own their memory
    are shared. Zero-area triangles, duplicates, open boundaries and non-manifold edges stay; `counts` reports them.

    Args:
        vertices: Coordinates, real (n, 3), finite, in the user's unit of length.
        triangles: Indices into ``vertices``, integer (m, 3), m > 0.
        notes: What was found where the mesh was read, and may make one doubt it, a sentence each.

    Raises:
        MeshError: Coordinates are not finite; indices are negative, out of range or not integers; there are no
            triangles, or their total area is zero. The message names the entries.

    >>> import sobolev_batch as sb
    >>> mesh = sb.Mesh([[0, 0, 0], [3, 0, 0], [0, 4, 0]], [[0, 1, 2]])
    >>> mesh.area, mesh.edge_lengths.tolist(), mesh.counts["boundary_edges"]
    (6.0, [[3.0, 5.0, 4.0]], 3)
    """

    vertices: Reals
    triangles: Indices
    notes: tuple[str, ...] = ()

    def __init__(self, vertices: ArrayLike, triangles: ArrayLike, notes: tuple[str, ...] = ()) -> None:
        checked, notes = checked_points(vertices, "vertices"), tuple(as_names(notes))
        vars(self).update(vertices=checked, triangles=_checked_triangles(triangles, len(checked)), notes=notes)
        self._require_sizes()

    def _require_sizes(self) -> None:
        largest = float(np.abs(self.vertices).max(initial=0.0))
        if largest > LARGEST_LENGTH or not np.isfinite(self.area):
            raise MeshError(f"areas or squared lengths overflow: largest absolute coordinate {largest:.3g}; rescale it")
        if self._sizes.without_area == len(self.triangles):
            total = f"the total area of the {len(self.triangles)} triangles is zero"
            raise MeshError(f"{total}: every one is degenerate, or too small for double precision; rescale the mesh")

    @classmethod
    def from_checked(cls, vertices: Reals, triangles: Indices, notes: tuple[str, ...] = ()) -> Mesh:
        """Return a mesh of arrays that were checked before, without a copy; they become read-only."""
        mesh = object.__new__(cls)
        vars(mesh).update(vertices=_frozen(vertices), triangles=_frozen(triangles), notes=notes)
        return mesh

    def corners(self, selection: slice | Indices = _ALL) -> Corners:
        """Return the first, second and third corners (k, 3) of all or some triangles, in units of length."""
        selected = self.triangles[selection]
        return self.vertices[selected[:, 0]], self.vertices[selected[:, 1]], self.vertices[selected[:, 2]]

    @property
    def areas(self) -> Reals:
        """Area of each triangle (m,), in squared units of length; zero where it has none to double precision."""
        return self._sizes.areas

    @property
    def with_area(self) -> Mesh:
        """The mesh without triangles that have no area to double precision: they are no part of its measure."""
        return self if not self._sizes.without_area else self._without_flat

    @cached_property
    def _without_flat(self) -> Mesh:
        return Mesh.from_checked(self.vertices, np.ascontiguousarray(self.triangles[self.areas > 0]), self.notes)

    @cached_property
    def area(self) -> float:
        """Total area, in squared units of length."""
        with np.errstate(over="ignore", invalid="ignore"):
            return float(self.areas.sum())

    @property
    def edge_lengths(self) -> Reals:
        """Lengths of the three sides of each triangle (m, 3); an inner edge appears twice."""
        return self._per_triangle(_side_lengths)

    @property
    def edge_length_range(self) -> tuple[float, float]:
        """Mean and maximum of the `edge_lengths`."""
        return self._sizes.mean_edge, self._sizes.longest_edge

    @property
    def centroid_radii(self) -> Reals:
        """Distance from the centroid of each triangle to its farthest corner (m,)."""
        return self._sizes.radii

    @cached_property
    def extent(self) -> Extent:
        """Extent of the vertices of triangles `with_area` along `DIRECTIONS`."""
        return Extent.of_points(self.vertices[self.with_area.used_vertices].T)

    @property
    def bounding_sphere(self) -> tuple[Point, float]:
        """Centre of the bounding box, and distance from it to the farthest vertex of triangles `with_area`."""
        lower, upper = self.extent.box
        center = lower + (upper - lower) / 2
        x, y, z = center.tolist()
        return (x, y, z), float(np.linalg.norm(self.vertices[self.with_area.used_vertices] - center, axis=1).max())

    def moved(self, scale: float, origin: Point, turn: Reals | None = None) -> Mesh:
        """Return the mesh after x -> scale * turn (x - origin), where a turn (3, 3) is a rotation."""
        vertices = self.vertices - np.asarray(origin)
        vertices = vertices if turn is None else vertices @ turn.T
        vertices *= scale
        moved = Mesh.from_checked(vertices, self.triangles, self.notes)
        try:
            moved._require_sizes()
        except MeshError as error:
            raise MeshError(
                f"{error}, once a mesh of size {self.extent.widths.max():.3g} is scaled by {scale:.3g} about "
                f"({', '.join(f'{x:.6g}' for x in origin)}); check the units and places of the meshes"
            ) from error
        moved.__dict__["rounding"] = scale * self.rounding
        return moved

    @cached_property
    def rounding(self) -> float:
        """Largest move of a vertex by single precision, as in STL, in units of length; zero where it has more digits.

        Coordinates that single precision holds count as rounded, also once they are scaled and moved.

        >>> import sobolev_batch as sb
        >>> sb.Mesh([[0, 0, 0], [4, 0, 0], [0, 4, 0]], [[0, 1, 2]]).rounding == 2**-20
        True
        """
        with np.errstate(over="ignore"):
            single = bool(np.all(self.vertices.astype(np.float32) == self.vertices))
        return _SINGLE_ROUNDING * self.extent.reach if single else 0.0

    @cached_property
    def used_vertices(self) -> Indices:
        """Indices of the vertices that triangles use, in ascending order."""
        return _frozen(_used(self.triangles, len(self.vertices)))

    @cached_property
    def counts(self) -> dict[str, int]:
        """Counts of how triangles are connected, and of what is unusual. Nothing of that is repaired.

        The keys are "zero_area_triangles", to double precision; "duplicate_triangles", which repeat the three vertices
        of an earlier one in any orientation; "boundary_edges" of exactly one triangle; "nonmanifold_edges" of more
        than two; "inconsistent_edges" of exactly two that face opposite sides there; "components" that share no vertex;
        and "euler_characteristic", the number of vertices in use less that of edges plus that of triangles. Closed
        surfaces have two for each component, less two for each handle.

        >>> import sobolev_batch as sb
        >>> counts = sb.shapes.Torus(1.0, 0.3).mesh(12, 8).counts
        >>> counts["components"], counts["euler_characteristic"]
        (1, 0)
        """
        unused = len(self.vertices) - len(self.used_vertices)
        duplicates = _count_duplicates(self.triangles)
        edges, components, boundary, nonmanifold, inconsistent = _edges_of(self.triangles, len(self.vertices))
        return {
            "zero_area_triangles": self._sizes.without_area,
            "duplicate_triangles": duplicates,
            "boundary_edges": boundary,
            "nonmanifold_edges": nonmanifold,
            "inconsistent_edges": inconsistent,
            "components": components - unused,
            "euler_characteristic": len(self.used_vertices) - edges + len(self.triangles),
        }

    @cached_property
    def merged(self) -> Mesh | None:
        """The mesh whose vertices of the same place are one, as of seams that double them; None where that is none.

        It is looked for where the mesh has open edges or several components.
        """
        if not self.counts["boundary_edges"] and self.counts["components"] == 1:
            return None
        vertices, triangles = merge_coincident(self.vertices, self.triangles)
        return Mesh.from_checked(vertices, triangles) if len(vertices) < len(self.vertices) else None

    @property
    def defects(self) -> tuple[str, ...]:
        """Defects in words: all that keeps the mesh from being a closed surface that faces outwards; empty without any.

        Seams that double vertices are none.

        >>> import sobolev_batch as sb
        >>> sphere = sb.shapes.icosphere(1)
        >>> sb.Mesh(sphere.vertices, sphere.triangles[1:]).defects
        ('3 open edges',)
        >>> sb.Mesh(sphere.vertices, sphere.triangles[:, ::-1]).defects
        ('all triangles face inwards',)
        """
        return tuple(self._defects.values())

    @property
    def _defects(self) -> dict[str, str]:
        words = {
            "boundary_edges": ("open edge", ""),
            "nonmanifold_edges": ("edge", " of more than two triangles"),
            "inconsistent_edges": ("edge", " at which normals flip"),
            "duplicate_triangles": ("duplicate triangle", ", counted twice"),
            "zero_area_triangles": ("triangle", " without area"),
        }
        counts = (self.merged or self).counts
        found = {key: counts[key] for key in words if counts[key]}
        texts = {key: f"{n:,} {words[key][0]}{'s' * (n != 1)}{words[key][1]}" for key, n in found.items()}
        return texts | ({"volume": "all triangles face inwards"} if self.volume < 0 else {})

    def damage_beside(self, original: Mesh) -> tuple[str, ...]:
        """Return in words what a mesh that was made of another one has lost: defects of kinds that this one has not.

        Another number of components, or another Euler characteristic, of parts, handles and holes, counts too.

        >>> import sobolev_batch as sb
        >>> sphere = sb.shapes.icosphere(1)
        >>> sb.Mesh(sphere.vertices, sphere.triangles[1:]).damage_beside(sphere)
        ('3 open edges', 'Euler characteristic 1 (was 2)')
        """
        new = [text for kind, text in self._defects.items() if kind not in original._defects]
        now, was = ((one.merged or one).counts for one in (self, original))
        named = {"components": "components", "euler_characteristic": "Euler characteristic"}
        changes = [f"{name} {now[key]:,} (was {was[key]:,})" for key, name in named.items() if now[key] != was[key]]
        return (*new, *changes)

    @cached_property
    def volume(self) -> float:
        """Enclosed volume, in cubed units of length; negative where triangles, seen from outside, run clockwise.

        NaN unless each edge has two triangles that face the same side: `counts` has no boundary, non-manifold or
        inconsistent edges, at least once vertices of the same place are one.

        >>> import sobolev_batch as sb
        >>> f"{sb.shapes.icosphere(5).volume:.3f}"
        '4.187'
        """
        if any(self.counts[f"{kind}_edges"] for kind in ("boundary", "nonmanifold", "inconsistent")):
            return self.merged.volume if self.merged else np.nan
        # From a point nearby: far from the origin, the parts cancel.
        origin = self.vertices[self.triangles[0, 0]]
        batches = ([corner - origin for corner in self.corners(batch)] for batch in slices(len(self.triangles), _BATCH))
        return math.fsum(float(np.einsum("ij,ij->", a, np.cross(b, c))) for a, b, c in batches) / 6

    @property
    def smallest_angles(self) -> Reals:
        """Smallest angle of each triangle (m,), in degrees; zero without an area."""
        return self._per_triangle(_smallest_angles)

    @property
    def aspect_ratios(self) -> Reals:
        """Longest edge of each triangle over the radius of its incircle (m,), over that of an equilateral triangle.

        From 1 on, and infinite without an area. Source: C. Stimpson et al., "The Verdict geometric quality library",
        Sandia report SAND2007-1751 (2007), section 4.3.
        """
        return self._per_triangle(_aspect_ratios)

    def batches(self, size: int) -> Iterator[tuple[int, Mesh]]:
        """Yield the mesh as numbered meshes of at most ``size`` triangles, each with only the vertices that it uses.

        Batches without area are left out: they add nothing to a transform.
        """
        new_indices = np.empty(len(self.vertices), dtype=np.int64)
        for number, batch in enumerate(slices(len(self.triangles), size)):
            if not np.any(self.areas[batch] > 0):
                continue
            triangles, corners = self.triangles[batch], self.triangles[batch].ravel()
            if len(corners) * _MANY > len(self.vertices):
                used = _used(triangles, len(self.vertices))
            else:
                # Of the corners at each vertex the last one, without a look at all vertices.
                new_indices[corners] = numbers = np.arange(len(corners))
                used = corners[new_indices[corners] == numbers]
            new_indices[used] = np.arange(len(used))
            yield number, Mesh.from_checked(self.vertices[used], new_indices[triangles])

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the vertices and triangles, in hexadecimal."""
        digest = hashlib.sha256()
        for array in (self.vertices, self.triangles):
            digest.update(str(array.shape).encode())
            digest.update(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).data)
        return digest.hexdigest()

    def to_trimesh(self) -> Any:
        """Return a new ``trimesh.Trimesh`` of the same vertices and triangles, all digits kept."""
        import trimesh

        # Without processing it merges and drops nothing.
        return trimesh.Trimesh(np.array(self.vertices), np.array(self.triangles), process=False)

    def to_pyvista(self) -> Any:
        """Return a new ``pyvista.PolyData`` of the same vertices and triangles, all digits kept.

        Raises:
            InputError: PyVista is not installed (the extra ``vtk``).
        """
        with from_extra("vtk", "a mesh of PyVista needs"):
            import pyvista
        return pyvista.PolyData.from_regular_faces(np.array(self.vertices), np.array(self.triangles))

    @cached_property
    def _sizes(self) -> _Sizes:
        """One pass reads the corners for all sizes."""
        areas, radii = np.empty((2, len(self.triangles)))
        total, longest, without_area = 0.0, 0.0, 0
        with np.errstate(over="ignore", invalid="ignore"):
            for batch, squares in zip(slices(len(areas), _BATCH), map(_squared_sizes, self._edges()), strict=True):
                twice_areas, thrice_radii, *sides = np.sqrt(squares, out=squares)
                areas[batch], radii[batch] = twice_areas / 2, thrice_radii / 3
                longest_sides = np.maximum.reduce(sides)
                is_flat = areas[batch] <= _AREA_RESOLUTION * longest_sides**2
                areas[batch][is_flat] = 0.0
                without_area += int(np.count_nonzero(is_flat))
                total, longest = total + float(squares[2:].sum()), max(longest, float(longest_sides.max()))
        return _Sizes(_frozen(areas), _frozen(radii), total / (3 * len(areas)), longest, without_area)

    def _per_triangle(self, measure: Callable[[_Edges], Reals]) -> Reals:
        """Return a measure of all triangles, taken batch by batch: edges of millions at once take gigabytes."""
        return _frozen(np.concatenate([measure(edges) for edges in self._edges()]))

    def _edges(self) -> Iterator[_Edges]:
        axes = np.ascontiguousarray(self.vertices.T)
        for batch in slices(len(self.triangles), _BATCH):
            a, b, c = (axes.take(corner, axis=1) for corner in self.triangles[batch].T)
            yield b - a, c - a

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices)} vertices, {len(self.triangles)} triangles)"

    def __reduce__(self) -> tuple[type[Mesh], tuple[Reals, Indices, tuple[str, ...]]]:
        return Mesh, (self.vertices, self.triangles, self.notes)


def dot(first: Vectors | Array, second: Vectors | Array) -> Array:
    """Return the products (...) of vectors (3, ...) of any backend, without a BLAS and its threads."""
    # Products that are added one by one have the same digits in a compiled loop.
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


def cross(first: Vectors, second: Vectors) -> tuple[Reals, Reals, Reals]:
    """Return the vector products of vectors (3, ...)."""
    (ux, uy, uz), (vx, vy, vz) = first, second
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


def cross_lengths(first: Vectors, second: Vectors) -> Reals:
    """Return |u × v| of vectors (3, ...)."""
    normals = cross(first, second)
    return np.asarray(np.sqrt(dot(normals, normals)))


def _side_lengths(edges: _Edges) -> Reals:
    first, second = edges
    return np.stack([np.sqrt(dot(side, side)) for side in (first, second - first, second)], axis=1)


def _squared_sizes(edges: _Edges) -> Reals:
    """Return the squares of twice the area, of three times the centroid radius, and of the three sides (5, k)."""
    first, second = edges
    normals = cross(first, second)
    arms = [dot(arm, arm) for arm in (first + second, first + first - second, second + second - first)]
    sides = [dot(side, side) for side in (first, second - first, second)]
    return np.stack([dot(normals, normals), np.maximum.reduce(arms), *sides])


def _smallest_angles(edges: _Edges) -> Reals:
    # Opposite the shortest side. Unlike the law of cosines, this keeps the digits of small angles.
    shortest, *others = np.sort(_side_lengths(edges), axis=1).T ** 2
    return np.asarray(np.degrees(np.arctan2(2 * cross_lengths(*edges), sum(others) - shortest)))


def _aspect_ratios(edges: _Edges) -> Reals:
    lengths, twice_areas = _side_lengths(edges), cross_lengths(*edges)
    # Twice the area is the perimeter times the radius of the incircle.
    products = lengths.max(axis=1) * lengths.sum(axis=1)
    flat = np.full_like(products, np.inf)
    return np.asarray(np.divide(products, 2 * np.sqrt(3) * twice_areas, out=flat, where=twice_areas > 0))


def _used(triangles: Indices, vertex_count: int) -> Indices:
    used = np.zeros(vertex_count, dtype=bool)
    used[triangles] = True
    return np.flatnonzero(used).astype(np.int64, copy=False)


def merge_coincident(vertices: NDArray[Any], triangles: Indices) -> tuple[NDArray[Any], Indices]:
    """Merge vertices with exactly the same coordinates, for formats and programs that repeat them."""
    if not np.isfinite(vertices).all():
        # The mesh refuses them and names the entries.
        return vertices, triangles
    # Several times as fast as to look for unique rows.
    order = np.lexsort(vertices.T[::-1])
    ordered, indices, is_new = vertices[order], np.empty(len(order), np.int64), np.ones(len(order), bool)
    is_new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    indices[order] = np.cumsum(is_new) - 1
    return ordered[is_new], indices[triangles]


def _array(values: ArrayLike, name: str) -> NDArray[Any]:
    if np.ma.is_masked(values):
        raise MeshError(f"{name} have masked entries")
    try:
        return np.asarray(values)
    except ValueError as error:
        raise MeshError(f"{name} must be an array of rows of three, found rows of different lengths") from error


def checked_points(points: ArrayLike, name: str = "points") -> Reals:
    """Return points as read-only float64 (n, 3); MeshError, with their name, where they are not real and finite."""
    array = _array(points, name)
    if array.dtype.kind not in "fiu":
        raise MeshError(f"{name} must be real numbers, found dtype {array.dtype}")
    if array.ndim != 2 or array.shape[1] != 3:
        raise MeshError(f"{name} must have shape (n, 3), found {array.shape}")
    with np.errstate(over="ignore"):
        converted = _owned(array, np.float64)
    if (bad := np.flatnonzero(~np.isfinite(converted).all(axis=1))).size:
        raise MeshError(f"{bad.size} of {len(array)} {name} have NaN or infinite coordinates: {_listed(bad, array)}")
    return _frozen(converted)


def _checked_triangles(triangles: ArrayLike, vertex_count: int) -> Indices:
    array = _array(triangles, "triangles")
    if array.size == 0:
        raise MeshError("the mesh has no triangles")
    if array.dtype.kind not in "iu":
        raise MeshError(f"triangles must be integer indices, found dtype {array.dtype}")
    if array.ndim != 2 or array.shape[1] != 3:
        raise MeshError(f"triangles must have shape (m, 3), found {array.shape}")
    if array.min() < 0 or array.max() >= vertex_count:
        bad = np.flatnonzero(((array < 0) | (array >= vertex_count)).any(axis=1))
        outside = f"indices outside 0..{vertex_count - 1}: {_listed(bad, array)}"
        raise MeshError(f"{bad.size} of {len(array)} triangles have {outside}")
    return _frozen(_owned(array, np.int64))


def _owned(array: NDArray[Any], dtype: type[_Scalar]) -> NDArray[_Scalar]:
    """Return the array itself where nobody can change it any more, else a copy."""
    unchangeable = array.flags.c_contiguous and array.flags.owndata and not array.flags.writeable
    return array if unchangeable and array.dtype == dtype else np.array(array, dtype=dtype, order="C")


def _listed(rows: NDArray[np.intp], values: NDArray[np.generic]) -> str:
    return ", ".join([*(f"#{row} = {values[row].tolist()}" for row in rows[:3]), *["..."] * (len(rows) > 3)])


def _frozen(array: NDArray[_Scalar]) -> NDArray[_Scalar]:
    array.setflags(write=False)
    return array


def _edges_of(triangles: Indices, vertex_count: int) -> tuple[int, int, int, int, int]:
    """Return the number of edges, and into how many parts they connect all vertices.

    Return also the numbers of edges of exactly one triangle, of more than two, and of two that run along it alike.
    """
    keys = np.empty(3 * len(triangles), dtype=np.int64)
    for start in range(0, len(triangles), _BATCH):
        ends = np.ascontiguousarray(triangles[start : start + _BATCH].T)
        nexts = ends[[1, 2, 0]]
        low, high = np.minimum(ends, nexts), np.maximum(ends, nexts)
        # A triangle that repeats a vertex has one edge at most, along which it runs both ways.
        repeats = (low == high).any(axis=0)
        batch_keys = 3 * (low * vertex_count + high) + np.where(repeats, 2, ends < nexts)
        batch_keys[low == high] = -1
        for side in (1, 2):
            batch_keys[side, repeats & (batch_keys[:side] == batch_keys[side]).any(axis=0)] = -1
        keys[3 * start : 3 * start + batch_keys.size] = batch_keys.ravel()
    keys.sort()
    keys = keys[np.searchsorted(keys, 0) :]
    # Meshes have tens of millions of triangles: what is not needed any more makes room.
    edges = keys // 3
    starts = np.flatnonzero(np.diff(edges, prepend=-1))
    edges, numbers = edges[starts], np.diff(starts, append=len(edges))
    pairs = starts[numbers == 2]
    is_alike = (keys[pairs] == keys[pairs + 1]) & (keys[pairs] % 3 < 2)
    boundary, nonmanifold, alike = (int(np.count_nonzero(one)) for one in (numbers == 1, numbers > 2, is_alike))
    del keys, starts, numbers, pairs, is_alike
    links = coo_array((np.ones(len(edges), np.int8), np.divmod(edges, vertex_count)), (vertex_count, vertex_count))
    components, _ = connected_components(links, directed=False)
    return len(edges), int(components), boundary, nonmanifold, alike


def _count_duplicates(triangles: Indices) -> int:
    ordered = np.sort(triangles, axis=1)
    ordered = ordered[np.lexsort(ordered.T)]
    return int(np.count_nonzero((ordered[1:] == ordered[:-1]).all(axis=1)))
