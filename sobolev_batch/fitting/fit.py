"""Meshes that come nearer to a target: their vertices move to lower a squared distance."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.fitting.closeness import Closeness
from sobolev_batch.fitting.derivative.transform import require_mesh
from sobolev_batch.fitting.optimisation.problem import FitProblem
from sobolev_batch.fitting.optimisation.stages import (
    DEFAULT_ORDER,
    DEFAULT_SMOOTHING,
    DEFAULT_STEPS,
    FitProgress,
    FitSettings,
    Run,
    stages_of,
)
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.metrics.inputs import Operand, check_surface, common_lattice, field_of, quality_of
from sobolev_batch.spectral.transform.settings import Execution
from sobolev_batch.surfaces.shapes.extent import Extent
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.shapes.surface import Surface

Reals = NDArray[np.float64]

# Start and target whose sizes differ by this factor are in different units.
_OTHER_UNIT = 20.0
_HAUSDORFF_GROWTH = 1.5


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
    order: float = DEFAULT_ORDER,
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
            is added, relative to the start, so that the mesh keeps its detail.
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
    settings = FitSettings(order, steps, smoothing, keep_boundary)
    task = _Task.of(mesh, target, lattice, settings, Execution(threads=threads or os.cpu_count() or 1))
    before = task.closeness(task.start)
    if before.error >= before.distance > 0 and isinstance(target, xr.DataArray):
        raise InputError(
            f"the field ends at the frequency {task.problem.lattice.xi_max:g}: at order {settings.order:g} the "
            f"distance {before.distance:.2g} has an error of {before.error:.2g}, so there is nothing that a fit could "
            "lower; take a more negative order, or a field on a larger lattice"
        )
    run = Run(task.problem, task.free, steps, notify)
    fitted = Mesh(run.carried_out(stages_of(task.problem, settings)), task.start.triangles)
    after = task.closeness(fitted)
    remarks = []
    if after.distance - after.error > before.distance + before.error:
        remarks.append("no nearer mesh was found: this is the start")
        fitted, after = task.start, before
    if after.hausdorff > _HAUSDORFF_GROWTH * before.hausdorff:
        remarks.append(
            f"the Hausdorff distance grew from {before.hausdorff:.2g} to {after.hausdorff:.2g}: the worst point lies "
            "farther away than before; take a larger smoothing or a less negative order"
        )
    return Fit(task.own(fitted), settings.order, before, after, run.taken, run.end.value, tuple(remarks))


def fitted_mesh(mesh: Mesh, target: Operand, settings: FitSettings, execution: Execution) -> Mesh:
    """Return the mesh that `fit` finds, without measures of its closeness; the start if it would be farther away.

    Raises:
        LatticeError: The mesh does not fit into the lattice of a field.
        InputError: See `fit`.
    """
    task = _Task.of(mesh, target, None, settings, execution)
    vertices = Run(task.problem, task.free, settings.steps, None).carried_out(stages_of(task.problem, settings))
    before, after = (
        task.problem.squares(one, [settings.order])[0] for one in (np.asarray(task.start.vertices), vertices)
    )
    return task.own(Mesh(vertices, task.start.triangles)) if after <= before else mesh


@dataclass(frozen=True, eq=False)
class _Task:
    """A fit, brought to a common centre and to vertices that all differ.

    Attributes:
        mesh: Mesh as it was given.
        start: The same mesh, prepared.
        place: Vertex of the prepared mesh for each vertex of the given one.
        move: Movement to the centre.
        target: Target, moved with the mesh.
        problem: Mesh and field of the target.
        settings: Settings.
    """

    mesh: Mesh
    start: Mesh
    place: NDArray[np.int64]
    move: Similarity
    target: Operand
    problem: FitProblem
    settings: FitSettings

    @classmethod
    def of(
        cls, mesh: Mesh, target: Operand, lattice: Lattice | None, settings: FitSettings, execution: Execution
    ) -> Self:
        _require_comparable(mesh, target)
        start, place = _welded(mesh)
        move = Similarity()
        if isinstance(target, xr.DataArray):
            field = field_of(target, common_lattice((target,), lattice), (settings.order,))
            problem = FitProblem.of_field(start, field, execution)
        else:
            if lattice is None:
                move = _centering(start, target)
            start, target = move.apply(start), move.apply(target)
            orders = tuple(dict.fromkeys((settings.order, settings.coarse_order)))
            problem = FitProblem.of_surface(start, target, lattice, orders, execution)
        return cls(mesh, start, place, move, target, problem, settings)

    @property
    def free(self) -> NDArray[np.int64]:
        """Vertices that may move."""
        return _free_vertices(self.start, keep_boundary=self.settings.keep_boundary)

    def closeness(self, mesh: Mesh) -> Closeness:
        """Measure how close a prepared mesh is to the target."""
        return Closeness.of(mesh, self.target, self.settings.order, self.problem.lattice)

    def own(self, mesh: Mesh) -> Mesh:
        """Return a prepared mesh with the vertices and triangles of the given one, at its place."""
        vertices = np.asarray(mesh.vertices)[self.place] + np.asarray(self.move.origin)
        return Mesh(vertices, self.mesh.triangles)


def _require_comparable(mesh: Mesh, target: Operand) -> None:
    """Refuse a mesh and target with which there is nothing to fit.

    Raises:
        InputError: See `fit`.
    """
    require_mesh(mesh)
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
