"""Orders near -1/2: what a distance costs whose tail is measured, and what a sum over points costs instead."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import TypeVar

import numpy as np

import sobolev_batch as sb
from benchmarks.meshes import pair_of_cortex, pair_of_parts
from benchmarks.table import Row, as_seconds, at_most
from benchmarks.timing import Effort
from sobolev_batch.arrays import Reals

Found = TypeVar("Found")
Sum = Callable[[Reals, Reals], float]

# Order, rtol, and most processor seconds, for a coarse organic mesh against a fine one.
_REQUESTS = ((-2.0, 1e-2, 3.0), (-2.0, 1e-3, 10.0), (-1.0, 1e-2, 20.0), (-0.6, 1e-1, 20.0))
_OF_SPHERE = (-2.0, 1e-3, 10.0)
_OF_PARTS = ((-2.0, 1e-2, 5.0), (-0.75, 1e-1, 30.0))


def low_orders(effort: Effort) -> Iterator[Row]:
    """Item 10: distances of meshes at low orders, and the sum over points that a user would write instead."""
    coarse, fine = pair_of_cortex(effort, 1280)
    # What is loaded and prepared once.
    sb.distance(sb.shapes.icosphere(0), sb.shapes.icosphere(1), -2.0, rtol=1e-2)
    what = f"{len(coarse.triangles):,} against {len(fine.triangles):,} triangles"
    for order, rtol, most in _REQUESTS:
        yield _row(what, coarse, fine, order, rtol, most)
    order, rtol, most = _OF_SPHERE
    level = 3 if effort.quick else 5
    yield _row(f"T_{level} against the sphere", sb.shapes.icosphere(level), sb.shapes.Sphere(), order, rtol, most)
    for triangles in (1_500, 6_000):
        part, original = pair_of_parts(effort, triangles)
        name = f"a mechanical part, {len(part.triangles):,} against {len(original.triangles):,} triangles"
        for order, rtol, most in _OF_PARTS:
            yield _row(name, part, original, order, rtol, most)
    yield from _against_points(what, coarse, fine, effort)


def _row(what: str, a: sb.Mesh, b: sb.Mesh | sb.shapes.Sphere, order: float, rtol: float, most: float) -> Row:
    seconds, found = _processor_seconds(lambda: sb.distance(a, b, order, rtol=rtol))
    reported = found["error"].item() / found["distance"].item()
    text = f"{what}, order {order:g}, rtol {rtol:g}: processor seconds, relative error {reported:.1g}"
    return Row("10", text, as_seconds(seconds), "", seconds, at_most(most))


def _against_points(what: str, coarse: sb.Mesh, fine: sb.Mesh, effort: Effort) -> Iterator[Row]:
    """Compare with double sums of the kernels of orders -2 and -1 over centroids of triangles, cut in four or not.

    These kernels are π² exp(-2πr), in all pairs, and π exp(-2πr) / r, by a fast multipole method and without r = 0.
    """
    from benchmarks.direct import exponential_sum

    exponential_sum(*_points(sb.shapes.icosphere(0), sb.shapes.icosphere(0), 0))  # compiled by now
    sums: dict[float, tuple[float, Sum, int]] = {-2.0: (np.pi**2, exponential_sum, 2), -1.0: (np.pi, _yukawa_sum, 3)}
    for order, (factor, double_sum, most_cuts) in sums.items():
        seconds, found = _processor_seconds(partial(sb.distance, coarse, fine, order, rtol=1e-2))
        for cuts in range(1 if effort.quick else most_cuts):
            taken, square = _processor_seconds(partial(double_sum, *_points(coarse, fine, cuts)))
            distance = float(np.sqrt(max(factor * square, 0.0)))
            digits = abs(distance - found["distance"].item()) / found["distance"].item()
            text = f"{what}, order {order:g}: sum over centroids, cut {cuts} times, off by {digits:.1g}"
            yield Row("10", text, as_seconds(seconds), as_seconds(taken), taken / seconds)


def _yukawa_sum(points: Reals, weights: Reals) -> float:
    """The double sum of w_i w_j exp(-2πr) / r over the distances r > 0 of points (n, 3) with weights (n,)."""
    import fmm3dpy

    # Its kernel is exp(ikr) / (4πr).
    found = fmm3dpy.hfmm3d(eps=1e-6, zk=2j * np.pi, sources=points.T, charges=weights.astype(np.complex128), pg=1)
    return float(4 * np.pi * np.real(weights @ found.pot))


def _points(a: sb.Mesh, b: sb.Mesh, cuts: int) -> tuple[Reals, Reals]:
    """Centroids (n, 3) of the triangles of both meshes, each cut in four so often, and their signed areas."""
    points, weights = [], []
    for mesh, sign in ((a, 1.0), (b, -1.0)):
        corners = mesh.vertices[mesh.triangles]
        for _ in range(cuts):
            middles = (corners + np.roll(corners, -1, axis=1)) / 2
            first = [np.stack([corners[:, i], middles[:, i], middles[:, i - 1]], axis=1) for i in range(3)]
            corners = np.concatenate([*first, middles])
        points.append(corners.mean(axis=1))
        weights.append(sign * np.tile(mesh.areas / 4**cuts, 4**cuts))
    return np.concatenate(points), np.concatenate(weights)


def _processor_seconds(work: Callable[[], Found]) -> tuple[float, Found]:
    started = time.process_time()
    result = work()
    return time.process_time() - started, result
