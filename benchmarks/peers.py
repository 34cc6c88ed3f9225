"""What other packages answer about the same pairs, in how much processor time: GeomLoss, pymeshlab and libigl."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from typing import TypeVar

import igl
import numpy as np

import sobolev_batch as sb
from benchmarks.meshes import pair_of_cortex
from benchmarks.table import Row, as_seconds
from benchmarks.timing import Effort
from sobolev_batch.arrays import Reals

Found = TypeVar("Found")

# Points on each mesh. Sums over all pairs of more take too much memory, and samples of distances hardly any time.
_SUMMED, _SAMPLED = (1_000, 3_000, 10_000), (10_000, 100_000, 1_000_000)
# Sets of random points, over which errors are averaged.
_DRAWS = 3


def peers(effort: Effort) -> Iterator[Row]:
    """The squared distance at order -2, and the largest deviation, of a decimated cortex and the cortex."""
    coarse, fine = pair_of_cortex(effort, 5120)
    # What is loaded and compiled once.
    sb.distance(*pair_of_cortex(effort, 1280), -2.0, rtol=1e-1)
    truth = sb.distance(coarse, fine, -2.0, rtol=1e-3)["distance"].item() ** 2
    for rtol in (1e-1, 1e-2):
        seconds, found = _processor_seconds(partial(sb.distance, coarse, fine, -2.0, rtol=rtol))
        off = abs(found["distance"].item() ** 2 / truth - 1)
        yield Row("peers", f"squared distance, rtol {rtol:g}: off by {off:.1g}", as_seconds(seconds))
    if find_spec("geomloss"):
        for count in _SUMMED[:1] if effort.quick else _SUMMED:
            taken = [_processor_seconds(partial(_geomloss, coarse, fine, count, seed)) for seed in range(_DRAWS)]
            off = float(np.mean([abs(square / truth - 1) for _, square in taken]))
            seconds = float(np.mean([one for one, _ in taken]))
            yield Row("peers", f"GeomLoss, {count:,} points a mesh: off by {off:.2g}", "", as_seconds(seconds))
    yield from _deviations(coarse, fine, effort)


def _geomloss(coarse: sb.Mesh, fine: sb.Mesh, count: int, seed: int) -> float:
    """The squared distance at order -2 between random points, whose kernel is π² exp(-2πr)."""
    import torch
    from geomloss import SamplesLoss

    weights, points = [], []
    for number, mesh in enumerate((coarse, fine)):
        points.append(torch.tensor(_drawn(mesh, count, seed + 100 * number)))
        weights.append(torch.full((count,), mesh.area / count, dtype=torch.float64))
    loss = SamplesLoss("laplacian", blur=1 / (2 * np.pi), backend="tensorized")
    # GeomLoss halves squares.
    return 2 * np.pi**2 * float(loss(weights[0], points[0], weights[1], points[1]))


def _deviations(coarse: sb.Mesh, fine: sb.Mesh, effort: Effort) -> Iterator[Row]:
    """Bounds of the largest deviation of the cortex from the decimated one, and what samples of points find of it."""
    seconds, found = _processor_seconds(lambda: sb.largest_deviation(fine, coarse).forward)
    yield Row("peers", f"largest deviation, {found.lower:.4g} to {found.upper:.4g}", as_seconds(seconds))
    for count in _SAMPLED[:1] if effort.quick else _SAMPLED:
        sampled: dict[str, Callable[[Reals], float]] = {"libigl": partial(_by_igl, coarse)}
        if find_spec("pymeshlab"):
            sampled["pymeshlab"] = partial(_by_pymeshlab, coarse, fine)
        for name, largest in sampled.items():
            seconds, most = _processor_seconds(partial(largest, _drawn(fine, count, 0)))
            text = f"{name}, {count:,} points: {100 * most / found.lower:.3g} % of the lower bound"
            yield Row("peers", text, "", as_seconds(seconds))


def _by_igl(coarse: sb.Mesh, points: Reals) -> float:
    squares = igl.point_mesh_squared_distance(points, coarse.vertices, coarse.triangles.astype(np.int64))[0]
    return float(np.sqrt(squares.max()))


def _by_pymeshlab(coarse: sb.Mesh, fine: sb.Mesh, points: Reals) -> float:
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    for mesh in (coarse, fine):
        meshes.add_mesh(pymeshlab.Mesh(mesh.vertices, mesh.triangles))
    settings = {"samplenum": len(points), "sampleface": True, "maxdist": pymeshlab.PercentageValue(100)}
    return float(meshes.get_hausdorff_distance(sampledmesh=1, targetmesh=0, **settings)["max"])


def _drawn(mesh: sb.Mesh, count: int, seed: int) -> Reals:
    """Random points (n, 3), spread evenly by area."""
    rng = np.random.default_rng(seed)
    triangles = rng.choice(len(mesh.triangles), count, p=mesh.areas / mesh.areas.sum())
    root, part = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    a, b, c = mesh.vertices[mesh.triangles[triangles]].transpose(1, 0, 2)
    return np.asarray((1 - root) * a + root * (1 - part) * b + root * part * c)


def _processor_seconds(act: Callable[[], Found]) -> tuple[float, Found]:
    started = time.process_time()
    found = act()
    return time.process_time() - started, found
