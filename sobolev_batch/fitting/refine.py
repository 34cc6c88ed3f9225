"""Finer meshes: their edges are split where that brings them nearest to a target, and their vertices move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from sobolev_batch.errors import InputError
from sobolev_batch.fitting import DEFAULT_ORDER, DEFAULT_SMOOTHING, DEFAULT_STEPS
from sobolev_batch.fitting.descent import End
from sobolev_batch.fitting.fit import Fit, FitProgress, FitRun, conclude, start_quality
from sobolev_batch.fitting.problem import FitProblem, FitSettings, welded
from sobolev_batch.parameters import is_whole_number
from sobolev_batch.spectral.fields import Operand, OperandLike, as_operand
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.transform.settings import Execution, thread_count
from sobolev_batch.surfaces.formats.readers import MeshLike, as_mesh
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.subdivision import Edges

# While the goal is larger by this factor, all edges are split. A choice of triangles came no nearer then: fits pull
# vertices to where they are needed, and even splits leave better triangles.
_EVEN_ABOVE = 4
# Then a finer mesh has at most this factor times the triangles of the one before.
_GROWTH = 2.0
# The last factor may be a little larger, instead of a round for few triangles.
_LAST_GROWTH = 1.15
# Steps after each round but the last.
_STEPS_BETWEEN = 40
MOST_TRIANGLES = 1_000_000

Notify = Callable[[FitProgress], None]
# Makes the problem of a round from its mesh.
Make = Callable[[Mesh], FitProblem]


def refine(
    mesh: MeshLike,
    target: OperandLike,
    order: float = DEFAULT_ORDER,
    *,
    triangles: int,
    lattice: Lattice | None = None,
    steps: int = DEFAULT_STEPS,
    smoothing: float = DEFAULT_SMOOTHING,
    keep_boundary: bool = False,
    threads: int | None = None,
    notify: Notify | None = None,
) -> Fit:
    """Split edges of a mesh where that lowers its Sobolev distance from a target most, and move its vertices.

    The mesh is fitted, the number of its triangles at most doubled, and so on. Triangles are split where the squared
    distance would change most if the middles of their edges moved by a fraction of the length: where the derivative
    with respect to a vertex there, times the length, is largest. While the goal is at least four times as large, all
    triangles are split. An interrupt (Ctrl-C) ends with the best mesh so far.

    Args:
        mesh: Mesh to start from, as for `fit`. Vertices at one place become one.
        target: As for `fit`.
        order: As for `fit`.
        triangles: Number of triangles to reach, up to 1,000,000. The result may have a few less, as splits come in
            groups.
        lattice: Lattice of the frequencies to look at; chosen by the mean edge of each mesh if not given. A field
            brings its own.
        steps: Largest number of steps after the last split, and up to 40 after each before.
        smoothing: As for `fit`.
        keep_boundary: Leave vertices of open boundaries where they are. Their edges may be split.
        threads: As for `fit`.
        notify: Called after each step.

    Returns:
        The finer mesh with the distances of the start and of itself. It is never farther away than the start by more
        than the reported errors.

    Raises:
        OrderError: The order is not below -1/2.
        LatticeError: The mesh or target does not fit into the lattice.
        InputError: The mesh has as many triangles already, or `fit` would refuse mesh, target or settings.

    >>> import sobolev_batch as sb
    >>> refined = sb.refine(sb.icosphere(0), sb.Sphere(), -4.0, triangles=40, steps=5)
    >>> len(refined.mesh.triangles) <= 40, refined.after.distance < refined.before.distance / 4
    (True, True)
    """
    mesh, target = as_mesh(mesh), as_operand(target)
    settings = FitSettings(order, steps, smoothing, keep_boundary)
    execution = Execution(threads=thread_count(threads))
    make = partial(FitProblem.for_target, target=target, lattice=lattice, settings=settings, execution=execution)
    problem = _first_problem(mesh, triangles, make)
    before = start_quality(problem)
    refined = conclude(mesh, before, _refine(problem, triangles, make, notify))
    count = len(refined.mesh.triangles)
    if count >= triangles or refined.end == End.INTERRUPTED.value:
        return refined
    remark = f"it has {count:,} triangles instead of {triangles:,}, as splits come in groups"
    return replace(refined, remarks=(*refined.remarks, remark))


def refined_mesh(mesh: Mesh, target: Operand, triangles: int, settings: FitSettings, execution: Execution) -> Mesh:
    """Return the mesh that `refine` finds, without measures of its distance."""
    make = partial(FitProblem.for_target, target=target, lattice=None, settings=settings, execution=execution)
    last = _refine(_first_problem(mesh, triangles, make), triangles, make)
    return last.problem.given_mesh(last.mesh)


def _first_problem(mesh: Mesh, goal: int, make: Make) -> FitProblem:
    """Return the problem of the first round, and refuse a number of triangles that is out of range."""
    count = len(mesh.triangles)
    if not is_whole_number(goal) or not 1 <= goal <= MOST_TRIANGLES:
        raise InputError(f"triangles must be a whole number up to {MOST_TRIANGLES:,}, found {goal!r}")
    if count >= goal:
        raise InputError(f"the mesh has {count:,} triangles already: ask for more than that, found {goal:,}")
    return make(welded(mesh)[0])


def _refine(problem: FitProblem, triangles: int, make: Make, notify: Notify | None = None) -> FitRun:
    """Return the last run, with the steps of all rounds."""
    settings = problem.settings
    between = replace(settings, steps=min(_STEPS_BETWEEN, settings.steps))
    goals, taken = _goals(len(problem.start.triangles), triangles), 0
    total = between.steps * len(goals) + settings.steps

    def count(progress: FitProgress) -> None:
        if notify is not None:
            notify(FitProgress(taken + progress.step, total, progress.relative))

    for goal in (*goals, None):
        run = FitRun(problem if goal is None else replace(problem, settings=between), count).finish()
        taken += run.taken
        run.taken = taken
        if goal is None or run.end is End.INTERRUPTED:
            break
        try:
            problem = make(_split(problem.given_mesh(run.mesh), goal, make))
        except KeyboardInterrupt:
            run.end = End.INTERRUPTED
            break
    return run


def _split(mesh: Mesh, triangles: int, make: Make) -> Mesh:
    """Return a fitted mesh with the edges split where that helps most."""
    edges = Edges.from_mesh(mesh)
    everywhere = edges.split(np.ones(len(edges.ends), dtype=bool))
    if triangles >= 4 * len(mesh.triangles):
        return everywhere
    problem = make(everywhere)
    vertices = np.asarray(problem.start.vertices)
    weights = problem.relative_to(vertices, problem.settings.shares)
    _, gradient = problem.objective(vertices, weights)[0](vertices)
    at_middles = gradient[problem.place][len(mesh.vertices) :]
    scores = edges.lengths * np.linalg.norm(at_middles, axis=1)
    if problem.settings.keep_boundary:
        scores[edges.on_boundary] = 0.0
    return edges.split(edges.best(scores[edges.sides].sum(axis=1), triangles))


def largest_while_refining(count: int, triangles: int) -> int:
    """Return the most triangles on the way from a count to another: scores come from a mesh of four times as many."""
    *before, last = [count, *_goals(count, triangles)]
    return max([last, *(4 * number for number in before)])


def _goals(count: int, triangles: int) -> list[int]:
    """Return the number of triangles after each split of a mesh with this many triangles."""
    goals = []
    while count < triangles:
        if count * _EVEN_ABOVE <= triangles:
            count *= 4
        elif count * _GROWTH * _LAST_GROWTH >= triangles:
            count = triangles
        else:
            count = round(_GROWTH * count)
        goals.append(count)
    return goals
