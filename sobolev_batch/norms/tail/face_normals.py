"""Normals of flat faces, around which transforms are concentrated, and a density of directions that follows them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Indices, Reals, slices
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.transform.backends import combine

# Normals whose entries agree to this many parts are one direction.
_DIRECTION_PARTS = 500
# Numbers that an entry can be rounded to; three of them make a key of 32 bits.
_KEYS_PER_AXIS = 2 * _DIRECTION_PARTS + 1
# Triangles whose normals are taken at a time.
_BATCH = 1 << 14
# A direction counts if the faces along it hold this fraction of the area; this many directions at most.
_LEAST_SHARE, _MOST_DIRECTIONS = 0.01, 64
# κ as a fraction of 2π |ξ| · size of the faces: the spots around normals are about 1/κ wide.
_SPOT_FRACTION = 0.5
# The part of directions that `FacesAndEdges` draws across edges.
_ACROSS_EDGES = 0.5
# Edges of one direction are on one line where they are this much of the largest coordinate apart, or less.
_ONE_LINE = 1e-5
# No direction of small whole numbers is orthogonal to this one, where rounding would decide.
_UPWARDS = np.array([1.0, np.sqrt(2.0), np.pi])
_NO_NORMALS = (np.zeros((0, 3)), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, eq=False)
class FaceNormals:
    """Directions of the flat faces of some surfaces, and a density of directions that follows them.

    The transform of a flat face is concentrated around its normal, in a spot as wide as the inverse size of the face,
    and falls off from there like the inverse third power. So does the density around each normal n, which is
    (1 + κ²) / (4π (1 + κ² sin²θ)^(3/2)) at an angle θ to n, with κ in proportion to |ξ| times the size.

    Attributes:
        directions: Unit normals, float64 (n, 3); the density is the same at opposite directions.
        shares: Area of the faces along each normal over that along all of them, float64 (n,).
        sizes: Typical width of these faces, float64 (n,), in units of length.
    """

    directions: Reals
    shares: Reals
    sizes: Reals

    @classmethod
    def from_surfaces(cls, surfaces: Sequence[Surface]) -> Self:
        """Return the normals of the flat faces of surfaces; none for curved ones."""
        found = [_main_normals(surface) for surface in surfaces if isinstance(surface, Mesh)]
        directions, areas, sizes = (np.concatenate(rows) for rows in zip(_NO_NORMALS, *found, strict=True))
        return cls(directions, areas / max(float(areas.sum()), np.finfo(np.float64).tiny), sizes)

    def __bool__(self) -> bool:
        return len(self.shares) > 0

    def draw(self, radii: Reals, rng: np.random.Generator) -> Reals:
        """Draw a unit direction on the side of a normal for each |ξ| (n,) by the density, float64 (n, 3)."""
        chosen = rng.choice(len(self.shares), len(radii), p=self.shares)
        axes = self.directions[chosen]
        squares = self._concentrations(radii, self.sizes[chosen])
        levels = rng.random(len(radii))
        # The distribution of u = |cos θ| is u / √(1 + κ² - κ² u²), which inverts in closed form.
        return _around(axes, levels * np.sqrt((1 + squares) / (1 + squares * levels**2)), rng)

    def density(self, directions: Reals, radii: Reals) -> Reals:
        """Return the density per solid angle (n,) at unit directions (n, 3), for their |ξ| (n,)."""
        total, columns = np.zeros(len(radii)), np.ascontiguousarray(directions.T)
        for axis, share, size in zip(self.directions, self.shares, self.sizes, strict=True):
            squares = self._concentrations(radii, size)
            spread = 1 + squares * np.maximum(1 - combine(axis, columns) ** 2, 0.0)
            total += share / (4 * np.pi) * (1 + squares) / (spread * np.sqrt(spread))
        return total

    @staticmethod
    def _concentrations(radii: Reals, sizes: Reals | float) -> Reals:
        """Return κ² of the density."""
        return np.asarray((_SPOT_FRACTION * 2 * np.pi * radii * sizes) ** 2)


@dataclass(frozen=True, eq=False)
class FacesAndEdges(FaceNormals):
    """Directions of the flat faces of some surfaces and of the edges of these, and a density that follows both.

    The transform of a face falls off least in the plane across each of its edges, in a band as wide as the inverse
    length of the edge. Where faces repeat, as in folds, most of it may lie there, far from all normals. The density
    around each edge is κ / (4π arctan κ (1 + κ² cos²θ)) at an angle θ to it.

    Attributes:
        edges: Directions of edges, their shares of the length of all, and their typical lengths as sizes.
    """

    edges: FaceNormals

    @classmethod
    def from_surfaces(cls, surfaces: Sequence[Surface]) -> Self:
        """Return the normals and edges of the flat faces of surfaces; none for curved ones."""
        faces = FaceNormals.from_surfaces(surfaces)
        found = [_main_edges(mesh, faces.directions) for mesh in surfaces if isinstance(mesh, Mesh)]
        directions, lengths, sizes = (np.concatenate(rows) for rows in zip(_NO_NORMALS, *found, strict=True))
        edges = FaceNormals(directions, lengths / max(float(lengths.sum()), np.finfo(np.float64).tiny), sizes)
        return cls(faces.directions, faces.shares, faces.sizes, edges)

    def draw(self, radii: Reals, rng: np.random.Generator) -> Reals:
        """Draw a unit direction around a normal or across an edge for each |ξ| (n,), float64 (n, 3)."""
        directions, edges = super().draw(radii, rng), self.edges
        if edges:
            across = np.flatnonzero(rng.random(len(radii)) < _ACROSS_EDGES)
            chosen = rng.choice(len(edges.shares), len(across), p=edges.shares)
            widths = np.sqrt(self._concentrations(radii[across], edges.sizes[chosen]))
            cosines = np.tan(np.arctan(widths) * (2 * rng.random(len(across)) - 1)) / widths
            directions[across] = _around(edges.directions[chosen], cosines, rng)
        return directions

    def density(self, directions: Reals, radii: Reals) -> Reals:
        """Return the density per solid angle (n,); see `FaceNormals.density`."""
        total, edges = super().density(directions, radii), self.edges
        if not edges:
            return total
        total, columns = (1 - _ACROSS_EDGES) * total, np.ascontiguousarray(directions.T)
        for axis, share, size in zip(edges.directions, edges.shares, edges.sizes, strict=True):
            widths = np.sqrt(self._concentrations(radii, size))
            spread = 4 * np.pi * np.arctan(widths) * (1 + (widths * combine(axis, columns)) ** 2)
            total += _ACROSS_EDGES * share * widths / spread
        return total


def _around(axes: Reals, cosines: Reals, rng: np.random.Generator) -> Reals:
    """Return unit directions (n, 3) whose angles to unit axes have some cosines, turned around these at random."""
    sines = np.sqrt(np.maximum(1 - cosines**2, 0.0))
    turns = 2 * np.pi * rng.random(len(axes))
    across = np.cross(axes, np.eye(3)[np.abs(axes).argmin(axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    sideways = np.cos(turns)[:, None] * across + np.sin(turns)[:, None] * np.cross(axes, across)
    # A direction stands for its opposite too, since all integrands are even.
    return np.asarray(cosines[:, None] * axes + sines[:, None] * sideways)


def _main_edges(mesh: Mesh, normals: Reals) -> tuple[Reals, Reals, Reals]:
    """Return directions, lengths together and typical lengths of the edges around a mesh's faces along some normals."""
    if not len(normals):
        return _NO_NORMALS
    units = _unit_normals(mesh)
    borders = []
    for normal in normals:
        cosines = units @ normal
        face = np.abs(cosines) > 1 - _DIRECTION_PARTS**-2.0
        borders.append(_borders(mesh, face, np.sign(cosines[face]).astype(np.int8)))
    ends = mesh.vertices[np.concatenate(borders)]
    edges = ends[:, 1] - ends[:, 0]
    lengths = np.linalg.norm(edges, axis=1)
    ends, edges, lengths = (rows[lengths > 0] for rows in (ends, edges, lengths))
    edges /= lengths[:, None]
    edges[edges @ _UPWARDS < 0] *= -1
    _, first, members = np.unique(np.round(edges * _DIRECTION_PARTS), axis=0, return_index=True, return_inverse=True)
    sums = np.bincount(members.ravel(), weights=lengths)
    largest = np.argsort(-sums)[:_MOST_DIRECTIONS]
    largest = largest[sums[largest] > _LEAST_SHARE * sums.sum()]
    sizes, cell = np.empty(len(largest)), _ONE_LINE * float(np.abs(ends).max(initial=0.0))
    for number, group in enumerate(largest):
        # Those on one line are one edge, into however many it is cut.
        along, centres = members.ravel() == group, ends[members.ravel() == group].mean(axis=1)
        offsets = centres - np.outer(centres @ edges[first[group]], edges[first[group]])
        _, lines = np.unique(np.round(offsets / cell), axis=0, return_inverse=True)
        of_lines = np.bincount(lines.ravel(), weights=lengths[along])
        sizes[number] = of_lines @ of_lines / sums[group]
    return edges[first[largest]], sums[largest], sizes


def _borders(mesh: Mesh, face: NDArray[np.bool_], ways: NDArray[np.int8]) -> Indices:
    """Return the vertices (n, 2) of the edges around faces whose normals point one way, 1, or the other, -1."""
    from scipy.sparse import coo_array, triu

    sides = mesh.triangles[face][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    one_way = coo_array((np.repeat(ways, 3), sides.T), shape=(len(mesh.vertices),) * 2).tocsr()
    # Along a side between two triangles of a face, both go opposite ways.
    return np.stack(triu(one_way - one_way.T).nonzero(), axis=1)


def _unit_normals(mesh: Mesh) -> Reals:
    """Return the normals of triangles (T, 3); zeros for those without area."""
    normals = np.empty((len(mesh.triangles), 3))
    # The corners and temporaries of all triangles of a fine mesh would take gigabytes.
    for part in slices(len(normals), _BATCH):
        a, b, c = mesh.corners(part)
        crosses, lengths = np.cross(b - a, c - a), 2 * mesh.areas[part]
        normals[part] = crosses / np.where(lengths > 0, lengths, 1.0)[:, None]
    return normals


def _main_normals(mesh: Mesh) -> tuple[Reals, Reals, Reals]:
    """Return the normals, areas and face sizes of the directions that hold much of a mesh's area."""
    areas, normals = mesh.areas, _unit_normals(mesh)
    keys = np.empty(len(areas), dtype=np.int32)
    for part in slices(len(areas), _BATCH):
        # A normal and its opposite are one direction.
        normals[part][combine(_UPWARDS, normals[part].T) < 0] *= -1
        # A number for each normal, the same for those that count as one direction.
        x, y, z = np.round(normals[part] * _DIRECTION_PARTS).astype(np.int32).T
        keys[part] = (x * _KEYS_PER_AXIS + y) * _KEYS_PER_AXIS + z
    _, members = np.unique(keys, return_inverse=True)
    sums = np.bincount(members, weights=areas)
    largest = np.argsort(-sums)[:_MOST_DIRECTIONS]
    largest = largest[sums[largest] > _LEAST_SHARE * areas.sum()]
    directions, sizes = np.empty((len(largest), 3)), np.empty(len(largest))
    for number, group in enumerate(largest):
        face = members == group
        directions[number] = areas[face] @ normals[face]
        used = np.zeros(len(mesh.vertices), dtype=bool)
        used[mesh.triangles[face]] = True
        # Between the width of one triangle and that of all faces along the normal: spots of both lie there.
        sizes[number] = np.sqrt(np.ptp(mesh.vertices[used], axis=0).max() * np.sqrt(areas[face].mean()))
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return directions, sums[largest], sizes
