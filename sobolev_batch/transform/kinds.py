"""The kinds of surfaces, each a class, and what transforms need of them: quadrature points and exact values."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from typing import Any, ClassVar

import numpy as np

from sobolev_batch.arrays import Complexes, Reals, slices
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.closed_forms import Sphere
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.smooth import Counts, Smooth
from sobolev_batch.transform.backends import CPU, Backend, compute_on
from sobolev_batch.transform.exact import exact_transform
from sobolev_batch.transform.faces import FaceArrays
from sobolev_batch.transform.lattice import FrequencyLattice
from sobolev_batch.transform.nufft import WeightedPoints
from sobolev_batch.transform.quadrature import RuleUse, assign_rules
from sobolev_batch.transform.resolution import direct_transform, exact_counts, resolution_of
from sobolev_batch.transform.rule_errors import loosest_tolerance, weight_masses
from sobolev_batch.transform.spheres import sphere_transform

# Nodes of a parametrised surface that are made at a time: their temporaries take 4 MB.
_NODES = 1 << 14
# With fewer triangles a GPU takes longer to help with the choice of their rules than the processor alone.
_MANY_TRIANGLES = 1 << 16
# The error of a parametrised surface's nodes grows with the frequency like that of a rule of a high degree: of the
# degrees tried on tori and ellipsoids with too few nodes, 8 and 16 drew frequencies that showed most of it.
_SMOOTH_DEGREE = 16
# A parametrised surface has at least this many nodes.
_FEWEST_NODES = 500


@dataclass(frozen=True, eq=False)
class SurfaceKind(ABC):
    """A surface as transforms see it: exact values anywhere, and points that stand for it up to a frequency.

    `kind_of` makes it, for exact values alone or with the attributes of points, which are chosen when first needed.

    Attributes:
        surface: Surface in units of length.
        highest_frequency: Largest |ξ| at which the points stand for the surface, in cycles per unit length.
        eps: Largest quadrature error there, relative to the area. Only "auto" and parametrised surfaces observe it.
        quadrature: As in `TransformSettings`, like the tolerance.
    """

    surface: Any
    highest_frequency: float = 0.0
    eps: float = 0.0
    quadrature: str | int = "auto"
    tolerance: float | None = None
    # True if the transform is a formula at every frequency.
    is_closed_form: ClassVar[bool] = False

    @property
    def triangles(self) -> int:
        """Number of triangles."""
        return 0

    @property
    def fewest_points(self) -> int:
        """Number of quadrature points at least, among which the errors of a NUFFT spread."""
        return 1

    @property
    @abstractmethod
    def expected_points(self) -> float:
        """Expected number of points."""

    @property
    @abstractmethod
    def largest_points(self) -> int:
        """Bound on the number of points, before shared ones are merged."""

    @property
    @abstractmethod
    def lowest_degree(self) -> int:
        """Lowest degree among the rules, whose error shows first; 0 for a closed form."""

    @property
    def change(self) -> float:
        """Change of values when nodes are doubled, over the area, where exact values come from such nodes too."""
        return 0.0

    def choose_points(self, backend: Backend) -> None:  # noqa: B027 -- most kinds need no help
        """Choose the points with the help of the backend that is to make them."""

    @abstractmethod
    def batches(self, capacity: int, backend: Backend = CPU) -> Iterator[WeightedPoints]:
        """Yield the points in nearly equal batches of at most a number, 8 times that of the largest rule or more."""

    @abstractmethod
    def exact_values(self, frequencies: Reals, threads: int = 1, backend: Backend = CPU) -> Complexes:
        """Return the exact transform at frequencies (P, 3), complex128 (P,). Threads and a backend may help."""

    def loosest_tolerance(self, lattice: FrequencyLattice, orders: Sequence[float], norms: Reals) -> float:
        """Return the largest tolerance of points whose error is predicted to have at most some norms (orders,)."""
        # Usually it bounds the error at every single frequency: assume it at all of them.
        return float(np.min(norms / (self.surface.area * np.sqrt(weight_masses(lattice, orders)))))


class _Triangles(SurfaceKind):
    @cached_property
    def uses(self) -> tuple[RuleUse, ...]:
        """Rules of the triangles, which take four bytes for each."""
        return self._chosen()

    def _chosen(self, backend: Backend = CPU) -> tuple[RuleUse, ...]:
        settings = self.highest_frequency, self.eps, self.quadrature, self.tolerance
        faces = None if backend is CPU or self.triangles < _MANY_TRIANGLES else self.faces(backend)
        return assign_rules(self.surface, *settings, faces, backend)

    def choose_points(self, backend: Backend) -> None:
        if backend is not CPU and "uses" not in self.__dict__:
            # Other threads have the device meanwhile.
            self.__dict__["uses"] = compute_on(backend, self._chosen, alone=False)

    def faces(self, backend: Backend) -> FaceArrays:
        """Return the triangles on a backend: on a device they stay for the next block."""
        if backend is CPU:
            return FaceArrays.of_mesh(self.surface)
        if "_faces" not in self.__dict__:
            self.__dict__["_faces"] = FaceArrays.of_mesh(self.surface, backend)
        found: FaceArrays = self.__dict__["_faces"]
        return found

    @property
    def triangles(self) -> int:
        return len(self.surface.triangles)

    @property
    def fewest_points(self) -> int:
        return self.triangles

    @property
    def expected_points(self) -> float:
        return sum((use.expected_points for use in self.uses), 0.0)

    @property
    def largest_points(self) -> int:
        return sum(use.largest_points for use in self.uses)

    @property
    def lowest_degree(self) -> int:
        return min(use.rule.degree for use in self.uses)

    def batches(self, capacity: int, backend: Backend = CPU) -> Iterator[WeightedPoints]:
        # Nodes are merged within a batch of triangles: these are large where nodes are shared.
        fits = self.expected_points <= capacity
        most = {True: capacity // (1 if fits else 2), False: capacity // 8}
        triangles = [batch for use in self.uses for batch in use.split(most[use.rule.shares])]
        expected = [batch.expected_points for batch in triangles]
        ends = np.cumsum(expected)
        total = float(ends[-1])
        count = math.ceil(total / (capacity if fits else capacity - max(expected)))
        # A batch of triangles goes where its first point goes, so that each batch of points exceeds its equal number by
        # at most one of these.
        numbers = (np.concatenate([[0], ends[:-1]]) * count // total).astype(int).tolist()
        faces = self.faces(backend)
        for _, group in groupby(zip(numbers, triangles, strict=True), key=itemgetter(0)):
            points = WeightedPoints.concatenated([batch.points(faces) for _, batch in group])
            # Where neighbours share fewer nodes than those of a closed mesh, there are more points than expected.
            yield from map(points.part, slices(len(points.weights), capacity))

    def exact_values(self, frequencies: Reals, threads: int = 1, backend: Backend = CPU) -> Complexes:
        return exact_transform(self.surface, frequencies, backend, threads)

    def loosest_tolerance(self, lattice: FrequencyLattice, orders: Sequence[float], norms: Reals) -> float:
        return loosest_tolerance(self.surface, lattice, orders, norms)


class _Parametrised(SurfaceKind):
    fewest_points = _FEWEST_NODES
    lowest_degree = _SMOOTH_DEGREE

    @property
    def resolution(self) -> tuple[Counts, float]:
        """Nodes along both parameters, and the change of the transform when they are doubled."""
        return resolution_of(self.surface, self.highest_frequency, self.tolerance or self.eps)

    @property
    def expected_points(self) -> float:
        return float(self.largest_points)

    @property
    def largest_points(self) -> int:
        return math.prod(self.resolution[0])

    @property
    def change(self) -> float:
        return self.resolution[1]

    def batches(self, capacity: int, backend: Backend = CPU) -> Iterator[WeightedPoints]:
        gathered: list[WeightedPoints] = []
        count = 0
        for coordinates, weights in self.surface.nodes(self.resolution[0], min(capacity, _NODES)):
            if count + len(weights) > capacity:
                yield WeightedPoints.concatenated(gathered)
                gathered, count = [], 0
            gathered.append(WeightedPoints(backend.upload(coordinates), backend.upload(weights)))
            count += len(weights)
        yield WeightedPoints.concatenated(gathered)

    def exact_values(self, frequencies: Reals, threads: int = 1, backend: Backend = CPU) -> Complexes:
        # With more nodes than it converges with, the error is about 1e-14 of the area, if half a million suffice.
        highest = float(np.linalg.norm(frequencies, axis=1).max(initial=0.0))
        return direct_transform(self.surface, exact_counts(self.surface, highest), frequencies)


class _ClosedForm(SurfaceKind):
    is_closed_form = True
    expected_points, largest_points, lowest_degree = 0.0, 0, 0

    def batches(self, capacity: int, backend: Backend = CPU) -> Iterator[WeightedPoints]:
        yield from ()

    def exact_values(self, frequencies: Reals, threads: int = 1, backend: Backend = CPU) -> Complexes:
        return sphere_transform(self.surface, frequencies)


_KINDS: Mapping[type, type[SurfaceKind]] = {Mesh: _Triangles, Smooth: _Parametrised, Sphere: _ClosedForm}


def kind_of(surface: object, *of_points: Any) -> SurfaceKind:
    """Return a surface as transforms see it, with some `of_points`; InputError where it is of no known kind."""
    for surface_type, kind in _KINDS.items():
        if isinstance(surface, surface_type):
            return kind(surface.with_area if isinstance(surface, Mesh) else surface, *of_points)
    expected = "a Mesh, a Sphere or a parametrised surface (Ellipsoid, Torus, ParametrisedSurface)"
    raise InputError(f"a surface must be {expected}, found {type(surface).__name__}")
