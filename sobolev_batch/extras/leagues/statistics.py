"""Curves of methods at equal sizes, their intervals, and tests whether two methods differ."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import InputError
from sobolev_batch.sources.names import quoted

# Sizes at which curves are compared, evenly spaced on a logarithmic axis.
_SIZES = 5
EDGE_LENGTH = "edge_length"
# Columns of a table that are sizes: the finer a mesh is, the smaller is the first, and the larger are the others.
_LABELS = {
    EDGE_LENGTH: "mean edge length in {unit}",
    "triangles": "number of triangles",
    "vertices": "number of vertices",
    "seconds": "computing time of the mesh in seconds",
    "make_seconds": "time of making the mesh in seconds",
    "make_cpu_seconds": "processor time of making the mesh in seconds",
    "make_peak_bytes": "memory of making the mesh in bytes",
}
# Methods whose ranges of sizes miss each other by less than this are compared between their ends.
_LARGEST_GAP = 1.2
# A p-value below it counts as a difference.
SIGNIFICANCE = 0.05
# Meshes whose sizes differ by a smaller factor tell no rate.
_SMALLEST_RANGE = 1.1
CONFIDENCE = 0.95
# Numbers of `table` that no method should have little of.
_MORE_IS_BETTER = ("fscore", "precision", "recall", "smallest_angle")
# Numbers of which neither is.
_NEITHER = ("order", "level", "rank", "rate", "rate_error")
# All changes of sign are tried for as many objects, and as many random ones for more.
_MOST_ENUMERATED, _DRAWS, _SEED = 14, 20_000, 0
_MOST_SIGNS = 1 << 22


@dataclass(frozen=True, eq=False)
class Curve:
    """The distances of the meshes of one method from one object, or another number of theirs.

    Attributes:
        sizes: Logarithms of the sizes (n,), ascending.
        values: Logarithms of the distances (n,).
        errors: Bounds on the errors of these logarithms (n,), infinite where a distance is not larger than its error.
    """

    sizes: Reals
    values: Reals
    errors: Reals

    def at(self, sizes: Reals) -> tuple[Reals, Reals]:
        """Return the logarithms of the distances at some sizes, on straight lines between the meshes, with errors.

        Beyond the ends the distance is that of the last mesh: a line through two of about one size could lead anywhere.
        """
        own, index, counts = np.unique(self.sizes, return_inverse=True, return_counts=True)
        # Meshes of one size count with their geometric mean.
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
        weights = centred / float(centred @ centred)
        with np.errstate(invalid="ignore"):
            error = float(np.abs(weights) @ self.errors)
        return float(weights @ self.values), np.inf if np.isnan(error) else error


def errors_of_logarithms(values: Reals, errors: Reals) -> Reals:
    """Return bounds on the errors of logarithms; infinite where a value is no larger than its error, or that is NaN."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(-np.log1p(-np.fmin(errors / values, 1.0)))


def numbers_of(frame: pd.DataFrame, y: str) -> tuple[Reals, Reals]:
    """Return a column of `table` of which less is better, and its errors; InputError where it has no such numbers.

    Of a bias, the modulus is meant. What is not known is NaN, and so is zero, but for distances.
    """
    known = [name for name in frame.select_dtypes("number") if name not in (*_MORE_IS_BETTER, *_NEITHER)]
    if y not in known:
        raise InputError(f"no number of which less is better is named {quoted(y)}; known are {', '.join(known)}")
    values = np.abs(frame[y].to_numpy(dtype=np.float64, na_value=np.nan))
    values = np.where((values > 0) | (y == "relative"), values, np.nan)
    if f"{y}_upper" in frame:
        return values, frame[f"{y}_upper"].to_numpy(dtype=np.float64) - values
    return values, frame[f"{y}_error"].to_numpy(dtype=np.float64) if f"{y}_error" in frame else np.zeros(len(frame))


def filled(values: Reals) -> Reals:
    """Return values (objects, methods) with those that are NaN by the sum of an effect of the object and the method.

    Effects are those of least squares. Objects must connect all methods.

    >>> filled(np.array([[1.0, 2.0, 4.0], [11.0, np.nan, 14.0]]))
    array([[ 1.,  2.,  4.],
           [11., 12., 14.]])
    """
    known = np.isfinite(values)
    shares = known / known.sum(axis=1, keepdims=True)
    # The equations of least squares, from which the effects of objects are eliminated: methods are few.
    matrix = np.diag(known.sum(axis=0)) - known.T @ shares
    own = np.where(known, values, 0.0)
    means = (shares * own).sum(axis=1, keepdims=True)
    of_methods = np.linalg.lstsq(matrix, (own - known * means).sum(axis=0))[0]
    of_objects = (shares * (own - of_methods)).sum(axis=1, keepdims=True)
    return np.where(known, values, of_objects + of_methods)


def gap_of(curves: Mapping[str, Curve]) -> str:
    """Return which methods have no range of sizes in common."""
    first = max(curves, key=lambda method: curves[method].sizes[0])
    last = min(curves, key=lambda method: curves[method].sizes[-1])
    begin, end = math.exp(curves[first].sizes[0]), math.exp(curves[last].sizes[-1])
    return f"no common range of sizes: {first} begins at {begin:,.5g}, {last} ends at {end:,.5g}"


def least_objects(tests: int) -> int:
    """Return with how many objects the most extreme of all changes of sign is rare enough, among several tests.

    >>> least_objects(1), least_objects(6)
    (6, 8)
    """
    # Of 2^n changes of sign two are as extreme.
    return math.floor(math.log2(2 * tests / SIGNIFICANCE)) + 1


def common_sizes(curves: Sequence[Curve]) -> Reals | None:
    """Return sizes (5,) in the range that all curves have, all alike between their ends where these nearly meet."""
    low, high = max(curve.sizes[0] for curve in curves), min(curve.sizes[-1] for curve in curves)
    if low - high > math.log(_LARGEST_GAP):
        return None
    ends = (low, high) if low <= high else ((low + high) / 2,) * 2
    return np.linspace(*ends, _SIZES)


def interval(values: Reals, errors: Reals, spread: float | None = None) -> Reals:
    """Return a mean and the ends of its interval by Student's t (3,), widened by the mean of errors (n,) of values.

    The spread is the standard deviation of the values (n,), by default their own. One value says nothing of it: NaN.
    """
    count = len(values)
    if count < 2:
        return np.array([*values, *[math.nan] * (3 - count)])
    deviation = float(np.std(values, ddof=1)) if spread is None else spread
    half = float(stdtrit(count - 1, (1 + CONFIDENCE) / 2)) * deviation / math.sqrt(count) + float(np.mean(errors))
    return np.asarray(np.mean(values) + np.array([0.0, -half, half]))


def within_objects(values: Reals) -> Reals:
    """Return the standard deviation of each method over values (objects, methods), without that of the objects; or NaN.

    Each object's mean over the methods is taken off, and the variance scaled by m / (m - 1) for m methods: Morey,
    Confidence intervals from normalized data, Tutorials in Quantitative Methods for Psychology 4(2), 2008.
    """
    methods = values.shape[1]
    if len(values) < 2:
        return np.full(methods, np.nan)
    centred = values - values.mean(axis=1, keepdims=True) if methods > 1 else values
    return np.asarray(np.std(centred, axis=0, ddof=1) * math.sqrt(methods / max(1, methods - 1)))


def sign_flip_test(differences: Reals, errors: Reals) -> float:
    """Return the p-value of paired differences with mean zero: the share of sign changes with as large a mean.

    If two methods were alike, each difference could as well have the other sign. It is the permutation test of pairs,
    and the p-value is the largest that the bounds on the errors of the differences allow.
    """
    count = len(differences)
    if count == 0 or not np.isfinite(errors).all():
        return 1.0
    if count <= _MOST_ENUMERATED:
        sums = np.array(list(product((1.0, -1.0), repeat=count))) @ differences
    else:
        rng, step = np.random.default_rng(_SEED), max(1, _MOST_SIGNS // count)
        sizes = (min(step, _DRAWS - start) for start in range(0, _DRAWS, step))
        drawn = [rng.choice((1.0, -1.0), size=(size, count)) @ differences for size in sizes]
        # With the observed signs among them, the p-value is never zero.
        sums = np.concatenate([[differences.sum()], *drawn])
    observed, slack = abs(float(differences.sum())), float(errors.sum())
    # Rounding must not decide between a sum and its mirror image.
    tolerance = 1e-12 * float(np.abs(differences).sum())
    return float(np.mean(np.abs(sums) + slack >= observed - slack - tolerance))


def adjusted(p_values: Reals) -> Reals:
    """Return p-values adjusted for how many they are, by Holm's step-down method.

    >>> adjusted(np.array([0.01, 0.04, 0.03]))
    array([0.03, 0.06, 0.06])
    """
    order = np.argsort(p_values, kind="stable")
    scaled = p_values[order] * np.arange(len(p_values), 0, -1)
    result = np.empty_like(p_values)
    result[order] = np.minimum(np.maximum.accumulate(scaled), 1.0)
    return result


def label_of(x: str, unit: str = "each object's unit") -> str:
    """Return the label of an axis of sizes; one of the metadata has its name."""
    return _LABELS[x].format(unit=unit) if x in _LABELS else x


def sizes_of(frame: pd.DataFrame, x: str) -> Reals:
    """Return a column of `table`, NaN where sizes are not known; InputError where it has no such numbers."""
    numbers = [name for name in _LABELS if name in frame]
    given = [name for name in frame.attrs.get("metadata", ()) if pd.api.types.is_numeric_dtype(frame[name])]
    if not isinstance(x, str) or x not in (*numbers, *given):
        only = " (the store has no families of commands, functions or searches, which have it)"
        hint = only * str(x).startswith("make_")
        raise InputError(f"no size of meshes is named {quoted(x)}{hint}; known are {', '.join([*numbers, *given])}")
    sizes: Reals = frame[x].to_numpy(dtype=np.float64, na_value=np.nan)
    # A surface in closed form has none.
    return np.where(sizes > 0, sizes, np.nan)
