"""Lattices of frequencies, their blocks, and sums over their shells |k|².

Blocks are rectangular: of the half with xi_z >= 0, or of turned and shifted lattices. Every weight (1 + |ξ|²)^s reduces
a field to its sums over shells.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import Any, ClassVar, Self

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.special import erf, erfc

from sobolev_batch.arrays import Complexes, Indices, Reals
from sobolev_batch.errors import InputError, LatticeError, OrderError
from sobolev_batch.geometry.surface import is_finite_number
from sobolev_batch.parameters import is_whole_number

# Beyond this a field takes more than 34 GB even in single precision.
LARGEST_M = 2048
# Beyond this and its inverse, volumes of cells and periods leave double precision.
_LOWEST_XI_MAX = 1e-50
AXES = ("xi_x", "xi_y", "xi_z")
# The cube's volume is that of a ball of this radius, in units of half its side.
_BALL = (6 / math.pi) ** (1 / 3)
# Layers of an octave's lattice with ξ_z < 0, over which it fades out, and the width of the fading in layers.
_FADED_LAYERS, _FADING_LAYERS = 3, 1.2
_LOWEST_ORDER = -100.0
# Kernels of orders above this have a narrow peak.
_NARROW = -3.0
# The smooth step falls from one to zero between this fraction of the cutoff and the cutoff.
STEP_START = 0.5
# At the ends of the fall it is off by erfc(3)/2 = 1e-5, on both sides of the cut: a partition by steps stays one.
_STEEPNESS = 3.0
# It is erfc((|ξ| - middle)/width)/2, both as fractions of the cutoff.
STEP_MIDDLE, STEP_WIDTH = (1 + STEP_START) / 2, (1 - STEP_START) / 2 / _STEEPNESS

Axes = tuple[Reals, Reals, Reals]
Orders = float | Sequence[float]


@dataclass(frozen=True)
class Block:
    """A rectangular block of the half lattice: its lowest index k along each axis, maybe negative, and its shape."""

    start: tuple[int, int, int]
    shape: tuple[int, int, int]

    @property
    def size(self) -> int:
        """Number of samples."""
        return math.prod(self.shape)

    def indices(self, axis: int) -> Indices:
        """Return the indices k along an axis, int64 (shape[axis],)."""
        return np.arange(self.start[axis], self.start[axis] + self.shape[axis], dtype=np.int64)

    def place_in(self, block: Block) -> tuple[slice, slice, slice]:
        """Return the slices of this block in an array of another one that holds it."""
        starts = zip(block.start, self.start, self.shape, strict=True)
        x, y, z = (slice(start - first, start - first + count) for first, start, count in starts)
        return x, y, z

    def intersection(self, block: Block) -> Block | None:
        """Return the block that this one and another have in common; None where that is none."""
        ends = zip(self.start, self.shape, block.start, block.shape, strict=True)
        (i, di), (j, dj), (k, dk) = ((max(a, b), min(a + m, b + n) - max(a, b)) for a, m, b, n in ends)
        return Block((i, j, k), (di, dj, dk)) if min(di, dj, dk) > 0 else None

    def split(self, largest_size: int) -> tuple[Block, ...]:
        """Return equal blocks of at most ``largest_size`` samples that make up this one.

        They differ in shape only at the high ends, as the chunks of a regular grid do. The slow axes are split first.
        """
        shape = list(self.shape)
        for axis in range(3):
            longest = max(1, largest_size // math.prod(shape[axis + 1 :]))
            shape[axis] = math.ceil(shape[axis] / math.ceil(shape[axis] / longest))
            if math.prod(shape) <= largest_size:
                break
        tiles = self.tiles((shape[0], shape[1], shape[2]))
        return tuple(part for tile, _ in tiles if (part := self.intersection(tile)))

    def tiles(self, shape: tuple[int, int, int]) -> Iterator[tuple[Block, tuple[slice, slice, slice]]]:
        """Yield blocks of one shape that cover this one or more, each with its slices of an array of this one."""
        for offsets in product(*(range(0, count, step) for count, step in zip(self.shape, shape, strict=True))):
            i, j, k = (first + offset for first, offset in zip(self.start, offsets, strict=True))
            sides = zip(offsets, shape, self.shape, strict=True)
            x, y, z = (slice(offset, min(offset + step, count)) for offset, step, count in sides)
            yield Block((i, j, k), shape), (x, y, z)


class FrequencyLattice:
    """Equally spaced frequencies along three orthogonal axes.

    Attributes:
        tolerates_images: True if images at the period 1/h cancel on average over lattices; else surfaces lie within it.
        spacing: Distance h between neighbouring frequencies, in cycles per unit length.
        half: Block of all samples.
        highest_frequency: Largest |ξ| at which samples count, in cycles per unit length.
        radial_range: Range of |ξ| over which errors of samples count, for predictions.
        shift: Shift of all samples along the lattice's axes, in units of the spacing.
    """

    tolerates_images: ClassVar[bool] = False
    spacing: float
    half: Block
    highest_frequency: float
    radial_range: tuple[float, float]
    shift: tuple[float, float, float] = 0.0, 0.0, 0.0

    @property
    def rotation(self) -> Reals | None:
        """Rotation (3, 3) that takes coordinates of surfaces to the lattice's axes; None for none."""
        return None

    @property
    def half_period(self) -> float:
        """Bound 1/(2h) on the |coordinates| of surfaces, in units of length."""
        return 1 / (2 * self.spacing)

    def frequencies(self, block: Block) -> Axes:
        """Return the frequencies along the lattice's three axes in a block, in cycles per unit length."""
        x, y, z = (self.spacing * (block.indices(axis).astype(np.float64) + self.shift[axis]) for axis in range(3))
        return x, y, z

    def points(self, block: Block) -> Reals:
        """Return all frequencies of a block along the axes of surfaces (block.size, 3), in cycles per unit length."""
        along = np.stack([axis.ravel() for axis in np.meshgrid(*self.frequencies(block), indexing="ij")])
        return np.asarray((along if self.rotation is None else np.einsum("kq,kn->qn", self.rotation, along)).T)


@dataclass(frozen=True)
class Lattice(FrequencyLattice):
    """The frequencies xi = h k with h = 2 xi_max / M and k = -M/2..M/2 on each axis.

    A surface measure is real, so its transform at -xi is the conjugate of that at xi. Only the Hermitian half with
    xi_z >= 0 is computed and stored: shape (M+1, M+1, M/2+1).

    Attributes:
        xi_max: Half the side of the frequency cube, in cycles per unit length.
        M: Number of intervals along each axis, even.
        spacing: Distance h between neighbouring frequencies, in cycles per unit length.
        half: Half lattice xi_z >= 0 as one block.
        highest_frequency: Length |xi| of the cube's corners, in cycles per unit length.

    Raises:
        LatticeError: xi_max is not positive and finite, or M is not an even integer from 2 to 2048.

    >>> lattice = Lattice(xi_max=5.0, M=64)
    >>> lattice.shape, lattice.spacing
    ((65, 65, 33), 0.15625)
    >>> lattice.half_period  # surfaces must lie within |coordinate| < 3.2 units of length
    3.2
    """

    xi_max: float
    M: int

    def __post_init__(self) -> None:
        if not (is_finite_number(self.xi_max) and _LOWEST_XI_MAX <= self.xi_max <= 1 / _LOWEST_XI_MAX):
            ends = f"{_LOWEST_XI_MAX:g} to {1 / _LOWEST_XI_MAX:g}"
            raise LatticeError(f"xi_max must be from {ends}, found {self.xi_max!r}; choose another unit of length")
        if not is_whole_number(self.M) or self.M % 2 or not 2 <= self.M <= LARGEST_M:
            raise LatticeError(f"M must be an even integer from 2 to {LARGEST_M}, found {self.M!r}")
        M = int(self.M)  # not NumPy's, whose products may overflow
        vars(self).update(
            M=M,
            spacing=2 * self.xi_max / M,
            half=Block((-M // 2, -M // 2, 0), (M + 1, M + 1, M // 2 + 1)),
            highest_frequency=math.sqrt(3) * self.xi_max,
            radial_range=(0.0, _BALL * self.xi_max),
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of samples along xi_x, xi_y, xi_z of the half lattice."""
        return self.half.shape

    @cached_property
    def axes(self) -> Axes:
        """Frequencies along xi_x, xi_y, xi_z of the half lattice, float64, in cycles per unit length."""
        return self.frequencies(self.half)

    def axis_weights(self, block: Block) -> Axes:
        """Return the weights of the trapezoidal rule along the three axes of a block, with the factor h.

        Their products integrate over the whole cube: samples at the ends of an axis count half, and samples with
        xi_z > 0 count twice, for themselves and their conjugates.
        """
        x, y, z = (np.where(np.abs(block.indices(axis)) == self.M // 2, 0.5, 1.0) * self.spacing for axis in range(3))
        return x, y, z * np.where(block.indices(2) > 0, 2.0, 1.0)

    def trapezoid_weights(self, block: Block) -> Reals:
        """Return the product of the `axis_weights` at each sample of a block, float64 (block.shape)."""
        x, y, z = self.axis_weights(block)
        return np.asarray(x[:, None, None] * y[:, None] * z)

    def shells(self, block: Block) -> NDArray[np.int32]:
        """Return the squared length |k|^2 of each index triple of a block, int32 (block.shape)."""
        x, y, z = (block.indices(axis).astype(np.int32) ** 2 for axis in range(3))
        return np.asarray(x[:, None, None] + y[:, None] + z)

    @property
    def shell_count(self) -> int:
        """Number of values that `shells` can take: 3 (M/2)^2 + 1."""
        return 3 * (self.M // 2) ** 2 + 1

    @classmethod
    def from_field(cls, field: xr.DataArray) -> Lattice:
        """Return the lattice of a field.

        Raises:
            LatticeError: The array lacks the three axes, or they are not those of the half of a lattice.
        """
        if not set(AXES) <= set(field.coords):
            raise LatticeError(f"a Fourier field needs the coordinates {', '.join(AXES)}, found {list(field.coords)}")
        axes = [np.asarray(field[name].values, dtype=np.float64) for name in AXES]
        if axes[0].ndim != 1 or len(axes[0]) < 3:
            raise LatticeError(f"xi_x must be an axis of at least three samples, found shape {axes[0].shape}")
        lattice = cls(float(axes[0][-1]), len(axes[0]) - 1)
        for name, axis, expected in zip(AXES, axes, lattice.axes, strict=True):
            if axis.shape != expected.shape or not np.allclose(axis, expected, rtol=1e-12, atol=1e-12 * lattice.xi_max):
                half = f"the half (xi_z >= 0) of a lattice of xi_max {lattice.xi_max:g} and M {lattice.M}"
                raise LatticeError(f"{name} does not run over {half}; select whole fields, not parts of them")
        return lattice


@dataclass(frozen=True)
class OctaveLattice(FrequencyLattice):
    """The frequencies h Rᵀ (k + o) of a lattice that is turned by R and shifted by o, both drawn at random.

    Over all shifts, the sum over such a lattice has the integral as its expectation, whatever the spacing: the images
    of the surfaces average out. So a lattice of the same size serves each octave of |ξ|, at twice the spacing.

    The integrands are even, so one half of space counts for both. Samples fade out across its boundary
    (`half_weights`), since a sharp edge would cut some cells of the lattice in two.

    Attributes:
        lowest: Least |ξ| at which samples count, in cycles per unit length.
        highest: Largest |ξ| at which samples count; those beyond it are computed with a larger error.
        M: Samples along the x and y axis, even; the z axis has half as many, with ξ_z > 0 along the lattice's axis, and
            three layers below that fade out.
        quaternion: Rotation R as a unit quaternion (x, y, z, w).
        offset: Shift o in units of the spacing, each from 0 to 1.
    """

    lowest: float
    highest: float
    M: int
    quaternion: tuple[float, float, float, float]
    offset: tuple[float, float, float]

    tolerates_images: ClassVar[bool] = True

    @classmethod
    def random(cls, lowest: float, highest: float, M: int, rng: np.random.Generator) -> Self:
        """Draw the rotation and shift of a lattice."""
        from scipy.spatial.transform import Rotation

        x, y, z, w = Rotation.random(rng=rng).as_quat().tolist()
        i, j, k = rng.random(3).tolist()
        return cls(lowest, highest, M, (x, y, z, w), (i, j, k))

    def __post_init__(self) -> None:
        M, faded = self.M, _FADED_LAYERS
        vars(self).update(
            spacing=2 * self.highest / M,
            half=Block((-M // 2, -M // 2, -faded), (M, M, M // 2 + faded)),
            highest_frequency=self.highest,
            radial_range=(self.lowest, self.highest),
            shift=self.offset,
        )

    @cached_property
    def rotation(self) -> Reals:
        """Rotation R as a matrix (3, 3)."""
        from scipy.spatial.transform import Rotation

        return np.asarray(Rotation.from_quat(self.quaternion).as_matrix())

    def half_weights(self) -> Reals:
        """Return the weight of each layer of samples along the z axis, float64: 2 inside, fading to 0 across ξ_z = 0.

        The weights of a frequency and of its negative add up to 2.
        """
        return np.asarray(1 + erf((self.half.indices(2) + self.offset[2]) / _FADING_LAYERS))


@dataclass(frozen=True)
class SobolevWeights:
    """Weights (1 + |ξ|²)^s of one or several orders on a lattice.

    Attributes:
        lattice: Lattice of ξ, in cycles per unit length.
        cutoff: Radius |ξ| at which a `smooth_step` ends that the weights are multiplied by; None for none.
    """

    lattice: Lattice
    orders: tuple[float, ...]
    cutoff: float | None = None

    @cached_property
    def per_shell(self) -> Reals:
        """Weight of each shell |k|² for each order, float64 (orders, lattice.shell_count)."""
        squares = self.lattice.spacing**2 * np.arange(self.lattice.shell_count, dtype=np.float64)
        step = 1.0 if self.cutoff is None else smooth_step(np.sqrt(squares), self.cutoff)
        return np.stack([(1 + squares) ** s * step for s in self.orders])

    @cached_property
    def narrower(self) -> SobolevWeights:
        """Weights of half of each order, but none above -3 that was not: kernels narrower than theirs, or the same."""
        return SobolevWeights(self.lattice, tuple(max(s, min(s / 2, _NARROW)) for s in self.orders), self.cutoff)

    def __getstate__(self) -> dict[str, Any]:
        # Tasks carry these weights: it is cheaper to compute them again than to send them.
        return {"lattice": self.lattice, "orders": self.orders, "cutoff": self.cutoff}


def smooth_step(radii: Reals, cutoff: float) -> Reals:
    """Return a smooth function of |ξ| that is 1 up to half the cutoff and 0 from the cutoff on.

    Where a sharp cut would spoil it, the trapezoidal rule stays spectrally accurate.
    """
    fractions = np.asarray(radii, dtype=np.float64) / cutoff
    falling = 0.5 * erfc((fractions - STEP_MIDDLE) / STEP_WIDTH)
    return np.select([fractions <= STEP_START, fractions < 1], [1.0, falling], 0.0)


def check_orders(order: Orders) -> tuple[float, ...]:
    """Return one or several orders as floats, each once; OrderError where one is not between -100 and -1/2, or none."""
    try:
        given = np.atleast_1d(np.asarray(order))
    except ValueError:
        given = np.empty((0, 0))
    if given.dtype.kind not in "iuf" or given.ndim > 1:
        raise OrderError(f"an order is a number, such as -2.0, or a list of numbers; found {order!r}")
    if not (orders := tuple(dict.fromkeys(given.astype(float).tolist()))):
        raise OrderError("at least one order is needed")
    for s in orders:
        if not (np.isfinite(s) and s < -0.5):
            raise OrderError(f"the norm of a surface is finite only for orders below -1/2, found {s:g}")
        if s < _LOWEST_ORDER:
            raise OrderError(f"orders go down to {_LOWEST_ORDER:g}, where weights leave double precision, found {s:g}")
    return orders


def single_order(order: float) -> float:
    """Return one order as a float, as `check_orders` does; several are an InputError."""
    if len(orders := check_orders(order)) > 1:
        raise InputError(f"one order is needed, found {len(orders)}")
    return orders[0]


def shell_sums(values: Complexes, others: Complexes | None, lattice: Lattice, block: Block) -> Reals:
    """Sum Re(a conj b) by the trapezoidal rule over each shell of one block of the half lattice.

    The fields a and b, or a itself for None, are complex (..., *block.shape). The sums are float64 (...,
    lattice.shell_count), indexed by |k|². Those of all blocks add up to those of the whole lattice, conjugate half
    included. A NaN makes the sum of its shell NaN.
    """
    # The type that counting needs, and the weights, once for all fields.
    shells = lattice.shells(block).ravel().astype(np.intp)
    weights = lattice.trapezoid_weights(block)
    sums = np.empty((*values.shape[:-3], lattice.shell_count))
    for i in np.ndindex(sums.shape[:-1]):
        a = values[i]
        b = a if others is None else others[i]
        products = a.real.astype(np.float64) * b.real
        products += a.imag.astype(np.float64) * b.imag
        products *= weights
        sums[i] = np.bincount(shells, weights=products.ravel(), minlength=lattice.shell_count)
    return sums


@lru_cache(maxsize=16)
def shell_volumes(lattice: Lattice) -> Reals:
    """Return the sum of the trapezoidal weights of each shell, float64 (lattice.shell_count,)."""
    x, y, z = lattice.axis_weights(lattice.half)
    squares = lattice.half.indices(0) ** 2
    plane = np.bincount((squares[:, None] + squares).ravel(), weights=np.outer(x, y).ravel())
    volumes = np.zeros(lattice.shell_count)
    for k, weight in enumerate(z):
        volumes[k * k : k * k + len(plane)] += weight * plane
    return volumes
