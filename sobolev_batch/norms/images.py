"""What images of surfaces at the period of a given lattice add to a squared norm, by the field itself.

A sum over a lattice has, besides the integral, the correlation of the measure with each of its images. The sum over the
frequencies half a step further along one axis has the same, with the other sign for images of odd number along it. So
half the difference of both is what these add, and quarters of a step show those at twice the period, and so on. As the
surfaces lie within the period, their field between samples follows from the samples by the Dirichlet kernel; a taper
keeps the end of the lattice out of it. Images of faces parallel to them count most, and of these only the lowest
frequencies across an axis fade slowly: see `_ACROSS`.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import diric

from sobolev_batch.arrays import Complexes, Reals
from sobolev_batch.transform.lattice import Block, Lattice

# The orders at which images are known.
IMAGE_ORDERS = (-0.5, -0.75, -1, -1.5, -2, -2.5, -3, -3.5, -4, -5, -6, -8, -10, -14, -20, -30, -50, -100)
# Frequencies across an axis up to which images count, in cycles per unit length: beyond it, a kernel falls more than
# twice as fast with the distance. And the bytes of values near the axes of one field at most.
_ACROSS, _MOST_BYTES = 2.0, 8e6
# Tapers are exp(-(σξ/xi_max)²/2) for these σ, and the largest result counts. They blur surfaces by σ/(2π xi_max): a
# wide blur reaches across a narrow gap to images and hides them, and under a narrow one the lattice's end may do so.
_TAPERS = 1.0, 2.0, 3.0
# Where the period is shorter than this length, images at multiples of it count too, by at most so many parts of a step.
_REACH, _MOST_STEPS = 3.0, 64
# Images of boxes, spheres and sticks in little to much room were 0.7 to 2 times what is measured here.
_CAUTION = 2.0


class NearAxes:
    """Values of several fields near the three axes of a given lattice, gathered block by block."""

    def __init__(self, lattice: Lattice, count: int) -> None:
        self.lattice, end = lattice, lattice.M // 2
        most = int(np.sqrt(_MOST_BYTES / (3 * 16 * 2 * (lattice.M + 1)))) - 1
        # Samples on each side of an axis.
        self._width = wide = max(1, min(int(np.ceil(_ACROSS / lattice.spacing)), most, end))
        along, across = (-end, 2 * end + 1), (-wide, 2 * wide + 1)
        sides = (along, across, (0, wide + 1)), (across, along, (0, wide + 1)), (across, across, (0, end + 1))
        self._blocks = [Block(*zip(*side, strict=True)) for side in sides]
        self._values = [np.zeros((count, *block.shape), dtype=np.complex128) for block in self._blocks]

    def take(self, fields: slice, block: Block, values: Complexes) -> None:
        """Take what is needed of a block of some fields, (fields, *block.shape)."""
        for near, held in zip(self._blocks, self._values, strict=True):
            if (common := near.intersection(block)) is not None:
                held[fields, *common.place_in(near)] = values[:, *common.place_in(block)]

    def images(self) -> Reals:
        """Return bounds on what images add to squared norms of `IMAGE_ORDERS`, either way, (fields, orders)."""
        sums, of_axes = self._sums(), 0.0
        # Images at odd multiples of the period, of twice the period, and so on.
        while len(sums) > 1:
            half = len(sums) // 2
            of_axes = of_axes + np.abs(sums[0] - sums[half]) / 2
            sums = (sums[:half] + sums[half:]) / 2
        # Images along different axes may cancel, but not what is off by a fraction of each.
        found = np.asarray(_CAUTION * self.lattice.spacing**3 * of_axes).sum(axis=1).max(axis=0)
        # Where their sign changes from order to order, they are as uncertain as at the orders beside it.
        first, orders, last = (np.array(IMAGE_ORDERS[k : len(IMAGE_ORDERS) - 2 + k]) for k in range(3))
        parts = (orders - first) / (last - first)
        inner = np.maximum(found[:, 1:-1], found[:, :-2] ** (1 - parts) * found[:, 2:] ** parts)
        return np.concatenate([found[:, :1], inner, found[:, -1:]], axis=1)

    def _sums(self) -> Reals:
        """Return sums over samples moved along an axis by k/n of a step (n, tapers, axes, fields, orders)."""
        lattice, end, wide = self.lattice, self.lattice.M // 2, self._width
        along, across = np.arange(-end, end + 1), np.arange(-wide, wide + 1)
        tapers = np.exp(-((np.multiply.outer(_TAPERS, along) / end) ** 2) / 2)
        # Lines with their conjugates, by their squared distances from the axis.
        squares, places = np.unique(across[:, None] ** 2 + across[wide:] ** 2, return_inverse=True)
        weights = np.where(across[wide:] > 0, 2.0, 1.0)[:, None] * np.eye(len(squares))[places]
        weights = weights.reshape(-1, len(squares))
        lines = [values.reshape(*values.shape[:2], -1) for values in map(self._lines, range(3))]
        steps = int(np.clip(2 ** np.ceil(np.log2(_REACH * lattice.spacing)), 2, _MOST_STEPS))
        sums = np.zeros((steps, len(tapers), 3, len(lines[0]), len(IMAGE_ORDERS)))
        for step in range(steps // 2 + 1):
            moved = along[:, None] + step / steps
            between = diric(2 * np.pi / len(along) * (moved - along), len(along))
            factors = np.exp(np.multiply.outer(IMAGE_ORDERS, np.log1p(lattice.spacing**2 * (moved**2 + squares))))
            for taper, axis, field in np.ndindex(sums.shape[1:-1]):
                found = (between * tapers[taper]) @ lines[axis][field]
                energies = (found.real**2 + found.imag**2) @ weights
                # The field at the opposite is the conjugate.
                sums[[step, -step], taper, axis, field] = np.tensordot(factors, energies)
        return sums

    def _lines(self, axis: int) -> Complexes:
        """Return values along an axis (fields, M + 1, ...) at half of the frequencies across it."""
        values = self._values[axis]
        if axis == 2:
            # The other half along the axis is the conjugate at the opposite of frequencies across it.
            mirrored = values[:, ::-1, ::-1, :0:-1].conj()
            values = np.concatenate([mirrored, values], axis=3)[:, :, self._width :]
        return np.moveaxis(values, axis + 1, 1)


def images_at(images: Reals, orders: Sequence[float]) -> Reals:
    """Return what images add to squared norms of any orders (orders, fields), from those of `IMAGE_ORDERS`."""
    # Equal surfaces have none.
    return by_chords(images, IMAGE_ORDERS, orders) * images.any(axis=1)


def by_chords(values: Reals, known: Sequence[float] | Reals, orders: Sequence[float]) -> Reals:
    """Return numbers at any orders (orders, fields), from those at known ones (fields, known), along logarithms."""
    logarithms = np.log(np.maximum(values, np.finfo(np.float64).tiny))
    rows = [np.interp(-np.array(orders), -np.array(known), row) for row in logarithms]
    return np.exp(np.reshape(rows, (len(values), len(orders))).T)
