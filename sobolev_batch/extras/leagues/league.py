"""A league: the methods of a study, ranked over all objects, and as text."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Literal, overload

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import InputError, StoreError
from sobolev_batch.extras.leagues import statistics
from sobolev_batch.extras.leagues.costs import DEFAULT_COST, LACKS_TABLES, CostLeague, cost_leagues_of, objects_text
from sobolev_batch.extras.leagues.statistics import EDGE_LENGTH, Curve, common_sizes
from sobolev_batch.norms.accuracy.tolerance import NEXT_TO_EQUAL
from sobolev_batch.norms.columns import NUMBER, VARIABLES
from sobolev_batch.parameters import as_names, check_choice
from sobolev_batch.shown import shown_tables
from sobolev_batch.sources.names import quoted
from sobolev_batch.tables import Format
from sobolev_batch.tables.convergence import tables_of
from sobolev_batch.tables.open import AnyStores, as_tree, objects_of, root_attribute, source_of
from sobolev_batch.tables.rendering import Column, Section, rendered
from sobolev_batch.tables.text import number_text, times, wrapped
from sobolev_batch.transform.lattice import Orders

_MEANS_NOTE = """\
Numbers ({y}) are geometric means over the objects, at equal {x}, with 95 % intervals. Rates are slopes over the edge
length."""
_RANKS_NOTE = """
The intervals tell how methods compare: they hold the errors of the numbers, and not that some objects are harder than
others. A rank such as 1-3 says which places the intervals allow. Two methods differ where the permutation test of pairs
says so, at the level of 5 % for all pairs together. Pairs are compared at the sizes and over the objects that both
have."""

# What methods are compared by unless another number is named.
RELATIVE = "relative"
# Objects that serve no league are told with their reasons, so many of them.
_MOST_REASONS = 3
ENDS = ("low", "high")


def percent_text(value: float) -> str:
    """Return a fraction in per cent, as `number_text` does."""
    return number_text(100 * value, " %")


def interval_text(shown: Callable[[float], str]) -> Callable[[float, float], str]:
    """Return the format of intervals, with ? for an end that nothing bounds."""
    return lambda low, high: f"{shown(low)} to {shown(high)}"


def league_columns(y: str) -> tuple[Column, ...]:
    """Return the columns of `League.table` for people."""
    shown = percent_text if y == RELATIVE else number_text
    return (
        Column("method", "method", kind="label"),
        Column("rank", "rank", lambda first, last: f"{first}" if first == last else f"{first}-{last}", "last_rank"),
        Column(y, y, shown),
        Column("low", "95 % interval", interval_text(shown), "high"),
        Column("rate", "rate", number_text),
        Column("rate_low", "95 % interval", interval_text(number_text), "rate_high"),
        Column("objects", "objects"),
    )


PAIR_COLUMNS = (
    Column("method", "method", kind="label"),
    Column("other", "other", kind="text"),
    Column("ratio", "ratio", number_text),
    Column("low", "95 % interval", interval_text(number_text), "high"),
    Column("p", "p", "{:.2g}".format),
    Column("nearer", "nearer", kind="text"),
    Column("objects", "objects"),
)


@dataclass(frozen=True, eq=False, repr=False)
class League:
    """The methods of a study, compared over its objects at one order. Make it by `league`.

    Attributes:
        order: Sobolev order s.
        x: Size at which methods are compared, such as "triangles".
        y: What they are compared by, such as "relative" or "hausdorff".
        objects: Names of the objects that have two methods at least.
        methods: Names of the methods.
        left_out: Why other objects, whole methods (method NAME), and single methods of an object (object/method), are
            not there, by name.
        curves: The meshes of each method, for each object: logarithms of sizes and numbers, and errors of these.
        known: Which methods (objects, methods) each object has.
        sizes: Logarithms of the sizes (objects, sizes) at which the methods are compared.
        values_at: Logarithms of the numbers (objects, methods, sizes). Those that are not known follow from the others
            of the object, and the mean ratios to these.
        errors_at: Bounds on the errors of these.
        slopes: Observed rates in the edge length, and bounds on their errors (objects, methods, 2); NaN without one.

    >>> import sobolev_batch as sb
    >>> (at_order,) = sb.league({"sphere": "storage/icosphere.zarr"}, -10)
    >>> at_order
    <League at order -10, over 1 object: icosphere>
    >>> at_order.x, at_order.methods, len(at_order.pairs)
    ('triangles', ('icosphere',), 0)
    """

    order: float
    x: str
    y: str
    objects: tuple[str, ...]
    methods: tuple[str, ...]
    left_out: Mapping[str, str]
    curves: Mapping[str, Mapping[str, Curve]]
    known: NDArray[np.bool_]
    sizes: Reals
    values_at: Reals
    errors_at: Reals
    slopes: Reals

    @property
    def values(self) -> Reals:
        """Logarithms of the numbers (objects, methods), averaged over the sizes."""
        return np.asarray(self.values_at.mean(axis=-1))

    @property
    def errors(self) -> Reals:
        """Bounds (objects, methods) on the errors of these."""
        return np.asarray(self.errors_at.mean(axis=-1))

    def mean_curve(self, method: str) -> tuple[Reals, Reals]:
        """Return sizes (n,), and means over the objects with the ends of their intervals (n, 3), as in the table."""
        i, at_sizes = self.methods.index(method), np.stack([self.values_at, self.errors_at]).transpose(3, 0, 1, 2)
        spreads = [statistics.within_objects(values)[i] for values, _ in at_sizes]
        means = list(map(statistics.interval, at_sizes[:, 0, :, i], at_sizes[:, 1, :, i], spreads))
        return np.exp(self.sizes.mean(axis=0)), np.exp(means)

    @property
    def caption(self) -> str:
        """Caption of its table."""
        of, at = ("", f" at order {self.order:g}") if self.y == RELATIVE else (f" by {self.y}", "")
        return f"League{of}{at}, over {objects_text(len(self.objects))}"

    @cached_property
    def table(self) -> pd.DataFrame:
        """Methods from the nearest to the farthest, one row each.

        Columns: rank and last_rank, the best and the worst place that the interval of the method allows; method;
        objects, the number of those that have it; by its name, as "relative", the geometric mean of its numbers at
        equal sizes, with the ends low and high of its interval; rate, the mean observed order of convergence in the
        edge length, with rate_low and rate_high.
        """
        spreads = statistics.within_objects(self.values)
        slopes = [of_method[np.isfinite(of_method[:, 0])] for of_method in self.slopes.swapaxes(0, 1)]
        frame = pd.DataFrame({"method": self.methods, "objects": self.known.sum(axis=0)})
        frame[[self.y, *ENDS]] = np.exp(list(map(statistics.interval, self.values.T, self.errors.T, spreads)))
        frame[["rate", "rate_low", "rate_high"]] = [statistics.interval(*of_method.T) for of_method in slopes]
        frame = frame.sort_values(self.y, kind="stable", ignore_index=True)
        low, high = frame["low"].to_numpy(), frame["high"].to_numpy()
        # Where there are no intervals, any place is possible.
        frame.insert(0, "rank", [1 + int(np.sum(high < end)) for end in low])
        frame.insert(1, "last_rank", [len(frame) - int(np.sum(low > end)) for end in high])
        return frame

    @cached_property
    def pairs(self) -> pd.DataFrame:
        """Each two methods, compared over the objects that have both, at the sizes that both have there.

        Columns: method, other; ratio, the geometric mean over the objects of the ratio of their numbers at equal
        sizes, with the ends low and high of its interval; p, the p-value of the paired permutation test, adjusted for
        the number of pairs (Holm); nearer, the method with the smaller numbers by this test at the level of 5 %, or
        nothing; objects, the number of those compared.
        """
        rows = []
        for first, second in combinations(self.methods, 2):
            pairs = [(one[first], one[second]) for one in self.curves.values() if {first, second} <= one.keys()]
            found = [(*a.at(sizes), *b.at(sizes)) for a, b in pairs if (sizes := common_sizes([a, b])) is not None]
            means = np.reshape(found, (len(found), 4, -1)).mean(axis=2) if found else np.empty((0, 4))
            differences, errors = means[:, 0] - means[:, 2], means[:, 1] + means[:, 3]
            ratio = np.exp(statistics.interval(differences, errors))
            rows.append([first, second, *ratio, statistics.sign_flip_test(differences, errors), len(found)])
        frame = pd.DataFrame(rows, columns=["method", "other", "ratio", *ENDS, "p", "objects"])
        frame["p"] = statistics.adjusted(frame["p"].to_numpy(dtype=np.float64))
        nearer = np.where(frame["ratio"] < 1, frame["method"], frame["other"])
        frame["nearer"] = np.where(frame["p"] < statistics.SIGNIFICANCE, nearer, "")
        return frame

    def verdict(self, order_text: Callable[[float], str] = "{:g}".format) -> str:
        """Return a sentence on the nearest method, as far as intervals and the test permit it; nothing of others."""
        if self.y != RELATIVE:
            return ""
        names, count = self.table["method"].tolist(), len(self.objects)
        leaders = self.table["method"][self.table["rank"] == 1].tolist()
        first, amount = names[0], percent_text(self.table[RELATIVE][0]).replace(" ", "\N{NO-BREAK SPACE}")
        over = f"over {count} objects" if count > 1 else f"on {self.objects[0]}"
        over += f" at order {order_text(self.order)}"
        if len(names) == 1:
            return f"{first} differs from the references by {amount} {over}."
        if len(leaders) == 1 and (self.pairs["nearer"] == first).sum() == len(names) - 1:
            return f"{first} is nearest to the references {over}: it differs by {amount}."
        if len(leaders) == 1:
            doubt = "but the test of pairs does not tell it from all others"
            return f"{first} has the smallest mean {over}, {amount}, {doubt}."
        if count == 1:
            return f"{first} is nearest {over}: it differs by {amount}. One object ranks no methods."
        named = f"{', '.join(leaders[:-1])} and {leaders[-1]}"
        among = named if len(leaders) <= _MOST_REASONS else f"{len(leaders)} of {len(names)} methods"
        return f"The intervals do not separate {among} {over}. {first} has the smallest mean, {amount}."

    def __str__(self) -> str:
        """Return what `sobolev-batch table league` prints of it."""
        return format_league([self])

    def __repr__(self) -> str:
        return f"<{self.caption}: {', '.join(self.table['method'])}>"

    def _repr_html_(self) -> str:
        return shown_tables(self.caption, self.table, self.pairs)


@overload
def league(
    store: AnyStores,
    order: Orders | None = None,
    *,
    by: Literal["size"] = "size",
    x: str | None = None,
    y: str = RELATIVE,
    methods: Sequence[str] | None = None,
) -> tuple[League, ...]: ...


@overload
def league(
    store: AnyStores,
    order: Orders | None = None,
    *,
    by: Literal["cost"],
    x: str | None = None,
    methods: Sequence[str] | None = None,
) -> tuple[CostLeague, ...]: ...


def league(
    store: AnyStores,
    order: Orders | None = None,
    *,
    by: Literal["size", "cost"] = "size",
    x: str | None = None,
    y: str = RELATIVE,
    methods: Sequence[str] | None = None,
) -> tuple[League, ...] | tuple[CostLeague, ...]:
    """Rank the methods of a study over its objects, for each order.

    Methods are families. On each object, they are compared at equal sizes: at sizes evenly spaced over the range that
    all of them have, with straight lines on logarithmic axes between their meshes. A method that an object lacks, or
    has at other sizes, is compared over the other objects.
    By cost, they need nothing in common: what counts are the meshes that no other one of the object beats in both its
    distance and its cost. docs/leagues.md explains the intervals and the test.

    Args:
        store: Path or URL of the store of several objects, or what `open_store` made of it; or stores of single objects
            by the name of the object. By cost, also the store of one object.
        order: One of the stores' orders, or several; default all.
        by: What methods are compared by, "size" or "cost".
        x: Size or cost of a mesh: "triangles" (the default by size), "vertices", "edge_length", "make_seconds" (the
            default by cost), "make_cpu_seconds", "make_peak_bytes", or a number among the metadata of the meshes, such
            as the seconds that a method took.
        y: What methods are compared by, a column of `table` of which less is better: "relative", "hausdorff", "rms",
            "make_seconds", "triangles" (of searched families, at equal x="target_tolerance") and so on. Its errors are
            those of the column with _error. One that is the same at all orders has one league.
        methods: Names of the methods to compare; default all.

    Returns:
        A league for each order: with the tables `League.table` and `League.pairs`, or by cost with `CostLeague.table`,
        `CostLeague.means` and `CostLeague.meshes`.

    Raises:
        InputError: There are no tables yet, an order, size or method is unknown, no objects connect methods, or no mesh
            has the cost.
        StoreError: The location has no store.

    >>> import sobolev_batch as sb
    >>> (at_order,) = sb.league({"sphere": "storage/icosphere.zarr"}, -10)
    >>> at_order.table[["method", "objects"]].to_dict("records")
    [{'method': 'icosphere', 'objects': 1}]
    >>> (by_cost,) = sb.league("storage/icosphere.zarr", -10, by="cost", x="triangles")
    >>> by_cost.means[["member", "triangles", "front"]].round(1).to_dict("list")
    {'member': ['0', '1', '2', '3'], 'triangles': [20.0, 80.0, 320.0, 1280.0], 'front': [True, True, True, True]}
    """
    check_choice("by", by, ("size", "cost"))
    objects = objects_of(store)
    if not objects and by == "size":
        place = source_of(store) if isinstance(store, xr.DataTree) else store
        raise StoreError(
            f"{place}: it does not hold several objects; take a store that does, or several stores by their names"
        )
    if not objects:
        tree = as_tree(store)  # type: ignore[arg-type]  # stores by name have objects
        objects = (str(root_attribute(tree, "study")["name"]),)
        store = {objects[0]: tree}
    tables = tables_of(store, order)
    if by == "cost":
        chosen = chosen_methods(tables.values(), methods)
        return cost_leagues_of(tables, objects, chosen, DEFAULT_COST if x is None else x)
    return leagues_of(tables, objects, x="triangles" if x is None else x, y=y, methods=methods)


def leagues_of(
    tables: Mapping[str, pd.DataFrame],
    objects: Sequence[str],
    *,
    x: str = "triangles",
    y: str = RELATIVE,
    methods: Sequence[str] | None = None,
) -> tuple[League, ...]:
    """Rank methods by the rows of `table` of each object that has some, among all objects; see `league`."""
    x, y = as_names((x, y))
    if x == y:
        raise InputError(f"all methods have the same {y} at equal {x}; choose another x, such as target_tolerance")
    chosen = chosen_methods(tables.values(), methods)
    unfinished = dict.fromkeys((name for name in objects if name not in tables), LACKS_TABLES)
    return tuple(_league(tables, s, x, y, chosen, unfinished) for s in orders_of(tables.values(), y))


def orders_of(frames: Iterable[pd.DataFrame], y: str) -> list[float]:
    """Return the orders of tables; the first one alone if a number is the same at all of them."""
    orders = list(dict.fromkeys(s for frame in frames for s in frame["order"]))
    is_same = all(y in frame and frame.groupby("mesh")[y].nunique().le(1).all() for frame in frames)
    return orders[:1] if y != RELATIVE and is_same else orders


def chosen_methods(frames: Iterable[pd.DataFrame], methods: str | Sequence[str] | None) -> list[str]:
    """Return the methods to compare, default all of some tables; InputError where one is unknown."""
    families = list(dict.fromkeys(family for frame in frames for family in frame["family"]))
    chosen = families if methods is None else as_names(methods)
    if not chosen:
        raise InputError(f"there are no methods to compare; known are {', '.join(families)}")
    for method in chosen:
        if method not in families:
            raise InputError(f"no method is named {quoted(method)}; known are {', '.join(families)}")
    return chosen


def _league(
    tables: Mapping[str, pd.DataFrame], order: float, x: str, y: str, methods: Sequence[str], absent: Mapping[str, str]
) -> League:
    rows: dict[str, tuple[Reals, Reals, Reals, Reals]] = {}
    of_objects: dict[str, dict[str, Curve]] = {}
    left_out, least = dict(absent), np.log(NEXT_TO_EQUAL) if y == RELATIVE else -np.inf
    for name, frame in tables.items():
        found = _curves(frame, order, x, y, methods)
        curves = {method: curve for method, curve in found.items() if np.all(curve.values >= least)}
        of_objects[name], in_common = curves, _with_common_sizes(curves)
        lacking = [method for method in methods if method not in in_common]
        why = {method: f"no {y if y != RELATIVE else 'distance'} of {method}" for method in methods}
        why |= {method: f"{method} reproduced it, up to rounding" for method in found}
        if curves:
            why |= dict.fromkeys(curves, statistics.gap_of(curves))
        common = common_sizes([*in_common.values()]) if in_common else None
        if common is None or len(in_common) < min(2, len(methods)):
            left_out[name] = "; ".join(dict.fromkeys(why[method] for method in lacking or methods))
            continue
        left_out |= {f"{name}/{method}": why[method] for method in lacking}
        at = {method: curve.at(common) for method, curve in in_common.items()}
        missing = np.full((2, len(common)), np.nan)
        values, errors = np.array([at.get(method, missing) for method in methods]).swapaxes(0, 1)
        slopes = {method: curve.slope() for method, curve in _curves(frame, order, EDGE_LENGTH, y, methods).items()}
        rows[name] = common, values, errors, np.array([slopes.get(method, (np.nan, np.nan)) for method in methods])
    if rows:
        sizes, values, errors, slopes_of = (np.array(parts) for parts in zip(*rows.values(), strict=True))
        is_known = np.isfinite(values).all(axis=2)
        parts = connected_components(is_known.T.astype(int) @ is_known)[1]
        counts = np.bincount(parts)
        if len(counts) == 1:
            values = np.stack([statistics.filled(at_size) for at_size in values.transpose(2, 0, 1)], axis=2)
            errors = np.where(np.isnan(errors), np.nanmean(errors, axis=0), errors)
            at_sizes = sizes, values, errors, slopes_of
            return League(order, x, y, tuple(rows), tuple(methods), left_out, of_objects, is_known, *at_sizes)
        if np.sum(counts == counts.max()) == 1:
            # Objects that have two methods at common sizes connect these; the league has the largest group.
            connected = [method for method, part in zip(methods, parts, strict=True) if part == counts.argmax()]
            reason = "no object connects it with the methods that are compared"
            others = {f"method {method}": reason for method in methods if method not in connected}
            return _league(tables, order, x, y, connected, {**absent, **others})
    # Those with tables tell more.
    tell_most = sorted(left_out.items(), key=lambda item: item[0] in absent)
    reasons = "; ".join(f"{name}: {reason}" for name, reason in tell_most[:_MOST_REASONS])
    if (more := len(tell_most) - _MOST_REASONS) > 0:
        reasons += f"; {more:,} more"
    raise InputError(
        f"no objects can serve to compare the methods {', '.join(methods)} ({reasons}); compare fewer methods, "
        'or compare them by cost (table league --by cost, in Python by="cost")'
    )


def _with_common_sizes(curves: Mapping[str, Curve]) -> dict[str, Curve]:
    """Return the curves of most methods, as far as they have sizes in common: those farthest from the others go."""
    kept = dict(curves)
    while len(kept) > 2 and common_sizes([*kept.values()]) is None:
        middles = {method: (curve.sizes[0] + curve.sizes[-1]) / 2 for method, curve in kept.items()}
        center = float(np.median([*middles.values()]))
        del kept[max(middles, key=lambda method: abs(middles[method] - center))]
    return kept


def _curves(frame: pd.DataFrame, order: float, x: str, y: str, methods: Sequence[str]) -> dict[str, Curve]:
    """Return the curve at an order of each method that has numbers for an object."""
    sizes, (values, errors) = statistics.sizes_of(frame, x), statistics.numbers_of(frame, y)
    known = np.flatnonzero((frame["order"].to_numpy() == order) & np.isfinite(sizes) & np.isfinite(values))
    by_size = known[np.argsort(sizes[known], kind="stable")]
    families = frame["family"].to_numpy()[by_size]
    with np.errstate(divide="ignore", invalid="ignore"):
        numbers = np.stack([np.log(sizes), np.log(values), statistics.errors_of_logarithms(values, errors)])[:, by_size]
    return {method: Curve(*numbers[:, families == method]) for method in methods if method in families}


def format_league(leagues: Sequence[League], style: Format = "text") -> str:
    """Return leagues as text; see `league`."""
    frame = pd.concat([one.table.assign(order=one.order) for one in leagues], ignore_index=True)
    sections = [Section(sentences=[line for one in leagues for line in wrapped(one.verdict())])]
    sections += [Section(one.caption, [(league_columns(one.y), one.table)], pair_lines(one)) for one in leagues]
    notes = wrapped(league_note(leagues))
    notes += [f"{name} is left out{where}: {reason}." for name, where, reason in left_out(leagues)]
    return rendered(style, frame[["order", *frame.columns.drop("order")]], sections, notes)


def league_note(leagues: Sequence[League]) -> str:
    """Return how to read leagues at one size; of a single method, nothing on ranks and pairs."""
    ranks = _RANKS_NOTE if any(len(one.methods) > 1 for one in leagues) else ""
    # Tables show no units.
    units = {one.y: VARIABLES.get(one.y, {}).get("units", NUMBER) for one in leagues}
    numbers = ", ".join(y if unit == NUMBER else f"{y} in {unit}" for y, unit in units.items())
    return _MEANS_NOTE.format(x=leagues[0].x, y=numbers) + ranks


def left_out(leagues: Sequence[League]) -> Iterator[tuple[str, str, str]]:
    """Yield the objects that leagues leave out, at which of their orders (nothing for all of them), and why."""
    orders: dict[tuple[str, str], list[float]] = {}
    for one in leagues:
        for name, reason in one.left_out.items():
            orders.setdefault((name, reason), []).append(one.order)
    for (name, reason), at in orders.items():
        where = "" if len(at) == len(leagues) else f" at order {', '.join(f'{s:g}' for s in at)}"
        yield name, where, reason


def pair_lines(league: League) -> list[str]:
    """Return a line for each pair of methods that differ, those of the nearest method first."""
    lines, places, pairs = [], league.table["method"].tolist(), league.pairs[league.pairs["nearer"] != ""]
    for row in pairs.sort_values("nearer", key=lambda names: names.map(places.index), kind="stable").itertuples():
        farther, ratio = (row.other, 1 / row.ratio) if row.nearer == row.method else (row.method, row.ratio)
        less = "is {} times nearer than" if league.y == RELATIVE else f"has {{}} times less {league.y} than"
        lines.append(f"{row.nearer} {less.format(times(ratio))} {farther} (p = {row.p:.2g}).")
    count, methods = len(league.objects), len(league.table)
    if not lines and methods > 1:
        least = statistics.least_objects(len(league.pairs))
        few = f"The test cannot tell {methods} methods from chance with {objects_text(count)}; take {least} or more."
        lines.append("No two methods differ beyond chance and error." if count >= least else few)
    return lines
