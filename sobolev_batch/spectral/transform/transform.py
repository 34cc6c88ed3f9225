"""The Fourier transform of a surface on a block of the lattice: closed form, or quadrature and NUFFT."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field, replace
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError, LatticeError
from sobolev_batch.spectral.backends.backends import CPU, Backend, Gpu
from sobolev_batch.spectral.backends.costs import Costs
from sobolev_batch.spectral.dtypes import ComplexDtype, Complexes, item_bytes
from sobolev_batch.spectral.exact.spheres import sphere_block
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.quadrature.meshes import Quadrature
from sobolev_batch.spectral.transform.memory import Division, Load, divide, transform_bytes
from sobolev_batch.spectral.transform.nufft import transform_points
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.smooth import Smooth
from sobolev_batch.surfaces.shapes.sphere import Sphere
from sobolev_batch.surfaces.shapes.surface import Surface

# Raise it whenever the numbers that a given surface and settings lead to change: stored fields of
# another version are then computed again instead of being compared with new ones.
NUMERICS_VERSION = 3

# Points of one NUFFT call: 2 million take 0.3 GB with their strengths and their sorting, and make
# the FFT of a call a small part of it.
DEFAULT_BATCH = 1 << 21

# What FINUFFT can reach; below it warns in 2.5 and refuses from 2.6.
FINEST_EPS: dict[ComplexDtype, float] = {"complex128": 1e-14, "complex64": 2e-7}
COARSEST_EPS = 0.1
# The error of a parametrised surface's nodes grows with the frequency like that of a rule of a high degree: of
# degrees tried on tori and ellipsoids with too few nodes, 8 and 16 drew frequencies that found most of it.
_SMOOTH_DEGREE = 16
# Samples of a closed form at a time.
_SLAB = 1 << 18
# Of a GPU's free memory, what a transform plans with; and how often it is tried, each time with half as much.
_DEVICE_SHARE, _ATTEMPTS = 0.9, 4
_OUT_OF_MEMORY = "out of memory"

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TransformSettings:
    """How fields are computed.

    Args:
        eps: accuracy of a field relative to the surface's area. None stands for 1e-9 in complex128
            and 1e-6 in complex64.
        dtype: "complex128" or "complex64".
        quadrature: see `Quadrature`.
        tolerance: largest error of the triangle rules on any one triangle, relative to its area, and of
            the nodes of a parametrised surface, relative to the whole area; None stands for eps.

    Raises:
        InputError: a precision that does not exist, or an eps beyond what it can hold.
    """

    eps: float | None = None
    dtype: ComplexDtype = "complex128"
    quadrature: Quadrature = field(default_factory=Quadrature)
    tolerance: float | None = None

    def __post_init__(self) -> None:
        if self.dtype not in get_args(ComplexDtype):
            raise InputError(f"dtype must be 'complex128' or 'complex64', found {self.dtype!r}")
        if self.eps is None:
            object.__setattr__(self, "eps", 1e-9 if self.dtype == "complex128" else 1e-6)
        finest = FINEST_EPS[self.dtype]
        if not finest <= self.accuracy <= COARSEST_EPS:
            raise InputError(
                f"eps must lie between {finest:g} and {COARSEST_EPS:g} in {self.dtype}, found {self.eps!r}"
            )

    @property
    def accuracy(self) -> float:
        """The eps in force."""
        return float(self.eps) if self.eps is not None else float("nan")

    @property
    def rule_tolerance(self) -> float:
        """The tolerance in force."""
        return self.accuracy if self.tolerance is None else self.tolerance

    def lowest_degree(self, surface: Surface, lattice: Lattice) -> int:
        """The lowest degree among the rules that triangles get, whose error shows first; 0 for a closed form."""
        if isinstance(surface, Sphere):
            return 0
        if isinstance(surface, Smooth):
            return _SMOOTH_DEGREE
        return self.quadrature.lowest_degree(surface, lattice.highest_frequency, self.rule_tolerance)


@dataclass(frozen=True, eq=False)
class Transformed:
    """A block of a field, and from what it was made.

    Attributes:
        values: complex (block.shape).
        points: of the quadrature; 0 for a closed form.
        backend: the library that computed it; also which one failed before, and why. "closed form"
            where none was needed.
    """

    values: Complexes
    points: int
    backend: str


def transform_block(
    surface: Surface,
    lattice: Lattice,
    block: Block,
    settings: TransformSettings,
    *,
    backend: Backend = CPU,
    threads: int = 1,
    batch: int = DEFAULT_BATCH,
    memory: float | None = None,
) -> Transformed:
    """The transform of a surface on one block of the lattice.

    Args:
        surface: what to transform.
        lattice: where.
        block: which part of it.
        settings: how.
        backend: where to compute. What a GPU fails to do is done on the processor.
        threads: of FINUFFT.
        batch: the largest number of points of one NUFFT.
        memory: what this may take besides the mesh and the result, in bytes. What does not fit is
            computed in smaller batches, in parts of the block and with less oversampling, whichever is
            predicted to be the fastest; that changes the values by a small multiple of eps. Without
            it, a transform takes what `memory_bytes` says, however many points there are. On a GPU what
            is free there is the bound, and this one holds for the processor that may have to step in.

    Raises:
        LatticeError: a surface reaches beyond the lattice's half period.
        InputError: the memory is too little for any way of computing it, or the quadrature of a
            parametrised surface does not settle.
    """
    if isinstance(surface, Sphere):
        return Transformed(_closed_form(surface, lattice, block, settings.dtype), 0, "closed form")
    require_inside(surface, lattice)
    division = Division(batch)
    if memory is not None:
        division, _ = _division(surface, lattice, block, settings, CPU.costs, memory=memory, batch=batch)
    failure = ""
    if isinstance(backend, Gpu):
        made = _on_gpu(surface, lattice, block, settings, batch, backend)
        if isinstance(made, Transformed):
            return made
        _log.warning("%s: %s; the processor computes it instead", backend.library, made)
        failure = f" after {backend.library}: {made}"
    values, points = _computed(surface, lattice, block, settings, division, CPU, threads)
    return Transformed(values, points, CPU.library + failure)


def _on_gpu(
    surface: Mesh | Smooth, lattice: Lattice, block: Block, settings: TransformSettings, batch: int, backend: Gpu
) -> Transformed | str:
    """The transform of a surface by a GPU, or why it failed.

    Where memory is too little after all, it is tried again in smaller batches and parts.
    """
    try:
        with backend.work():
            room = _DEVICE_SHARE * backend.free_bytes - block.size * item_bytes(settings.dtype)
            for _ in range(_ATTEMPTS):
                division, taken = _division(surface, lattice, block, settings, backend.costs, memory=room, batch=batch)
                backend.make_room(taken)
                try:
                    values, points = _computed(surface, lattice, block, settings, division, backend, 1)
                    return Transformed(values, points, backend.library)
                except Exception as error:
                    # cuFINUFFT says of a failure only where it happened; cuFFT's want of memory is not even known.
                    suspect = type(error) is RuntimeError and taken > room / 2
                    if not (backend.libraries.is_out_of_memory(error) or suspect):
                        raise
                room = min(room, taken) / 2
                _log.warning("%s: %s; trying again with %.3g MB", backend.library, _OUT_OF_MEMORY, room / 1e6)
                backend.make_room(math.inf)
    except InputError:  # no division is small enough
        return _OUT_OF_MEMORY
    except Exception as error:
        return (" ".join(str(error).split()) or type(error).__name__)[:200]
    return _OUT_OF_MEMORY


def _computed(
    surface: Mesh | Smooth,
    lattice: Lattice,
    block: Block,
    settings: TransformSettings,
    division: Division,
    backend: Backend,
    threads: int,
) -> tuple[Complexes, int]:
    """The transform of a surface on one backend, divided in one way, and the number of points."""
    batches = settings.quadrature.batches(
        surface, lattice.highest_frequency, settings.rule_tolerance, division.batch, backend
    )
    values, points = transform_points(
        batches,
        lattice,
        block,
        eps=settings.accuracy,
        dtype=settings.dtype,
        threads=threads,
        backend=backend,
        shape=division.shape,
        oversampling=division.oversampling,
    )
    return backend.download(values), points


def memory_bytes(
    block: Block,
    settings: TransformSettings,
    batch: int = DEFAULT_BATCH,
    *,
    memory: float | None = None,
    triangles: int = 0,
) -> int:
    """Peak memory of `transform_block`, its result included and the mesh itself not, as an upper estimate.

    The oversampled grid and its copy where the surface is, the block and its sum, a batch's coordinates,
    angles, strengths, phases and sorting.

    Args:
        block: see `transform_block`.
        settings: likewise.
        batch: likewise.
        memory: likewise.
        triangles: of the mesh; each takes some bytes while its rule is chosen.
    """
    load = Load(math.inf, triangles=triangles)
    needed: float = transform_bytes(block.shape, settings.accuracy, settings.dtype, load, Division(batch), CPU.costs)
    if memory is not None:
        needed = min(needed, memory)
    return block.size * item_bytes(settings.dtype) + math.ceil(needed)


def _division(
    surface: Mesh | Smooth,
    lattice: Lattice,
    block: Block,
    settings: TransformSettings,
    costs: Costs,
    *,
    memory: float,
    batch: int,
) -> tuple[Division, int]:
    """How the transform of a surface is divided to fit into memory, and what it then takes, in bytes.

    Raises:
        InputError: the memory is too little.
    """
    shape, eps, dtype = block.shape, settings.accuracy, settings.dtype
    low, high = surface.bounds
    fill = float(np.prod((high - low) / (2 * lattice.half_period)))
    triangles = len(surface.triangles) if isinstance(surface, Mesh) else 0
    load = Load(math.inf, triangles=triangles, fill=fill)
    if transform_bytes(shape, eps, dtype, load, Division(batch), costs) > memory:
        # Only now do the points need counting.
        points, most = settings.quadrature.sizes(surface, lattice.highest_frequency, settings.rule_tolerance)
        load = replace(load, points=points, most_points=most)
    division = divide(shape, eps, dtype, load, costs, memory=memory, batch=batch)
    return division, transform_bytes(shape, eps, dtype, load, division, costs)


def _closed_form(sphere: Sphere, lattice: Lattice, block: Block, dtype: ComplexDtype) -> Complexes:
    """The transform of a sphere, slab by slab: whole temporaries would take several times the block."""
    values: Complexes = np.empty(block.shape, dtype=dtype)
    step = max(1, _SLAB // math.prod(block.shape[1:]))
    for first in range(0, block.shape[0], step):
        count = min(step, block.shape[0] - first)
        slab = Block((block.start[0] + first, *block.start[1:]), (count, *block.shape[1:]))
        values[first : first + count] = sphere_block(sphere, lattice, slab)
    return values


def require_inside(surface: Surface, lattice: Lattice) -> None:
    """Refuse a surface that does not fit into the lattice's period, where its points would fold.

    Raises:
        LatticeError: some |coordinate| is not below 1/(2h).
    """
    kind = "mesh" if isinstance(surface, Mesh) else "surface"
    _require_reach(max(float(np.abs(bound).max()) for bound in surface.bounds), lattice, f"the {kind} reaches", "it")


def require_points_inside(coordinates: NDArray[np.float64], lattice: Lattice) -> None:
    """Refuse points (3, n) that do not lie within the lattice's period.

    Raises:
        LatticeError: some |coordinate| is not below 1/(2h).
    """
    _require_reach(float(np.abs(coordinates).max(initial=0.0)), lattice, "the points reach", "them")


def _require_reach(reach: float, lattice: Lattice, subject: str, what: str) -> None:
    if not reach < lattice.half_period:
        needed = 2 * math.floor(2 * lattice.xi_max * reach) + 2
        raise LatticeError(
            f"{subject} to |coordinate| = {reach:.6g}, but the lattice (xi_max {lattice.xi_max:g}, "
            f"M {lattice.M}) holds only |coordinate| < 1/(2h) = {lattice.half_period:.6g}; "
            f"take M >= {needed}, a smaller xi_max, or scale {what} down"
        )
