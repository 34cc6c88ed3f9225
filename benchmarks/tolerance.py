"""Processor time of largest deviations within 1 %, and of searches for the fewest triangles within a length."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

import sobolev_batch as sb
from benchmarks.table import Row, at_most
from benchmarks.timing import Effort
from sobolev_batch.batch.reduce import Reduction
from sobolev_batch.sources.derived import decimated

# Tolerance of the searches, as a fraction of the radius: scans of 20,000 triangles then need a tenth of them.
_TOLERANCE = 0.005


def tolerances(effort: Effort) -> Iterator[Row]:
    """Largest deviations of two pairs, and searches beside one decimation and one distance each."""
    # The first call compiles and loads what later ones do not.
    sb.reduce(_scan(20), 0.05, workers=1)
    pairs = [(224, 10_000, 5.0), *([(806, 100_000, 60.0)] if effort.large else [])]
    for cells, triangles, most in [(30, 200, 5.0)] if effort.quick else pairs:
        fine = _scan(cells)
        coarse = decimated(fine, triangles)
        started = time.process_time()
        deviation = sb.largest_deviation(coarse, fine).both.upper
        seconds = time.process_time() - started
        what = f"largest deviation within 1 %, {len(fine.triangles):,} against {triangles:,} triangles, both ways"
        yield Row("14", what, f"{seconds:.3g} CPU s", ratio=seconds, target=at_most(most))
        for factor, answer in ((2.0, "yes"), (0.5, "no")):
            ask = partial(sb.largest_deviation, coarse, fine, within=factor * deviation)
            asked = _processor_seconds(ask)
            what = f"the same, within {factor:g} times of it: {answer}; the bounds"
            yield Row("14", what, f"{asked:.3g} CPU s", f"{seconds:.3g} CPU s", asked / seconds, at_most(1 / 3))
    count, cells = (10, 100) if not effort.quick else (2, 30)
    scans = {f"{seed}": _scan(cells, seed) for seed in range(count)}
    radius = scans["0"].bounding_sphere[1]
    found: dict[str, Reduction] = {}
    searches = _processor_seconds(lambda: found.update(sb.reduce(scans, _TOLERANCE * radius, workers=1)))

    def once() -> None:
        for name, scan in scans.items():
            best = found[name].bracket.best
            assert best is not None
            sb.largest_deviation(decimated(scan, best.triangles), scan)

    single = _processor_seconds(once)
    trials = np.mean([len(one.trials) for one in found.values()])
    what = f"{count} scans of {2 * cells**2:,} triangles: searches of {trials:.3g} trials; one decimation and distance"
    yield Row("14", what, f"{searches:.3g} CPU s", f"{single:.3g} CPU s", searches / single, at_most(12))


def _scan(cells: int, seed: int = 0) -> sb.Mesh:
    """Return a lumpy torus."""
    torus = sb.shapes.Torus(1.0, 0.35).mesh(cells, cells)
    waves = np.random.default_rng(seed).normal(scale=6.0, size=(3, 6))
    lumps = np.sin(torus.vertices @ waves).sum(axis=1, keepdims=True)
    return sb.Mesh(torus.vertices * (1 + 0.02 * lumps), torus.triangles)


def _processor_seconds(act: Callable[[], object]) -> float:
    started = time.process_time()
    act()
    return time.process_time() - started
