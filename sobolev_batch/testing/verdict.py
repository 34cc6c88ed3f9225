"""Verdicts on two surfaces: the same to a tolerance, different, or undecided; and an assertion for test suites."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import mkdtemp
from typing import Literal

from sobolev_batch.errors import InputError, SobolevBatchError, one_line
from sobolev_batch.geometry.formats.conversion import SurfaceLike, as_surface, each
from sobolev_batch.geometry.surface import Similarity, is_finite_number, placement_doubt
from sobolev_batch.machine import available, available_cores
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.accuracy.threshold import Method, relative_distance
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.parameters import check_flags, check_seed
from sobolev_batch.shown import Shown
from sobolev_batch.tables.text import percent, rounded_outwards
from sobolev_batch.testing.difference import write_difference
from sobolev_batch.transform.lattice import single_order

Outcome = Literal["same", "different", "undecided"]

_DEFAULT_TOLERANCE = 1e-3
# A larger relative error says less than the bounds themselves.
_WIDEST = 0.25
# From here on per cents are whole numbers.
_WHOLE = 10
# An accuracy must have one; only its memory counts for a verdict.
_ANY_RTOL = 1e-2


@dataclass(frozen=True)
class Verdict(Shown):
    """Answer to whether two surfaces are the same, to a tolerance. It is true if they are the same.

    Attributes:
        outcome: "same" if the upper bound is at most the tolerance, "different" if the lower is above, or "undecided".
        lower: Lower bound on the Sobolev distance of the surfaces over the Sobolev norm of the reference.
        upper: Upper bound on it. The bounds are only as narrow as the outcome needs.
        tolerance: Largest relative distance of surfaces that count as the same.
        order: Order s of the norm.
        area_change: Area of the surface over that of the reference, less one.
        method: What the distance follows from: "identical" (meshes have the same triangles), "lattice" (the areas bound
            what lies beyond it), or "octaves" (random frequencies measure what lies beyond a lattice).
        doubt: Question whether both are in the same unit of length and in the same place, where they do not look it.

    >>> import sobolev_batch as sb
    >>> verdict = sb.testing.same_surface(sb.shapes.icosphere(3), sb.shapes.Sphere(), order=-4)
    >>> verdict.outcome, f"{verdict.distance:.3f}", f"{verdict.area_change:.3f}"
    ('different', '0.008', '-0.005')
    """

    outcome: Outcome
    lower: float
    upper: float
    tolerance: float
    order: float
    area_change: float
    method: Method
    doubt: str = ""

    @property
    def distance(self) -> float:
        """Middle of the bounds."""
        return (self.lower + self.upper) / 2

    @property
    def error(self) -> float:
        """Half of the distance between the bounds."""
        return (self.upper - self.lower) / 2

    def __bool__(self) -> bool:
        return self.outcome == "same"

    def __str__(self) -> str:
        if self.error <= _WIDEST * self.distance:
            amount = percent(self.distance, self.error)
        else:
            lower, upper = rounded_outwards(100 * self.lower, 100 * self.upper)
            amount = f"at most {upper} %" if self else f"from {lower} to {upper} %"
        tolerance = f"tolerance {100 * self.tolerance:g} %"
        number = f"relative distance {amount} at order {self.order:g}"
        if self.outcome == "undecided":
            return f"undecided: {number}, which does not tell it from {tolerance}; take another"
        if self.outcome == "same":
            return f"same surface: {number}, within {tolerance}"
        change = 100 * self.area_change
        area = f"area {change:+,.0f} %" if abs(change) >= _WHOLE else f"area {change:+.2g} %"
        return "; ".join(filter(None, (f"different surfaces: {number}, above {tolerance}", area, self.doubt)))


def same_surface(
    a: SurfaceLike,
    b: SurfaceLike,
    *,
    tolerance: float = _DEFAULT_TOLERANCE,
    order: float = DEFAULT_ORDER,
    scaling: bool = True,
    memory: float | str | None = None,
    seed: int = 0,
) -> Verdict:
    """Return whether two surfaces are the same, to a tolerance.

    Vertices, triangles and their order do not matter, only how the surfaces spread their area in space. So a mesh that
    is subdivided, triangulated anew or merged from parts is the same, and one that has lost a patch is not. Which way
    triangles face does not matter either. The distance is only computed as exactly as the answer needs.

    Args:
        a: Surface: a `Mesh`, a surface in closed form such as a `Sphere`, the path of a mesh file, or a tuple of
            vertices (n, 3) and triangles (m, 3).
        b: Reference, likewise.
        tolerance: Largest distance of surfaces that count as the same, over the norm of the reference.
        order: Order s < -1/2 of the norm. Orders from -4 down are proven without random frequencies, in tenths of a
            second for a tolerance of 1e-3; others take seconds, and most time near -1/2.
        scaling: Compare both in the unit of length in which the bounding sphere of the reference has the radius 1.
            Otherwise they are compared in their own, on which norms depend.
        memory: Memory that a transform may take, in bytes or as a text such as "4GB"; default 2e9.
        seed: Seed of the random frequencies that orders near -1/2 need.

    Returns:
        The verdict, with the distance and its error.

    Raises:
        InputError: An argument is no surface, or out of range; or there is less memory.
        MeshError: A file or arrays hold no valid mesh.
        OrderError: The order is not below -1/2.

    >>> import sobolev_batch as sb
    >>> fine, coarse = sb.shapes.icosphere(4), sb.shapes.icosphere(3)
    >>> print(sb.testing.same_surface(coarse, fine, tolerance=0.01, order=-4))
    same surface: relative distance 0.7 % ...
    >>> sb.testing.same_surface(coarse, fine).outcome
    'different'
    """
    check_seed(seed)
    check_flags(scaling=scaling)
    if not (is_finite_number(tolerance) and 0 < tolerance < 1):
        raise InputError(f"tolerance must be a number between 0 and 1, found {tolerance!r}")
    accuracy = Accuracy(_ANY_RTOL) if memory is None else Accuracy(_ANY_RTOL, available(memory))
    checked_order = single_order(order)
    surface, reference = each(as_surface, {"a": a, "b": b})
    area_change = surface.area / reference.area - 1
    similarity = Similarity.to_unit_ball(reference) if scaling else Similarity()
    pair = similarity.apply(surface), similarity.apply(reference)
    bounds, method = relative_distance(*pair, checked_order, tolerance, accuracy, available_cores(), seed)
    lower, upper = bounds.lower, bounds.upper
    outcome: Outcome = "same" if upper <= tolerance else "different" if lower > tolerance else "undecided"
    doubt = placement_doubt(surface.extent, reference.extent) or ""
    return Verdict(outcome, lower, upper, float(tolerance), checked_order, area_change, method, doubt)


def assert_same_surface(
    a: SurfaceLike,
    b: SurfaceLike,
    *,
    tolerance: float = _DEFAULT_TOLERANCE,
    order: float = DEFAULT_ORDER,
    scaling: bool = True,
    memory: float | str | None = None,
    seed: int = 0,
    witness: str | Path | None = None,
) -> Verdict:
    """Raise an AssertionError unless two surfaces are the same, to a tolerance.

    A test passes if they are proven to be the same: an undecided comparison fails too, with a message that says so.

    The parameters are those of `same_surface`, and ``witness``: the beginning of the paths of files to write unless the
    surfaces are the same, such as "failures/part"; default a new temporary folder. Meshes are written as
    failures/part-a.ply and failures/part-b.ply, with the witness function of a against b at their vertices: positive
    where a has area that b lacks. A path that ends in .png, .svg or .pdf gets a picture of them. The message names the
    files, and the place where it is largest.

    Returns:
        The verdict, which is "same".

    Raises:
        AssertionError: The surfaces are different, or it is undecided. The message is one line.
        InputError: An argument is no surface, or out of range.

    >>> import sobolev_batch as sb
    >>> sphere = sb.shapes.icosphere(4)
    >>> sb.testing.assert_same_surface(sphere, sb.shapes.Sphere(), tolerance=0.01, order=-4).outcome
    'same'
    >>> sb.testing.assert_same_surface((sphere.vertices, sphere.triangles[100:]), sphere, order=-4)
    Traceback (most recent call last):
        ...
    AssertionError: different surfaces: relative distance 5...% at order -4, above tolerance 0.1 %; area -1.9 %;
    a has less area near (...); witness: ...-a.ply ...-b.ply
    """
    __tracebackhide__ = True
    surface, reference = each(as_surface, {"a": a, "b": b})
    verdict = same_surface(
        surface, reference, tolerance=tolerance, order=order, scaling=scaling, memory=memory, seed=seed
    )
    if verdict:
        return verdict
    message = str(verdict)
    try:
        path = Path(mkdtemp(prefix="sobolev-batch-"), "difference") if witness is None else Path(witness)
        message += f"; {write_difference(surface, reference, path, order, scaling=scaling)}"
    except (SobolevBatchError, OSError, ValueError, TypeError) as error:
        # The test must fail for its own reason.
        message += f"; no witness: {one_line(error)}"
    raise AssertionError(message)
