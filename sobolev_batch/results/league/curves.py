"""Distances of the methods of each object, brought to equal sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sobolev_batch.results.tables.sizes import sizes_of
from sobolev_batch.spectral.adaptive.tolerance import NEXT_TO_EQUAL

Reals = NDArray[np.float64]

# Sizes at which curves are compared, evenly spaced on a logarithmic axis.
_SIZES = 5
# Curves whose ranges miss each other by less than this are compared between their ends.
_LARGEST_GAP = 1.2
# Meshes whose sizes differ by a smaller factor tell no rate.
_SMALLEST_RANGE = 1.1


@dataclass(frozen=True, eq=False)
class Curve:
    """The distances of the meshes of one method from one object.

    Attributes:
        sizes: Logarithms of the sizes (n,), ascending.
        values: Logarithms of the relative distances (n,).
        errors: Bounds on the errors of these logarithms (n,), infinite where a distance is not larger than its error.
    """

    sizes: Reals
    values: Reals
    errors: Reals

    @classmethod
    def of(cls, rows: pd.DataFrame, x: str) -> Self | None:
        """Return the curve of some rows of `table`, of one order and family; None where no mesh has a distance."""
        sizes, relative = sizes_of(rows, x), rows["relative"].to_numpy()
        known = np.isfinite(sizes) & np.isfinite(relative)
        if not known.any():
            return None
        order = np.argsort(sizes[known], kind="stable")
        relative = relative[known][order]
        relative_errors = rows["relative_error"].to_numpy()[known][order]
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.fmin(relative_errors / relative, 1.0)
            return cls(np.log(sizes[known][order]), np.log(relative), -np.log1p(-shares))

    @property
    def is_exact(self) -> bool:
        """True if a mesh is next to equal to the object, so that its distance tells of rounding alone."""
        return bool(np.any(self.values < np.log(NEXT_TO_EQUAL)))

    def at(self, sizes: Reals) -> tuple[Reals, Reals]:
        """Return the logarithms of the distances at some sizes, on straight lines between the meshes, with errors.

        Beyond the ends the distance is that of the last mesh: a line through two of about one size could lead anywhere.
        """
        own, index, counts = np.unique(self.sizes, return_inverse=True, return_counts=True)
        # Of meshes of one size, the geometric mean.
        values, errors = (np.bincount(index, numbers) / counts for numbers in (self.values, self.errors))
        left = np.clip(np.searchsorted(own, sizes, side="right") - 1, 0, len(own) - 1)
        right = np.minimum(left + 1, len(own) - 1)
        # The larger of both errors, since an infinite one has no weight that one could take.
        return np.interp(sizes, own, values), np.maximum(errors[left], errors[right])

    def slope(self) -> tuple[float, float]:
        """Return the slope of the least-squares line and a bound on its error; NaN where sizes hardly differ."""
        if np.ptp(self.sizes) < np.log(_SMALLEST_RANGE):
            return np.nan, np.nan
        centred = self.sizes - self.sizes.mean()
        square = float(centred @ centred)
        weights = centred / square
        with np.errstate(invalid="ignore"):
            error = float(np.abs(weights) @ self.errors)
        return float(weights @ self.values), np.inf if np.isnan(error) else error


@dataclass(frozen=True, eq=False)
class Scores:
    """Mean logarithms of relative distances at equal sizes.

    Attributes:
        objects: Names of the objects that have all methods.
        methods: Names of the methods.
        values: (objects, methods), averaged over the sizes.
        errors: (objects, methods), bounds on their errors.
        left_out: Why other objects are not there, by name.
    """

    objects: tuple[str, ...]
    methods: tuple[str, ...]
    values: Reals
    errors: Reals
    left_out: Mapping[str, str]

    @classmethod
    def of(
        cls, curves: Mapping[str, Mapping[str, Curve]], methods: Sequence[str], unfinished: Mapping[str, str]
    ) -> Self:
        """Return the scores of methods from their curves, by object and method; other objects have none yet."""
        rows: dict[str, tuple[Reals, Reals]] = {}
        left_out = dict(unfinished)
        for name, by_method in curves.items():
            lacking = [method for method in methods if method not in by_method]
            if lacking:
                left_out[name] = f"no distance of {', '.join(lacking)}"
                continue
            exact = [method for method in methods if by_method[method].is_exact]
            if exact:
                left_out[name] = f"{', '.join(exact)} reproduced it, up to rounding"
                continue
            sizes = _common_sizes([by_method[method] for method in methods])
            if sizes is None:
                left_out[name] = _gap(by_method, methods)
                continue
            at_sizes = [by_method[method].at(sizes) for method in methods]
            rows[name] = (
                np.array([values.mean() for values, _ in at_sizes]),
                np.array([errors.mean() for _, errors in at_sizes]),
            )
        shape = len(rows), len(methods)
        return cls(
            tuple(rows),
            tuple(methods),
            np.array([values for values, _ in rows.values()]).reshape(shape),
            np.array([errors for _, errors in rows.values()]).reshape(shape),
            left_out,
        )


def _gap(curves: Mapping[str, Curve], methods: Sequence[str]) -> str:
    """Return which methods have no range of sizes in common."""
    first = max(methods, key=lambda method: curves[method].sizes[0])
    last = min(methods, key=lambda method: curves[method].sizes[-1])
    begin, end = np.exp(curves[first].sizes[0]), np.exp(curves[last].sizes[-1])
    return f"no common range of sizes: {first} begins at {begin:,.5g}, {last} ends at {end:,.5g}"


def _common_sizes(curves: Sequence[Curve]) -> Reals | None:
    """Return sizes in the range that all curves have, or between their ends where these nearly meet."""
    low, high = max(curve.sizes[0] for curve in curves), min(curve.sizes[-1] for curve in curves)
    if low <= high:
        return np.linspace(low, high, _SIZES) if low < high else np.array([low])
    return np.array([(low + high) / 2]) if low - high <= np.log(_LARGEST_GAP) else None
