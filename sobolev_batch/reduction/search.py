"""The search for the coarsest mesh within a tolerance: what to try next is a function of what was tried.

A remesher has a parameter, here the size: a number of triangles, or a length such as the largest deviation that it aims
at. Distances follow a power of it, nearly, so the search takes secant steps in logarithms, inside the bracket of the
coarsest mesh that holds and the next coarser one that does not.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

from sobolev_batch.errors import InputError
from sobolev_batch.geometry.surface import is_finite_number

# Width of the last bracket, as a fraction of the size, and trials after which a search ends without it. Decimations of
# seven meshes down to seven limits took 7.1 trials in the mean, and 10 at most.
PRECISION, _MOST_TRIALS = 0.05, 16
# Exponent of distances in the size before two trials show one, and the range in which a shown one is believed.
_FIRST_SLOPE, _LEAST_SLOPE, _LARGEST_SLOPE = 1.0, 0.3, 3.0
# Least logarithm of a distance over the limit, also in place of a zero; and the largest one that counts at the end of a
# bracket: beyond it, distances say little about where the limit is met.
_LEAST_EXCESS, _NEAR = -7.0, 0.5
# How far beside the predicted size to try, as a part of the last bracket's width: on its wider side, to end the search.
_BESIDE = 0.4
# Steps are kept so short, or cut off so much of the bracket, that halving it can end the search within so many trials:
# where decimation spoils one spot early, the largest deviation is the same for many sizes, and follows no power.
# Whole sizes are rounded, so that halving aims at this fraction of the last bracket's width.
_FEW_TRIALS, _CLOSED = 8, 0.85
# Widths that differ by this fraction are equal.
_EQUAL = 1e-9
# Remeshers fail at single sizes, and at all that are too coarse. So a size that fails between two that do not says
# nothing, and where only the coarsest one failed, another is tried, so many widths of the last bracket beyond it.
_BEYOND = 1.5
# So many trials that all made the same mesh, or none, are followed by the finest size, or by the one beside it where
# that holds: others between would fail too. Until a mesh was made, either end may be the finest.
_ALIKE = 3
# Trials at once lie the last bracket's width apart, or this part of the way to the prediction; first, this logarithm.
_APART, _SPREAD, _FIRST_APART = 0.9, 0.4, 0.7


@dataclass(frozen=True)
class Trial:
    """A mesh that was made and judged; what cannot be made is infinitely far away.

    Attributes:
        size: Parameter of the remesher.
        triangles: Triangles of the mesh; 0 where there is none.
        estimate: Estimate of its distance, which guides the search.
        lower, upper: Bounds of the distance.
        is_within: True where the distance is certainly within the limit. An open question counts as not within.
        seconds: Time of making and judging it.
        reason: Why there is no mesh, or no distance.
        broken: How a mesh within the limit is broken, unlike its reference; see `Mesh.damage_beside`.
    """

    size: float
    triangles: int = 0
    estimate: float = math.inf
    lower: float = math.inf
    upper: float = math.inf
    is_within: bool = False
    seconds: float = 0.0
    reason: str = ""
    broken: str = ""

    @property
    def has_distance(self) -> bool:
        """True where a mesh was made and compared."""
        return math.isfinite(self.estimate)


@dataclass(frozen=True)
class Bracket:
    """State of a search: the coarsest mesh that holds, and the next coarser one that does not.

    Attributes:
        best: The mesh of fewest triangles within the limit; None where none is.
        failed: The next coarser mesh that is not; None where the coarsest is within.
        is_monotone: False where a finer mesh is certainly farther away than a coarser one. Then a mesh that is coarser
            than the one that failed may hold, which no search by bracketing can tell.
    """

    best: Trial | None
    failed: Trial | None
    is_monotone: bool


@dataclass(frozen=True)
class Search:
    """A search between two sizes. It has no state: give it the trials so far, in any order.

    Attributes:
        limit: Largest distance.
        low, high: Smallest and largest size to try.
        is_whole: True where sizes are whole numbers.
        first: Size to try first; None for the middle.
        larger_is_coarser: Whether a larger size makes a coarser mesh; None to find out by the triangles of trials.
        precision: Width of the last bracket, as a fraction of the size.

    >>> search, trials = Search(limit=0.02, low=4, high=10_000, is_whole=True, larger_is_coarser=False), []
    >>> while sizes := search.next(trials):
    ...     trials += [Trial(n, int(n), 8 / n, 8 / n, 8 / n, is_within=8 / n <= 0.02) for n in sizes]
    >>> found = search.bracket(trials)
    >>> found.failed.triangles < 400 <= found.best.triangles < 1.05 * found.failed.triangles
    True
    """

    limit: float
    low: float
    high: float
    is_whole: bool = False
    larger_is_coarser: bool | None = None
    first: float | None = None
    precision: float = PRECISION

    def __post_init__(self) -> None:
        ends = self.low, self.high
        if not all(map(is_finite_number, ends)) or not 0 < self.low <= self.high:
            raise InputError(f"sizes to search are two positive numbers, the smaller one first, found {ends}")
        if not (is_finite_number(self.precision) and 0 < self.precision < 1):
            raise InputError(f"precision is a fraction between 0 and 1, such as 0.05, found {self.precision!r}")

    def bracket(self, trials: Sequence[Trial]) -> Bracket:
        """Return what trials say."""
        sign = self._sign(trials)
        ordered = sorted(trials, key=lambda one: sign * one.size)
        # Of equal meshes the one of the coarsest size.
        best = min((one for one in ordered[::-1] if one.is_within), key=lambda one: one.triangles, default=None)
        coarser = ordered if best is None else ordered[ordered.index(best) + 1 :]
        # Those that failed alone do not say where the limit is met, but where none is coarser.
        told = (one for one in coarser if one is ordered[-1] or not _failed_alone(one, ordered))
        made = [one for one in ordered if one.triangles]
        is_monotone = all(a.lower <= b.upper for a, b in combinations(made, 2))
        return Bracket(best, next((one for one in told if not one.is_within), None), is_monotone)

    def next(self, trials: Sequence[Trial], count: int = 1) -> tuple[float, ...]:
        """Return sizes to try now, up to a count of them at a time; none where the search is over."""
        bracket, sign = self.bracket(trials), self._sign(trials)
        # Places are logarithms of sizes, from fine to coarse.
        finest, coarsest = sorted(sign * math.log(size) for size in (self.low, self.high))
        start = finest if bracket.best is None else sign * math.log(bracket.best.size)
        end = coarsest if bracket.failed is None else sign * math.log(bracket.failed.size)
        again = self._again(trials, bracket, sign) if len(trials) < _MOST_TRIALS else ()
        if len(trials) >= _MOST_TRIALS or not self._is_open(bracket, start, end):
            return again
        tried, failed = {one.size for one in trials}, [one for one in trials if not one.is_within]
        if start == finest and len(failed) >= _ALIKE and len({(one.triangles, one.estimate) for one in failed}) == 1:
            if bracket.best is not None:
                return (self._size(sign, finest + _BESIDE * math.log1p(self.precision), bracket),)
            ends = (float(self.high), float(self.low))[::sign]
            is_open = self.larger_is_coarser is None and not failed[0].triangles
            return tuple(size for size in ends[not is_open :] if size not in tried)[:1]
        points = {
            sign * math.log(one.size): math.log(max(one.estimate / self.limit, math.exp(_LEAST_EXCESS)))
            for one in trials
            if one.has_distance
        }
        # Sizes that failed alone lie inside the bracket, so more places are asked for.
        wanted = count + len(trials) if points else count
        places = self._places(points, len(trials), bracket, start, end, wanted)
        if self.first is not None and not trials:
            places = [sign * math.log(self.first) + _FIRST_APART * (k - (count - 1) / 2) for k in range(count)]
        sizes = dict.fromkeys([*again, *(self._size(sign, place, bracket) for place in places)])
        return tuple(size for size in sizes if size not in tried)[:count]

    def _again(self, trials: Sequence[Trial], bracket: Bracket, sign: int) -> tuple[float, ...]:
        """Return a size beyond the coarsest one where only that failed, and a finer one, if any, holds."""
        ordered = sorted(trials, key=lambda one: sign * one.size)
        is_open = ordered and bracket.failed == ordered[-1] and (len(ordered) == 1 or bracket.best is not None)
        if not is_open or not _failed_alone(ordered[-1], ordered):
            return ()
        last = ordered[-1]
        size = last.size * math.exp(sign * _BEYOND * math.log1p(self.precision))
        size = float((math.ceil if sign > 0 else math.floor)(size)) if self.is_whole else size
        size = min(max(size, self.low), self.high)
        return () if size == last.size else (size,)

    def _sign(self, trials: Sequence[Trial]) -> int:
        """Return 1 where a larger size is coarser, which is assumed until trials tell, and -1 otherwise."""
        if self.larger_is_coarser is not None:
            return 1 if self.larger_is_coarser else -1
        made = sorted((one.size, one.triangles) for one in trials if one.triangles)
        return -1 if made and made[0][1] < made[-1][1] else 1

    def _is_open(self, bracket: Bracket, start: float, end: float) -> bool:
        """Tell whether a bracket between two places is too wide."""
        if bracket.best is None or bracket.failed is None:
            return end > start or bracket.best == bracket.failed
        is_adjacent = self.is_whole and abs(bracket.best.size - bracket.failed.size) <= 1
        # Rounding must not tell 760 and 798 apart from a width of 5 %.
        return end - start > math.log1p(self.precision) * (1 + _EQUAL) and not is_adjacent

    def _places(
        self, points: Mapping[float, float], tried: int, bracket: Bracket, start: float, end: float, count: int
    ) -> Sequence[float]:
        """Return where to try next between the ends of a bracket, from the excess of the distance at some places.

        Of the trials so far, those that made no mesh have no distance.
        """
        width = math.log1p(self.precision)
        if not points:
            # Where nothing could be made, halves arrive at the finest size.
            is_last = bracket.failed is not None and end - start < 2 * width
            return [start] if is_last else [start + (end - start) * k / (count + 1) for k in range(1, count + 1)]
        # Steps towards an end that was not tried double, and arrive there.
        least = _BESIDE * width * 2.0**tried
        reach = _CLOSED * max(math.log1p(PRECISION) * 2.0 ** (_FEW_TRIALS - 1 - tried), width)
        if bracket.best is None or bracket.failed is None:
            (near, far), side = ((end, start), -1) if bracket.best is None else ((start, end), 1)
            step = side * (_extrapolated(points, near) - near) + _BESIDE * width
            guess = near + side * max(min(step, reach), least)
            guess = far if side * (far - guess) < width else guess
        else:
            # Sobolev distances follow a power closely; the first secant step then arrives.
            is_first = len(points) == 2 and bracket.failed.has_distance
            guess = _extrapolated(points, start) if is_first else _interpolated(points, start, end)
            guess += _BESIDE * width * (1 if 2 * guess < start + end else -1)
            is_hopeless = end - start > 2 * reach
            least_cut = end - start - reach if not is_hopeless else 0.0 if is_first else (end - start) / 2
            margin = max(least_cut, _BESIDE * width / 2)
            guess = min(max(guess, start + margin), end - margin)
        apart = max(_APART * width, _SPREAD * min(abs(guess - place) for place in points))
        beside = (guess + apart * k * side for k in range(1, count) for side in (1, -1))
        return [guess, *(place for place in beside if start < place < end)][:count]

    def _size(self, sign: int, place: float, bracket: Bracket) -> float:
        """Return the size at a place; a whole one lies strictly between those of the bracket."""
        size = min(max(math.exp(sign * place), self.low), self.high)
        if not self.is_whole:
            return size
        finer = -sign * math.inf if bracket.best is None else bracket.best.size + sign
        coarser = sign * math.inf if bracket.failed is None else bracket.failed.size - sign
        return float(min(max(round(size), min(finer, coarser)), max(finer, coarser)))


def _failed_alone(trial: Trial, ordered: Sequence[Trial]) -> bool:
    """Tell whether a trial failed, and those beside it, if any, did not."""
    place = ordered.index(trial)
    return [one for one in ordered[max(place - 1, 0) : place + 2] if not one.has_distance] == [trial]


def _extrapolated(points: Mapping[float, float], end: float) -> float:
    """Return the place where the excess would be zero, by the two places that are nearest to the end of a bracket."""
    (place, excess), *others = sorted(points.items(), key=lambda point: abs(point[0] - end))
    slope = (others[0][1] - excess) / (others[0][0] - place) if others else _FIRST_SLOPE
    return place - excess / min(max(slope, _LEAST_SLOPE), _LARGEST_SLOPE)


def _interpolated(points: Mapping[float, float], start: float, end: float) -> float:
    """Return the place within a bracket where the excess would be zero."""
    # An open question may leave either of them without its sign.
    excesses = -points.get(start, -_NEAR), points.get(end, _NEAR)
    below, above = (min(max(excess, _NEAR / 100), _NEAR) for excess in excesses)
    return start + (end - start) * below / (below + above)
