"""Decomposition of a distance: a mere change of total area, and the rest."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.metrics.datasets import labelled, lattice_attributes
from sobolev_batch.spectral.metrics.inputs import OperandLike, pair_of, shells_against
from sobolev_batch.spectral.shells import Orders, Reals, SobolevWeights, check_orders


@dataclass(frozen=True)
class Proportion:
    """Two orthogonal parts of distances to a reference, each (orders, ...).

    Attributes:
        area: Part that a multiple of the reference explains.
        shape: Rest. The squares of both add up to the squared distance.
        excess: Difference of that multiple from one.
    """

    area: Reals
    shape: Reals
    excess: Reals

    def __iter__(self) -> Iterator[Reals]:
        yield from (self.area, self.shape, self.excess)

    @classmethod
    def of_shells(cls, squares: Reals, products: Reals, reference: Reals, weights: SobolevWeights) -> Proportion:
        """Return the parts of distances to a reference b, from shell sums of the differences e = a - b.

        The best multiple c of b has c - 1 = <e, b>/<b, b>. Nothing cancels in it for near-duplicates, since a
        itself does not occur. The square of the shape part is what the area part leaves over of the
        squared distance, and good to 1e-15 of that.

        Args:
            squares: Shell sums of |e|², (..., lattice.shell_count); see `shell_sums`.
            products: Shell sums of Re(e conj b), likewise.
            reference: Shell sums of |b|², (lattice.shell_count,).
            weights: Weights of the shells.
        """
        square, product = (np.tensordot(weights.per_shell, sums, axes=(1, -1)) for sums in (squares, products))
        return cls.of_totals(square, product, weights.per_shell @ reference)

    @classmethod
    def of_totals(cls, square: Reals, product: Reals, reference: Reals) -> Proportion:
        """Return the parts from ||e||² and <e, b>, each (orders, ...), and ||b||² (orders,); see `of_shells`."""
        norm = np.sqrt(reference).reshape(-1, *[1] * (square.ndim - 1))
        with np.errstate(divide="ignore", invalid="ignore"):
            area = np.abs(product) / norm
            excess = product / norm**2
        # Rounding may make the projection longer than what it projects.
        area = np.minimum(area, np.sqrt(square))
        return cls(area, np.sqrt(np.maximum(square - area**2, 0.0)), excess)


def proportion(a: OperandLike, b: OperandLike, order: Orders, *, lattice: Lattice | None = None) -> xr.Dataset:
    """Return the distance ||a - b||_s split into a pure change of total area and the rest.

    Of all multiples of b, c b with c = <a, b>_s/<b, b>_s is nearest to a. Then a - b = (c - 1) b + (a - c b),
    and both parts are orthogonal in the norm of order s.

    Args:
        a: Field from `fourier_transform` or a store, or a surface.
        b: Reference: a field on the same lattice, or a surface.
        order: One order s < -1/2, or several.
        lattice: Lattice to transform surfaces on. A field brings its own.

    Returns:
        Dataset over `order` with `distance`, `area_part` = |c - 1| ||b||_s, `shape_part` = ||a - c b||_s,
        `area_share` = area_part² / distance² (NaN between equal fields), and `excess` = c - 1, positive
        where a has more area than b. All are float64. The squares of both parts add up to that of the
        distance. A single order has no dimension. Attributes hold the lattice and the kernel.

    Raises:
        OrderError: An order is not below -1/2.
        LatticeError: The fields lie on different lattices, or a surface does not fit into the lattice.
        InputError: A surface comes without a lattice.

    >>> from sobolev_batch import Lattice, Sphere, proportion
    >>> parts = proportion(Sphere(0.9), Sphere(), -2.0, lattice=Lattice(3.0, 32))
    >>> f"{parts['excess'].item():.3f}", f"{parts['area_share'].item():.2f}"
    ('-0.206', '0.19')
    """
    orders = check_orders(order)
    first, second = pair_of(a, b, lattice, orders)
    weights = SobolevWeights(Lattice.of(first), orders)
    squares, products, reference = shells_against(first, second, weights.lattice)
    area, shape, excess = Proportion.of_shells(squares, products, reference, weights)
    distance = np.sqrt(weights.per_shell @ squares)
    with np.errstate(invalid="ignore"):
        share = (area / distance) ** 2
    parts = {"distance": distance, "area_part": area, "shape_part": shape, "area_share": share, "excess": excess}
    return labelled(order, parts, lattice_attributes(weights.lattice, first, second))
