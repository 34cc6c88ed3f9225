"""Times of transforms on a GPU, where there is one."""

from __future__ import annotations

from collections.abc import Iterator

import sobolev_batch as sb
from benchmarks.table import Row, as_seconds, at_most
from benchmarks.timing import Effort, take_turns
from benchmarks.transforms import XI_MAX, settings_of_the_paper
from sobolev_batch.spectral.backends import ComplexDtype, gpu_backend
from sobolev_batch.spectral.transform import Execution, TransformSettings, transform_block

# Level of the icosphere, intervals per axis, seconds to stay below.
_CASES = ((7, 128, 0.060), (5, 416, 0.150))
_QUICK_CASES = ((3, 32, 0.060),)
_PRECISIONS: tuple[ComplexDtype, ...] = ("complex128", "complex64")


def on_a_gpu(effort: Effort) -> Iterator[Row]:
    """Item 9: transforms alone, of meshes whose lengths are known, until the field is back on the host."""
    try:
        backend = gpu_backend()
    except sb.errors.BackendError as error:
        yield Row("9", f"not run: {error}")
        return
    yield Row("9", f"device: {backend.description}")
    for level, intervals, limit in _QUICK_CASES if effort.quick else _CASES:
        mesh, lattice = sb.shapes.icosphere(level), sb.Lattice(XI_MAX, intervals)
        for dtype in _PRECISIONS:
            settings = settings_of_the_paper(mesh, lattice, dtype)

            def ours(given: sb.Mesh, lattice: sb.Lattice = lattice, settings: TransformSettings = settings) -> None:
                made = transform_block(given, lattice, lattice.half, settings, Execution(backend))
                if made.backend != backend.library:
                    raise RuntimeError(f"not a time of the GPU: {made.backend}")

            (seconds,) = take_turns([ours], lambda mesh=mesh: mesh, effort.repeats)  # type: ignore[misc]
            what = f"GPU: T_{level}, M = {intervals}, {dtype}: transform"
            yield Row("9", what, as_seconds(seconds), as_seconds(limit), seconds / limit, at_most(1.0))
