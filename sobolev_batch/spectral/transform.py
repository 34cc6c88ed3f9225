"""The Fourier transform of a surface on a block of the lattice: closed form, or quadrature and NUFFT."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import get_args

import numpy as np

from sobolev_batch.errors import InputError, LatticeError
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.nufft import LARGEST_OVERSAMPLING, Complexes, Precision, transform_points
from sobolev_batch.spectral.quadrature import Quadrature, WeightedPoints
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
    """A block of a field, and from how many points it was made.

    Attributes:
        values: complex (block.shape).
        points: of the quadrature; 0 for a closed form.
    """

    values: Complexes
    points: int


def transform_block(
    surface: Surface,
    lattice: Lattice,
    block: Block,
    settings: Transform,
    *,
    threads: int = 1,
    batch: int = DEFAULT_BATCH,
) -> Transformed:
    """The transform of a surface on one block of the lattice.

    Memory is that of the block (about twelve times its bytes), of the mesh, and of one batch of
    points: it does not grow with the number of points.

    Raises:
        LatticeError: a mesh reaches beyond the lattice's half period.
    """
    if isinstance(surface, Sphere):
        return Transformed(sphere_block(surface, lattice, block).astype(settings.precision, copy=False), 0)
    require_inside(surface, lattice)
    points = 0

    def counted() -> Iterator[WeightedPoints]:
        nonlocal points
        batches = settings.quadrature.batches(surface, lattice.highest_frequency, settings.rule_tolerance, batch)
        for part in batches:
            points += len(part.weights)
            yield part

    values = transform_points(
        counted(), lattice, block, eps=settings.accuracy, precision=settings.precision, threads=threads
    )
    return Transformed(values, points)


def memory_bytes(block: Block, settings: Transform, batch: int = DEFAULT_BATCH) -> int:
    """Peak memory of `transform_block`, without the mesh itself, as an upper estimate.

    The oversampled grid, the block and its sum, and a batch's coordinates, angles, strengths,
    phases and sorting.
    """
    item = 16 if settings.precision == "complex128" else 8
    return int(block.size * item * (LARGEST_OVERSAMPLING**3 * 1.3 + 2)) + batch * 140


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
