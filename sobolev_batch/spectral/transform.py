"""The Fourier transform of a surface on a block of the lattice: closed form, or quadrature and NUFFT."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import get_args

import numpy as np

from sobolev_batch.errors import InputError, LatticeError
from sobolev_batch.spectral.backends import CPU, Backend
from sobolev_batch.spectral.division import Division, Load, divide, transform_bytes
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.nufft import transform_points
from sobolev_batch.spectral.precision import Complexes, Precision, item_bytes
from sobolev_batch.spectral.quadrature import Quadrature
from sobolev_batch.spectral.spheres import sphere_block
from sobolev_batch.surfaces.mesh import Mesh
from sobolev_batch.surfaces.similarity import Surface
from sobolev_batch.surfaces.sphere import Sphere

# Raise it whenever the numbers that a given surface and settings lead to change: stored fields of
# another version are then computed again instead of being compared with new ones.
NUMERICS_VERSION = 3

# Points of one NUFFT call: 2 million take 0.3 GB with their strengths and their sorting, and make
# the FFT of a call a small part of it.
DEFAULT_BATCH = 1 << 21

# What FINUFFT can reach; below it warns in 2.5 and refuses from 2.6.
FINEST_EPS: dict[Precision, float] = {"complex128": 1e-14, "complex64": 2e-7}
COARSEST_EPS = 0.1
# Samples of a closed form at a time.
_SLAB = 1 << 18


@dataclass(frozen=True)
class Transform:
    """How fields are computed.

    Args:
        eps: accuracy of a field relative to the surface's area. None stands for 1e-9 in complex128
            and 1e-6 in complex64.
        precision: "complex128" or "complex64".
        quadrature: see `Quadrature`.
        tolerance: largest error of the triangle rules on any one triangle, relative to its area;
            None stands for eps.

    Raises:
        InputError: a precision that does not exist, or an eps beyond what it can hold.
    """

    eps: float | None = None
    precision: Precision = "complex128"
    quadrature: Quadrature = field(default_factory=Quadrature)
    tolerance: float | None = None

    def __post_init__(self) -> None:
        if self.precision not in get_args(Precision):
            raise InputError(f"dtype must be 'complex128' or 'complex64', found {self.precision!r}")
        if self.eps is None:
            object.__setattr__(self, "eps", 1e-9 if self.precision == "complex128" else 1e-6)
        finest = FINEST_EPS[self.precision]
        if not finest <= self.accuracy <= COARSEST_EPS:
            raise InputError(
                f"eps must lie between {finest:g} and {COARSEST_EPS:g} in {self.precision}, found {self.eps!r}"
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
        if not isinstance(surface, Mesh):
            return 0
        return self.quadrature.lowest_degree(surface, lattice.highest_frequency, self.rule_tolerance)


@dataclass(frozen=True, eq=False)
class Transformed:
    """A block of a field, and from what it was made.

    Attributes:
        values: complex (block.shape).
        points: of the quadrature; 0 for a closed form.
        backend: the library that computed it; also which one failed before, and why.
    """

    values: Complexes
    points: int
    backend: str = CPU.library


def transform_block(
    surface: Surface,
    lattice: Lattice,
    block: Block,
    settings: Transform,
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
        backend: where to compute.
        threads: of FINUFFT.
        batch: the largest number of points of one NUFFT.
        memory: what this may take besides the mesh and the result, in bytes. What does not fit is
            computed in smaller batches, in parts of the block and with less oversampling, whichever is
            predicted to be the fastest; that changes the values by a small multiple of eps. Without
            it, a transform takes what `memory_bytes` says, however many points there are.

    Raises:
        LatticeError: a mesh reaches beyond the lattice's half period.
        InputError: the memory is too little for any way of computing it.
    """
    if isinstance(surface, Sphere):
        return Transformed(_closed_form(surface, lattice, block, settings.precision), 0)
    require_inside(surface, lattice)
    division = Division(batch)
    if memory is not None:
        load = _load(surface, lattice, settings)
        eps, precision = settings.accuracy, settings.precision
        division = divide(block.shape, eps, precision, load, CPU.costs, memory=memory, batch=batch)
    values, points = transform_points(
        settings.quadrature.batches(surface, lattice.highest_frequency, settings.rule_tolerance, division.batch),
        lattice,
        block,
        eps=settings.accuracy,
        precision=settings.precision,
        threads=threads,
        shape=division.shape,
        oversampling=division.oversampling,
    )
    return Transformed(values, points)


def memory_bytes(
    block: Block,
    settings: Transform,
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
    needed: float = transform_bytes(
        block.shape, settings.accuracy, settings.precision, load, Division(batch), CPU.costs
    )
    if memory is not None:
        needed = min(needed, memory)
    return block.size * item_bytes(settings.precision) + math.ceil(needed)


def _load(mesh: Mesh, lattice: Lattice, settings: Transform) -> Load:
    """What transforming a mesh has to deal with."""
    points, most = settings.quadrature.sizes(mesh, lattice.highest_frequency, settings.rule_tolerance)
    low, high = mesh.bounds
    return Load(points, most, len(mesh.triangles), float(np.prod((high - low) / (2 * lattice.half_period))))


def _closed_form(sphere: Sphere, lattice: Lattice, block: Block, precision: Precision) -> Complexes:
    """The transform of a sphere, slab by slab: whole temporaries would take several times the block."""
    values: Complexes = np.empty(block.shape, dtype=precision)
    step = max(1, _SLAB // math.prod(block.shape[1:]))
    for first in range(0, block.shape[0], step):
        count = min(step, block.shape[0] - first)
        slab = Block((block.start[0] + first, *block.start[1:]), (count, *block.shape[1:]))
        values[first : first + count] = sphere_block(sphere, lattice, slab)
    return values


def require_inside(mesh: Mesh, lattice: Lattice) -> None:
    """Refuse a mesh that does not fit into the lattice's period, where its points would fold.

    Raises:
        LatticeError: some |coordinate| is not below 1/(2h).
    """
    reach = max(float(np.abs(bound).max()) for bound in mesh.bounds)
    if not reach < lattice.half_period:
        needed = 2 * math.floor(2 * lattice.xi_max * reach) + 2
        raise LatticeError(
            f"the mesh reaches to |coordinate| = {reach:.6g}, but the lattice (xi_max {lattice.xi_max:g}, "
            f"M {lattice.M}) holds only |coordinate| < 1/(2h) = {lattice.half_period:.6g}; "
            f"take M >= {needed}, a smaller xi_max, or scale the mesh down"
        )
