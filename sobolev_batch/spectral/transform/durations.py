"""Processor time of fields, predicted, and how it compares with the time that one takes on this machine."""

from __future__ import annotations

import math
import time
from functools import lru_cache

from sobolev_batch.spectral.backends.backends import CPU, Backend
from sobolev_batch.spectral.backends.costs import CPU_COSTS, NufftSpec
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.transform.memory import Batching, Workload
from sobolev_batch.spectral.transform.settings import Execution, TransformSettings
from sobolev_batch.spectral.transform.transform import transform_block
from sobolev_batch.surfaces.shapes.icosphere import icosphere
from sobolev_batch.surfaces.shapes.similarity import Similarity

# Triangles of a mesh differ in size, which their rules follow; those of this sphere stand for them.
_STAND_IN_LEVEL = 2
# A sphere, transformed in a fraction of a second, of which spreading its points takes most.
_TRIAL_LEVEL, _TRIAL_LATTICE = 5, Lattice(5.0, 64)
_NANO = 1e-9


def field_seconds(triangles: int, area: float, lattice: Lattice, settings: TransformSettings) -> float:
    """Return the predicted processor time of a field.

    Args:
        triangles: Number of triangles of the mesh; 0 for a closed form.
        area: Area, in squared units of length.
        lattice: Lattice of the field.
        settings: Accuracy and dtype.
    """
    spec = NufftSpec(lattice.half.shape, settings.eps, settings.dtype)
    workload = Workload(points=expected_points(triangles, area, lattice, settings), triangles=triangles)
    return _NANO * Batching(spec).projected_nanoseconds(spec.shape, workload, CPU_COSTS)


@lru_cache(maxsize=4)
def slowness(backend: Backend = CPU) -> float:
    """Return how many times as long as predicted a field takes on this machine, in processor time of one thread.

    Args:
        backend: Backend to try. The time of a GPU is that of the whole computation.
    """
    mesh, settings = icosphere(_TRIAL_LEVEL), TransformSettings()
    clock = time.thread_time if backend is CPU else time.perf_counter
    predicted = field_seconds(len(mesh.triangles), mesh.area, _TRIAL_LATTICE, settings)
    times = []
    # The first time includes what is loaded and tabulated once.
    for _ in range(2):
        started = clock()
        transform_block(mesh, _TRIAL_LATTICE, _TRIAL_LATTICE.half, settings, Execution(backend))
        times.append(clock() - started)
    return min(times) / predicted


def expected_points(triangles: int, area: float, lattice: Lattice, settings: TransformSettings) -> float:
    """Return the number of quadrature points of a mesh, as if all its triangles were alike; see `field_seconds`."""
    if not triangles:
        return 0.0
    # Of many sizes a few stand for all.
    return triangles * _points_of_triangle(float(f"{area / triangles:.1e}"), lattice, settings)


@lru_cache(maxsize=1 << 10)
def _points_of_triangle(area: float, lattice: Lattice, settings: TransformSettings) -> float:
    sphere = icosphere(_STAND_IN_LEVEL)
    count = len(sphere.triangles)
    alike = Similarity(math.sqrt(area * count / sphere.area)).apply(sphere)
    return settings.plan(alike, lattice).size.expected / count
