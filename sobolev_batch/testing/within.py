"""Whether the largest deviation of two meshes is within a length: a verdict, and an assertion of test suites."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from sobolev_batch.geometry.deviation import Deviation, Deviations, largest_deviation
from sobolev_batch.geometry.formats.conversion import MeshLike, as_mesh, each
from sobolev_batch.geometry.proximity import share_beyond
from sobolev_batch.geometry.surface import placement_doubt
from sobolev_batch.parameters import check_flags, length_in
from sobolev_batch.tables.text import between, percent, place_text

# Digits of bounds and of the length, at least.
_DIGITS, _LENGTH_DIGITS = 4, 6
# A longer upper bound, in lower ones, was left where it was when the answer was clear, and would mislead.
_CLOSE = 1.1


@dataclass(frozen=True)
class DeviationVerdict:
    """Answer to whether the largest deviation of two meshes is within a length; a line as text.

    Attributes:
        length: The length, in the unit of the meshes.
        unit: Name of this unit; None where it is not known.
        deviations: Bounds of the largest deviation, only as close as the answer needs.
        beyond: Share of the area that is farther away, the larger of both directions, and its standard error; zero
            unless some is certainly.
        one_way: True where only the points of the first mesh count.
        names: Names of the meshes.
        beyond_of: Number of the mesh that has this share of its area farther away, 0 or 1.
        doubt: Question whether both are in the same unit of length and place, where they do not look it.
    """

    length: float
    unit: str | None
    deviations: Deviations
    beyond: tuple[float, float] = (0.0, 0.0)
    one_way: bool = False
    names: tuple[str, str] = ("a", "b")
    beyond_of: int = 0
    doubt: str | None = None

    @property
    def largest(self) -> Deviation:
        """Bounds of the deviation that counts."""
        return self.deviations.forward if self.one_way else self.deviations.both

    @property
    def farther(self) -> int:
        """Number of the mesh of whose points one is farthest away, 0 or 1."""
        return int(not self.one_way and self.deviations.backward.lower > self.deviations.forward.lower)

    @property
    def outcome(self) -> Literal["within", "not within", "undecided"]:
        """The answer; it is undecided where the length lies between the bounds, which rounding keeps apart."""
        is_within = self.largest.is_within(self.length)
        return "undecided" if is_within is None else "within" if is_within else "not within"

    def __str__(self) -> str:
        """Return the answer with the bounds and the place on a mesh, and the share of its area beyond the length."""
        length = f"{self.length:.{max(_LENGTH_DIGITS, self._digits)}g}{f' {self.unit}' if self.unit else ''}"
        answer = f"undecided whether within {length}" if self.outcome == "undecided" else f"{self.outcome} {length}"
        largest, beyond = self.largest, ""
        if self.outcome == "not within":
            beyond = f"; {percent(*self.beyond)} of the area of {self.names[self.beyond_of]} is farther away"
            beyond += f"; {self.doubt}" if self.doubt else ""
            largest = replace(largest, upper=math.nan) if largest.upper > _CLOSE * largest.lower else largest
        deviation = f"{deviation_text(largest, self.unit, self._digits)} of {self.names[self.farther]}"
        return f"{answer}: largest deviation {deviation}{beyond}"

    @property
    def _digits(self) -> int:
        """Digits of bounds: as many as tell the lower one from a length that it is above."""
        lower = self.largest.lower
        if self.outcome != "not within":
            return _DIGITS
        return max(_DIGITS, 2 + math.floor(math.log10(lower)) - math.floor(math.log10(lower - self.length)))


def judge_deviation(
    a: MeshLike,
    b: MeshLike,
    length: float | str,
    unit: str | None = None,
    *,
    one_way: bool = False,
    names: tuple[str, str] = ("a", "b"),
) -> DeviationVerdict:
    """Return whether the largest deviation of two meshes, with names, is within a length; see `assert_within`."""
    limit = length_in(length, unit)
    check_flags(one_way=one_way)
    a, b = each(as_mesh, {"a": a, "b": b})
    verdict = DeviationVerdict(limit, unit, largest_deviation(a, b, within=limit), one_way=one_way, names=names)
    if verdict.outcome != "not within":
        return verdict
    share, error, of = share_beyond(a, b, limit, one_way=one_way)
    doubt = placement_doubt(a.extent, b.extent)
    return replace(verdict, beyond=(share, error), beyond_of=of if share else verdict.farther, doubt=doubt)


def assert_within(
    a: MeshLike, b: MeshLike, length: float | str, *, unit: str | None = None, one_way: bool = False
) -> Deviations:
    """Raise an AssertionError unless no point of either mesh is farther from the other mesh than a length.

    Bounds decide, and no sample: a spike or a closed hole is found, however small, whatever the vertices and triangles.

    Args:
        a: Mesh, the path of a mesh file, or a tuple of vertices (n, 3) and triangles (m, 3).
        b: The other one, likewise, in the same unit of length.
        length: Largest deviation that passes: a number in the unit of the meshes, or a text such as "0.1 mm".
        unit: Name of the unit of the meshes, which a length with a unit needs. um, mm, cm, m and in are converted into
            each other.
        one_way: True if points of b may be farther from a: what a scan has not seen of a part, for example.

    Returns:
        Bounds of the largest deviation each way and both, in the unit of the meshes, as close as the answer needs.

    Raises:
        AssertionError: A point is farther away, or rounding leaves that open. The message is one line, with the bounds
            that are known, the place of the lower one, and the share of the area that is farther away.
        InputError: The length is not positive, or has a unit that cannot be converted; or see `as_mesh`.

    >>> import sobolev_batch as sb
    >>> fine, coarse = sb.shapes.icosphere(4), sb.shapes.icosphere(3)
    >>> sb.testing.assert_within(coarse, fine, "1 mm", unit="cm").both.upper <= 0.1
    True
    >>> sb.testing.assert_within(coarse, fine, 0.001)
    Traceback (most recent call last):
        ...
    AssertionError: not within 0.001: largest deviation ≥ 0.00..., at (...) of b; 9... % of the area of b is ...
    """
    __tracebackhide__ = True
    verdict = judge_deviation(a, b, length, unit, one_way=one_way)
    if verdict.outcome != "within":
        raise AssertionError(str(verdict))
    return verdict.deviations


def deviation_text(deviation: Deviation, unit: str | None, digits: int = _DIGITS) -> str:
    """Return the bounds of a deviation with their unit, the upper one where it is known, and the place."""
    bounds = (0.0, 0.0) if deviation.upper <= deviation.rounding else (deviation.lower, deviation.upper)
    place = place_text(deviation.place, bounds[math.isfinite(bounds[1])] or 1.0)
    return f"{between(*bounds, f' {unit}' if unit else '', digits)}, at {place}"
