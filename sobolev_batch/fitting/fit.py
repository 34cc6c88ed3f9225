"""Meshes that come nearer to a target: their vertices move to lower a squared distance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sobolev_batch.errors import InputError
from sobolev_batch.fitting.closeness import Closeness
from sobolev_batch.fitting.defaults import DEFAULT_ORDER, DEFAULT_SMOOTHING, DEFAULT_STEPS
from sobolev_batch.fitting.optimisation.descent import End
from sobolev_batch.fitting.optimisation.stages import FitProgress, FitSettings, Run
from sobolev_batch.fitting.task import FitTask
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.metrics.inputs import Operand, OperandLike, as_operand
from sobolev_batch.spectral.transform.settings import Execution, thread_count
from sobolev_batch.surfaces.formats.objects import MeshLike, as_mesh
from sobolev_batch.surfaces.shapes.mesh import Mesh

# Growth of the Hausdorff distance that a user should know.
_HAUSDORFF_GROWTH = 1.5


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted mesh.

    Attributes:
        mesh: The mesh, in the start's unit of length; from `fit` with the triangles of the start.
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
    mesh: MeshLike,
    target: OperandLike,
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

    Triangles stay as they are, and no step turns one over. An interrupt (Ctrl-C) ends the fit with the best mesh so
    far.

    Args:
        mesh: Mesh to start from, or what `as_mesh` makes one of. Vertices at one place move together.
        target: Surface in the same unit of length, or its field from `fourier_transform` or a store. Distances depend
            on the unit: bring both to the unit ball with a `Similarity` unless you have reasons.
        order: Order s < -1/2 of the distance. At orders of -1.5 and below, the squared distance at half the order is
            lowered too, with a tenth of the weight, so that the mesh keeps its detail.
        lattice: Lattice of the frequencies that the fit looks at; chosen by the mean edge if not given. A field brings
            its own.
        steps: Largest number of steps.
        smoothing: Weight λ of the mesh's Laplacian in steps. A larger one keeps triangles and worst points better, and
            the distance falls less. A start that is far away takes at least 4.
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
    >>> fitted = sb.fit(sb.icosphere(1), sb.Sphere(), -4.0, steps=8)
    >>> fitted.after.distance < fitted.before.distance / 4
    True
    """
    mesh, target = as_mesh(mesh), as_operand(target)
    settings = FitSettings(order, steps, smoothing, keep_boundary)
    task = FitTask.of(mesh, target, lattice, settings, Execution(threads=thread_count(threads)))
    before = measured(task)
    fitted, run = task.run(notify)
    return concluded(mesh, before, task, fitted, run)


def fitted_mesh(mesh: Mesh, target: Operand, settings: FitSettings, execution: Execution) -> Mesh:
    """Return the mesh that `fit` finds, without measures of its closeness.

    Raises:
        LatticeError: The mesh does not fit into the lattice of a field.
        InputError: See `fit`.
    """
    task = FitTask.of(mesh, target, None, settings, execution)
    fitted, _ = task.run()
    return task.own(fitted)


def measured(task: FitTask) -> Closeness:
    """Return the closeness of the start.

    Raises:
        InputError: The field cannot serve the order.
    """
    before = task.closeness(task.start)
    if before.error >= before.distance > 0 and isinstance(task.target, xr.DataArray):
        raise InputError(
            f"the field ends at the frequency {task.problem.lattice.xi_max:g}: at order {task.settings.order:g} the "
            f"distance {before.distance:.2g} has an error of {before.error:.2g}, so there is nothing that a fit could "
            "lower; take a more negative order, or a field on a larger lattice"
        )
    return before


def concluded(start: Mesh, before: Closeness, task: FitTask, fitted: Mesh, run: Run) -> Fit:
    """Return a fit with its end, or with the start if that is nearer.

    Args:
        start: Mesh that was given.
        before: Closeness of the start.
        task: Last task of the fit.
        fitted: Prepared mesh at its end.
        run: Its run.
    """
    mesh, remarks, end = task.own(fitted), [], run.end
    try:
        after = task.closeness(fitted)
    except KeyboardInterrupt:
        after, end = Closeness.unknown(), End.INTERRUPTED
        remarks.append("it was interrupted before the mesh was measured")
    if after.distance - np.nan_to_num(after.error) > before.distance + np.nan_to_num(before.error):
        remarks.append("no nearer mesh was found: this is the start")
        mesh, after = start, before
    if after.error >= after.distance > 0:
        remarks.append("the distance is not larger than its error: ask for a more negative order")
    if after.hausdorff > _HAUSDORFF_GROWTH * before.hausdorff:
        remarks.append(
            f"the Hausdorff distance grew {after.hausdorff / before.hausdorff:.2g} times: the worst point lies "
            "farther away than before; take a larger smoothing or a less negative order"
        )
    return Fit(mesh, task.settings.order, before, after, run.taken, end.value, tuple(remarks))
