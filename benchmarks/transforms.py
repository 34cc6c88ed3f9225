"""Times of one transform: against the paper's pipeline, against the direct sum, and how they grow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

import sobolev_batch as sb
from benchmarks.direct import direct_transform, frequencies_of
from benchmarks.paper import faster_upsampling, relative_distance, whole_transform
from benchmarks.table import Row, as_seconds, at_least, at_most
from benchmarks.timing import Effort, take_turns
from sobolev_batch.arrays import ComplexDtype, Complexes
from sobolev_batch.transform.exact import exact_transform
from sobolev_batch.transform.fourier import ErrorTarget, Execution, TransformSettings, choose_settings, transform_block

ORDER = -10.0
XI_MAX = 5.0
_EPS: dict[ComplexDtype, float] = {"complex128": 1e-9, "complex64": 1e-6}
# The norm of the field's own error over the distance. What it does to the distance is less, and measured.
_FIELD_ERROR = 6e-6
_SPEED_UP, _BY_DEFAULT = at_least(18), at_least(8)
_SAME_DISTANCE = at_most(2e-6)
# Relative to the area. The direct sum's guard keeps some eleven digits.
_DIRECT_AGREES = 1e-9


@dataclass(frozen=True)
class Case:
    """One mesh on one lattice, for both pipelines.

    Attributes:
        mesh: its caches may be filled.
        lattice: the frequencies.
        dtype: of both pipelines.
        threads: of both NUFFTs.
        upsampling: of the paper's.
        error_target: what the package's field may err; both have the same eps.
    """

    mesh: sb.Mesh
    lattice: sb.Lattice
    dtype: ComplexDtype
    threads: int
    upsampling: float
    error_target: ErrorTarget

    @classmethod
    @cache
    def from_level(cls, level: int, intervals: int, effort: Effort, dtype: ComplexDtype = "complex128") -> Case:
        """An icosphere on a lattice up to 5 cycles per unit length."""
        mesh, lattice = sb.shapes.icosphere(level), sb.Lattice(XI_MAX, intervals)
        upsampling = faster_upsampling(mesh, lattice, eps=_EPS[dtype], dtype=dtype, threads=effort.threads)
        return cls(mesh, lattice, dtype, effort.threads, upsampling, error_target_of_the_paper(mesh))

    def fresh_mesh(self) -> sb.Mesh:
        """The mesh as `fresh` leaves it."""
        return fresh(self.mesh)

    def ours(self, mesh: sb.Mesh) -> Complexes:
        """The package's transform, on half the lattice."""
        settings = choose_settings(mesh, self.lattice, self.error_target, TransformSettings(dtype=self.dtype))
        same_eps = replace(settings, eps=_EPS[self.dtype])
        return transform_block(mesh, self.lattice, self.lattice.half, same_eps, Execution(threads=self.threads)).values

    def papers(self, mesh: sb.Mesh) -> Complexes:
        """The paper's transform, on all of it."""
        return whole_transform(
            mesh,
            self.lattice,
            eps=_EPS[self.dtype],
            dtype=self.dtype,
            upsampling=self.upsampling,
            threads=self.threads,
        )

    def times(self, repeats: int) -> tuple[float, float]:
        """Median seconds of the package's transform and the paper's."""
        ours, papers = take_turns([self.ours, self.papers], self.fresh_mesh, repeats)
        return ours, papers

    def distances(self) -> tuple[float, float]:
        """The relative distance to the unit sphere from the package's transform and the paper's."""
        sphere = sb.fourier_transform(sb.shapes.Sphere(), self.lattice)
        field = sphere.copy(data=self.ours(self.mesh))
        ours = sb.distance(field, sphere, ORDER)["distance"].item() / sb.norm(sphere, ORDER)["norm"].item()
        return ours, relative_distance(self.papers(self.mesh), self.lattice, ORDER)


def error_target_of_the_paper(mesh: sb.Mesh) -> ErrorTarget:
    """The error of a field that keeps the digits of its mesh's distance to the unit sphere."""
    distance = sb.distance(mesh, sb.shapes.Sphere(), ORDER, rtol=1e-2)["distance"].item()
    return ErrorTarget((ORDER,), (_FIELD_ERROR * distance,))


def settings_of_the_paper(mesh: sb.Mesh, lattice: sb.Lattice, dtype: ComplexDtype) -> TransformSettings:
    """The settings that items 1 and 3 arrive at for a mesh."""
    settings = choose_settings(mesh, lattice, error_target_of_the_paper(mesh), TransformSettings(dtype=dtype))
    return replace(settings, eps=_EPS[dtype])


def fresh(mesh: sb.Mesh) -> sb.Mesh:
    """A mesh with none of its lengths or bounds known yet, as one that was just read."""
    return sb.Mesh(mesh.vertices, mesh.triangles)


def our_transform(mesh: sb.Mesh, lattice: sb.Lattice, threads: int) -> Complexes:
    """The package's transform on half the lattice, with its default settings."""
    return transform_block(mesh, lattice, lattice.half, TransformSettings(), Execution(threads=threads)).values


def against_the_paper(effort: Effort) -> Iterator[Row]:
    """Item 1: the finest icosphere of the paper in double precision, with a loose rule and with the default one."""
    yield from _speed_up_and_distance("1", "complex128", effort)
    level, intervals = (4, 32) if effort.quick else (7, 128)
    case = Case.from_level(level, intervals, effort)

    def ours(mesh: sb.Mesh) -> Complexes:
        return our_transform(mesh, case.lattice, effort.threads)

    fast, slow = take_turns([ours, case.papers], case.fresh_mesh, effort.repeats)
    what = f"T_{level}, M = {intervals}, default settings: transform"
    yield Row("1", what, as_seconds(fast), as_seconds(slow), slow / fast, _BY_DEFAULT)


def as_in_the_paper(effort: Effort) -> Iterator[Row]:
    """Item 3: the same in single precision, and the sizes of the paper's Fig. 4."""
    yield from _speed_up_and_distance("3", "complex64", effort)
    level, intervals = (2, 32) if effort.quick else (5, 128)
    finest = 3 if effort.quick else 7
    sizes = [(n, intervals) for n in range(finest + 1)]
    sizes += [(level, m) for m in ((48,) if effort.quick else (32, 64))]
    if effort.large:
        sizes += [(level, m) for m in (256, 416)]
    for n, m in sizes:
        ours, papers = Case.from_level(n, m, effort).times(effort.repeats)
        yield Row("3", f"Fig. 4: T_{n}, M = {m}", as_seconds(ours), as_seconds(papers), papers / ours)


def against_the_direct_sum(effort: Effort) -> Iterator[Row]:
    """Item 4: the exact formula, timed where it finishes and carried on by its O(triangles · frequencies)."""
    level, intervals = (2, 24) if effort.quick else (3, 32)
    mesh, lattice = sb.shapes.icosphere(level), sb.Lattice(XI_MAX, intervals)
    frequencies = frequencies_of(lattice, lattice.half)
    few = frequencies[:: len(frequencies) // 7]
    error = float(np.abs(direct_transform(mesh, few) - exact_transform(mesh, few)).max() / mesh.area)
    yield Row("4", "direct sum: error relative to the area", ratio=error, target=at_most(_DIRECT_AGREES))

    def ours(given: sb.Mesh) -> object:
        return our_transform(given, lattice, effort.threads)

    def direct(given: sb.Mesh) -> object:
        return direct_transform(given, frequencies)

    fast, slow = take_turns([ours, direct], lambda: fresh(mesh), effort.repeats)
    yield Row("4", f"direct sum: T_{level}, half of M = {intervals}", as_seconds(fast), as_seconds(slow), slow / fast)
    finest, most = (4, 32) if effort.quick else (7, 128)
    large, whole = sb.shapes.icosphere(finest), sb.Lattice(XI_MAX, most)
    larger = len(large.triangles) / len(mesh.triangles) * (whole.half.size / lattice.half.size)
    fast = _our_seconds(large, whole, effort)
    what = f"direct sum: T_{finest}, half of M = {most}, extrapolated"
    yield Row("4", what, as_seconds(fast), as_seconds(slow * larger), slow * larger / fast)


def growth(effort: Effort) -> Iterator[Row]:
    """Exponents of the package's time in the triangles and in the intervals per axis."""
    levels = range(1, 4) if effort.quick else range(3, 9 if effort.large else 8)
    intervals = 32 if effort.quick else 64
    meshes = [sb.shapes.icosphere(level) for level in levels]
    lattice = sb.Lattice(XI_MAX, intervals)
    yield _fitted(
        f"time against triangles: T_{levels[0]} to T_{levels[-1]}, M = {intervals}",
        [len(mesh.triangles) for mesh in meshes],
        [_our_seconds(mesh, lattice, effort) for mesh in meshes],
    )
    level = 3 if effort.quick else 5
    mesh = sb.shapes.icosphere(level)
    sizes = (24, 32, 48) if effort.quick else (32, 64, 128, 256)
    yield _fitted(
        f"time against M: T_{level}, M = {sizes[0]} to {sizes[-1]}",
        sizes,
        [_our_seconds(mesh, sb.Lattice(XI_MAX, m), effort) for m in sizes],
    )


def _speed_up_and_distance(item: str, dtype: ComplexDtype, effort: Effort) -> Iterator[Row]:
    level, intervals = (4, 32) if effort.quick else (7, 128)
    case = Case.from_level(level, intervals, effort, dtype)
    ours, papers = case.times(effort.repeats)
    what = f"T_{level}, M = {intervals}, {dtype}"
    # Single precision holds six digits of a field, hence about one of so small a distance.
    double = dtype == "complex128"
    speed_up, target = (_SPEED_UP, _SAME_DISTANCE) if double else (None, None)
    yield Row(item, f"{what}: transform", as_seconds(ours), as_seconds(papers), papers / ours, speed_up)
    near, far = case.distances()
    difference = abs(near - far) / far
    yield Row(item, f"{what}: distance, relative difference", f"{near:.6e}", f"{far:.6e}", difference, target)


def _our_seconds(mesh: sb.Mesh, lattice: sb.Lattice, effort: Effort) -> float:
    def transform(given: sb.Mesh) -> object:
        return our_transform(given, lattice, effort.threads)

    (seconds,) = take_turns([transform], lambda: fresh(mesh), effort.repeats)
    return seconds


def _fitted(what: str, sizes: Sequence[int], seconds: Sequence[float]) -> Row:
    exponent = float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])
    ends = f"{as_seconds(seconds[0])} to {as_seconds(seconds[-1])}"
    return Row("growth", f"{what}, exponent", ends, ratio=exponent)
