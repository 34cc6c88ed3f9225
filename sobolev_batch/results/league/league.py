"""A league: the methods of a collection, ranked by their distances to the references over all objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
import pandas as pd

from sobolev_batch.errors import InputError
from sobolev_batch.results.league.curves import Curve, Scores
from sobolev_batch.results.league.intervals import SIGNIFICANCE, Interval, adjusted, sign_flip_test, within_objects
from sobolev_batch.results.league.objects import AnyCollection, stores_of
from sobolev_batch.results.tables.convergence import tables_of
from sobolev_batch.results.tables.sizes import EDGE_LENGTH
from sobolev_batch.spectral.shells import Orders
from sobolev_batch.surfaces.sources.names import quoted


@dataclass(frozen=True, eq=False)
class League:
    """The methods of a collection, compared over its objects at one order. Make it by `league`.

    Attributes:
        order: Sobolev order s.
        x: Size at which methods are compared, such as "triangles".
        scores: Logarithms of relative distances, by object and method.
        curves: Curve of each method over the sizes, by object and method.
        edge_curves: The same over the edge length, from which rates follow.

    >>> import sobolev_batch as sb
    >>> alone = {"sphere": "storage/icosphere.zarr"}
    >>> (at_order,) = sb.league(alone, -10)
    >>> at_order.x, at_order.scores.methods, len(at_order.pairs)
    ('triangles', ('icosphere',), 0)
    """

    order: float
    x: str
    scores: Scores
    curves: Mapping[str, Mapping[str, Curve]]
    edge_curves: Mapping[str, Mapping[str, Curve]]

    @cached_property
    def table(self) -> pd.DataFrame:
        """Methods from the nearest to the farthest, one row each.

        Columns: rank and last_rank, the best and the worst place that the interval of the method allows; method;
        objects, their number; relative, the geometric mean of its relative distances at equal sizes, with the ends low
        and high of its interval; rate, the mean observed order of convergence in the edge length, with rate_low and
        rate_high.
        """
        scores, methods = self.scores, self.scores.methods
        count = len(scores.objects)
        spreads = within_objects(scores.values) if count > 1 else np.full(len(methods), np.nan)
        rows = []
        for k, method in enumerate(methods):
            interval = Interval.of(scores.values[:, k], scores.errors[:, k], spreads[k]).exp()
            rate = self._rate(method)
            rows.append(
                {
                    "method": method,
                    "objects": count,
                    "relative": interval.mean,
                    "low": interval.low,
                    "high": interval.high,
                    "rate": rate.mean,
                    "rate_low": rate.low,
                    "rate_high": rate.high,
                }
            )
        frame = pd.DataFrame(rows).sort_values("relative", kind="stable", ignore_index=True)
        low, high = frame["low"].to_numpy(), frame["high"].to_numpy()
        # Where there are no intervals, any place is possible.
        frame.insert(0, "rank", [1 + int(np.sum(high < one)) for one in low])
        frame.insert(1, "last_rank", [len(frame) - int(np.sum(low > one)) for one in high])
        return frame

    @cached_property
    def pairs(self) -> pd.DataFrame:
        """Each two methods, compared on the same objects.

        Columns: method, other; ratio, the geometric mean over the objects of the ratio of their distances at equal
        sizes, with the ends low and high of its interval; p, the p-value of the paired permutation test, adjusted for
        the number of pairs (Holm); nearer, the method that is nearer by this test at the level of 5 %, or nothing.
        """
        scores, rows = self.scores, []
        for i, j in combinations(range(len(scores.methods)), 2):
            differences = scores.values[:, i] - scores.values[:, j]
            errors = scores.errors[:, i] + scores.errors[:, j]
            interval = Interval.of(differences, errors).exp()
            rows.append(
                {
                    "method": scores.methods[i],
                    "other": scores.methods[j],
                    "ratio": interval.mean,
                    "low": interval.low,
                    "high": interval.high,
                    "p": sign_flip_test(differences, errors),
                }
            )
        columns = ["method", "other", "ratio", "low", "high", "p"]
        frame = pd.DataFrame(rows, columns=columns)
        frame["p"] = adjusted(frame["p"].to_numpy(dtype=np.float64))
        nearer = np.where(frame["ratio"] < 1, frame["method"], frame["other"])
        frame["nearer"] = np.where(frame["p"] < SIGNIFICANCE, nearer, "")
        return frame

    def _repr_html_(self) -> str:
        count = len(self.scores.objects)
        frames = [self.table, *([self.pairs] if len(self.pairs) else [])]
        # pandas escapes the names of methods.
        tables = "".join(frame.to_html(index=False, float_format="{:.3g}".format) for frame in frames)
        caption = f"League at order {self.order:g}, over {count} object{'s' if count > 1 else ''}"
        return f"<div><strong>{caption}</strong>{tables}</div>"

    def _rate(self, method: str) -> Interval:
        slopes = [self.edge_curves[name][method].slope() for name in self.scores.objects]
        known = np.array([slope for slope in slopes if np.isfinite(slope[0])], dtype=np.float64).reshape(-1, 2)
        return Interval.of(known[:, 0], known[:, 1])


def league(
    store: AnyCollection,
    order: Orders | None = None,
    *,
    x: str = "triangles",
    methods: Sequence[str] | None = None,
) -> tuple[League, ...]:
    """Rank the methods of a collection over its objects, for each order.

    Methods are the families that the objects have in common. On each object, they are compared at equal sizes: at sizes
    evenly spaced over the range that all of them have, with straight lines on logarithmic axes between their meshes.
    docs/leagues.md explains the intervals and the test.

    Args:
        store: Path or URL of the store of a collection; or stores of single objects by the name of the object.
        order: One of the stores' orders, or several; default all.
        x: Size of a mesh: "triangles", "vertices", "edge_length", or a number among the metadata of the meshes, such as
            the seconds that a method took.
        methods: Names of the methods to compare; default all.

    Returns:
        A league for each order, with the tables `League.table` and `League.pairs`.

    Raises:
        InputError: There are no tables yet, an order, size or method is unknown, or no object has all methods.
        StoreError: The location has no store.

    >>> import sobolev_batch as sb
    >>> collection = sb.StudyCollection.from_table({
    ...     "study": {"name": "balls"},
    ...     "lattice": {"xi_max": 3.0, "M": 16},
    ...     "norm": {"orders": [-2.0]},
    ...     "object": [
    ...         {"name": "ball", "reference": {"source": "sphere"}},
    ...         {"name": "large", "reference": {"source": "sphere", "radius": 1.1}, "scaling": {"mode": "none"}},
    ...     ],
    ...     "family": [
    ...         {"name": "ico", "source": "icosphere", "levels": [1, 2]},
    ...         {"name": "egg", "source": "ellipsoid-levels", "axes": [1.0, 1.0, 0.7], "levels": [1, 2]},
    ...     ],
    ... })
    >>> summary = sb.run(collection, "memory://league-example.zarr", workers=1)
    >>> (at_order,) = sb.league("memory://league-example.zarr")
    >>> at_order.table["method"].tolist(), at_order.scores.objects
    (['ico', 'egg'], ('ball', 'large'))
    """
    stores, objects = stores_of(store)
    return leagues_of(tables_of(stores, order), objects, x=x, methods=methods)


def leagues_of(
    tables: Mapping[str, pd.DataFrame],
    objects: Sequence[str],
    *,
    x: str = "triangles",
    methods: Sequence[str] | None = None,
) -> tuple[League, ...]:
    """Rank methods by the rows of `table` of each object that has some, among all objects; see `league`."""
    orders = list(dict.fromkeys(s for frame in tables.values() for s in frame["order"]))
    families = list(dict.fromkeys(family for frame in tables.values() for family in frame["family"]))
    chosen = families if methods is None else list(methods)
    unknown = next((method for method in chosen if method not in families), None)
    if unknown is not None:
        raise InputError(f"no method is named {quoted(unknown)}; known are {', '.join(families)}")
    unfinished = dict.fromkeys((name for name in objects if name not in tables), "it has no tables yet")
    return tuple(_league(tables, s, x, chosen, unfinished) for s in orders)


def _league(
    tables: Mapping[str, pd.DataFrame], order: float, x: str, methods: Sequence[str], unfinished: Mapping[str, str]
) -> League:
    at_order = {name: frame[frame["order"] == order] for name, frame in tables.items()}
    curves = _curves(at_order, x, methods)
    scores = Scores.of(curves, methods, unfinished)
    if not scores.objects:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(scores.left_out.items())[:3])
        raise InputError(
            f"no object can serve to compare the methods {', '.join(methods)} ({reasons}); compare fewer methods"
        )
    return League(order, x, scores, curves, _curves(at_order, EDGE_LENGTH, methods))


def _curves(tables: Mapping[str, pd.DataFrame], x: str, methods: Sequence[str]) -> dict[str, dict[str, Curve]]:
    """Return the curves of all objects and methods that have distances."""
    curves: dict[str, dict[str, Curve]] = {}
    for name, frame in tables.items():
        by_method = {method: Curve.of(frame[frame["family"] == method], x) for method in methods}
        curves[name] = {method: curve for method, curve in by_method.items() if curve is not None}
    return curves
