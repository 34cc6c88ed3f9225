"""A league: the methods of a collection, ranked over all objects; and a study against an earlier one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Self

import numpy as np
import pandas as pd
import xarray as xr

from sobolev_batch.batch.collection_store import CollectionStore
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.errors import InputError, StoreError
from sobolev_batch.results.open import AnyStore, as_tree
from sobolev_batch.results.tables.convergence import table, tables_of
from sobolev_batch.results.tables.groups import EDGE_LENGTH, finished_group, reference_of
from sobolev_batch.results.tables.statistics import (
    SIGNIFICANCE,
    Curve,
    Interval,
    Reals,
    adjusted,
    common_sizes,
    sign_flip_test,
    within_objects,
)
from sobolev_batch.spectral.adaptive.tolerance import NEXT_TO_EQUAL
from sobolev_batch.spectral.shells import Orders
from sobolev_batch.surfaces.sources.names import quoted

# The store of a collection, or stores of single objects by their names.
AnyCollection = str | Path | Location | Mapping[str, AnyStore]
# Of the rows that two studies have in common.
_KEYS = ["order", "mesh"]


@dataclass(frozen=True, eq=False)
class Scores:
    """Mean logarithms of relative distances at equal sizes.

    Attributes:
        objects: Names of the objects that have all methods.
        methods: Names of the methods.
        sizes: Logarithms of the sizes (objects, sizes) at which the methods are compared.
        values_at: Logarithms of relative distances (objects, methods, sizes).
        errors_at: Bounds on the errors of these.
        left_out: Why other objects are not there, by name.
    """

    objects: tuple[str, ...]
    methods: tuple[str, ...]
    sizes: Reals
    values_at: Reals
    errors_at: Reals
    left_out: Mapping[str, str]

    @property
    def values(self) -> Reals:
        """Logarithms of relative distances (objects, methods), averaged over the sizes."""
        return np.asarray(self.values_at.mean(axis=-1))

    @property
    def errors(self) -> Reals:
        """Bounds (objects, methods) on the errors of these."""
        return np.asarray(self.errors_at.mean(axis=-1))

    def mean_curve(self, method: str) -> Curve:
        """Return the mean over the objects of a method's distances at each size, whose mean is that of the table."""
        number = self.methods.index(method)
        parts = self.sizes, self.values_at[:, number], self.errors_at[:, number]
        return Curve(*(np.mean(part, axis=0) for part in parts))

    @classmethod
    def from_curves(
        cls, curves: Mapping[str, Mapping[str, Curve]], methods: Sequence[str], unfinished: Mapping[str, str]
    ) -> Self:
        """Return the scores of methods from their curves, by object and method; other objects have none yet."""
        rows: dict[str, tuple[Reals, Reals, Reals]] = {}
        left_out = dict(unfinished)
        for name, by_method in curves.items():
            lacking = [method for method in methods if method not in by_method]
            if lacking:
                left_out[name] = f"no distance of {', '.join(lacking)}"
                continue
            exact = [method for method in methods if by_method[method].is_exact]
            if exact:
                left_out[name] = f"{', '.join(exact)} reproduced it, up to rounding"
                continue
            common = common_sizes([by_method[method] for method in methods])
            if common is None:
                left_out[name] = _gap(by_method, methods)
                continue
            at_sizes = [by_method[method].at(common) for method in methods]
            rows[name] = (
                common,
                np.array([values for values, _ in at_sizes]),
                np.array([errors for _, errors in at_sizes]),
            )
        sizes, values, errors = (np.array([row[k] for row in rows.values()]) for k in range(3))
        return cls(tuple(rows), tuple(methods), sizes, values, errors, left_out)


def _gap(curves: Mapping[str, Curve], methods: Sequence[str]) -> str:
    """Return which methods have no range of sizes in common."""
    first = max(methods, key=lambda method: curves[method].sizes[0])
    last = min(methods, key=lambda method: curves[method].sizes[-1])
    begin, end = np.exp(curves[first].sizes[0]), np.exp(curves[last].sizes[-1])
    return f"no common range of sizes: {first} begins at {begin:,.5g}, {last} ends at {end:,.5g}"


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
            interval = Interval.from_values(scores.values[:, k], scores.errors[:, k], spreads[k]).exp()
            rows.append(
                {
                    "method": method,
                    "objects": count,
                    **interval.named("relative"),
                    **self._rate(method).named("rate", "rate_"),
                }
            )
        frame = pd.DataFrame(rows).sort_values("relative", kind="stable", ignore_index=True)
        low, high = frame["low"].to_numpy(), frame["high"].to_numpy()
        # Where there are no intervals, any place is possible.
        frame.insert(0, "rank", [1 + int(np.sum(high < end)) for end in low])
        frame.insert(1, "last_rank", [len(frame) - int(np.sum(low > end)) for end in high])
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
            interval = Interval.from_values(differences, errors).exp()
            rows.append(
                {
                    "method": scores.methods[i],
                    "other": scores.methods[j],
                    **interval.named("ratio"),
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
        return Interval.from_values(known[:, 0], known[:, 1])


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
    scores = Scores.from_curves(curves, methods, unfinished)
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
        by_method = {method: Curve.from_rows(frame[frame["family"] == method], x) for method in methods}
        curves[name] = {method: curve for method, curve in by_method.items() if curve is not None}
    return curves


def compare_studies(
    new: AnyCollection | AnyStore, old: AnyCollection | AnyStore, order: Orders | None = None
) -> pd.DataFrame:
    """Compare the distances of two studies of the same objects, such as those of two releases of a remesher.

    Meshes of the same label are compared, by the ratio of their distances to the same reference. Relative distances
    below 1e-5 count as 1e-5, since they tell of rounding.

    Args:
        new: Store of the new study: of a collection, or of one object; or stores of single objects by their names.
        old: Store of the old study, likewise.
        order: One of the stores' orders, or several; default all that both have.

    Returns:
        A row for each order and method (family): order, method; objects and meshes, their numbers; ratio, the geometric
        mean of the ratios of new to old distances, with the ends low and high of its interval over the objects, or over
        the meshes of a single object; p, the p-value of the paired permutation test, adjusted for the number of methods
        (Holm); verdict, "nearer" or "farther" by this test at the level of 5 %, else "undecided"; worst, the mesh whose
        distance grew most, and worst_ratio, by how much.

    Raises:
        InputError: The studies have no mesh in common, or an object has another reference or unit of length.
        StoreError: A location has no store.

    >>> import sobolev_batch as sb
    >>> same = sb.compare_studies("storage/icosphere.zarr", "storage/icosphere.zarr", -10)
    >>> same[["method", "meshes", "ratio", "verdict"]].to_dict("records")
    [{'method': 'icosphere', 'meshes': 4, 'ratio': 1.0, 'verdict': 'undecided'}]
    """
    news, olds = _stores(new), _stores(old)
    common = [name for name in news if name in olds]
    if not common:
        raise InputError(
            f"the studies have no object in common: the new one has {', '.join(news)}, the old one {', '.join(olds)}"
        )
    frames = [_joined(name, news[name], olds[name], order) for name in common]
    joined = pd.concat(frames, ignore_index=True)
    if joined.empty:
        raise InputError("the studies have no mesh in common that both have computed at the same order")
    rows = [
        {"order": s, "method": method, **_change(meshes)}
        for (s, method), meshes in joined.groupby(["order", "family"], sort=False)
    ]
    result = pd.DataFrame(rows)
    for _, of_order in result.groupby("order", sort=False):
        result.loc[of_order.index, "p"] = adjusted(of_order["p"].to_numpy())
    words = np.where(result["ratio"] < 1, "nearer", "farther")
    result.insert(8, "verdict", np.where(result["p"] < SIGNIFICANCE, words, "undecided"))
    return result


def _stores(store: AnyCollection | AnyStore) -> Mapping[str, AnyStore]:
    """Return the stores of objects; a store of one object has an empty name."""
    if isinstance(store, xr.DataTree):
        return {"": store}
    if not isinstance(store, str | Path | Location):
        return store
    collection = CollectionStore.read(Location.parse(store))
    if collection is None:
        return {"": store}
    return dict(collection.existing_stores)


def _joined(name: str, new: AnyStore, old: AnyStore, order: Orders | None) -> pd.DataFrame:
    """Return the meshes that two stores of an object have in common, with the logarithms of their ratios."""
    trees = as_tree(new), as_tree(old)
    if trees[0].attrs["similarity"] != trees[1].attrs["similarity"] or len({_identity(tree) for tree in trees}) > 1:
        raise InputError(
            f"{name or 'the studies'}: they have different references or units of length, so their distances cannot be "
            "compared; give both the same [reference] and [scaling]"
        )
    first, second = (_distances(table(tree, order)) for tree in trees)
    both = first.merge(second, on=_KEYS, suffixes=("", "_old"))
    ratios = np.log(both["relative"] / both["relative_old"])
    errors = both["share"] + both["share_old"]
    return both.assign(object=name, log_ratio=ratios, log_error=errors)


def _identity(tree: xr.DataTree) -> str:
    """Return what tells the reference from others: the digest of its mesh, or the keys of a surface in closed form."""
    digest = str(finished_group(tree, "meshes")["digest"].sel(mesh=reference_of(tree)).item())
    return digest or repr(sorted(tree.attrs["study"]["table"]["reference"].items()))


def _distances(frame: pd.DataFrame) -> pd.DataFrame:
    known = frame[frame["relative"].notna()]
    relative = np.maximum(known["relative"], NEXT_TO_EQUAL)
    with np.errstate(divide="ignore"):
        share = -np.log1p(-np.minimum(known["relative_error"] / relative, 1.0))
    return known[[*_KEYS, "family"]].assign(relative=relative, share=share)


def _change(meshes: pd.DataFrame) -> dict[str, object]:
    """Return the change of one method at one order."""
    by_object = meshes.groupby("object", sort=False)[["log_ratio", "log_error"]].mean()
    units = by_object if len(by_object) > 1 else meshes
    ratios, errors = units["log_ratio"].to_numpy(), units["log_error"].to_numpy()
    interval = Interval.from_values(ratios, errors).exp()
    worst = meshes.loc[meshes["log_ratio"].idxmax()]
    return {
        "objects": len(by_object),
        "meshes": len(meshes),
        **interval.named("ratio"),
        "p": sign_flip_test(ratios, errors),
        "worst": f"{worst['object']}/{worst['mesh']}".lstrip("/"),
        "worst_ratio": float(np.exp(worst["log_ratio"])),
    }


def stores_of(store: AnyCollection) -> tuple[dict[str, AnyStore], tuple[str, ...]]:
    """Return the store of each object that has one, by its name, and the names of all objects.

    Raises:
        StoreError: The location has no store of a collection.
    """
    if isinstance(store, Mapping):
        return dict(store), tuple(store)
    location = Location.parse(store)
    collection = CollectionStore.read(location)
    if collection is None:
        raise StoreError(
            f"{location}: it holds no store of a collection; run a study with several objects, or give the stores of "
            "single objects by their names"
        )
    return dict(collection.existing_stores), collection.objects
