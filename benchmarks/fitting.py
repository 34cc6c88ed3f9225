"""What derivatives cost beside values, and how much nearer fitted meshes are."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import sobolev_batch as sb
from benchmarks.meshes import pair_of_cortex
from benchmarks.table import Row, as_seconds, at_most
from benchmarks.timing import Effort, elapsed_seconds, take_turns

# Triangles of the cortex, and order of the fit; orders at which the fitted mesh is measured, with the largest ratio to
# the distance of the start; most seconds.
_CORTEX_FITS = (
    (1280, -2.0, {-2.0: 0.5, -4.0: 0.5}, None),
    (2000, -4.0, {-4.0: 0.1}, 60.0),
)


def fits(effort: Effort) -> Iterator[Row]:
    """Item 11: value and derivative against the value alone, and fits of the cortex and of an ellipsoid.

    The cortex is refined too, and compared with quadric decimation to as many triangles.
    """
    for level, intervals in ((2, 16), (2, 24)) if effort.quick else ((5, 64), (6, 64), (3, 128)):
        yield _derivative(level, intervals, effort)
    for triangles, order, ratios, most_seconds in _CORTEX_FITS:
        start, target = pair_of_cortex(effort, triangles)
        what = f"{len(start.triangles):,} against {len(target.triangles):,} triangles, fitted at order {order:g}"
        yield from _fit(what, start, target, order, ratios, most_seconds, effort)
    yield from _refinement(effort)
    ellipsoid = sb.shapes.Ellipsoid((1.0, 0.8, 0.6))
    level = 1 if effort.quick else 3
    yield from _fit(
        f"ellipsoid of level {level}, fitted", ellipsoid.mesh(level), ellipsoid, -4.0, {-4.0: 0.05}, None, effort
    )


def _derivative(level: int, intervals: int, effort: Effort) -> Row:
    mesh, lattice = sb.shapes.icosphere(level), sb.Lattice(2.0 if effort.quick else 5.0, intervals)
    squared = sb.fitting.SquaredDistance.for_mesh(
        mesh, sb.shapes.Sphere(0.9), -2.0, lattice=lattice, threads=effort.threads
    )
    vertices = np.array(mesh.vertices)
    value, both = take_turns([squared.value, squared], lambda: vertices, effort.repeats)
    what = f"T_{level}, M = {intervals}: value and derivative, against the value"
    return Row("11", what, as_seconds(both), as_seconds(value), both / value, at_most(2.5))


def _fit(
    what: str,
    start: sb.Mesh,
    target: sb.Mesh | sb.shapes.Ellipsoid,
    order: float,
    ratios: dict[float, float],
    most_seconds: float | None,
    effort: Effort,
) -> Iterator[Row]:
    found: list[sb.fitting.Fit] = []
    steps = 10 if effort.quick else 150
    seconds = elapsed_seconds(lambda: found.append(sb.fit(start, target, order, steps=steps)))
    (fitted,) = found
    for measured, most in ratios.items():
        before, after = (
            sb.distance(mesh, target, measured, rtol=1e-2)["distance"].item() for mesh in (start, fitted.mesh)
        )
        text = f"{what}: distance at order {measured:g}, against the start"
        yield Row("11", text, f"{after:.3g}", f"{before:.3g}", after / before, at_most(most))
    limit = None if most_seconds is None else at_most(most_seconds)
    yield Row("11", f"{what}: seconds, {fitted.steps} steps", as_seconds(seconds), "", seconds, limit)
    before_worst, after_worst = fitted.before.hausdorff, fitted.after.hausdorff
    if np.isfinite(after_worst):
        text = f"{what}: Hausdorff distance, against the start"
        yield Row("11", text, f"{after_worst:.3g}", f"{before_worst:.3g}", after_worst / before_worst, at_most(1.5))


def _refinement(effort: Effort) -> Iterator[Row]:
    (start, target), (decimated, _) = (pair_of_cortex(effort, triangles) for triangles in (320, 1280))
    triangles = 2 * len(start.triangles) if effort.quick else len(decimated.triangles)
    found: list[sb.fitting.Fit] = []
    seconds = elapsed_seconds(lambda: found.append(sb.fitting.refine(start, target, -2.0, triangles=triangles)))
    what = f"{len(start.triangles):,} triangles refined to {triangles:,} at order -2"
    for order in (-2.0, -4.0):
        ours, theirs = (
            sb.distance(mesh, target, order, rtol=1e-2)["distance"].item() for mesh in (found[0].mesh, decimated)
        )
        text = f"{what}: distance at order {order:g}, against decimation to as many"
        yield Row("11", text, f"{ours:.3g}", f"{theirs:.3g}", ours / theirs)
    yield Row("11", f"{what}: seconds, {found[0].steps} steps", as_seconds(seconds), "", seconds)
