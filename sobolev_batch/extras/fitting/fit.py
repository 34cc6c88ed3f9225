"""Meshes that come nearer to a target: their vertices move, and their edges are split where that helps most."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import AccuracyError, InputError
from sobolev_batch.extras.fitting import DEFAULT_SMOOTHING, DEFAULT_STEPS
from sobolev_batch.extras.fitting.descent import Descent, End, Smoothing
from sobolev_batch.extras.fitting.objective import FitProblem, FitSettings, OrderWeights, welded
from sobolev_batch.geometry.formats.conversion import MeshLike, as_mesh, each
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.proximity import proximity
from sobolev_batch.geometry.subdivision import Edges, Marks
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.distances import distance
from sobolev_batch.norms.fields import Operand, OperandLike, as_operand
from sobolev_batch.parameters import callback, is_whole_number
from sobolev_batch.shown import progress_line
from sobolev_batch.transform.fourier import Execution, thread_count
from sobolev_batch.transform.lattice import Lattice

# Relative errors of distances that are requested, one after the other.
_RTOLS = (0.02, 0.1)
# Beyond this relative distance at the coarse order, a mesh is far from its target.
_FAR = 0.05
# Smoothing of the stages that bring a far mesh near, and the fraction of all steps for each.
_FAR_SMOOTHINGS, _FAR_STEPS = (16.0, 4.0), 0.25
# After a step that would turn triangles over, smoothing is increased by this factor, so often at most.
_SMOOTHER, _MOST_RETREATS = 4.0, 4
_HAUSDORFF_GROWTH = 1.5
# While the goal is larger by this factor, all edges are split. A choice of triangles came no nearer then: fits pull
# vertices to where they are needed, and even splits leave better triangles.
_EVEN_ABOVE = 4
# Then a finer mesh has at most this factor times the triangles of the one before.
_GROWTH = 2.0
# The last factor may be a little larger, instead of a round for few triangles.
_LAST_GROWTH = 1.15
_STEPS_BETWEEN = 40
MOST_TRIANGLES = 1_000_000


@dataclass(frozen=True)
class FitQuality:
    """Distances of a mesh from its target, and the quality of its triangles.

    Attributes:
        distance: Sobolev distance, in the square root of a unit length.
        error: Error of the distance.
        hausdorff: Hausdorff distance, a lower bound in units of length; NaN without a target of triangles.
        chamfer: Chamfer distance, in units of length; NaN likewise.
        smallest_angle: Smallest angle of all triangles, in degrees.
        relative: Distance over the norm of the target.
        relative_error: Error of that.

    >>> import sobolev_batch as sb
    >>> sb.fitting.FitQuality(distance=0.5, error=0.01, smallest_angle=30.0).distance
    0.5
    """

    distance: float
    error: float
    hausdorff: float = np.nan
    chamfer: float = np.nan
    smallest_angle: float = np.nan
    relative: float = np.nan
    relative_error: float = np.nan


@dataclass(frozen=True)
class FitProgress:
    """The state of a fit after a step.

    Attributes:
        step: Number of steps so far.
        steps: Largest number of steps.
        relative: Square root of what the descent lowers, which is about 1 at the start of each stage: a weighted sum
            of squared distances, and a small penalty for triangles that lose their shape.

    >>> import sobolev_batch as sb
    >>> sb.fitting.FitProgress(step=3, steps=150, relative=0.5).relative
    0.5
    """

    step: int
    steps: int
    relative: float

    def __str__(self) -> str:
        return f"step {self.step} of at most {self.steps}: {self.relative:.3g} of the start"


Notify = Callable[[FitProgress], object]


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted mesh.

    Attributes:
        mesh: The mesh, in the start's unit of length; from `fit` with the triangles of the start.
        order: Order s of the distance that was lowered.
        before: Distances of the start from the target.
        after: Distances of the fitted mesh.
        steps: Number of steps that were taken.
        end: Why the fit ended.
        remarks: What a user should know about the mesh, as sentences.

    >>> import sobolev_batch as sb
    >>> fitted = sb.fit(sb.shapes.icosphere(1), sb.shapes.Sphere(1.1), -4.0, steps=5)
    >>> fitted.steps, fitted.end
    (5, 'all steps are taken')
    """

    mesh: Mesh
    order: float
    before: FitQuality
    after: FitQuality
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
    on_progress: Notify | None = None,
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
        on_progress: Called with a `FitProgress` after each step; by default notebooks show the last one.

    Returns:
        The fitted mesh with its distances before and after. It is never farther away than the start by more than the
        reported errors.

    Raises:
        OrderError: The order is not below -1/2.
        LatticeError: The mesh or target does not fit into the lattice.
        InputError: The start is not a mesh, lies apart from its target or in another unit; the field cannot serve the
            order; or a setting is out of range.

    >>> import sobolev_batch as sb
    >>> fitted = sb.fit(sb.shapes.icosphere(1), sb.shapes.Sphere(), -4.0, steps=8)
    >>> fitted.after.distance < fitted.before.distance / 4
    True
    """
    settings = FitSettings(order, steps, smoothing, keep_boundary)
    return _measured(FitRun(mesh, target, lattice, settings, None, threads), on_progress)


def fitted_mesh(mesh: Mesh, target: Operand, settings: FitSettings, triangles: int | None = None) -> Mesh:
    """Return the mesh that `fit` finds, or `refine` for a number of triangles, without measures of its distance."""
    # The result must not depend on the worker, so one thread it is.
    run = FitRun(mesh, target, None, settings, triangles, 1)
    run.finish()
    if run.end is End.INTERRUPTED:
        # A mesh of a study is the whole fit.
        raise KeyboardInterrupt
    return run.problem.given_mesh(run.vertices)


class FitRun:
    """A fit that is under way: its problem, positions (n, 3) in units of length, steps taken, and why it ended.

    For a number of triangles it goes in rounds, one before each split and one after the last.
    """

    def __init__(
        self,
        mesh: MeshLike,
        target: OperandLike,
        lattice: Lattice | None,
        settings: FitSettings,
        triangles: int | None,
        threads: int | None,
    ) -> None:
        (self.given,), (operand,) = each(as_mesh, {"mesh": mesh}), each(as_operand, {"target": target})
        self.goals = [] if triangles is None else _goals(len(self.given.triangles), triangles)
        start, execution = welded(self.given)[0] if self.goals else self.given, Execution(threads=thread_count(threads))
        self.problem = FitProblem.for_target(start, operand, lattice, settings, execution)
        self.vertices, self.taken, self.end = np.asarray(self.problem.start.vertices), 0, End.CONVERGED
        self.rounds = [*[min(_STEPS_BETWEEN, settings.steps)] * len(self.goals), settings.steps]
        self.notify: Notify = str

    def finish(self) -> None:
        """Go through all rounds, or up to an interrupt."""
        try:
            for goal, steps in zip((None, *self.goals), self.rounds, strict=True):
                if goal is not None:
                    self._split(goal)
                self._fit(steps)
        except KeyboardInterrupt:
            self.end = End.INTERRUPTED

    def _fit(self, steps: int) -> None:
        """Take this many steps at most, and go back to where they began if that is nearer, also when interrupted."""
        start, last, order = self.vertices, self.taken + steps, self.problem.settings.order
        try:
            for shares, smoothing, count in self._stages(steps):
                self._descend(shares, smoothing, min(count, last - self.taken))
        finally:
            before, after = (self.problem.squares(vertices, [order])[0] for vertices in (start, self.vertices))
            if after > before:
                self.vertices, self.end = start, End.FARTHER

    def _stages(self, steps: int) -> list[tuple[OrderWeights, float, int]]:
        """Return shares of orders, smoothing and steps of each stage; a far mesh comes near at a coarse order first."""
        settings = self.problem.settings
        if not self.problem.relative_distance(settings.coarse_order) > _FAR:
            return [(settings.shares, settings.smoothing, steps)]
        part = max(1, int(_FAR_STEPS * steps))
        stages = [(((settings.coarse_order, 1.0),), amount, part) for amount in _FAR_SMOOTHINGS]
        left = max(1, steps - part * len(stages))
        return [*stages, (settings.shares, max(settings.smoothing, _FAR_SMOOTHINGS[-1]), left)]

    def _descend(self, shares: OrderWeights, amount: float, steps: int) -> None:
        """Go through a stage: descents with ever finer fields, and smoother steps where needed."""
        problem, last, retreats = self.problem, self.taken + steps, 0
        weights = problem.relative_to(self.vertices, shares)
        smoothing = Smoothing(problem.start, problem.free_vertices, amount)
        while (before := self.taken) < last:
            objective, floor = problem.objective(self.vertices, weights)
            self.end = Descent(objective, self.vertices, smoothing, floor, self._count).run(last - before)
            if self.end in (End.TURNED, End.LEFT) and retreats < _MOST_RETREATS:
                retreats += 1
                smoothing = Smoothing(problem.start, smoothing.free, max(_SMOOTHER * smoothing.amount, 1.0))
            # Finer fields may show the way on, unless they are as fine as they can be.
            elif self.end is not End.ERROR or self.taken == before:
                break

    def _count(self, vertices: Reals, objective: float) -> None:
        self.vertices, self.taken = vertices, self.taken + 1
        self.notify(FitProgress(self.taken, sum(self.rounds), float(np.sqrt(objective))))

    def _split(self, triangles: int) -> None:
        """Split the edges of the fitted mesh where that helps most."""
        mesh, settings = self.problem.given_mesh(self.vertices), self.problem.settings
        edges = Edges.from_mesh(mesh)
        finer = edges.split(np.ones(len(edges.ends), dtype=bool))
        if triangles < 4 * len(mesh.triangles):
            everywhere = self.problem.remade(finer)
            vertices = np.asarray(everywhere.start.vertices)
            weights = everywhere.relative_to(vertices, settings.shares)
            _, gradient = everywhere.objective(vertices, weights)[0](vertices)
            at_middles = gradient[everywhere.place][len(mesh.vertices) :]
            scores = edges.lengths * np.linalg.norm(at_middles, axis=1)
            if settings.keep_boundary:
                scores[edges.on_boundary] = 0.0
            finer = edges.split(best_edges(edges, scores[edges.sides].sum(axis=1), triangles))
        self.problem = self.problem.remade(finer)
        self.vertices = np.asarray(self.problem.start.vertices)


def measure_quality(problem: FitProblem, mesh: Mesh) -> FitQuality:
    """Measure distances of a prepared mesh from its target.

    The Sobolev distance has a relative accuracy where the target is a surface; from a field it is that on the lattice.
    """
    target, order = problem.target, problem.settings.order
    for rtol in () if isinstance(target, xr.DataArray) else _RTOLS:
        with suppress(AccuracyError):
            result = distance(mesh, target, order, rtol=rtol)
            break
    else:
        result = distance(mesh, target, order, lattice=problem.lattice)
    numbers = {name: result[name].item() for name in ("distance", "error", "relative", "relative_error")}
    quality = FitQuality(**numbers, smallest_angle=float(mesh.smallest_angles.min()))
    if not isinstance(target, Mesh):
        return quality
    near = proximity(mesh, target)
    return replace(quality, hausdorff=near["hausdorff"], chamfer=near["chamfer"])


def _measured(run: FitRun, on_progress: Notify | None) -> Fit:
    """Return the mesh of a fit with its distances, or the given one if that is nearer."""
    callback(on_progress)
    problem = run.problem
    before = measure_quality(problem, problem.start)
    if before.error >= before.distance > 0 and isinstance(problem.target, xr.DataArray):
        raise InputError(
            f"the field ends at the frequency {problem.lattice.xi_max:g}: at order {problem.settings.order:g} the "
            f"distance {before.distance:.2g} has an error of {before.error:.2g}, so there is nothing that a fit could "
            "lower; take a more negative order, or a field on a larger lattice"
        )
    with progress_line(on_progress) as run.notify:
        run.finish()
    problem, remarks = run.problem, []
    found = problem.given_mesh(run.vertices)
    try:
        after = measure_quality(problem, Mesh(run.vertices, problem.start.triangles))
    except KeyboardInterrupt:
        after, run.end = FitQuality(np.nan, np.nan), End.INTERRUPTED
        remarks.append("it was interrupted before the mesh was measured")
    if after.distance - np.nan_to_num(after.error) > before.distance + np.nan_to_num(before.error):
        remarks.append("no nearer mesh was found: this is the start")
        found, after = run.given, before
    if after.error >= after.distance > 0:
        remarks.append("the distance is not larger than its error: ask for a more negative order")
    if after.hausdorff > _HAUSDORFF_GROWTH * before.hausdorff:
        remarks.append(
            f"the Hausdorff distance grew {after.hausdorff / before.hausdorff:.2g} times: the worst point lies "
            "farther away than before; take a larger smoothing or a less negative order"
        )
    count, wanted = len(found.triangles), max(run.goals, default=0)
    if count < wanted and run.end is not End.INTERRUPTED:
        remarks.append(f"it has {count:,} triangles instead of {wanted:,}, as splits come in groups")
    return Fit(found, problem.settings.order, before, after, run.taken, run.end.value, tuple(remarks))


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
    on_progress: Notify | None = None,
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
        on_progress: Called with a `FitProgress` after each step; by default notebooks show the last one.

    Returns:
        The finer mesh with the distances of the start and of itself. It is never farther away than the start by more
        than the reported errors.

    Raises:
        OrderError: The order is not below -1/2.
        LatticeError: The mesh or target does not fit into the lattice.
        InputError: The mesh has as many triangles already, or `fit` would refuse mesh, target or settings.

    >>> import sobolev_batch as sb
    >>> refined = sb.fitting.refine(sb.shapes.icosphere(0), sb.shapes.Sphere(), -4.0, triangles=40, steps=5)
    >>> len(refined.mesh.triangles) <= 40, refined.after.distance < refined.before.distance / 4
    (True, True)
    """
    settings = FitSettings(order, steps, smoothing, keep_boundary)
    return _measured(FitRun(mesh, target, lattice, settings, triangles, threads), on_progress)


def best_edges(edges: Edges, scores: Reals, triangles: int) -> Marks:
    """Mark the edges of the triangles with the largest scores (m,), to lead to at most this many triangles.

    Where an edge of a triangle is marked, so is its longest one: then triangles do not become ever thinner. Source: M.
    C. Rivara, "Algorithms for refining triangular grids suitable for adaptive and multigrid techniques" (1984),
    doi:10.1002/nme.1620200412.
    """
    order, sides = np.argsort(-scores, kind="stable"), edges.sides
    longest = np.take_along_axis(sides, edges.lengths[sides].argmax(axis=1)[:, None], axis=1)[:, 0]

    def marked(number: int) -> Marks:
        marks, added = np.zeros(len(edges.ends), dtype=bool), sides[order[:number]].ravel()
        while len(added):
            marks[added] = True
            touched = longest[marks[sides].any(axis=1)]
            added = touched[~marks[touched]]
        return marks

    def triangles_after(number: int) -> int:
        return len(sides) + int(np.count_nonzero(marked(number)[sides]))

    return marked(bisect_right(range(1, len(order) + 1), triangles, key=triangles_after))


def largest_while_refining(count: int, triangles: int) -> int:
    """Return the most triangles on the way from a count to another: scores come from a mesh of four times as many."""
    # Nothing is known of a file that cannot be read, or of what a program will make.
    count = max(count, 1)
    *before, last = [count, *(_goals(count, triangles) if count < triangles else [])]
    return max([last, *(4 * number for number in before)])


def _goals(count: int, triangles: int) -> list[int]:
    """Return the number of triangles after each split of a mesh with this many; refuse a goal that is out of range."""
    if not is_whole_number(triangles) or not 1 <= triangles <= MOST_TRIANGLES:
        raise InputError(f"triangles must be a whole number up to {MOST_TRIANGLES:,}, found {triangles!r}")
    if count >= triangles:
        raise InputError(f"the mesh has {count:,} triangles already: ask for more than that, found {triangles:,}")
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
