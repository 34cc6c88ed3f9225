"""How far a mesh may be from its reference, and how a mesh is made and judged.

A question that is clear is answered early: bounds are only as close as it needs.
"""

import math
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Self

from sobolev_batch import compiled
from sobolev_batch.errors import InputError, MeshError, one_line
from sobolev_batch.geometry.closest import Triangles
from sobolev_batch.geometry.deviation import largest_deviation
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.proximity import DEFAULT_POINTS, METRICS, NUMBERS, sampled_numbers
from sobolev_batch.geometry.surface import Similarity
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.accuracy.threshold import relative_distance
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.norms.columns import ANGLE, FILE_LENGTH, VARIABLES
from sobolev_batch.norms.tail.integrals import quantile
from sobolev_batch.parameters import fraction, length_in
from sobolev_batch.reduction.search import Trial
from sobolev_batch.sources.names import known_names, quoted
from sobolev_batch.sources.programs import CannotStartError
from sobolev_batch.sources.registry import Member, load_mesh
from sobolev_batch.transform.lattice import single_order

# The accuracy of a distance follows from its limit; only the memory of this one counts.
_ANY_ACCURACY = Accuracy(1e-2)
# Each trial computes in one thread, and random frequencies are the same for all.
_THREADS, _SEED = 1, 0
# A limit that is met up to this fraction is met.
_EQUAL = 1e-9
# Default measures of a length and of a fraction; those whose change counts; and scores, of which more is better.
HAUSDORFF, RELATIVE, _OF_ONE_MESH, _SCORES = "hausdorff", "relative", ("area", "volume"), (*METRICS["fscore"],)
# All measures have bounds or an error, and are 0, or a score of 1, where a mesh is the reference.
_OTHERS = re.compile("upper|error|threshold|normal_max")
_MEASURES = (RELATIVE, *(name for name in NUMBERS if not _OTHERS.search(name)), *_OF_ONE_MESH)


@dataclass(frozen=True)
class Limit:
    """Largest distance of a mesh from its reference, by one measure.

    Attributes:
        value: Largest value of the measure, of either sign: a length in the unit of the meshes, degrees or a fraction;
            of "fscore", "precision" and "recall", the smallest.
        measure: Column of tables: "hausdorff", the largest deviation, of each point of either mesh from the closest one
            of the other; "relative", the Sobolev distance over the norm of the reference, in the unit in which its
            bounding sphere has the radius 1; "area" or "volume", its change over that of the reference; or another one
            of `proximity`, such as "rms", by random points, as far as it may be off at 99 %.
        order: Order s < -1/2 of the Sobolev distance; None for the others.
    """

    value: float
    measure: str = HAUSDORFF
    order: float | None = None

    @classmethod
    def parse(
        cls,
        within: float | str,
        order: float | None = None,
        unit: str | None = None,
        measure: str | None = None,
        default_order: float = DEFAULT_ORDER,
    ) -> Self:
        """Return the limit that is meant: by default a length, or with a per cent sign or an order, of the norm.

        >>> Limit.parse("0.1 mm", unit="m"), Limit.parse("1%"), Limit.parse(0.1, measure="rms").measure
        (Limit(value=0.0001, measure='hausdorff', order=None), Limit(value=0.01, measure='relative', order=-2.0), 'rms')
        """
        is_relative = order is not None or str(within).rstrip().endswith("%")
        column = (RELATIVE if is_relative else HAUSDORFF) if measure is None else str(measure)
        if column not in _MEASURES and column in VARIABLES:
            raise InputError(f"{column} cannot be a limit: it is no distance with bounds; {known_names('', _MEASURES)}")
        if column not in _MEASURES:
            raise InputError(f"no measure is named {quoted(column)}; {known_names(column, _MEASURES)}")
        if order is not None and column != RELATIVE:
            raise InputError(f"{column} has no order; take out one of them")
        unit_of, units = {FILE_LENGTH: unit, ANGLE: ANGLE}, VARIABLES[column]["units"]
        if units in unit_of:
            if is_relative:
                kind = "an angle in degrees" if units == ANGLE else "a length"
                others = ", ".join((RELATIVE, *_OF_ONE_MESH, *_SCORES))
                raise InputError(f"{column} is {kind}, found {within!r}; percentages are for {others}")
            text = str(within).replace("°", ANGLE) if units == ANGLE else within
            return cls(length_in(text, unit_of[units]), column)
        value, whole = math.inf, "norm" if column == RELATIVE else column
        with suppress(InputError):
            value = fraction(within)
        if value >= 1:
            raise InputError(
                f"in per cent or with an order, a tolerance is a fraction of the {whole} below 1, such as 1%, found "
                f"{within!r}; a length has no order"
            )
        orders = {RELATIVE: single_order(default_order if order is None else order)}
        return cls(value, column, orders.get(column))

    @property
    def units(self) -> str:
        """Units of the column: `FILE_LENGTH`, `ANGLE`, or others, in which the value is a fraction."""
        return str(VARIABLES[self.measure]["units"])

    @property
    def is_score(self) -> bool:
        """True for a measure of which more is better."""
        return self.measure in _SCORES

    @property
    def largest(self) -> float:
        """Largest distance: the value, or what is left from it to the best score."""
        return 1 - self.value if self.is_score else self.value

    def bounds(self, mesh: Mesh, reference: Mesh) -> tuple[float, float, float]:
        """Return an estimate of the distance of a mesh from a reference, a lower and an upper bound.

        That of a score is what it lacks to one. MeshError where the measure is not known.
        """
        if self.is_score:
            numbers = sampled_numbers(Triangles(mesh), Triangles(reference), signed=False)
            lower, upper = (max(0.0, 1 - score) for score in _score_ends(numbers, self.measure))
            return upper, lower, upper
        if self.order is not None:
            to_unit = Similarity.to_unit_ball(reference)
            pair = to_unit.apply(mesh), to_unit.apply(reference)
            found, _ = relative_distance(*pair, self.order, self.value, _ANY_ACCURACY, _THREADS, _SEED)
            # Of a distance that is too large, hardly any lies beyond the lattice.
            guess = found.upper if found.upper > self.value else (found.lower + found.upper) / 2
            return found.lower if found.lower > self.value else guess, found.lower, found.upper
        if self.measure.startswith(HAUSDORFF):
            ways = largest_deviation(mesh, reference, within=self.value)
            deviation = getattr(ways, self.measure.removeprefix(HAUSDORFF).removeprefix("_") or "both")
            # The lower bound is at least the distance of any vertex; the upper one falls hardly below the limit.
            return deviation.lower, deviation.lower, deviation.upper
        if self.measure in _OF_ONE_MESH:
            own, other = (getattr(one, self.measure) for one in (mesh, reference))
            value, error = abs(own - other) / (abs(other) or math.nan), 0.0
        else:
            numbers = sampled_numbers(Triangles(mesh), Triangles(reference), signed=self.measure == "bias")
            value = abs(numbers[self.measure])
            # How far it may be off at 99 %.
            error = float(quantile(DEFAULT_POINTS - 1)) * numbers[f"{self.measure}_error"]
        if math.isnan(value):
            causes = reference.defects or mesh.defects or ("it is zero, or vertices are double",)
            raise MeshError(f"no {self.measure} is known: {', '.join(causes)}")
        # The upper bound decides, so it guides the search too.
        return value + error, max(0.0, value - error), value + error


def _score_ends(numbers: Mapping[str, float], measure: str) -> Iterator[float]:
    """Yield the largest and the smallest score that random points permit at 99 %.

    Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference" (1927),
    doi:10.1080/01621459.1927.10502953, whose interval has a width also where all points are matched.
    """
    count, square = DEFAULT_POINTS, float(quantile(DEFAULT_POINTS - 1)) ** 2
    shares = numbers["precision"], numbers["recall"]
    widths = [math.sqrt(square * (count * share * (1 - share) + square / 4)) for share in shares]
    for sign in (1, -1):
        pairs = zip(shares, widths, strict=True)
        ends = [(count * share + square / 2 + sign * width) / (count + square) for share, width in pairs]
        yield dict(zip(_SCORES, (2 * math.prod(ends) / (sum(ends) or 1.0), *ends), strict=True))[measure]


def tried(reference_member: Member, member: Member, limit: Limit, size: float) -> tuple[Trial, Mesh | None]:
    """Make a mesh and judge it against a reference.

    Return the trial, and the mesh where it is within the limit. What goes wrong with the mesh is the reason of a trial
    that failed; what is wrong with the reference, or with a program at any size, is raised as a MeshError.
    """
    reference, started = load_mesh(reference_member), time.perf_counter()
    mesh, reason, bounds = None, "", (math.inf,) * 3
    # A search that was ended goes on in another process, by the same bounds.
    with compiled.by_itself(loops=True):
        if limit.measure in _OF_ONE_MESH:
            # What is not known of the reference is known of no mesh.
            limit.bounds(reference, reference)
        try:
            mesh = load_mesh(member)
            bounds = limit.bounds(mesh, reference)
        except CannotStartError:
            raise
        except InputError as error:
            reason = one_line(error)
    is_within, triangles = bounds[2] <= limit.largest * (1 + _EQUAL), 0 if mesh is None else len(mesh.triangles)
    broken = ", ".join(mesh.damage_beside(reference)) if is_within and mesh is not None else ""
    trial = Trial(float(size), triangles, *bounds, is_within, time.perf_counter() - started, reason, broken)
    return trial, mesh if is_within else None
