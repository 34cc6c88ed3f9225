"""Meshes that come nearer to a target: their vertices move to lower a squared distance."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.fitting.closeness import Closeness
from sobolev_batch.fitting.descent import End, descend
from sobolev_batch.fitting.problem import FitProblem, Weighting
from sobolev_batch.fitting.smoothing import Smoothing
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.metrics.inputs import Operand, check_surface, common_lattice, field_of, quality_of
from sobolev_batch.spectral.shells import check_orders
from sobolev_batch.spectral.transform.settings import Execution
from sobolev_batch.surfaces.shapes.extent import Extent
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.shapes.surface import Surface

Reals = NDArray[np.float64]

DEFAULT_STEPS, DEFAULT_SMOOTHING = 150, 0.25
# Far away, very negative orders lead: their kernels are wide.
_COARSE_ORDER = -4.0
# Beyond this relative distance at the coarse order, a mesh is far from its target.
_FAR = 0.05
# Smoothing of the stages that bring a far mesh near, and the fraction of all steps for each.
_FAR_SMOOTHINGS, _FAR_STEPS = (16.0, 4.0), 0.25
# The share of a squared distance at half the order, which keeps detail that the order itself hardly sees.
_DETAIL_SHARE, _HIGHEST_DETAILED = 0.1, -1.5
# After a step that would turn triangles over, smoothing is increased by this factor, so often at most.
_SMOOTHER, _MOST_RETREATS = 4.0, 4
# Start and target whose sizes differ by this factor are in different units.
_OTHER_UNIT = 20.0
_HAUSDORFF_GROWTH = 1.5


@dataclass(frozen=True)
class FitProgress:
    """The state of a fit after a step.

    Attributes:
        step: Number of steps so far.
        steps: Largest number of steps.
        relative: Present objective over that at the start of the stage, as a ratio of distances.

    >>> import sobolev_batch as sb
    >>> sb.FitProgress(step=3, steps=150, relative=0.5).relative
    0.5
    """

    step: int
    steps: int
    relative: float


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted mesh.

    Attributes:
        mesh: The mesh, with the triangles of the start and moved vertices, in the start's unit of length.
        order: Order s of the distance that was lowered.
        before: Closeness of the start to the target.
        after: Closeness of the fitted mesh.
        steps: Number of steps that were taken.
        end: Why the fit ended.
        remarks: What a user should know about the mesh, as sentences.

    >>> import sobolev_batch as sb
    >>> fitted = sb.fit(sb.icosphere(1), sb.Sphere(1.1), -4.0, steps=5)
    >>> fitted.steps, fitted.end
    (5, 'all steps are taken')
    """

    mesh: Mesh
    order: float
    before: Closeness
    after: Closeness
    steps: int
    end: str
    remarks: tuple[str, ...] = ()


def fit(
    mesh: Mesh,
    target: Operand,
    order: float = -2.0,
    *,
    lattice: Lattice | None = None,
    steps: int = DEFAULT_STEPS,
    smoothing: float = DEFAULT_SMOOTHING,
    keep_boundary: bool = False,
    threads: int | None = None,
    notify: Callable[[FitProgress], None] | None = None,
) -> Fit:
    """Move the vertices of a mesh to lower its Sobolev distance from a target.

    Triangles stay as they are, and none is turned over. An interrupt (Ctrl-C) ends the fit with the best mesh so far.

    Args:
        mesh: Mesh to start from. Vertices at one place move together.
        target: Surface in the same unit of length, or its field from `fourier_transform` or a store. Distances depend
            on the unit: bring both to the unit ball with a `Similarity` unless you have reasons.
        order: Order s < -1/2 of the distance. At orders up to -1.5, a tenth of the squared distance at half the order
            is added, relative to the start,, so that the mesh keeps its detail.
        lattice: Lattice of the frequencies that the fit looks at; chosen by the mean edge if not given. A field brings
            its own.
        steps: Largest number of steps.
        smoothing: Weight λ of the mesh's Laplacian in steps. A larger one keeps triangles and worst points better, and
            the distance falls less.
        keep_boundary: Leave vertices of open boundaries where they are.
        threads: Threads of the NUFFT; one per core by default.
        notify: Called after each step.

    Returns:
        The fitted mesh with its closeness before and after. It is never farther away than the start by more than the
        reported errors.

    Raises:
        OrderError: The order is not below -1/2.
        LatticeError: The mesh or target does not fit into the lattice.
        InputError: The start is not a mesh, lies apart from its target or in another unit; the field cannot serve the
            order; or a setting is out of range.

    >>> import sobolev_batch as sb
    >>> fitted = sb.fit(sb.icosphere(1), sb.Sphere(), -4.0, steps=20)
    >>> fitted.after.distance < fitted.before.distance / 4
    True
    """
    (checked,) = _one_order(order)
    _check(mesh, target, steps, smoothing)
    execution = Execution(threads=threads or os.cpu_count() or 1)
    start, place = _welded(mesh)
    move = Similarity()
    if isinstance(target, xr.DataArray):
        field = field_of(target, common_lattice((target,), lattice), (checked,))
        problem = FitProblem.of_field(start, field, execution)
    else:
        if lattice is None:
            move = _centering(start, target)
        start, target = move.apply(start), move.apply(target)
        problem = FitProblem.of_surface(start, target, lattice, _orders_of(checked), execution)
    before = Closeness.of(start, target, checked, problem.lattice)
    if before.error >= before.distance > 0 and isinstance(target, xr.DataArray):
        raise InputError(
            f"the field ends at the frequency {problem.lattice.xi_max:g}: at order {checked:g} the distance "
            f"{before.distance:.2g} has an error of {before.error:.2g}, so there is nothing that a fit could lower; "
            "take a more negative order, or a field on a larger lattice"
        )
    run = _Run(problem, _free_vertices(start, keep_boundary=keep_boundary), steps, notify)
    vertices = run.carried_out(_stages(problem, checked, smoothing, steps))
    fitted = Mesh(vertices, start.triangles)
    after = Closeness.of(fitted, target, checked, problem.lattice)
    remarks = []
    if after.distance - after.error > before.distance + before.error:
        remarks.append("no nearer mesh was found: this is the start")
        fitted, after = start, before
    if after.hausdorff > _HAUSDORFF_GROWTH * before.hausdorff:
        remarks.append(
            f"the Hausdorff distance grew from {before.hausdorff:.2g} to {after.hausdorff:.2g}: the worst point lies "
            "farther away than before; take a larger smoothing or a less negative order"
        )
    own = Mesh(np.asarray(fitted.vertices)[place] / move.scale + np.asarray(move.origin), mesh.triangles)
    return Fit(own, checked, before, after, run.taken, run.end.value, tuple(remarks))


@dataclass(frozen=True)
class _Stage:
    """A part of a fit: orders with the share of each in the objective, smoothing, and a largest number of steps."""

    shares: tuple[tuple[float, float], ...]
    smoothing: float
    steps: int


class _Run:
    """A fit that is under way."""

    def __init__(
        self, problem: FitProblem, free: NDArray[np.int64], steps: int, notify: Callable[[FitProgress], None] | None
    ) -> None:
        self.problem, self.free, self.steps, self.notify = problem, free, steps, notify
        self.taken = 0
        self.end = End.CONVERGED

    def carried_out(self, stages: list[_Stage]) -> Reals:
        """Return the vertices after all stages."""
        vertices = np.asarray(self.problem.mesh.vertices)
        for stage in stages:
            vertices = self._after(stage, vertices)
            if self.end is End.INTERRUPTED:
                break
        return vertices

    def _after(self, stage: _Stage, vertices: Reals) -> Reals:
        """Return the vertices after a stage: descents with ever finer fields, and smoother steps where needed."""
        orders = tuple(order for order, _ in stage.shares)
        squares = np.maximum(self.problem.squares(vertices, orders), np.finfo(np.float64).tiny)
        weighting = Weighting(orders, tuple(share / one for (_, share), one in zip(stage.shares, squares, strict=True)))
        smoothing = Smoothing.of(self.problem.mesh, self.free, stage.smoothing)
        unit, left, retreats = self.problem.mesh.edge_length_range[0], stage.steps, 0
        while left > 0:
            objective, floor = self.problem.objective(vertices, weighting)
            descent = descend(objective, vertices, smoothing, left, floor, unit, self._counted)
            vertices, left, self.end = descent.vertices, left - descent.steps, descent.end
            if descent.end in (End.TURNED, End.LEFT) and retreats < _MOST_RETREATS:
                retreats += 1
                smoothing = replace(smoothing, amount=max(_SMOOTHER * smoothing.amount, 1.0))
            # Finer fields may show the way on, unless they are as fine as they can be.
            elif descent.end is not End.ERROR or not descent.steps:
                break
        return vertices

    def _counted(self, squared: float) -> None:
        self.taken += 1
        if self.notify is not None:
            self.notify(FitProgress(self.taken, self.steps, float(np.sqrt(squared))))


def _stages(problem: FitProblem, order: float, smoothing: float, steps: int) -> list[_Stage]:
    vertices = np.asarray(problem.mesh.vertices)
    coarse = min(order, _COARSE_ORDER)
    stages = []
    if problem.relative(vertices, coarse) > _FAR:
        part = max(1, int(_FAR_STEPS * steps))
        stages = [_Stage(((coarse, 1.0),), amount, part) for amount in _FAR_SMOOTHINGS]
        smoothing = max(smoothing, _FAR_SMOOTHINGS[-1])
    shares = ((order, 1.0), (order / 2, _DETAIL_SHARE)) if order <= _HIGHEST_DETAILED else ((order, 1.0),)
    return [*stages, _Stage(shares, smoothing, max(1, steps - sum(stage.steps for stage in stages)))]


def _orders_of(order: float) -> tuple[float, ...]:
    """Return the orders at which a fit looks."""
    return tuple(dict.fromkeys((order, min(order, _COARSE_ORDER))))


def _one_order(order: float) -> tuple[float, ...]:
    orders = check_orders(order)
    if len(orders) > 1:
        raise InputError(f"one order is needed, found {len(orders)}")
    return orders


def _check(mesh: Mesh, target: Operand, steps: int, smoothing: float) -> None:
    """Refuse arguments with which there is nothing to fit.

    Raises:
        InputError: See `fit`.
    """
    if not isinstance(mesh, Mesh):
        raise InputError(f"only the vertices of a Mesh can move, found {type(mesh).__name__}")
    if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
        raise InputError(f"steps must be a whole number from 1 on, found {steps!r}")
    if isinstance(smoothing, bool) or not isinstance(smoothing, int | float) or not 0 <= smoothing < np.inf:
        raise InputError(f"smoothing must be a number from 0 on, found {smoothing!r}")
    if isinstance(target, xr.DataArray):
        quality = quality_of(target)
        extent = None if quality is None else quality.extent
    else:
        check_surface(target)
        extent = target.extent
    if extent is not None:
        _require_one_place(mesh.extent, extent)


def _require_one_place(start: Extent, target: Extent) -> None:
    ratio = float(start.widths.max() / target.widths.max())
    if not 1 / _OTHER_UNIT < ratio < _OTHER_UNIT:
        raise InputError(
            f"the start is {start.widths.max():.3g} units wide and the target {target.widths.max():.3g}: "
            "are both in the same unit of length?"
        )
    (low, high), (other_low, other_high) = start.box, target.box
    if np.any(low > other_high) or np.any(other_low > high):
        raise InputError(
            f"the start ({_corners(low, high)}) and the target ({_corners(other_low, other_high)}) do not overlap: "
            "move one of them to the other first"
        )


def _corners(low: Reals, high: Reals) -> str:
    return " to ".join("(" + ", ".join(f"{x:.3g}" for x in corner) + ")" for corner in (low, high))


def _welded(mesh: Mesh) -> tuple[Mesh, NDArray[np.int64]]:
    """Return a mesh without coinciding vertices, and the vertex there of each vertex of the mesh."""
    # Zero has two signs.
    places, place = np.unique(mesh.vertices + 0.0, axis=0, return_inverse=True)
    return Mesh(places, place.reshape(-1)[mesh.triangles]), place.reshape(-1)


def _centering(start: Mesh, target: Surface) -> Similarity:
    low, high = Extent.union([start.extent, target.extent]).box
    x, y, z = ((low + high) / 2).tolist()
    return Similarity(1.0, (x, y, z))


def _free_vertices(mesh: Mesh, *, keep_boundary: bool) -> NDArray[np.int64]:
    """Return the vertices that may move: those of triangles, without boundaries if these are kept.

    Raises:
        InputError: There are none.
    """
    free = np.asarray(mesh.used_vertices)
    if keep_boundary:
        sides = np.sort(np.asarray(mesh.triangles)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        edges, counts = np.unique(sides, axis=0, return_counts=True)
        free = np.setdiff1d(free, edges[counts == 1])
    if not len(free):
        raise InputError("all vertices lie on the boundary: there is nothing to move")
    return free
