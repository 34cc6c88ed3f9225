"""A league by cost: which meshes no other one beats in both the distance and the cost of making it."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.extras.leagues.statistics import EDGE_LENGTH, sizes_of
from sobolev_batch.norms.accuracy.tolerance import NEXT_TO_EQUAL
from sobolev_batch.shown import few_of, shown_tables
from sobolev_batch.tables import Format
from sobolev_batch.tables.rendering import Column, Section, rendered
from sobolev_batch.tables.text import number_text, percent, wrapped

DEFAULT_COST = "make_seconds"
# Why a league leaves an object out.
LACKS_TABLES = "it has no tables; the command status tells why"
# Members that a row of a table names, and objects whose fronts a text has.
_MOST_MEMBERS, _MOST_OBJECTS = 4, 10
COST_NOTE = """\
A mesh is on the front of its object unless another one, at no more cost, is nearer to the
reference or as near at less cost. It is undecided where the errors of the distances leave that
open. Costs are taken as measured. Means over objects are geometric, and those of members that all
objects have; an object that a mesh reproduces up to rounding has no part in them."""

METHOD_COLUMNS = (
    Column("method", "method", kind="label"),
    Column("front", "on the front", "{} of {}".format, "objects"),
    Column("undecided", "undecided"),
    Column("best", "members on most fronts", kind="text"),
)


@dataclass(frozen=True, eq=False)
class CostLeague:
    """The meshes of a study by distance and cost, at one order. Make it by `league` with ``by="cost"``.

    Attributes:
        order: Sobolev order s.
        x: What is the cost: a column of `table`, such as "make_seconds".
        objects: Names of the objects.
        methods: Names of the methods, also of those without meshes.
        left_out: Why other objects, and methods, are not there, by name.
        meshes: The meshes of all objects, a row each. Columns: object; method; member, the name of the mesh within its
            method, with {object} for the name of the object where only this makes names alike; mesh, its label; the
            cost, by its name; relative and relative_error; front, True unless another mesh of the object beats it in
            both; undecided, True where the errors of the distances leave that open.

    >>> import sobolev_batch as sb
    >>> (at_order,) = sb.league("storage/icosphere.zarr", -10, by="cost", x="triangles")
    >>> at_order.table[["method", "front", "objects", "best"]].to_dict("records")
    [{'method': 'icosphere', 'front': 1, 'objects': 1, 'best': '0, 1, 2, 3'}]
    """

    order: float
    x: str
    objects: tuple[str, ...]
    methods: tuple[str, ...]
    left_out: Mapping[str, str]
    meshes: pd.DataFrame

    @property
    def caption(self) -> str:
        """Caption of its table."""
        return f"League by {self.x} at order {self.order:g}, over {objects_text(len(self.objects))}"

    @cached_property
    def table(self) -> pd.DataFrame:
        """Methods from the one on the most fronts to the one on the fewest, one row each.

        Columns: method; front, the number of objects on whose front it has a mesh; objects, the number of those for
        which it has any; undecided, the number of objects for which the errors leave open whether it has one; best, its
        members that are on fronts, those on the most first, with their numbers of fronts where there are several
        objects.
        """
        meshes = self.meshes.assign(sure=self.meshes["front"] & ~self.meshes["undecided"], objects=True)
        found = meshes.groupby(["method", "object"], sort=False)[["front", "objects", "undecided", "sure"]].any()
        found["undecided"] &= ~found.pop("sure")
        frame = found.groupby("method", sort=False).sum().reset_index()
        frame["best"] = [self._best(self.meshes[self.meshes["method"] == method]) for method in frame["method"]]
        return frame.sort_values("front", ascending=False, kind="stable", ignore_index=True)

    def _best(self, meshes: pd.DataFrame) -> str:
        fronts = meshes[meshes["front"]].groupby("member", sort=False).size()
        fronts = fronts.sort_values(ascending=False, kind="stable")
        shown = [f"{name} ({n})" if len(self.objects) > 1 else str(name) for name, n in fronts.items()]
        return few_of(shown, _MOST_MEMBERS)

    @cached_property
    def means(self) -> pd.DataFrame:
        """Members that all objects have, from the cheapest to the most expensive, one row each.

        Columns: method; member; the cost by its name, relative and relative_error, geometric means over the objects
        (without those that a mesh reproduces up to rounding, where there are others); fronts, the number of objects
        on whose front it is; front, True unless another member beats both of its means.
        """
        # One object next to zero would outweigh all others.
        is_known = self.meshes.groupby("object")["relative"].transform("min") > NEXT_TO_EQUAL
        meshes = self.meshes[is_known] if is_known.any() else self.meshes
        share = (meshes["relative_error"] / meshes["relative"]).fillna(np.inf)
        with np.errstate(divide="ignore"):
            logarithms = meshes.assign(
                fall=np.log1p(-share.clip(upper=1.0)),
                rise=np.log1p(share),
                **{name: np.log(meshes[name]) for name in (self.x, "relative")},
            )
        # A member may be there twice for an object whose names do not tell its meshes apart.
        members = logarithms.groupby(["method", "member"], sort=False)
        found = np.exp(members[[self.x, "relative", "fall", "rise"]].mean())
        # The mean where all distances are as small, or as large, as their errors allow.
        widest = np.maximum(1 - found.pop("fall"), found.pop("rise") - 1)
        found["relative_error"] = found["relative"] * widest.where(np.isfinite(widest))
        found["fronts"] = self.meshes.groupby(["method", "member"])["front"].sum()
        found = found[members["object"].nunique() == meshes["object"].nunique()]
        found = found.sort_values([self.x, "relative"], kind="stable")
        return found.assign(front=_is_unbeaten(found[self.x], found["relative"], found["relative"])).reset_index()

    @property
    def front(self) -> pd.DataFrame:
        """Rows of `means` on the front, where member begins with its method; and objects, the number of all."""
        means = self.means[self.means["front"]]
        return means.assign(member=means["method"] + "/" + means["member"], objects=len(self.objects))

    def _repr_html_(self) -> str:
        return shown_tables(self.caption, self.table, self.means)


def cost_leagues_of(
    tables: Mapping[str, pd.DataFrame], objects: Iterable[str], methods: Sequence[str], x: str = DEFAULT_COST
) -> tuple[CostLeague, ...]:
    """Return the league by cost of each order, from the rows of `table` of each object that has some; see `league`."""
    if x == EDGE_LENGTH:
        raise InputError("edge_length falls where meshes get finer, so it is no cost; take triangles")
    known = {}
    for name, table in tables.items():
        with suppress(InputError):
            known[name] = table.assign(cost=sizes_of(table, x))
    if not known:
        # Names what could be taken instead.
        sizes_of(next(iter(tables.values())), x)
    frame = pd.concat(known, names=["object", "row"]).reset_index(level="object").reset_index(drop=True)
    frame = frame[frame["family"].isin(methods) & (frame["cost"] > 0) & frame["relative"].notna()]
    if frame.empty:
        raise InputError(f"no mesh has both a distance and {x}; name another cost, such as triangles")
    left_out = {name: LACKS_TABLES for name in objects if name not in tables}
    for names, present in ((tables, {*frame["object"]}), (methods, {*frame["family"]})):
        left_out |= {name: f"no mesh has a distance and {x}" for name in names if name not in present}
    # A name that objects do not share may hold that of its object.
    is_own = frame.groupby(["order", "mesh"])["object"].transform("nunique") == 1
    is_own &= frame.groupby("order")["object"].transform("nunique") > 1
    names = [mesh.removeprefix(f"{family}/") for mesh, family in zip(frame["mesh"], frame["family"], strict=True)]
    triples = zip(names, frame["object"], is_own, strict=True)
    members = [name.replace(owner, "{object}") if own else name for name, owner, own in triples]
    # What is next to equal tells of rounding.
    relative = frame["relative"].clip(lower=NEXT_TO_EQUAL)
    meshes = frame.assign(method=frame["family"], member=members, relative=relative, **{x: frame["cost"]})
    parts = []
    for _, own in meshes.groupby(["order", "object"], sort=False):
        costs, error = own[x], own["relative_error"].fillna(np.inf)
        low, high = own["relative"] - error, own["relative"] + error
        front = _is_unbeaten(costs, own["relative"], own["relative"])
        # At worst it has the largest distance that its error allows, and others the smallest; at best the reverse.
        at_worst, at_best = _is_unbeaten(costs, high, low), _is_unbeaten(costs, low, high)
        parts.append(own.assign(front=front, undecided=at_worst != at_best))
    columns = ["object", "method", "member", "mesh", x, "relative", "relative_error", "front", "undecided"]
    return tuple(
        CostLeague(s, x, tuple(rows["object"].unique()), tuple(methods), left_out, rows[columns].reset_index(drop=True))
        for s, rows in pd.concat(parts).groupby("order", sort=False)
    )


def objects_text(count: int) -> str:
    """Return a number of objects in words."""
    return f"{count} object{'s' if count > 1 else ''}"


def _is_unbeaten(costs: pd.Series, own: pd.Series, others: pd.Series) -> NDArray[np.bool_]:
    """Return which of some meshes no other one beats: at no more cost and nearer, or as near at less cost.

    Distances and costs are (meshes,); a mesh may have another distance where others are compared with it.
    """
    cost, rival, place = costs.to_numpy(), others.to_numpy(), np.arange(len(costs))

    def beaten(i: int, distance: float) -> np.bool_:
        beats = ((cost <= cost[i]) & (rival < distance)) | ((cost < cost[i]) & (rival <= distance))
        return np.any(beats & (place != i))

    return ~np.array([beaten(i, distance) for i, distance in enumerate(own)], dtype=bool)


def format_cost_leagues(leagues: Sequence[CostLeague], style: Format = "text") -> str:
    """Return leagues by cost as text, or their meshes for programs; see `league`."""
    frame = pd.concat([one.meshes.assign(order=one.order) for one in leagues], ignore_index=True)
    sections = [
        Section(one.caption, [(METHOD_COLUMNS, one.table), (front_columns(one.x), one.front)], _front_lines(one))
        for one in leagues
    ]
    notes = [*wrapped(COST_NOTE), *(f"{name} is left out: {why}." for name, why in leagues[0].left_out.items())]
    return rendered(style, frame[["order", *frame.columns.drop("order")]], sections, notes)


def front_columns(x: str = DEFAULT_COST) -> tuple[Column, ...]:
    """Return the columns of `CostLeague.front`, with a cost of this name."""
    return (
        Column("member", "front of the means", kind="label"),
        Column(x, x, number_text),
        Column("relative", "relative", percent, "relative_error"),
        Column("fronts", "on the front", "{} of {}".format, "objects"),
    )


def _front_lines(league: CostLeague) -> list[str]:
    """Return a line for the front of each object, from the cheapest mesh to the nearest one."""
    front = league.meshes[league.meshes["front"]].sort_values(league.x, kind="stable")
    labels = front.groupby("object")["mesh"].agg(", ".join)
    lines = [f"{name}: {labels[name]}" for name in league.objects[:_MOST_OBJECTS]]
    more = len(league.objects) - len(lines)
    return lines + [f"and {more} more objects: --format csv has all"] * (more > 0)
