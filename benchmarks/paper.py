"""The other contestant: the pipeline of K. Koga's paper, as fast as its design allows.

Every triangle gets the same 64 points, whatever its size; the whole lattice is one NUFFT, although
one half of it is the conjugate of the other; norms are trapezoidal sums over the whole lattice.
"""

from __future__ import annotations

from functools import partial

import finufft
import numpy as np

from benchmarks.timing import take_turns
from sobolev_batch import Lattice, Mesh
from sobolev_batch.arrays import ComplexDtype, Complexes
from sobolev_batch.shapes import Sphere
from sobolev_batch.transform.rules import gauss_rule

_RULE = gauss_rule(8)
# Below 1.5 the kernel is so wide that the points of this rule take several times as long.
_UPSAMPLINGS = (2.0, 1.5)


def whole_transform(
    mesh: Mesh, lattice: Lattice, *, eps: float, dtype: ComplexDtype, upsampling: float, threads: int
) -> Complexes:
    """The transform of a mesh's area measure on the whole lattice, complex (M+1, M+1, M+1).

    Args:
        mesh: in units of length.
        lattice: the frequencies.
        eps: accuracy of the NUFFT.
        dtype: of all of its arithmetic.
        upsampling: of the NUFFT's fine grid.
        threads: of the NUFFT.
    """
    real = np.float32 if dtype == "complex64" else np.float64
    barycentric = _RULE.barycentric.astype(real)
    corners = np.stack(mesh.corners()) * (2 * np.pi * lattice.spacing)
    # One contiguous row per axis, which is what the NUFFT reads without a copy.
    angles = [(barycentric @ corners[:, :, axis].astype(real)).ravel() for axis in range(3)]
    strengths = np.outer(_RULE.weights, mesh.areas).ravel().astype(dtype)
    values: Complexes = finufft.nufft3d1(
        *angles,
        strengths,
        (lattice.M + 1,) * 3,
        eps=eps,
        isign=-1,
        modeord=0,
        nthreads=threads,
        upsampfac=upsampling,
        showwarn=0,
    )
    return values


def faster_upsampling(mesh: Mesh, lattice: Lattice, *, eps: float, dtype: ComplexDtype, threads: int) -> float:
    """The upsampling of the NUFFT's fine grid with which `whole_transform` takes less time here."""
    contestants = [
        partial(whole_transform, lattice=lattice, eps=eps, dtype=dtype, upsampling=upsampling, threads=threads)
        for upsampling in _UPSAMPLINGS
    ]
    seconds = take_turns(contestants, lambda: mesh, repeats=1)
    return _UPSAMPLINGS[int(np.argmin(seconds))]


def relative_distance(values: Complexes, lattice: Lattice, order: float) -> float:
    """||μ - σ||_s / ||σ||_s of a transform on the whole lattice and the unit sphere."""
    axis = lattice.spacing * np.arange(-(lattice.M // 2), lattice.M // 2 + 1)
    squares = axis**2
    lengths = squares[:, None, None] + squares[:, None] + squares
    sphere = Sphere().area * np.sinc(2 * np.sqrt(lengths))
    ends = np.where(np.abs(axis) == axis[-1], 0.5, 1.0)
    weights = (1 + lengths) ** order * (ends[:, None, None] * ends[:, None] * ends)
    difference = values - sphere
    squared = float(np.sum(weights * (difference.real**2 + difference.imag**2)))
    return float(np.sqrt(squared / np.sum(weights * sphere**2)))
