"""Yardsticks: changes of a mesh that bring it as far from itself as another one is."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Literal, cast, get_args

import numpy as np
import xarray as xr

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import InputError, LatticeError, MeshError
from sobolev_batch.geometry.formats.conversion import MeshLike, as_mesh, each
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.machine import available_cores
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.accuracy.frequencies import Frequencies
from sobolev_batch.norms.accuracy.problem import support_of
from sobolev_batch.norms.accuracy.solution import SurfaceValues
from sobolev_batch.norms.columns import labelled
from sobolev_batch.norms.distances import accuracy_of, distance, to_accuracy
from sobolev_batch.norms.estimate import NormEstimate
from sobolev_batch.parameters import as_names, callback
from sobolev_batch.sources.derived import decimated, with_noise
from sobolev_batch.transform.fourier import ErrorTarget, Execution
from sobolev_batch.transform.lattice import Lattice, Orders, check_orders

# Error of the values of changed meshes, as a fraction of the distance.
_VALUES_ACCURACY = 1e-2
# No values are exact to less than this fraction of the area.
_ROUNDING = 1e-13
# A search ends where the distance is this near to the one wanted, in logarithms, or after this many changed meshes. It
# has failed if the distance is still farther off than the last number.
_CLOSENESS, _MOST_STEPS, _FAILED = 0.02, 8, 0.1
# Largest factor from one changed mesh to the next.
_LARGEST_STEP = math.log(16.0)
# Factor by which the error of an amount grows until it is confirmed.
_WIDER = 1.5
# Secants that are flatter, relative to what is usual, are noise.
_LEAST_POWER = 0.1
# Least and largest moves and noise, as fractions of the radius, and the fewest triangles.
_LEAST, _MOST, _FEWEST_TRIANGLES = 1e-10, 4.0, 4
Change = Literal["moved", "noise", "decimated"]
CHANGES: tuple[Change, ...] = get_args(Change)


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
    changes: Change | Collection[Change] = CHANGES,
    on_progress: Callable[[str], object] | None = None,
) -> xr.Dataset:
    """Return the distance of two meshes, and which changes of the second one bring it as far from itself.

    Distances of the changed meshes are computed at the frequencies of the first distance. For each order there are
    about three of noise and five of decimation: expect several times the time of `distance`. A move takes hardly any.

    Args:
        a: Mesh; see `as_mesh` for what may stand for it.
        b: Reference, likewise.
        order: One order s < -1/2, or several.
        lattice: Lattice to transform the meshes on.
        rtol: Largest relative error of the distance, in place of a lattice; see `distance`.
        memory: Memory that a transform may take with rtol; see `distance`.
        best_effort: As for `distance`.
        seed: Seed of the noise, and with rtol of the random frequencies.
        changes: The changes to look for.
        on_progress: Called with a line about each step.

    Returns:
        What `distance` returns, and over `order` these changes of b: `moved`, its move in any direction (root mean
        square over all of them), and `noise`, the standard deviation of Gaussian noise at its vertices along its
        normals, both as fractions of the radius of its bounding sphere; `decimated`, the number of triangles left by
        quadric edge collapse. All are float64, NaN where no such change is as far away, and where the distance is not
        larger than its error. `moved_error`, `noise_error` and `decimated_error` tell what the errors of distances
        and the end of the search leave open.

    Raises:
        OrderError: An order is not below -1/2.
        LatticeError: A mesh does not fit into the lattice.
        InputError: A surface is no mesh, a change is unknown, or there is neither a lattice nor an rtol, or both.
        AccuracyError: The rtol is out of reach, and no best effort; the message gives the reachable one.

    >>> import sobolev_batch as sb
    >>> found = sb.yardsticks(sb.shapes.icosphere(1), sb.shapes.icosphere(3), -2.0, lattice=sb.Lattice(3.0, 24))
    >>> bool(0.05 < found["moved"] < 0.2), bool(30 < found["decimated"] < 60)
    (True, True)
    """
    a, b = each(as_mesh, {"a": a, "b": b})
    if unknown := {*as_names(changes)} - {*CHANGES}:
        raise InputError(f"changes must be among {', '.join(CHANGES)}, found {', '.join(map(repr, sorted(unknown)))}")
    orders, solved, wanted = check_orders(order), None, [one for one in CHANGES if one in as_names(changes)]
    if (accuracy := accuracy_of(rtol, memory, best_effort, seed, on_progress)) is None:
        found = distance(a, b, order, lattice=lattice)
    else:
        found, solved = to_accuracy("distance", (a, b), order, lattice, accuracy, seed, on_progress)
    distances, errors, relative = (np.atleast_1d(found[name].values) for name in ("distance", "error", "relative"))
    estimate = NormEstimate(distances, *np.reshape(found["error_part"].values, (len(orders), -1)).T)
    columns = {name: np.full(len(orders), np.nan) for change in wanted for name in (change, f"{change}_error")}
    if (resolved := np.flatnonzero(distances > errors)).size:
        values_errors = np.maximum(_VALUES_ACCURACY * np.maximum(distances, errors), _ROUNDING * b.area)
        target = ErrorTarget(orders, tuple(values_errors.tolist()))
        if solved is not None:
            b, frequencies, values = cast(Mesh, solved.surface), solved.frequencies, solved.values
        else:
            # Without an accuracy there is one.
            frequencies = Frequencies(cast(Lattice, lattice), (), orders, support_of([a, b]).widths)
            values = frequencies.values(b, target, Execution(threads=available_cores()))
        curves = _curves(b, frequencies, values, target, float(relative[resolved].min()), seed)
        for i in resolved.tolist():
            for change in wanted:
                callback(on_progress)(f"order {orders[i]:g}: {change} as far")
                columns[change][i], columns[f"{change}_error"][i] = curves[change].equivalent(i, estimate)
    return found.assign(labelled(order, columns, {}).data_vars)


@dataclass(frozen=True, eq=False)
class _Curve:
    """Distances (orders,) to the reference by the amount of a change, each computed once.

    The search begins with a start between bounds. The distance usually grows like the amount to the power of the slope.
    Where a distance takes hardly any time, it is computed at both ends of what an amount is found to be, too. Amounts
    may be whole multiples of a unit.
    """

    distances: Callable[[float], NormEstimate]
    start: float
    bounds: tuple[float, float]
    slope: float
    is_cheap: bool = False
    unit: float = 0.0
    known: dict[float, NormEstimate] = field(default_factory=dict)

    def equivalent(self, order: int, wanted: NormEstimate) -> tuple[float, float]:
        """Return the amount at which the distance of an order is the one wanted, and how far off the amount may be.

        Both are NaN if there is none. The search follows secants of the logarithms.
        """
        if self.bounds[0] > self.bounds[1]:
            return math.nan, math.nan
        gaps = {one: self._gap(one, order, wanted) for one in self.known}
        amount = min(gaps, key=lambda one: abs(gaps[one]), default=self.start)
        for _ in range(_MOST_STEPS):
            if amount not in gaps:
                try:
                    self.known[amount] = self.distances(amount)
                except (LatticeError, MeshError):
                    return math.nan, math.nan
                gaps[amount] = self._gap(amount, order, wanted)
            power = self._power(gaps)
            nearest = min(gaps, key=lambda one: abs(gaps[one]))
            if abs(gaps[nearest]) <= _CLOSENESS:
                break
            step = math.exp(min(max(-gaps[nearest] / power, -_LARGEST_STEP), _LARGEST_STEP))
            following = min(max(nearest * step, self.bounds[0]), self.bounds[1])
            if following in gaps:
                break
            amount = following
        if abs(gaps[nearest]) > _FAILED:
            return math.nan, math.nan
        found = nearest * math.exp(-gaps[nearest] / power)
        value, error = wanted.values[order], _error_of_both(wanted, self.known[nearest])[order]
        uncertain = self.unit + found * (error / value + abs(gaps[nearest])) / abs(power)
        return self._confirmed(order, (value, error), found, uncertain) if self.is_cheap else (found, uncertain)

    def _gap(self, amount: float, order: int, wanted: NormEstimate) -> float:
        """Return the logarithm of the distance of a known amount over the one wanted."""
        return math.log(max(self.known[amount].values[order], np.finfo(np.float64).tiny) / wanted.values[order])

    def _confirmed(self, order: int, wanted: Sequence[float], found: float, uncertain: float) -> tuple[float, float]:
        """Return an amount, and how far off it may be: so much that the distance surely passes the one wanted.

        Both are NaN where it does not up to the largest amount: far moves are all as far.
        """
        value, error = wanted
        for _ in range(_MOST_STEPS):
            if found + uncertain > self.bounds[1]:
                break
            ends = max(found - uncertain, 0.0), found + uncertain
            lower, higher = (self.distances(amount).values[order] for amount in ends)
            if lower <= value - error and value + error <= higher:
                return found, uncertain
            uncertain *= _WIDER
        return math.nan, math.nan

    def _power(self, gaps: dict[float, float]) -> float:
        """Return the power of the amount that the distance grows with near the one wanted."""
        if len(gaps) > 1:
            first, *others = sorted(gaps, key=lambda one: abs(gaps[one]))
            # Two amounts on the same side may lie close together, where the distance need not be monotonic.
            second = next((one for one in others if gaps[one] * gaps[first] < 0), others[0])
            power = (gaps[second] - gaps[first]) / math.log(second / first)
            if power / self.slope > _LEAST_POWER:
                return power
        return self.slope


def _curves(
    mesh: Mesh, frequencies: Frequencies, values: SurfaceValues, target: ErrorTarget, start: float, seed: int
) -> dict[Change, _Curve]:
    """Return the distance of a mesh from itself by the amount of each change; searches begin with a relative one."""

    def apart(changed: Mesh) -> NormEstimate:
        others = frequencies.values(changed, target, Execution(threads=available_cores()))
        return frequencies.norms([others, values], [changed, mesh], [1, -1])

    _, radius = mesh.bounding_sphere
    bounds, count = (_LEAST, _MOST), len(mesh.triangles)
    return {
        "moved": _Curve(
            lambda amount: frequencies.moved(values, mesh, amount * radius), start, bounds, 1.0, is_cheap=True
        ),
        "noise": _Curve(lambda amount: apart(with_noise(mesh, amount * radius, seed)), start, bounds, 1.0),
        "decimated": _Curve(
            lambda amount: apart(decimated(mesh, round(amount))),
            max(count // 4, _FEWEST_TRIANGLES),
            (_FEWEST_TRIANGLES, count - 1),
            -1.0,
            unit=1.0,
        ),
    }


def _error_of_both(first: NormEstimate, second: NormEstimate) -> Reals:
    """Return bounds on the error (orders,) of the difference of two distances at the same frequencies.

    Truncation may only add to both: then the larger one bounds what it changes between them.
    """
    truncation = np.maximum(first.truncation, second.truncation)
    return np.asarray(truncation + sum(one.errors - one.truncation for one in (first, second)))
