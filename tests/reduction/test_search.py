"""The search for the coarsest size within a limit: what it finds, in how few trials, and what it says otherwise."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

import sobolev_batch as sb
from sobolev_batch.reduction.limit import Limit
from sobolev_batch.reduction.remesher import Remesher
from sobolev_batch.reduction.search import Search, Trial


def trials_of(search: Search, distance: Callable[[float], float], count: int = 1) -> list[Trial]:
    """Search with distances that are exact; a mesh of distance NaN cannot be made. Sizes are triangles, if whole."""
    trials: list[Trial] = []
    while sizes := search.next(trials, count):
        assert len(set(sizes)) == len(sizes) <= count
        assert not {one.size for one in trials} & set(sizes)
        assert all(search.low <= size <= search.high for size in sizes)
        for size in sizes:
            value = distance(size)
            triangles = int(size) if search.is_whole else math.ceil(1000 / size)
            made = {"triangles": triangles} if value == value else {"reason": "no mesh"}
            trials.append(
                Trial(size, **made, estimate=value, lower=value, upper=value, is_within=value <= search.limit)
            )
    return trials


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("seed", range(30))
def test_the_fewest_triangles_lie_in_the_bracket(seed: int, count: int) -> None:
    # Steps down at random sizes: most sizes have the distance of their neighbours. All are tried for comparison.
    rng = np.random.default_rng(seed)
    size = int(10 ** rng.uniform(1, 4))
    steps = np.sort(rng.integers(4, size + 1, 40))
    values = np.cumsum(rng.exponential(size=41))[::-1] / 10
    table = values[np.searchsorted(steps, np.arange(size + 1), side="right")]
    limit = rng.uniform(table[-1], table[4])
    search = Search(limit, 4, size, is_whole=True, larger_is_coarser=False)
    trials = trials_of(search, lambda n: float(table[int(n)]), count)
    found, fewest = search.bracket(trials), next(n for n in range(4, size + 1) if table[n] <= limit)
    assert found.best is not None
    assert found.best.upper <= limit
    if found.failed is None:
        assert found.best.size == fewest == 4
    else:
        assert found.failed.size < fewest <= found.best.size
        assert found.best.size <= max(1.0501 * found.failed.size, found.failed.size + 1)
    assert found.is_monotone


def test_powers_take_few_trials() -> None:
    for exponent in (0.7, 1.0, 1.4):
        for limit in np.geomspace(1e-4, 0.1, 7):
            search = Search(float(limit), 4, 100_000, is_whole=True, larger_is_coarser=False)
            assert len(trials_of(search, lambda n, power=exponent: 3.0 * n**-power)) <= 8  # type: ignore[misc]


def test_steps_take_few_trials_from_a_guess_on() -> None:
    # Distances of a power, that stay the same over ranges of sizes up to a factor of 2.2.
    counts = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        steps = 4 * np.exp(np.concatenate([[0], np.cumsum(rng.uniform(0.02, 0.8, 40))]))
        fewest = rng.choice(steps[(steps > 50) & (steps < 20_000)])
        search = Search(
            10 * fewest**-1.1, 4, 100_000, True, larger_is_coarser=False, first=fewest * np.exp(rng.uniform(-1.2, 1.2))
        )
        distance = lambda n, own=steps: 10 * own[np.searchsorted(own, n, side="right") - 1] ** -1.1  # noqa: E731
        counts.append(len(trials_of(search, distance)))
    assert np.mean(counts) < 7.5
    assert np.quantile(counts, 0.95) <= 8


def test_a_bracket_of_exactly_the_width_is_closed() -> None:
    search = Search(1.0, 4, 100_000, is_whole=True, larger_is_coarser=False)
    for failed in range(20, 4000, 20):
        sizes = (failed, False), (1.05 * failed, True)
        assert search.next([Trial(round(n), round(n), 1.0, 1.0, 1.0, is_within=held) for n, held in sizes]) == ()


def test_the_first_size_is_that_of_the_tolerance_whatever_the_unit() -> None:
    remesher = Remesher.parse("decimate")
    for scale in (1e-3, 1.0, 1e3):
        (size,) = remesher.search(Limit(0.002 * scale), 100_000, scale).next([])
        assert 1000 < size == remesher.search(Limit(0.002, "relative", -2.0), 100_000, scale).next([])[0] < 10_000
        assert size / remesher.search(Limit(0.02 * scale), 100_000, scale).next([])[0] == pytest.approx(10)
        assert size == remesher.search(Limit(0.002 * scale, "rms"), 100_000, scale).next([])[0]
        assert size == remesher.search(Limit(0.002 * 90, "normal_mean"), 100_000, scale).next([])[0]
        assert size == remesher.search(Limit(0.002, "area"), 100_000, scale).next([])[0]
    # Not the mesh itself, of which nothing is learned.
    assert remesher.search(Limit(1e-6), 5000, 1.0).next([])[0] < 4000


def test_the_estimate_of_a_sobolev_distance_guides_where_bounds_are_wide() -> None:
    coarse, fine = sb.shapes.icosphere(3), sb.shapes.icosphere(5)
    exact = sb.distance(coarse, fine, order=-2, rtol=0.05)["relative"].item()
    estimate, lower, upper = Limit(0.7 * exact, "relative", -2.0).bounds(coarse, fine)
    assert 0.7 * exact < lower <= exact
    assert upper > 2 * exact
    assert estimate == pytest.approx(exact, rel=0.1)


@pytest.mark.parametrize("power", [1, -1])
@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_which_end_is_coarse_shows_by_itself(power: int, scale: float) -> None:
    search = Search(0.05, 0.001 * scale, scale)
    trials: list[Trial] = []
    while sizes := search.next(trials):
        for size in sizes:
            # Meshes become coarser with the length, or with its inverse.
            length = (size / scale) ** power * (1 if power > 0 else 0.001)
            trials.append(Trial(size, math.ceil(100 / length), length, length, length, length <= 0.05))
    found = search.bracket(trials)
    assert found.best is not None
    assert found.failed is not None
    assert 0.05 / 1.0501 <= found.best.estimate <= 0.05 < found.failed.estimate
    assert len(trials) <= 10


def test_neither_end_is_passed_over() -> None:
    search = Search(1.0, 4, 5000, is_whole=True, larger_is_coarser=False)
    coarsest = search.bracket(trials_of(search, lambda n: 1e-9))
    assert coarsest.best is not None
    assert (coarsest.best.size, coarsest.failed) == (4, None)
    finest = search.bracket(trials_of(search, lambda n: 0.0 if n == 5000 else 7.0))
    assert finest.best is not None
    assert finest.failed is not None
    assert finest.best.size == 5000 <= 1.05 * finest.failed.size
    nothing = trials_of(search, lambda n: 7.0)
    assert search.bracket(nothing).best is None
    assert max(one.size for one in nothing) == 5000
    # There is nothing between the ends.
    assert trials_of(Search(1.0, 4, 4, is_whole=True, larger_is_coarser=False), lambda n: 7.0)[0].size == 4


def test_a_finer_mesh_that_is_farther_away_is_told() -> None:
    search = Search(1.0, 4, 10_000, is_whole=True, larger_is_coarser=False)
    trials = trials_of(search, lambda n: 500 / n)
    assert search.bracket(trials).is_monotone
    spoiled = Trial(5000, 5000, 2.0, 2.0, 2.0)
    found = search.bracket([*trials, spoiled])
    assert not found.is_monotone
    # The coarser mesh holds nevertheless.
    assert found.best == search.bracket(trials).best


def test_a_size_that_cannot_be_made_counts_as_failed() -> None:
    search = Search(1.0, 4, 10_000, is_whole=True, larger_is_coarser=False)
    found = search.bracket(trials_of(search, lambda n: math.nan if n < 900 else 500 / n))
    assert found.best is not None
    assert found.failed is not None
    assert found.failed.reason == "no mesh"
    assert found.failed.size < 900 <= found.best.size <= 1.05 * found.failed.size + 1
    # Nothing can be made at all: it ends, and has tried the finest.
    nothing = trials_of(search, lambda n: math.nan)
    assert max(one.size for one in nothing) == 10_000
    assert search.bracket(nothing).best is None


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("seed", range(20))
def test_a_size_that_fails_alone_is_passed_by(seed: int, count: int) -> None:
    # One of the sizes that the search tries fails, and all others can be made: each of them in turn.
    rng = np.random.default_rng(seed)
    fewest = float(np.exp(rng.uniform(np.log(100), np.log(9e3))))
    first = fewest * np.exp(rng.uniform(-1.2, 1.2))
    search = Search(1.0, 4, 20_000, is_whole=True, larger_is_coarser=False, first=first)

    def distance(size: float) -> float:
        return float((fewest / size) ** 0.9)

    tried = trials_of(search, distance, count)
    for bad in {one.size for one in tried}:
        trials = trials_of(search, lambda n, bad=bad: math.nan if n == bad else distance(n), count)  # type: ignore[misc]
        found = search.bracket(trials)
        assert found.best is not None
        # A width beside the bad size, where that one would have been the best.
        assert fewest <= found.best.size <= 1.15 * fewest
        assert len(trials) <= len(tried) + (5 if count == 1 else 9)


@pytest.mark.parametrize("seed", range(40))
def test_sizes_that_cannot_be_made_do_not_hold_up_the_search(seed: int) -> None:
    # None of a whole range of sizes, up to seven times wide, can be made, but the finest one can.
    rng = np.random.default_rng(seed)
    fewest, low, wide = np.exp(rng.uniform(np.log([6, 4, 1.1]), np.log([9e3, 1e3, 7])))
    search = Search(3 / fewest, 4, 10_000, True, larger_is_coarser=False, first=fewest * np.exp(rng.uniform(-1.2, 1.2)))
    trials = trials_of(search, lambda n: math.nan if low <= n <= low * wide else 3 / n)
    found = search.bracket(trials)
    assert found.best is not None
    assert len(trials) < 14
    if found.failed is not None:
        assert found.best.size <= max(1.0501 * found.failed.size, found.failed.size + 1)


@pytest.mark.parametrize("larger_is_coarser", [True, False, None])
@pytest.mark.parametrize("value", [math.nan, 7.0])
def test_what_fails_alike_at_all_sizes_ends_the_search_soon(value: float, larger_is_coarser: bool | None) -> None:
    search = Search(1.0, 1, 10**7, larger_is_coarser=larger_is_coarser)
    trials: list[Trial] = []
    while sizes := search.next(trials):
        made = math.inf if value != value else value
        trials += [Trial(size, 80 * (value == value), made, made, made) for size in sizes]
    # Of meshes of equal size, none is the finest.
    finest = {True: {1.0}, False: {1e7}, None: {1.0, 1e7} if value != value else {1.0}}[larger_is_coarser]
    assert finest <= {one.size for one in trials}
    assert len(trials) <= 5


@pytest.mark.parametrize("is_all", [True, False])
def test_the_finest_size_is_the_mesh_itself_and_the_next_one_is_tried(is_all: bool) -> None:
    # A remesher that makes nothing, or nothing of less than a third of the triangles.
    def distance(size: float) -> float:
        return 0.0 if size == 10**6 else math.nan if is_all or size < 3e5 else 1e5 / size

    search = Search(1.0, 4, 10**6, is_whole=True, larger_is_coarser=False, first=1000)
    trials = trials_of(search, distance)
    found = search.bracket(trials)
    assert found.best is not None
    assert found.failed is not None
    assert found.best.size <= 1.0501 * found.failed.size
    assert found.best.size == 10**6 if is_all else found.best.size < 3.2e5
    assert len(trials) <= (5 if is_all else 14)


@pytest.mark.parametrize("power", [1, -1])
def test_sizes_at_either_end_are_found_where_all_others_fail(power: int) -> None:
    # It is not known which end is coarse, and only a hundredth of the range can be made.
    search = Search(1.0, 0.001, 1.0)
    trials: list[Trial] = []
    while sizes := search.next(trials):
        for size in sizes:
            length = size if power > 0 else 0.001 / size
            made = (math.ceil(1 / length), *(100 * length,) * 3, True) if length < 0.01 else ()
            trials.append(Trial(size, *made))
    assert search.bracket(trials).best is not None


def test_a_closer_bracket_goes_on_from_the_same_trials() -> None:
    wide = Search(1.0, 4, 10_000, is_whole=True, larger_is_coarser=False)
    trials = trials_of(wide, lambda n: 500 / n)
    narrow = Search(1.0, 4, 10_000, is_whole=True, larger_is_coarser=False, precision=0.001)
    assert wide.next(trials) == ()
    assert narrow.next(trials) != ()
    best = narrow.bracket(trials_of(narrow, lambda n: 500 / n)).best
    assert best is not None
    assert best.size == 500


@pytest.mark.parametrize("ends", [(0, 1), (2, 1), (-1.0, 1.0), (1.0, math.inf), (math.nan, 1.0)])
def test_ranges_without_logarithms_are_refused(ends: tuple[float, float]) -> None:
    with pytest.raises(sb.errors.InputError, match="two positive numbers"):
        Search(1.0, *ends)
    with pytest.raises(sb.errors.InputError, match="precision"):
        Search(1.0, 1, 2, precision=1.5)
