"""Yardsticks: how far a mesh must be moved to be as far from itself as another one is."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import cast

import numpy as np
import xarray as xr
from scipy.optimize import brentq

from sobolev_batch.geometry.formats.conversion import MeshLike, as_mesh, each
from sobolev_batch.machine import available_cores
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.accuracy.frequencies import Frequencies
from sobolev_batch.norms.accuracy.problem import ROUNDING, support_of
from sobolev_batch.norms.columns import labelled
from sobolev_batch.norms.distances import distance, to_accuracy
from sobolev_batch.norms.estimate import NormEstimate
from sobolev_batch.transform.fourier import ErrorTarget, Execution
from sobolev_batch.transform.lattice import Lattice, Orders, check_orders

# Error of the values of the mesh, as a fraction of the distance.
_VALUES_ACCURACY = 1e-2
# A search ends where the move is known to this logarithm. It begins between moves that differ by this factor.
_CLOSENESS, _STEP = 1e-3, 2.0
# Factor by which the error of a move grows until it is confirmed, and how often.
_WIDER, _MOST_STEPS = 1.5, 8
# Least and largest moves, as fractions of the radius.
_LEAST, _MOST = 1e-10, 4.0


def yardsticks(
    a: MeshLike,
    b: MeshLike,
    order: Orders = DEFAULT_ORDER,
    *,
    lattice: Lattice | None = None,
    rtol: float | None = None,
    memory: float | str | None = None,
    best_effort: bool = False,
    seed: int = 0,
    on_progress: Callable[[str], object] | None = None,
) -> xr.Dataset:
    """Return the distance of two meshes, and which move of the second one brings it as far from itself.

    Args:
        a: Mesh; see `as_mesh` for what may stand for it.
        b: Reference, likewise.
        order: One order s < -1/2, or several.
        lattice: Lattice to transform the meshes on.
        rtol: Largest relative error of the distance, in place of a lattice; see `distance`.
        memory: Memory that a transform may take with rtol; see `distance`.
        best_effort: As for `distance`.
        seed: Seed of the random frequencies with rtol.
        on_progress: Called with a line about each step.

    Returns:
        What `distance` returns, and over `order` `moved`, the move of b in any direction (root mean square over all of
        them) as a fraction of the radius of its bounding sphere, float64. It is NaN where no move is as far away, and
        where the distance is not larger than its error. `moved_error` tells what the errors of distances leave open.

    Raises:
        OrderError: An order is not below -1/2.
        LatticeError: A mesh does not fit into the lattice.
        InputError: A surface is no mesh, or there is neither a lattice nor an rtol, or both.
        AccuracyError: The rtol is out of reach, and no best effort; the message gives the reachable one.

    >>> import sobolev_batch as sb
    >>> found = sb.yardsticks(sb.shapes.icosphere(1), sb.shapes.icosphere(3), -2.0, lattice=sb.Lattice(3.0, 24))
    >>> bool(0.05 < found["moved"] < 0.2)
    True
    """
    a, b = each(as_mesh, {"a": a, "b": b})
    orders = check_orders(order)
    known = to_accuracy("distance", (a, b), order, lattice, rtol, memory, best_effort, seed, on_progress)
    found, solved = known or (distance(a, b, order, lattice=lattice), None)
    distances, errors, relative = (np.atleast_1d(found[name].values) for name in ("distance", "error", "relative"))
    estimate = NormEstimate(distances, *np.reshape(found["error_part"].values, (len(orders), -1)).T)
    moves = np.full((2, len(orders)), np.nan)
    if (resolved := np.flatnonzero(distances > errors)).size:
        if solved is not None:
            b, frequencies, values = solved.surface, solved.frequencies, solved.values
        else:
            # Without an accuracy there is a lattice.
            frequencies = Frequencies(cast(Lattice, lattice), (), orders, support_of([a, b]).widths)
            values_errors = np.maximum(_VALUES_ACCURACY * np.maximum(distances, errors), ROUNDING * b.area)
            target = ErrorTarget(orders, tuple(values_errors.tolist()))
            values = frequencies.values(b, target, Execution(threads=available_cores()))
        (_, radius), moved = b.bounding_sphere, frequencies.moved(values, b)
        for i in resolved.tolist():
            moves[:, i] = _as_far(lambda amount: moved(amount * radius), i, estimate, float(relative[i]))
    return found.assign(labelled(order, {"moved": moves[0], "moved_error": moves[1]}, {}).data_vars)


def _as_far(
    distances: Callable[[float], NormEstimate], order: int, wanted: NormEstimate, start: float
) -> tuple[float, float]:
    """Return the move at which the distance of an order is the one wanted, and how far off it may be.

    The latter is so much that the distance surely passes the one wanted. Both are NaN where it does not up to the
    largest move: far moves are all as far. The search begins with a move like the relative distance.
    """
    value = wanted.values[order]

    def gap(logarithm: float) -> float:
        found = distances(math.exp(logarithm)).values[order]
        return math.log(max(found, np.finfo(np.float64).tiny) / value)

    low = high = math.log(min(max(start, _LEAST), _MOST / _STEP))
    while gap(high) < 0:
        high += math.log(_STEP)
        if high > math.log(_MOST):
            return math.nan, math.nan
    while gap(low) > 0 and low > math.log(_LEAST):
        low -= math.log(_STEP)
    moved = math.exp(brentq(gap, low, high, xtol=_CLOSENESS) if low < high else low)
    # At the same frequencies truncation may only add to both: the larger one bounds what it changes between them.
    both = wanted, distances(moved)
    others = sum(one.errors - one.truncation for one in both)
    error = (np.maximum(*(one.truncation for one in both)) + others)[order]
    uncertain = moved * (error / value + _CLOSENESS)
    for _ in range(_MOST_STEPS):
        if moved + uncertain > _MOST:
            break
        ends = max(moved - uncertain, 0.0), moved + uncertain
        lower, higher = (distances(amount).values[order] for amount in ends)
        if lower <= value - error and value + error <= higher:
            return moved, uncertain
        uncertain *= _WIDER
    return math.nan, math.nan
