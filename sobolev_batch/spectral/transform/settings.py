"""Settings of a transform: the accuracy of its values, and the means to compute them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

from sobolev_batch.errors import InputError
from sobolev_batch.machine import available_cores
from sobolev_batch.parameters import is_whole_number
from sobolev_batch.spectral.backends.arrays import ComplexDtype
from sobolev_batch.spectral.backends.backends import CPU, Backend
from sobolev_batch.spectral.lattice import FrequencyLattice
from sobolev_batch.spectral.quadrature.kinds import QuadraturePlan, kind_of
from sobolev_batch.spectral.quadrature.meshes import AUTO, Quadrature
from sobolev_batch.spectral.transform.memory import DEFAULT_BATCH
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
        quadrature: Rules for triangles.
        tolerance: Largest error of the rule on any one triangle, relative to its area, or of the nodes of a
            parametrised surface, relative to the whole area; eps by default.

    Raises:
        InputError: An unknown dtype, or an eps that it cannot reach.
    """

    eps: float
    dtype: ComplexDtype
    quadrature: Quadrature
    tolerance: float

    def __init__(
        self,
        eps: float | None = None,
        dtype: ComplexDtype = "complex128",
        quadrature: Quadrature = AUTO,
        tolerance: float | None = None,
    ) -> None:
        if dtype not in get_args(ComplexDtype):
            raise InputError(f"dtype must be 'complex128' or 'complex64', found {dtype!r}")
        eps = DEFAULT_EPS[dtype] if eps is None else float(eps)
        if not FINEST_EPS[dtype] <= eps <= COARSEST_EPS:
            raise InputError(f"eps must lie between {FINEST_EPS[dtype]:g} and {COARSEST_EPS:g} in {dtype}, found {eps}")
        object.__setattr__(self, "eps", eps)
        object.__setattr__(self, "dtype", dtype)
        object.__setattr__(self, "quadrature", quadrature)
        object.__setattr__(self, "tolerance", eps if tolerance is None else tolerance)

    def plan(self, surface: Surface, lattice: FrequencyLattice) -> QuadraturePlan:
        """Return the quadrature plan of a surface for a lattice."""
        return kind_of(surface).plan(lattice.highest_frequency, self.tolerance, self.quadrature)

    def lowest_degree(self, surface: Surface, lattice: FrequencyLattice) -> int:
        """Return the lowest degree among the rules of a surface: see `QuadraturePlan.lowest_degree`."""
        return self.plan(surface, lattice).lowest_degree


def thread_count(threads: int | None) -> int:
    """Return a number of threads, by default one per core.

    Raises:
        InputError: It is no whole number from 1 to 1,024.
    """
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
