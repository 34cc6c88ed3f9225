"""Norms and distances with their errors: sums over a lattice, octaves around it, and what remains beyond them.

For a signed measure m, such as the difference a - b of two surfaces, the squared norm ∫ (1 + |ξ|²)^s |m^|² dξ is a sum
of three terms, each of which has an error of its own:

    squared norm  =  sum over the lattice  +  integral over octaves  +  remainder beyond the last octave
    error            aliasing                 statistical               truncation

Without octaves the lattice ends sharply, and the remainder is only bounded (`truncated`): then the norm is what the
lattice holds, and truncation can only add to it. The values m^ themselves are off by the discretisation, whose norm is
known. By the triangle inequality the norm is off by no more. Of a difference it is the root of both surfaces' squares
added: the phases between both errors are those between the surfaces, and where these coincide, errors of rules cancel.
The other three are errors of the square, of which they change the root together (`change_of_root`): signs are unknown.

All that computes a norm or distance calls `estimate_norms`: pairs of surfaces, studies, tables of all pairs, accessors.
What a distance is relative to, and its parts, follow from the product of the difference with the reference, which is a
sum of the same terms (`ReferenceEstimate`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from sobolev_batch.arrays import Reals
from sobolev_batch.norms.budget import Sums, Support, aliased, truncated
from sobolev_batch.transform.lattice import SobolevWeights

# The parts of an error, in the order of `NormEstimate`.
PARTS = ("truncation", "aliasing", "discretisation", "statistical")
# The parts of a distance, each with its error, in the order of `ReferenceEstimate.area_and_shape`.
AREA_AND_SHAPE = ("area_part", "area_part_error", "shape_part", "shape_part_error")


@dataclass(frozen=True)
class NormEstimate:
    """Norms or distances with their errors, each (orders, ...).

    Attributes:
        truncation: Bound on the error by frequencies beyond the highest one; without octaves they can only add.
        aliasing: Estimate of the change by the lattice's spacing, either way.
        discretisation: Bound on the error by the triangle rules and the NUFFT.
        statistical: Bound on the error by random frequencies, which holds with a probability; zero without these.
    """

    values: Reals
    truncation: Reals
    aliasing: Reals
    discretisation: Reals
    statistical: Reals = field(default_factory=lambda: np.zeros(()))

    @property
    def stacked(self) -> Reals:
        """Values and the parts of their errors, (5, orders, ...)."""
        return np.stack(np.broadcast_arrays(*vars(self).values()))

    @property
    def errors(self) -> Reals:
        """Total error: the true value differs from the reported one by no more, as far as the parts hold."""
        return self.truncation + self.aliasing + self.discretisation + self.statistical

    def relative_to(self, norms: NormEstimate) -> dict[str, Reals]:
        """Return the values over some norms, and bounds on the errors, by name; see `quotients`."""
        relative, errors = quotients((self.values, self.errors), (norms.values, norms.errors))
        return {"relative": relative, "relative_error": errors}

    def named(self, name: str) -> dict[str, Reals]:
        """Return the values under a name, the error, and as "error_part" its `PARTS` (orders, ..., part)."""
        return {name: self.values, "error": self.errors, "error_part": np.moveaxis(self.stacked[1:], 0, -1)}


def quotients(values: tuple[Reals, Reals], norms: tuple[Reals, Reals]) -> tuple[Reals, Reals]:
    """Return values over norms, and bounds on the errors, from both with their errors; NaN up to a norm's own error.

    What is certainly zero is so over any norm.
    """
    (value, error), (norm, norm_error) = values, norms
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = value / norm
        errors = (error + relative * norm_error) / (norm - norm_error)
        errors = np.where(norm_error < norm, errors, np.where((value == 0) & (error == 0), 0.0, np.nan))
    return relative, errors


@dataclass(frozen=True, eq=False)
class Tail:
    """Parts of squared norms, or of products of two measures, beyond the lattice, each (orders, ...).

    Attributes:
        octaves: Integral over the octaves.
        octaves_error: How far off that may be at 99 %, as the frequencies are random.
        remainder: What lies beyond the last octave.
        remainder_error: How far off that may be.
    """

    octaves: Reals
    octaves_error: Reals
    remainder: Reals
    remainder_error: Reals

    @staticmethod
    def of_product(
        octaves: tuple[Reals, Reals], a: Tail | None, b: Tail | None, difference: Tail | None
    ) -> Tail | None:
        """Return the tail of <a - b, b> by its integral over the octaves, and the tails of ||a||², ||b||², ||a - b||².

        Beyond octaves no product is measured, but ||a||² - ||b||² - ||a - b||² is twice it. None for a lattice alone.
        """
        if a is None or b is None or difference is None:
            return None
        remainder = (a.remainder - b.remainder - difference.remainder) / 2
        error = (a.remainder_error + b.remainder_error + difference.remainder_error) / 2
        return Tail(*octaves, remainder, error)

    @property
    def totals(self) -> Reals:
        """The whole tail."""
        return self.octaves + self.remainder


def estimate_norms(
    sums: Sums,
    weights: SobolevWeights,
    support: Support,
    discretisation: Reals,
    tail: Tail | None = None,
    *,
    is_given: bool = False,
    beyond: Reals | float = np.nan,
    images: Reals | float = np.nan,
) -> NormEstimate:
    """Return norms (orders, ...) from sums over the lattice, and the tail beyond it where octaves measured that.

    The discretisation is the norm of the values' own errors (orders, ...), of a difference that of both. Bounds
    (orders, ...) on the squares beyond the lattice, chosen or given, and on what images add may be known, else NaN.
    """
    squares: Reals = np.maximum(sums.totals, 0.0)
    # Sublattices do not show images of ends that are farther apart at fractions of the period than at all of it.
    images = np.fmax(aliased(sums, weights, support.widths), images)
    if tail is None:
        values = np.sqrt(squares)
        beyond = np.where(np.isnan(beyond), truncated(sums, weights, support, is_given=is_given), beyond)
        truncation = np.sqrt(squares + beyond) - values
        return NormEstimate(values, truncation, change_of_root(squares, images), discretisation)
    squares = np.maximum(squares + tail.totals, 0.0)
    # The lower a square already is, the more a further error takes from its root: all of them together change it.
    changes = np.stack(np.broadcast_arrays(tail.remainder_error, images, tail.octaves_error))
    total = changes.sum(axis=0)
    shares = np.divide(changes, total, out=np.zeros_like(changes), where=total > 0)
    truncation, aliasing, statistical = shares * change_of_root(squares, total)
    return NormEstimate(np.sqrt(squares), truncation, aliasing, discretisation, statistical)


def change_of_root(squares: Reals, changes: Reals) -> Reals:
    """Return how much the root of squares changes at most if these are off by some changes, either way.

    The root is steep near zero: a square that may vanish gives an error as large as its root.
    """
    values = np.sqrt(squares)
    lower = np.sqrt(np.maximum(squares - changes, 0.0))
    return np.asarray(np.maximum(np.sqrt(squares + changes) - values, values - lower))


@dataclass(frozen=True, eq=False)
class ReferenceEstimate:
    """The norm of the reference b of a distance ||a - b||, and the product <a - b, b>, each (orders, ...).

    Attributes:
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
    def from_products(
        cls,
        products: Sums,
        weights: SobolevWeights,
        widths: Reals,
        distances: NormEstimate,
        norms: NormEstimate,
        tail: Tail | None = None,
    ) -> Self:
        """Return the estimate from the sums of <a - b, b> over the lattice, its tail, and the norms of both factors."""
        values = products.totals
        if tail is None:
            # By Schwarz's inequality the product beyond the lattice is at most that of both norms there, and images
            # change it by about as much as theirs.
            errors = np.zeros_like(values)
            for own, other in ((distances.truncation, norms.truncation), (distances.aliasing, norms.aliasing)):
                unseen = (distances.values + own) ** 2 - distances.values**2
                errors = errors + np.sqrt(unseen * ((norms.values + other) ** 2 - norms.values**2))
        else:
            values = values + tail.totals
            errors = tail.octaves_error + tail.remainder_error
        errors = errors + aliased(products, weights, widths)
        # The values of both factors are off, and so is their product.
        own, other = distances.discretisation, norms.discretisation
        errors = errors + (own * (norms.values + other) + other * distances.values)
        # Equal surfaces have no product, however uncertain the norm of each is.
        return cls(norms, values, np.where(distances.values + distances.errors == 0, 0.0, errors))

    def area_shares(self, distances: NormEstimate) -> dict[str, Reals]:
        """Return which share of squared distances a change of total area explains, by name, with bounds on the errors.

        The best multiple c b of the reference explains <a - b, b>² / ||b||² of ||a - b||².
        """
        products, norms = np.abs(self.products), self.norms
        lowest, highest = self._area_bounds
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.minimum((products / (distances.values * norms.values)) ** 2, 1.0)
            fewest = lowest / (distances.values + distances.errors)
            most = highest / np.maximum(distances.values - distances.errors, 0.0)
        errors = np.maximum(shares - fewest**2, np.minimum(most**2, 1.0) - shares)
        return {"area_share": shares, "area_share_error": errors}

    @property
    def _area_bounds(self) -> tuple[Reals, Reals]:
        """Bounds on |<a - b, b>| / ||b||."""
        products, norms, error = np.abs(self.products), self.norms, self.product_errors
        with np.errstate(divide="ignore", invalid="ignore"):
            lowest = np.maximum(products - error, 0.0) / (norms.values + norms.errors)
            highest = (products + error) / np.maximum(norms.values - norms.errors, 0.0)
        return lowest, np.where(products + error == 0, 0.0, highest)

    def area_and_shape(self, distances: NormEstimate) -> dict[str, Reals]:
        """Return two orthogonal parts of distances, that of area and the rest, by name, and bounds on their errors.

        For the difference e = a - b they follow from ||e||, <e, b> and ||b||. The multiple of b nearest to a is c b
        with c = 1 + <e, b>/<b, b>, in which nothing cancels for near-duplicates. Then e = (c - 1) b + (a - c b). The
        squares of the norms of both parts are good to 1e-15 of the squared distance.
        """
        (lowest, highest), values = self._area_bounds, distances.values
        least, most = np.maximum(values - distances.errors, 0.0), values + distances.errors
        with np.errstate(divide="ignore", invalid="ignore"):
            # Rounding may make the projection longer than what it projects.
            area = np.minimum(np.abs(self.products) / self.norms.values, values)
            highest = np.minimum(highest, most)
        pairs = (values, area), (least, highest), (most, lowest)
        shape, shortest, longest = (np.sqrt(np.maximum(distance**2 - part**2, 0.0)) for distance, part in pairs)
        errors = (np.maximum(area - lowest, highest - area), np.maximum(shape - shortest, longest - shape))
        return dict(zip(AREA_AND_SHAPE, (area, errors[0], shape, errors[1]), strict=True))

    @property
    def excesses(self) -> Reals:
        """Difference from one of the multiple of the reference that is nearest to the other surface (orders,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.products / self.norms.values**2)
