"""Sobolev norms and distances of surfaces or of their fields, for any list of orders at once.

The weight (1 + |ξ|²)^s depends on the shell |k|² of a lattice point only. A field is therefore
reduced to one number per shell first, whatever the orders; a norm of any order is then a short
weighted sum of those. Fields are read block by block, so they need not fit into memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.closed_forms import Sphere
from sobolev_batch.geometry.formats.conversion import as_surface, each
from sobolev_batch.geometry.surface import DIRECTIONS
from sobolev_batch.machine import available, available_cores
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.accuracy.frequencies import Reference
from sobolev_batch.norms.accuracy.problem import Problem, are_equal, support_of
from sobolev_batch.norms.accuracy.solution import Solution
from sobolev_batch.norms.accuracy.solve import solve
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.norms.budget import sums_of_shells
from sobolev_batch.norms.columns import VARIABLES, labelled, labelled_distances, lattice_attributes
from sobolev_batch.norms.estimate import NormEstimate, ReferenceEstimate, estimate_norms
from sobolev_batch.norms.fields import (
    OperandLike,
    as_operand,
    common_lattice,
    field_of,
    pair_of,
    quality_of,
    shells_against,
    shells_of,
)
from sobolev_batch.norms.images import NearAxes, images_at
from sobolev_batch.norms.tail.remainder import remainder_of_flat
from sobolev_batch.parameters import callback, check_flags, check_seed
from sobolev_batch.shown import progress_line
from sobolev_batch.transform.lattice import Lattice, Orders, SobolevWeights, check_orders
from sobolev_batch.transform.spheres import sphere_inner_product

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
    on_progress: Callable[[str], object] | None = None,
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
        seed: Seed of the random frequencies with rtol, a whole number from 0 on; the same seed gives the same result.
        on_progress: Called with a line about each step with rtol; by default notebooks show the last one.

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
    if solved := to_accuracy("norm", (a,), order, lattice, rtol, memory, best_effort, seed, on_progress):
        return solved[0]
    if spheres := _spheres(a, lattice=lattice):
        values = np.sqrt([sphere_inner_product(spheres[0], spheres[0], s) for s in orders])
        return labelled(order, _closed_form(values, values**2).named("norm"), {})
    field = field_of(a, lattice, orders)
    weights = SobolevWeights(Lattice.from_field(field), orders)
    near_axes = NearAxes(weights.lattice, 1)
    sums = shells_of([field], weights.lattice, near_axes)
    estimate = _estimate(weights, sums, [field], images_at(near_axes.images(), orders)[:, 0])
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
    on_progress: Callable[[str], object] | None = None,
) -> xr.Dataset:
    """Return the Sobolev distance ||a - b||_s of two surfaces' area measures, with its error.

    Args:
        a: Field, or a surface; see `norm`. The distance of two spheres without a lattice is a closed form.
        b: Field on the same lattice, or a surface.
        order: One order s < -1/2, or several.
        lattice: Lattice to transform surfaces on. A field brings its own.
        rtol: Largest relative error, in place of a lattice. Lattice, triangle rules, eps and dtype are then chosen, and
            again where the error of the result is too large. The attributes of the dataset hold the last choice.
        memory: Memory that a transform may take with rtol, in bytes or as a text such as "4GB"; default 2e9.
        best_effort: Return the nearest that can be reached where the rtol is out of reach, instead of raising.
        seed: Seed of the random frequencies with rtol, a whole number from 0 on; the same seed gives the same result.
        on_progress: Called with a line about each step with rtol; by default notebooks show the last one.

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
    a, b = each(as_operand, {"a": a, "b": b})
    if solved := to_accuracy("distance", (a, b), order, lattice, rtol, memory, best_effort, seed, on_progress):
        return solved[0]
    if spheres := _spheres(a, b, lattice=lattice):
        return _distance_of_spheres(spheres[0], spheres[1], order)
    has_fields = isinstance(a, xr.DataArray) or isinstance(b, xr.DataArray)
    if (lattice := common_lattice((), lattice)) is not None and not has_fields and are_equal(a, b):
        nothing, reference = Solution.zero(orders).estimate, ReferenceEstimate.of_equal(len(orders))
        return labelled_distances(order, nothing, reference, {"xi_max": lattice.xi_max, "M": lattice.M})
    first, second = pair_of(a, b, lattice, orders)
    weights = SobolevWeights(Lattice.from_field(first), orders)
    (squares, products, own), near_axes = shells_against(first, second, weights.lattice)
    images, images_of_second = images_at(near_axes.images(), orders).T
    found = None if has_fields else remainder_of_flat((a, b), weights.lattice.xi_max, orders)
    beyond = np.nan if found is None else found.bounds(orders)
    distances = _estimate(weights, squares, [first, second], images, beyond)
    of_second = _estimate(weights, own, [second], images_of_second)
    qualities = [quality for quality in map(quality_of, (first, second)) if quality is not None]
    if len(qualities) == len((first, second)) and squares.any():
        # A study knows how far its fields are from its reference, which may not be that of both.
        known = np.sqrt([quality.beyond_at(orders) for quality in qualities])
        least = np.hypot(distances.values, known.sum(axis=0)) - distances.values
        distances = replace(distances, truncation=np.fmax(distances.truncation, least))
    # Errors are unknown where a quality is, whatever the widths.
    widths = support_of(qualities).widths if qualities else np.zeros(len(DIRECTIONS))
    sums = sums_of_shells(products, weights)
    reference = ReferenceEstimate.from_products(sums, weights, widths, distances, of_second)
    return labelled_distances(order, distances, reference, lattice_attributes(weights.lattice, first, second))


def to_accuracy(
    name: str,
    operands: Sequence[OperandLike],
    order: Orders,
    lattice: Lattice | None,
    rtol: float | None,
    memory: float | str | None,
    best_effort: bool,
    seed: int,
    on_progress: Callable[[str], object] | None,
) -> tuple[xr.Dataset, Reference | None] | None:
    """Compute a norm or distance, and its reference, to an rtol by parameters of public functions; None without one.

    Attributes hold the settings that were chosen.
    """
    check_flags(best_effort=best_effort)
    check_seed(seed)
    callback(on_progress)
    if rtol is None:
        if memory is not None:
            raise InputError("memory limits the computation for an rtol; pass an rtol with it, or leave memory out")
        if best_effort:
            raise InputError("a best effort is made for an rtol; pass an rtol with it, or leave best_effort out")
        return None
    accuracy = Accuracy(rtol, best_effort=best_effort)
    accuracy = accuracy if memory is None else replace(accuracy, allowed_bytes=available(memory))
    orders = check_orders(order)
    surfaces = [as_surface(operand) for operand in operands if not isinstance(operand, xr.DataArray)]
    if lattice is not None or len(surfaces) < len(operands):
        raise InputError("an rtol chooses the lattice: pass surfaces and no lattice, or a lattice and no rtol")
    problem = Problem.from_surfaces(surfaces, orders, accuracy, f"the {name}", available_cores())
    problem = problem.up_to_rounding(surfaces)
    with progress_line(on_progress) as notify:
        solution = solve(replace(problem, notify=notify), seed)
    attributes = {"rtol": accuracy.rtol, "seed": seed, **solution.settings}
    reference = None
    if name == "norm":
        dataset = labelled(order, solution.estimate.named(name), attributes)
    else:
        is_zero = not problem.surfaces and not np.any(problem.moved)
        reference = None if is_zero else Reference.for_problem(problem, solution, seed)
        estimate = ReferenceEstimate.of_equal(len(problem.orders)) if reference is None else reference.estimate
        dataset = labelled_distances(order, solution.estimate, estimate, attributes)
    within = accuracy.met(solution.estimate).reshape(dataset[name].shape)
    return dataset.assign(within=(dataset[name].dims, within, VARIABLES["within"])), reference


def _estimate(
    weights: SobolevWeights, sums: Reals, fields: Sequence[xr.DataArray], images: Reals, beyond: Reals | float = np.nan
) -> NormEstimate:
    """Return a norm or distance from shell sums, with the errors that follow from the fields' qualities.

    Bounds on what lies beyond the lattice in the squared norm, and on what images add to it, (orders,) may be known.
    """
    qualities = [quality for quality in map(quality_of, fields) if quality is not None]
    found = sums_of_shells(sums, weights)
    if len(qualities) < len(fields):
        return NormEstimate(np.sqrt(np.maximum(found.totals, 0.0)), *[np.full(len(weights.orders), np.nan)] * 4)
    errors = np.hypot.reduce([quality.probe.norms(weights) for quality in qualities])
    support = support_of(qualities)
    return estimate_norms(found, weights, support, errors, is_given=True, beyond=beyond, images=images)


def _spheres(*operands: OperandLike, lattice: Lattice | None) -> tuple[Sphere, ...]:
    """Return the operands if they are spheres without a lattice: then all metrics are closed forms."""
    spheres = tuple(operand for operand in operands if isinstance(operand, Sphere))
    return spheres if lattice is None and len(spheres) == len(operands) else ()


def _distance_of_spheres(a: Sphere, b: Sphere, order: Orders) -> xr.Dataset:
    orders = check_orders(order)
    pairs = (a, a), (b, b), (a, b)
    own, other, product = (np.array([sphere_inner_product(*pair, s) for s in orders]) for pair in pairs)
    distances = _closed_form(np.sqrt(np.maximum(own + other - 2 * product, 0.0)), own + other)
    errors = _CLOSED_FORM_ACCURACY * (own + other)
    reference = ReferenceEstimate(_closed_form(np.sqrt(other), other), product - other, errors)
    return labelled_distances(order, distances, reference, {})


def _closed_form(values: Reals, squares: Reals) -> NormEstimate:
    """Return values whose squares are exact up to a small fraction of some squared norms."""
    zeros = np.zeros_like(values)
    rounding = _CLOSED_FORM_ACCURACY * squares
    return NormEstimate(values, zeros, zeros, np.sqrt(values**2 + rounding) - values + rounding**0.5 * (values == 0))
