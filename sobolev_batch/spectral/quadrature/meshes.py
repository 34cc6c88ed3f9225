"""From a surface to weighted points: which rule each triangle gets, in batches of bounded size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.spectral.backends.arrays import Array, combine
from sobolev_batch.spectral.backends.backends import CPU, Backend
from sobolev_batch.spectral.quadrature.rules import (
    HIGHEST_DEGREE,
    TriangleRule,
    corner_rule,
    gauss_rule,
    midpoint_rule,
    reaches,
    symmetric_rule,
)
from sobolev_batch.spectral.quadrature.shared_nodes import merged_corners, merged_midpoints
from sobolev_batch.spectral.quadrature.smooth import resolve
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.smooth import Smooth

Reals = NDArray[np.float64]
_Corners = tuple[Array, Array, Array]

# Triangles per slice: keeps the temporaries of a slice with a mid-sized rule near 50 MB.
_SLICE = 1 << 17
# Nodes of a parametrised surface that are made at a time: their temporaries take 4 MB.
_NODES = 1 << 14


@dataclass(frozen=True)
class WeightedPoints:
    """A sum of Dirac masses.

    Attributes:
        coordinates: (3, n) float64, one contiguous row per axis, in units of length.
        weights: (n,) float64, in squared units of length.

    Both are arrays of the backend that they were made on.
    """

    coordinates: Array
    weights: Array


@dataclass(frozen=True)
class Quadrature:
    """How triangles become points.

    Args:
        method: "auto" gives every triangle the cheapest rule that keeps the tolerance at all
            frequencies of the lattice, and subdivides those too large for any; an integer is the
            degree of one symmetric rule with interior nodes for all (1 to 50); "gauss8" is the
            64-point product rule of K. Koga's paper. A parametrised surface has a rule of its own,
            with as many nodes as the tolerance takes, whatever the method.

    Raises:
        InputError: any other method.
    """

    method: str | int = "auto"

    def __post_init__(self) -> None:
        if isinstance(self.method, bool) or (
            self.method not in ("auto", "gauss8")
            and not (isinstance(self.method, int) and 1 <= self.method <= HIGHEST_DEGREE)
        ):
            raise InputError(
                f"quadrature must be 'auto', 'gauss8' or a degree from 1 to {HIGHEST_DEGREE}, found {self.method!r}"
            )

    def batches(
        self, surface: Mesh | Smooth, highest_frequency: float, tolerance: float, capacity: int, backend: Backend = CPU
    ) -> Iterator[WeightedPoints]:
        """The points of a surface, in batches of at most ``capacity`` points, for a mesh nearly equal in size.

        Args:
            surface: a mesh or a parametrised surface.
            highest_frequency: the largest |ξ| at which the points must stand for the mesh, in
                cycles per unit length.
            tolerance: largest quadrature error at any such frequency, relative to the area; "auto"
                keeps it, the others ignore it.
            capacity: bound on the points of one batch, 8 times the largest rule (3,624) or more.
            backend: where to make the points; the rules are chosen on the processor.

        Raises:
            InputError: a parametrised surface whose quadrature does not settle.
        """
        if isinstance(surface, Smooth):
            yield from _smooth_batches(surface, highest_frequency, tolerance, capacity, backend)
            return
        groups = self._groups(surface, highest_frequency, tolerance)
        # Nodes are merged within a piece, hence large pieces where they are shared.
        pieces = [piece for group in groups for piece in group.cut(capacity // (2 if group.rule.sharing > 1 else 8))]
        ends = np.cumsum([piece.most_points for piece in pieces])
        total = int(ends[-1])
        count = -(-total // (capacity - max(piece.most_points for piece in pieces)))
        # A piece goes where it starts, so a batch ends at most one piece after its share of the points.
        batch_of = (np.concatenate([[0], ends[:-1]]) * count // total).tolist()
        faces = _Faces.of(surface, backend)
        for _, batch in groupby(zip(batch_of, pieces, strict=True), key=itemgetter(0)):
            yield _join([piece.points(faces, backend) for _, piece in batch])

    def lowest_degree(self, mesh: Mesh, highest_frequency: float, tolerance: float) -> int:
        """The lowest degree among the rules that triangles get: the one whose error shows first."""
        if self.method != "auto":
            return self._groups(mesh, highest_frequency, tolerance)[0].rule.degree
        rules, reach = reaches(tolerance)
        degrees = np.array([rule.degree for rule in rules])
        # Slice by slice: of tens of millions of triangles, groups take gigabytes.
        slices = (mesh.centroid_radii[first : first + _SLICE] for first in range(0, len(mesh.triangles), _SLICE))
        return min(int(degrees[choose_rules(2 * np.pi * highest_frequency * part, reach)[1]].min()) for part in slices)

    def sizes(self, surface: Mesh | Smooth, highest_frequency: float, tolerance: float) -> tuple[float, int]:
        """The expected number of points of a surface, and a bound that holds before shared ones are merged."""
        if isinstance(surface, Smooth):
            size = resolve(surface, highest_frequency, tolerance).size
            return float(size), size
        groups = self._groups(surface, highest_frequency, tolerance)
        expected = sum((group.most_points / (1 if group.splits else group.rule.sharing) for group in groups), 0.0)
        return expected, sum(group.most_points for group in groups)

    def _groups(self, mesh: Mesh, highest_frequency: float, tolerance: float) -> list[_Group]:
        everything = np.arange(len(mesh.triangles))
        if self.method == "gauss8":
            return [_Group(gauss_rule(8), 0, everything)]
        if isinstance(self.method, int):
            return [_Group(symmetric_rule(self.method), 0, everything)]
        return _cheapest_rules(mesh, 2 * np.pi * highest_frequency, tolerance)


@dataclass(frozen=True, eq=False)
class _Group:
    """Triangles that share a rule, each cut into 4^splits similar ones first.

    ``path`` names the quarter of a quarter ... of each triangle that is meant; empty for all of it.
    """

    rule: TriangleRule
    splits: int
    members: NDArray[np.int64]
    path: tuple[int, ...] = ()

    @property
    def most_points(self) -> int:
        return len(self.members) * self.rule.size << 2 * self.splits

    def cut(self, most: int) -> Iterator[_Group]:
        """Parts of at most ``most`` points, or of one undivided triangle."""
        each = self.rule.size << 2 * self.splits
        if each > most and self.splits:
            for quarter in range(4):
                yield from _Group(self.rule, self.splits - 1, self.members, (*self.path, quarter)).cut(most)
            return
        largest = most // each
        step = max(1, largest if self.rule.sharing > 1 else min(_SLICE, largest))
        for first in range(0, len(self.members), step):
            yield _Group(self.rule, self.splits, self.members[first : first + step], self.path)

    def points(self, faces: _Faces, backend: Backend) -> WeightedPoints:
        members = backend.upload(self.members)
        whole = not (self.splits or self.path)
        if self.rule is corner_rule() and whole:
            return WeightedPoints(*merged_corners(faces, members))
        if self.rule is midpoint_rule() and whole:
            return WeightedPoints(*merged_midpoints(faces, members))
        chosen = faces.triangles[members]
        a, b, c = (faces.vertices[chosen[:, corner]] for corner in range(3))
        areas = faces.areas[members] / 4 ** len(self.path)
        for quarter in self.path:
            a, b, c = _quarters((a, b, c))[quarter]
        for _ in range(self.splits):
            a, b, c = (np.concatenate(parts) for parts in zip(*_quarters((a, b, c)), strict=True))
            areas = np.tile(areas / 4, 4)
        rule = self.rule
        coordinates = np.empty((3, rule.size, len(areas)), like=areas)
        for axis in range(3):
            combine(rule.barycentric, np.stack([a[:, axis], b[:, axis], c[:, axis]]), out=coordinates[axis])
        weights = np.asarray(rule.weights, like=areas)[:, None] * areas
        return WeightedPoints(coordinates.reshape(3, -1), weights.ravel())


@dataclass(frozen=True, eq=False)
class _Faces:
    """What of a mesh its points are made from, on a backend: see `shared_nodes.Faces`."""

    vertices: Array
    triangles: Array
    areas: Array

    @classmethod
    def of(cls, mesh: Mesh, backend: Backend) -> _Faces:
        return cls(*map(backend.upload, (mesh.vertices, mesh.triangles, mesh.areas)))


def _cheapest_rules(mesh: Mesh, wavenumber: float, tolerance: float) -> list[_Group]:
    rules, reach = reaches(tolerance)
    sizes = wavenumber * mesh.centroid_radii
    splits, choice = choose_rules(np.array([sizes.min(), sizes.max()]), reach)
    if splits[0] == splits[1] and choice[0] == choice[1]:
        return [_Group(rules[choice[0]], int(splits[0]), np.arange(len(sizes)))]
    splits, choice = choose_rules(sizes, reach)
    kinds, group_of = np.unique(splits * len(rules) + choice, return_inverse=True)
    order = np.argsort(group_of, kind="stable")
    members = np.split(order, np.cumsum(np.bincount(group_of))[:-1])
    return [
        _Group(rules[kind % len(rules)], int(kind // len(rules)), chosen)
        for kind, chosen in zip(kinds.tolist(), members, strict=True)
    ]


def choose_rules(sizes: Reals, reach: Reals) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """How often triangles of sizes 2π|ξ|ρ are to be halved, and which of the rules each piece gets."""
    splits = np.ceil(np.log2(np.maximum(sizes / reach[-1], 1.0))).astype(np.int64)
    # Rounding of the logarithm may leave a size just beyond the last reach.
    choice = np.minimum(np.searchsorted(reach, sizes / 2.0**splits), len(reach) - 1)
    return splits, choice


def _quarters(corners: _Corners) -> tuple[_Corners, _Corners, _Corners, _Corners]:
    """Each triangle cut into four similar ones at its edge midpoints."""
    a, b, c = corners
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)


def _smooth_batches(
    surface: Smooth, highest_frequency: float, tolerance: float, capacity: int, backend: Backend
) -> Iterator[WeightedPoints]:
    """The nodes of a parametrised surface, gathered into batches."""
    counts = resolve(surface, highest_frequency, tolerance).counts
    made: list[WeightedPoints] = []
    gathered = 0
    for coordinates, weights in surface.nodes(counts, min(capacity, _NODES)):
        if gathered + len(weights) > capacity:
            yield _join(made)
            made, gathered = [], 0
        made.append(WeightedPoints(backend.upload(coordinates), backend.upload(weights)))
        gathered += len(weights)
    yield _join(made)


def _join(made: list[WeightedPoints]) -> WeightedPoints:
    if len(made) == 1:
        return made[0]
    return WeightedPoints(
        np.concatenate([points.coordinates for points in made], axis=1),
        np.concatenate([points.weights for points in made]),
    )
