"""What a distance is relative to: the norm of the reference, and the product of the difference with it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.errors.budget import NormEstimate, Sums, aliased
from sobolev_batch.spectral.shells import SobolevWeights

Reals = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ReferenceEstimate:
    """The norm of the reference b of a distance ||a - b||, and the product <a - b, b>, each (orders,).

    Attributes:
        norms: Norms of the reference.
        products: Products of the difference with the reference, in units of length.
        product_errors: Bounds on the errors of the products.
    """

    norms: NormEstimate
    products: Reals
    product_errors: Reals

    @classmethod
    def of_equal(cls, count: int) -> Self:
        """Return the estimate for equal surfaces at some orders: whatever the norm, they differ by none of it."""
        zeros = np.zeros(count)
        return cls(NormEstimate(zeros + 1, zeros, zeros, zeros), zeros, zeros)

    @classmethod
    def on_lattice(
        cls, products: Sums, distances: NormEstimate, norms: NormEstimate, weights: SobolevWeights, widths: Reals
    ) -> Self:
        """Return the estimate where the surfaces are known on a lattice alone.

        Beyond the lattice a product is at most the product of both norms there.

        Args:
            products: Sums of the products of the difference with the reference.
            distances: Distances ||a - b|| on the lattice.
            norms: Norms of the reference on the lattice.
            weights: Weights of the sums.
            widths: Widths of all surfaces, see `Support`.
        """
        beyond = np.prod([(one.values + one.truncation) ** 2 - one.values**2 for one in (distances, norms)], axis=0)
        errors = np.sqrt(beyond) + aliased(products, weights, widths)
        return cls(norms, products.totals, errors + product_rounding(distances, norms))

    def area_shares(self, distances: NormEstimate) -> tuple[Reals, Reals]:
        """Return which share of the squared distances a change of total area explains, and bounds on their errors.

        The best multiple c b of the reference explains <a - b, b>² / ||b||² of ||a - b||².
        """
        products, norms = np.abs(self.products), self.norms
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.minimum((products / (distances.values * norms.values)) ** 2, 1.0)
            fewest = np.maximum(products - self.product_errors, 0.0) / (
                (distances.values + distances.errors) * (norms.values + norms.errors)
            )
            most = (products + self.product_errors) / (
                np.maximum(distances.values - distances.errors, 0.0) * np.maximum(norms.values - norms.errors, 0.0)
            )
        return shares, np.maximum(shares - fewest**2, np.minimum(most**2, 1.0) - shares)

    @property
    def excesses(self) -> Reals:
        """Difference from one of the multiple of the reference that is nearest to the other surface (orders,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.products / self.norms.values**2)


def product_rounding(distances: NormEstimate, norms: NormEstimate) -> Reals:
    """Return how far off products may be by the errors of the values of both factors (orders,)."""
    rounding, of_reference = distances.discretisation, norms.discretisation
    return np.asarray(rounding * (norms.values + of_reference) + of_reference * distances.values)
