"""The proportion of two surfaces: how much of their distance a mere change of total area explains."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.metrics.inputs import Operand, over_orders, pair_of, read_blocks
from sobolev_batch.spectral.shells import Orders, Reals, check_orders, shell_sums, shell_weights


@dataclass(frozen=True)
class Proportion:
    """The two orthogonal parts of distances to a reference, each (orders, ...).

    Attributes:
        area: what multiplying the reference by a number explains.
        shape: the rest. The squares of both add up to the squared distance.
        excess: by how much that number exceeds one.
    """

    area: Reals
    shape: Reals
    excess: Reals

    def __iter__(self) -> Iterator[Reals]:
        yield from (self.area, self.shape, self.excess)

    @classmethod
    def of_shells(
        cls, squares: Reals, products: Reals, reference: Reals, lattice: Lattice, orders: Sequence[float]
    ) -> Proportion:
        """The parts of distances to a reference b, from shell sums of the differences e = a - b.

        The best multiple c of b has c - 1 = <e, b>/<b, b>. Nothing of it cancels for near twins, since a
        itself does not occur. The square of the shape part is what the area part leaves over of the
        squared distance, and good to 1e-15 of that.

        Args:
            squares: of |e|², (..., lattice.shell_count); see `shell_sums`.
            products: of Re(e conj b), likewise.
            reference: of |b|², (lattice.shell_count,).
            lattice: on which they were summed.
            orders: s, each.
        """
        weights = shell_weights(lattice, orders)
        square, product = (np.tensordot(weights, sums, axes=(1, -1)) for sums in (squares, products))
        norm = np.sqrt(weights @ reference).reshape(-1, *[1] * (square.ndim - 1))
        with np.errstate(divide="ignore", invalid="ignore"):
            area = np.abs(product) / norm
            excess = product / norm**2
        # Rounding may make the projection longer than what it projects.
        area = np.minimum(area, np.sqrt(square))
        return cls(area, np.sqrt(square - area**2), excess)


def proportion(a: Operand, b: Operand, order: Orders, *, lattice: Lattice | None = None) -> xr.Dataset:
    """The distance ||a - b||_s split into what a pure change of total area explains, and the rest.

    Of all multiples of b, c b with c = <a, b>_s/<b, b>_s is nearest to a. Then a - b = (c - 1) b + (a - c b),
    and both parts are orthogonal in the norm of order s.

    Args:
        a: a field from `fourier_transform` or a store, or a surface.
        b: the reference: a field on the same lattice, or a surface.
        order: one order s < -1/2, or several.
        lattice: where surfaces are to be transformed; a field brings its own.

    Returns:
        A dataset over `order` with `distance`, `area_part` = |c - 1| ||b||_s, `shape_part` = ||a - c b||_s,
        `area_share` = area_part² / distance² (NaN between equal fields), and `excess` = c - 1, positive
        where a has more area than b. The squares of both parts add up to that of the distance.

    Raises:
        OrderError: an order that is not below -1/2.
        LatticeError: fields on different lattices, or a surface that does not fit into the lattice.
        InputError: a mesh, and no lattice from anywhere.
    """
    orders = check_orders(order)
    first, second = pair_of(a, b, lattice, orders)
    known = Lattice.of(first)
    squares, products, reference = np.zeros((3, known.shell_count))
    for block, (values, others) in read_blocks(known, first, second):
        difference = values - others
        squares += shell_sums(difference, None, known, block)
        products += shell_sums(difference, others, known, block)
        reference += shell_sums(others, None, known, block)
    area, shape, excess = Proportion.of_shells(squares, products, reference, known, orders)
    distance = np.sqrt(shell_weights(known, orders) @ squares)
    with np.errstate(invalid="ignore"):
        share = (area / distance) ** 2
    parts = {"distance": distance, "area_part": area, "shape_part": shape, "area_share": share, "excess": excess}
    return over_orders(order, parts)
