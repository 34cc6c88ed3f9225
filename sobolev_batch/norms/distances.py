"""Sobolev norms and distances of fields, for any list of orders at once; and yardsticks for distances.

The weight (1 + |ξ|²)^s depends on the shell |k|² of a lattice point only. A field is therefore
reduced to one number per shell first, whatever the orders; a norm of any order is then a short
weighted sum of those. Fields are read block by block, so they need not fit into memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
import xarray as xr

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import InputError, LatticeError, MeshError
from sobolev_batch.geometry.closed_forms import Sphere
from sobolev_batch.geometry.formats.readers import MeshLike, as_mesh, as_surface
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import DIRECTIONS, Extent
from sobolev_batch.machine import available, available_cores
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.accuracy.frequencies import Frequencies, Reference
from sobolev_batch.norms.accuracy.problem import Problem, Solution, SurfaceValues, are_equal, support_of
from sobolev_batch.norms.accuracy.solve import solve
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.norms.budget import NormEstimate, ReferenceEstimate, Support, estimate_norms, sums_of_shells
from sobolev_batch.norms.columns import VARIABLES, labelled, labelled_distances, lattice_attributes
from sobolev_batch.norms.fields import (
    OperandLike,
    as_operand,
    field_of,
    pair_of,
    quality_of,
    shells_against,
    shells_of,
)
from sobolev_batch.parameters import check_seed
from sobolev_batch.sources.generated import decimated, with_noise
from sobolev_batch.transform.fourier import ErrorTarget, Execution
from sobolev_batch.transform.lattice import Lattice, Orders, SobolevWeights, check_orders
from sobolev_batch.transform.spheres import sphere_distance, sphere_inner_product, sphere_norm

# Relative accuracy of the closed forms of spheres.
_CLOSED_FORM_ACCURACY = 1e-13


def norm(
    a: OperandLike,
    order: Orders = DEFAULT_ORDER,
    *,
    lattice: Lattice | None = None,
    rtol: float | None = None,
    memory: float | str | None = None,
    best_effort: bool = False,
    seed: int = 0,
) -> xr.Dataset:
    """Return the Sobolev norm ||a||_s of a surface's area measure, with its error.

    Args:
        a: Field from `fourier_transform` or a store, or a surface; a mesh in any form that `as_mesh` takes. The norm
            of a sphere without a lattice is a closed form.
        order: One order s < -1/2, or several.
        lattice: Lattice to transform a surface on. A field brings its own.
        rtol: Largest relative error, in place of a lattice; see `distance`.
        memory: Memory that a transform may take with rtol, in bytes or as a text such as "4GB"; default 2e9.
        best_effort: Return the nearest that can be reached where the rtol is out of reach, instead of raising.
        seed: Seed of the random frequencies that measure the tail with rtol. The same seed gives the same result.
            A whole number from 0 on.

    Returns:
        Dataset over `order` with `norm`, its `error`, and `error_part`, the four parts of the error over `part`:
        truncation (frequencies beyond the highest one; on a given lattice it can only add to the norm), aliasing,
        discretisation and statistical (zero without octaves). All are float64, in the square root of a unit
        length. The error is NaN for fields without the attribute `quality`. A single order has no dimension.
        Attributes hold the lattice and the kernel. With rtol, `within` is True where the error is below rtol times
        the norm.

    Raises:
        OrderError: An order is not below -1/2.
        InputError: A surface comes without a lattice or an rtol, or with both.
        AccuracyError: The rtol is out of reach, and no best effort; the message gives the reachable one.

    >>> from sobolev_batch import Lattice, norm
    >>> from sobolev_batch.shapes import Sphere, icosphere
    >>> f"{norm(Sphere(), -2.0)['norm'].item():.6f}"
    '4.442778'
    >>> norms = norm(icosphere(2), [-2.0, -5.0], lattice=Lattice(3.0, 32))
    >>> norms["norm"].round(3).values.tolist()
    [4.39, 3.258]
    """
    orders = check_orders(order)
    if rtol is not None:
        accuracy = accuracy_of(rtol, memory, best_effort=best_effort)
        return to_accuracy("norm", (a,), order, lattice, accuracy, seed)[0]
    _refuse_settings_of_rtol(memory, best_effort=best_effort)
    if spheres := _spheres(a, lattice=lattice):
        values = np.array([sphere_norm(spheres[0], s) for s in orders])
        return labelled(order, _closed_form(values, values**2).named("norm"), {})
    field = field_of(a, lattice, orders)
    weights = SobolevWeights(Lattice.from_field(field), orders)
    estimate = _estimate(weights, shells_of(field, None, weights.lattice), [field])
    return labelled(order, estimate.named("norm"), lattice_attributes(weights.lattice, field))


def distance(
    a: OperandLike,
    b: OperandLike,
    order: Orders = DEFAULT_ORDER,
    *,
    lattice: Lattice | None = None,
    rtol: float | None = None,
    memory: float | str | None = None,
    best_effort: bool = False,
    seed: int = 0,
) -> xr.Dataset:
    """Return the Sobolev distance ||a - b||_s of two surfaces' area measures, with its error.

    Args:
        a: Field, or a surface; see `norm`. The distance of two spheres without a lattice is a closed form.
        b: Field on the same lattice, or a surface.
        order: One order s < -1/2, or several.
        lattice: Lattice to transform surfaces on. A field brings its own.
        rtol: Largest error of the distance relative to it, in place of a lattice. Lattice, triangle rules,
            eps and dtype are then chosen, and chosen again where the error of the result is too large. The
            attributes of the dataset hold the last choice.
        memory: Memory that a transform may take with rtol, in bytes or as a text such as "4GB"; default 2e9.
        best_effort: Return the nearest that can be reached where the rtol is out of reach, instead of raising.
        seed: Seed of the random frequencies that measure the tail with rtol. The same seed gives the same result.
            A whole number from 0 on.

    Returns:
        Dataset over `order` with `distance`, its `error`, and the parts of the error; see `norm`. `relative` is the
        distance over the norm of b, `relative_error` its error, `area_share` the share of the squared distance that a
        change of total area explains, `area_share_error` its error, and `excess` the relative
        change of area that does so. All are float64, NaN where they are unknown. With rtol, `within` is True where the
        error is below rtol times the distance.

    Raises:
        OrderError: An order is not below -1/2.
        LatticeError: The fields lie on different lattices, or a surface does not fit into the lattice.
        InputError: A surface comes without a lattice, or an rtol with a lattice or a field.
        AccuracyError: The rtol is out of reach, and no best effort; the message gives the reachable one.

    >>> from sobolev_batch import distance
    >>> from sobolev_batch.shapes import Sphere, icosphere
    >>> f"{distance(Sphere(), Sphere(0.9), -2.0)['distance'].item():.6f}"
    '2.205136'
    >>> near = distance(icosphere(2), Sphere(), -5.0, rtol=1e-2)
    >>> f"{near['relative'].item():.1%}", f"{near['area_share'].item():.0%}", near["within"].item()
    ('2.8%', '8%', True)
    """
    orders = check_orders(order)
    a, b = as_operand(a), as_operand(b)
    if rtol is not None:
        accuracy = accuracy_of(rtol, memory, best_effort=best_effort)
        return to_accuracy("distance", (a, b), order, lattice, accuracy, seed)[0]
    _refuse_settings_of_rtol(memory, best_effort=best_effort)
    if spheres := _spheres(a, b, lattice=lattice):
        return _distance_of_spheres(spheres[0], spheres[1], order)
    has_fields = isinstance(a, xr.DataArray) or isinstance(b, xr.DataArray)
    if lattice is not None and not has_fields and are_equal(a, b):
        nothing, reference = Solution.zero(orders).estimate, ReferenceEstimate.of_equal(len(orders))
        return labelled_distances(order, nothing, reference, {"xi_max": lattice.xi_max, "M": lattice.M})
    first, second = pair_of(a, b, lattice, orders)
    weights = SobolevWeights(Lattice.from_field(first), orders)
    squares, products, own = shells_against(first, second, weights.lattice)
    distances, of_second = _estimate(weights, squares, [first, second]), _estimate(weights, own, [second])
    reference = ReferenceEstimate.on_lattice(
        sums_of_shells(products, weights), distances, of_second, weights, _widths([first, second])
    )
    return labelled_distances(order, distances, reference, lattice_attributes(weights.lattice, first, second))


def accuracy_of(rtol: float, memory: float | str | None, *, best_effort: bool = False) -> Accuracy:
    """Return the accuracy that parameters of the public functions ask for."""
    accuracy = Accuracy(rtol, best_effort=best_effort)
    return accuracy if memory is None else replace(accuracy, allowed_bytes=available(memory))


def _refuse_settings_of_rtol(memory: float | str | None, *, best_effort: bool) -> None:
    if memory is not None:
        raise InputError("memory limits the computation for an rtol; pass an rtol with it, or leave memory out")
    if best_effort:
        raise InputError("a best effort is made for an rtol; pass an rtol with it, or leave best_effort out")


def to_accuracy(
    name: str, operands: Sequence[OperandLike], order: Orders, lattice: Lattice | None, accuracy: Accuracy, seed: int
) -> tuple[xr.Dataset, Reference | None]:
    """Compute a norm or distance, and its reference, to an accuracy; attributes hold the settings that were chosen."""
    orders = check_orders(order)
    surfaces = [as_surface(operand) for operand in operands if not isinstance(operand, xr.DataArray)]
    if lattice is not None or len(surfaces) < len(operands):
        raise InputError("an rtol chooses the lattice: pass surfaces and no lattice, or a lattice and no rtol")
    check_seed(seed)
    problem = Problem.from_surfaces(surfaces, orders, accuracy, f"the {name}", available_cores())
    solution = solve(problem, seed)
    attributes = {"rtol": accuracy.rtol, "seed": seed, **solution.settings}
    reference = None
    if name == "norm":
        dataset = labelled(order, solution.estimate.named(name), attributes)
    else:
        reference = Reference.for_problem(problem, solution, seed) if problem.surfaces else None
        estimate = ReferenceEstimate.of_equal(len(problem.orders)) if reference is None else reference.estimate()
        dataset = labelled_distances(order, solution.estimate, estimate, attributes)
    within = accuracy.met(solution.estimate).reshape(np.shape(order))
    return dataset.assign(within=(dataset[name].dims, within, VARIABLES["within"])), reference


def _estimate(weights: SobolevWeights, sums: Reals, fields: Sequence[xr.DataArray]) -> NormEstimate:
    """Return a norm or distance from shell sums, with the errors that follow from the fields' qualities."""
    qualities = [quality for quality in map(quality_of, fields) if quality is not None]
    areas = np.array(sum(quality.area for quality in qualities))
    errors = np.sum([quality.probe.norms(weights) for quality in qualities], axis=0)
    estimate = estimate_norms(sums_of_shells(sums, weights), weights, Support(areas, _widths(fields)), errors)
    if len(qualities) == len(fields):
        return estimate
    return NormEstimate(estimate.values, *[np.full_like(estimate.values, np.nan)] * 4)


def _widths(fields: Sequence[xr.DataArray]) -> Reals:
    """Return the widths of the surfaces of some fields together, see `Support`; zero where they are unknown."""
    extents = [quality.extent for quality in map(quality_of, fields) if quality is not None]
    return Extent.union(extents).widths if len(extents) == len(fields) else np.zeros(len(DIRECTIONS))


def _spheres(*operands: OperandLike, lattice: Lattice | None) -> tuple[Sphere, ...]:
    """Return the operands if they are spheres without a lattice: then all metrics are closed forms."""
    spheres = tuple(operand for operand in operands if isinstance(operand, Sphere))
    return spheres if lattice is None and len(spheres) == len(operands) else ()


def _distance_of_spheres(a: Sphere, b: Sphere, order: Orders) -> xr.Dataset:
    orders = check_orders(order)
    values = np.array([sphere_distance(a, b, s) for s in orders])
    norms = np.array([sphere_norm(b, s) for s in orders])
    squares = np.array([sphere_norm(a, s) ** 2 for s in orders]) + norms**2
    products = np.array([sphere_inner_product(a, b, s) for s in orders]) - norms**2
    reference = ReferenceEstimate(_closed_form(norms, norms**2), products, _CLOSED_FORM_ACCURACY * squares)
    return labelled_distances(order, _closed_form(values, squares), reference, {})


def _closed_form(values: Reals, squares: Reals) -> NormEstimate:
    """Return values whose squares are exact up to a small fraction of some squared norms."""
    zeros = np.zeros_like(values)
    rounding = _CLOSED_FORM_ACCURACY * squares
    return NormEstimate(values, zeros, zeros, np.sqrt(values**2 + rounding) - values + rounding**0.5 * (values == 0))


# Error of the values of changed meshes, as a fraction of the distance.
_VALUES_ACCURACY = 1e-2
# No values are exact to less than this fraction of the area.
_ROUNDING = 1e-13
# A search ends where the distance is this near to the one wanted, in logarithms, or after this many changed meshes. It
# has failed if the distance is still farther off than the last number.
_CLOSENESS, _MOST_STEPS, _FAILED = 0.02, 8, 0.1
# Largest factor from one changed mesh to the next.
_LARGEST_STEP = math.log(16.0)
# Secants that are flatter, relative to what is usual, are noise.
_LEAST_POWER = 0.1
# Least and largest moves and noise, as fractions of the radius, and the fewest triangles.
_LEAST, _MOST, _FEWEST_TRIANGLES = 1e-10, 4.0, 4
_KINDS = ("moved", "noise", "decimated")


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
) -> xr.Dataset:
    """Return the distance of two meshes, and which changes of the second one bring it as far from itself.

    Distances of the changed meshes are computed at the frequencies of the first distance. For each order there are
    about three of noise and five of decimation: expect several times the time of `distance`.

    Args:
        a: Mesh; see `as_mesh` for what may stand for it.
        b: Reference, likewise.
        order: One order s < -1/2, or several.
        lattice: Lattice to transform the meshes on.
        rtol: Largest relative error of the distance, in place of a lattice; see `distance`.
        memory: Memory that a transform may take with rtol; see `distance`.
        best_effort: As for `distance`.
        seed: Seed of the noise, and with rtol of the random frequencies.

    Returns:
        What `distance` returns, and over `order` the changes of b: `moved`, its move in any direction (root mean
        square over all of them), and `noise`, the standard deviation of Gaussian noise at its vertices along its
        normals, both as fractions of the radius of its bounding sphere; `decimated`, the number of triangles left by
        quadric edge collapse. All are float64, NaN where no such change is as far away, and where the distance is not
        larger than its error. `moved_error`, `noise_error` and `decimated_error` tell what the error of the distance
        and the end of the search leave open.

    Raises:
        OrderError: An order is not below -1/2.
        LatticeError: A mesh does not fit into the lattice.
        InputError: A surface is no mesh, or there is neither a lattice nor an rtol, or both.
        AccuracyError: The rtol is out of reach, and no best effort; the message gives the reachable one.

    >>> import sobolev_batch as sb
    >>> found = sb.yardsticks(sb.shapes.icosphere(1), sb.shapes.icosphere(3), -2.0, lattice=sb.Lattice(3.0, 24))
    >>> bool(0.05 < found["moved"] < 0.2), bool(30 < found["decimated"] < 60)
    (True, True)
    """
    a, b = as_mesh(a), as_mesh(b)
    check_seed(seed)
    orders, solved = check_orders(order), None
    if rtol is None:
        found = distance(a, b, order, lattice=lattice, memory=memory, best_effort=best_effort)
    else:
        accuracy = accuracy_of(rtol, memory, best_effort=best_effort)
        found, solved = to_accuracy("distance", (a, b), order, lattice, accuracy, seed)
    distances, errors, relative = (np.atleast_1d(found[name].values) for name in ("distance", "error", "relative"))
    columns = {name: np.full(len(orders), np.nan) for kind in _KINDS for name in (kind, f"{kind}_error")}
    if distances.any():
        values_errors = np.maximum(_VALUES_ACCURACY * np.maximum(distances, errors), _ROUNDING * b.area)
        target = ErrorTarget(orders, tuple(values_errors.tolist()))
        if solved is not None:
            b, frequencies, values = cast(Mesh, solved.pair[-1]), solved.frequencies, solved.values
        else:
            # Without an accuracy there is one.
            frequencies = Frequencies(cast(Lattice, lattice), (), orders, support_of([a, b]).widths)
            values = frequencies.values(b, target, Execution(threads=available_cores()))
        curves = _curves(b, frequencies, values, target, float(relative.min()), seed)
        for i in np.flatnonzero(distances > errors).tolist():
            for kind, curve in curves.items():
                columns[kind][i], columns[f"{kind}_error"][i] = curve.equivalent(i, distances[i], errors[i])
    return found.assign(labelled(order, columns, {}).data_vars)


def _curves(
    mesh: Mesh, frequencies: Frequencies, values: SurfaceValues, target: ErrorTarget, start: float, seed: int
) -> dict[str, _Curve]:
    """Return the distance of a mesh from itself by the amount of each change; searches begin with a relative one."""

    def apart(changed: Mesh) -> Reals:
        others = frequencies.values(changed, target, Execution(threads=available_cores()))
        return frequencies.norms([others, values], [changed, mesh], [1, -1]).values

    _, radius = mesh.bounding_sphere
    bounds, count = (_LEAST, _MOST), len(mesh.triangles)
    return {
        "moved": _Curve(lambda amount: frequencies.moved(values, mesh, amount * radius), start, bounds, 1.0),
        "noise": _Curve(lambda amount: apart(with_noise(mesh, amount * radius, seed)), start, bounds, 1.0),
        "decimated": _Curve(
            lambda amount: apart(decimated(mesh, round(amount))),
            max(count // 4, _FEWEST_TRIANGLES),
            (_FEWEST_TRIANGLES, max(count - 1, _FEWEST_TRIANGLES)),
            -1.0,
        ),
    }


@dataclass(frozen=True, eq=False)
class _Curve:
    """Distances (orders,) to the reference by the amount of a change, each computed once.

    The search begins with a start between bounds. The distance usually grows like the amount to the power of the slope.
    """

    distances: Callable[[float], Reals]
    start: float
    bounds: tuple[float, float]
    slope: float
    known: dict[float, Reals] = field(default_factory=dict)

    def equivalent(self, order: int, wanted: float, error: float) -> tuple[float, float]:
        """Return the amount at which the distance of an order is the one wanted, and how far off the amount may be.

        Both are NaN if there is none. The search follows secants of the logarithms.
        """
        gaps = {amount: _gap(distances[order], wanted) for amount, distances in self.known.items()}
        amount = min(gaps, key=lambda one: abs(gaps[one]), default=self.start)
        for _ in range(_MOST_STEPS):
            if amount not in gaps:
                try:
                    self.known[amount] = self.distances(amount)
                except (LatticeError, MeshError):
                    return math.nan, math.nan
                gaps[amount] = _gap(self.known[amount][order], wanted)
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
        return found, found * (error / wanted + abs(gaps[nearest])) / abs(power)

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


def _gap(found: float, wanted: float) -> float:
    return math.log(max(found, np.finfo(np.float64).tiny) / wanted)
