"""Settings of a transform: the accuracy of its values, the means to compute them, and the cheapest ones for an error.

The prediction of errors is good enough to choose settings by; the probe measures the error afterwards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from sobolev_batch.errors import InputError
from sobolev_batch.parameters import available_cores, is_whole_number
from sobolev_batch.spectral.backends import CPU, DEFAULT_BATCH, Backend, ComplexDtype
from sobolev_batch.spectral.lattice import FrequencyLattice
from sobolev_batch.spectral.quadrature.kinds import SurfaceKind, kind_of
from sobolev_batch.spectral.quadrature.meshes import fixed_rule, weight_masses
from sobolev_batch.surfaces.shapes.surface import Surface

DEFAULT_EPS: dict[ComplexDtype, float] = {"complex128": 1e-9, "complex64": 1e-6}
# The limits of FINUFFT: below them 2.5 warns, and 2.6 refuses.
FINEST_EPS: dict[ComplexDtype, float] = {"complex128": 1e-14, "complex64": 2e-7}
COARSEST_EPS = 0.1
# OpenMP crashes with very many.
_MOST_THREADS = 1024


@dataclass(frozen=True, init=False)
class TransformSettings:
    """Accuracy, dtype and quadrature of fields.

    Attributes:
        eps: Accuracy of a field relative to the surface's area; by default 1e-9 in complex128 and 1e-6 in
            complex64.
        dtype: "complex128" or "complex64".
        quadrature: Rules for triangles: see `fixed_rule`.
        tolerance: Largest error of the rule on any one triangle, relative to its area, or of the nodes of a
            parametrised surface, relative to the whole area; eps by default.

    Raises:
        InputError: An unknown dtype or quadrature, or an eps that the dtype cannot reach.
    """

    eps: float
    dtype: ComplexDtype
    quadrature: str | int
    tolerance: float

    def __init__(
        self,
        eps: float | None = None,
        dtype: ComplexDtype = "complex128",
        quadrature: str | int = "auto",
        tolerance: float | None = None,
    ) -> None:
        if dtype not in get_args(ComplexDtype):
            raise InputError(f"dtype must be 'complex128' or 'complex64', found {dtype!r}")
        eps = DEFAULT_EPS[dtype] if eps is None else float(eps)
        if not FINEST_EPS[dtype] <= eps <= COARSEST_EPS:
            raise InputError(f"eps must lie between {FINEST_EPS[dtype]:g} and {COARSEST_EPS:g} in {dtype}, found {eps}")
        fixed_rule(quadrature)
        object.__setattr__(self, "eps", eps)
        object.__setattr__(self, "dtype", dtype)
        object.__setattr__(self, "quadrature", quadrature)
        object.__setattr__(self, "tolerance", eps if tolerance is None else tolerance)

    def plan(self, surface: Surface, lattice: FrequencyLattice) -> SurfaceKind:
        """Return a surface with quadrature points for a lattice."""
        return kind_of(surface).plan(lattice.highest_frequency, self.tolerance, self.quadrature)


def thread_count(threads: int | None) -> int:
    """Return a number of threads, by default one per core; InputError where it is not from 1 to 1,024."""
    if threads is None:
        return available_cores()
    if not is_whole_number(threads) or not 1 <= threads <= _MOST_THREADS:
        raise InputError(f"threads must be a whole number from 1 to {_MOST_THREADS:,}, found {threads!r}")
    return int(threads)


@dataclass(frozen=True)
class Execution:
    """The means to compute a transform; values depend on them by a small multiple of eps at most.

    Attributes:
        backend: Backend to compute on. The processor steps in for a GPU that fails.
        threads: Threads of FINUFFT.
        allowed_bytes: Memory that a transform may take on the processor, without the mesh and the result; None
            for no limit. To stay within it, a transform uses smaller batches, sub-blocks and less oversampling,
            whichever is predicted to be the fastest. On a GPU the limit is its free memory.
        batch: Largest number of points of one NUFFT.
    """

    backend: Backend = CPU
    threads: int = 1
    allowed_bytes: float | None = None
    batch: int = DEFAULT_BATCH


ON_CPU = Execution()


# Fraction of a field's error that is left to the NUFFT.
_NUFFT_FRACTION = 0.4
# The rms error of a field of many points at one frequency over eps · area: measured 0.003 to 0.006.
_NUFFT_ERROR = 0.005
# The same of single precision over the area, however small its eps; measured 1e-7 at most.
_SINGLE_ROUNDING = 3e-7


@dataclass(frozen=True)
class ErrorTarget:
    """Largest permitted norms ||computed - exact||_s of a field's own error, one for each order s."""

    orders: tuple[float, ...]
    norms: tuple[float, ...]

    def tightened(self, factor: float) -> ErrorTarget:
        """Return a target that is smaller by a factor."""
        return ErrorTarget(self.orders, tuple(norm / factor for norm in self.norms))


def permits_single(surface: Surface, lattice: FrequencyLattice, target: ErrorTarget) -> bool:
    """Tell whether single precision meets a target: its rounding is 1e-7 of the area at every frequency."""
    rounding = _SINGLE_ROUNDING * surface.area * np.sqrt(weight_masses(lattice, target.orders))
    return bool(np.all(rounding <= _NUFFT_FRACTION * np.array(target.norms)))


def choose_settings(
    surface: Surface, lattice: FrequencyLattice, target: ErrorTarget, settings: TransformSettings
) -> TransformSettings:
    """Return the cheapest settings that are predicted to meet a target, or the finest possible ones.

    The dtype and quadrature are kept, and all settings for a closed form, which depends on none.
    """
    kind = kind_of(surface)
    if kind.is_closed_form:
        return settings
    tolerance = kind.loosest_tolerance(lattice, target.orders, (1 - _NUFFT_FRACTION) * np.array(target.norms))
    eps = _nufft_eps(surface.area, kind.fewest_points, lattice, target, settings)
    return replace(settings, eps=eps, tolerance=tolerance)


def _nufft_eps(
    area: float, points: float, lattice: FrequencyLattice, target: ErrorTarget, settings: TransformSettings
) -> float:
    """Return the largest eps with which the NUFFT of this many points keeps to its fraction of a target."""
    masses = weight_masses(lattice, target.orders)
    spread = _NUFFT_ERROR + 1 / math.sqrt(points)
    eps = float(np.min(_NUFFT_FRACTION * np.array(target.norms) / (area * spread * np.sqrt(masses))))
    return min(max(eps, FINEST_EPS[settings.dtype]), COARSEST_EPS)
