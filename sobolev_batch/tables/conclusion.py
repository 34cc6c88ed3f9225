"""The verdict on a study: the nearest meshes, the smallest ones below bounds; and its objects, the worst first."""

import math
import shlex
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from sobolev_batch.geometry.proximity import METRICS
from sobolev_batch.shown import few_of
from sobolev_batch.tables import Format
from sobolev_batch.tables.convergence import ALONE, DEVIATION, joined, notes_of_left_out, remarks, tables_of
from sobolev_batch.tables.open import AnyStore, as_tree, source_of, stores_of
from sobolev_batch.tables.rendering import Column, Section, rendered
from sobolev_batch.tables.smallest import remark, smallest_of
from sobolev_batch.tables.text import count, minus, percent, spread, times, wrapped

# A row of a table: a record of a frame. It may also have its "order"; a "mark", a short remark about its marked number;
# the number of its "color"; and the text "absent" in place of all numbers, with the section "reasons" that explains it.
TableRow = Mapping[Any, Any]

_BOUNDS = (0.05, 0.01)
# Meshes whose numbers of triangles differ by no more than this factor are of one size.
_SAME_SIZE = 1.2
# More triangles make a mesh nearer by this power of their number at most: steeper rates are rare.
_STEEPEST = 2.0
# More rows are no verdict any more.
_MOST_SIZES = 8
_MOST_FAMILIES = 6
_MOST_REMARKS = 10
# Whole verdicts on more objects fill several screens.
_MOST_WHOLE = 3

VERDICT_COLUMNS = (
    Column("verdict", "verdict", kind="label"),
    Column("mesh", "mesh", kind="text"),
    Column("relative", "relative", percent, "relative_error"),
    Column("triangles", "triangles", count),
    DEVIATION,
    Column("remark", "remark", kind="text"),
)
TOTALS = ("meshes", "missing", "above_rtol")
_OF_NEAREST = ["mesh", "relative", "relative_error", *METRICS["hausdorff"]]
# What an object is judged by: to cut it from all columns of `table` takes much longer.
_OF_OBJECTS = ["order", "distance", "resolved", "within", *_OF_NEAREST]
_OBJECT_COLUMNS = (
    Column("object", "object", kind="label"),
    Column("mesh", "nearest mesh", kind="text"),
    Column("relative", "relative", percent, "relative_error"),
    DEVIATION,
    *(Column(name, name.replace("_", " "), count) for name in TOTALS),
)


def study_verdict(
    frame: pd.DataFrame, failed: Mapping[str, str], order_text: Callable[[float], str] = lambda s: minus(f"{s:g}")
) -> tuple[tuple[str, ...], list[TableRow], str]:
    """Return the verdict on a study at each order, from the rows of `table` and the reasons of meshes that are missing.

    It is a sentence for each order; rows of nearest meshes, smallest meshes below bounds, and meshes that are missing
    or imprecise, with their order; and a note on the sizes and families that are left out, empty where none is.
    """
    if frame.empty:
        return (ALONE,), [], ""
    sizes = _sizes(frame.drop_duplicates("mesh"))
    shown_sizes = spread(sizes, _MOST_SIZES)
    sized = frame[frame["triangles"] > 0]["family"].unique().tolist()
    deviations = frame.drop_duplicates("mesh").set_index("mesh").filter(METRICS["hausdorff"]).to_dict(orient="index")
    families, sentences, lines = sized[:_MOST_FAMILIES], [], list[TableRow]()
    for order, rows in frame.groupby("order", sort=False):
        at_sizes, at_shown = ([rows[rows["mesh"].isin(labels)] for labels in some] for some in (sizes, shown_sizes))
        at_order = f"at order {order_text(order)}"
        sentences.append(f"{_of_sizes(at_order, at_sizes)}{_sentence(at_order, rows, frame.attrs)}")
        of_order = (*_nearest_rows(rows, at_shown), *_smallest_rows(rows, families), *_doubtful_rows(rows, failed))
        lines += [{**line, **deviations.get(line.get("mesh"), {}), "order": order} for line in of_order]
    shown = {"sizes": (len(shown_sizes), len(sizes)), "families": (len(families), len(sized))}
    omitted = [f"{few} of {total} {things}" for things, (few, total) in shown.items() if few < total]
    return tuple(sentences), lines, " and ".join(omitted)


def _of_sizes(at_order: str, at_sizes: Sequence[pd.DataFrame]) -> str:
    """Return a sentence on which family is nearest among meshes of one size, by more than their triangles explain."""
    wins, leads = Counter[str](), list[float]()
    for members in at_sizes:
        if (closest := _nearest(members)) is not None:
            best, rivals = closest
            families = members["family"]
            if not any(members["mesh"].isin(rivals) & (families != best["family"])):
                second = members[families != best["family"]].sort_values("distance").iloc[0]
                lead = second["distance"] / best["distance"] if best["resolved"] else math.inf
                if lead > (best["triangles"] / second["triangles"]) ** _STEEPEST:
                    wins[best["family"]] += 1
                    leads.append(lead)
    if not wins:
        return ""
    total = len(at_sizes)
    is_sweep = len(wins) == 1 and wins.total() == total
    parts = []
    for family, number in wins.most_common(_MOST_FAMILIES):
        where = "the same size" if total == 1 else f"{'each' if is_sweep else number} of {total:,} sizes"
        parts.append(f"{family} is nearest at {where}")
    if is_sweep and np.isfinite(leads).all():
        low, high = (times(lead, 2) for lead in (min(leads), max(leads)))
        parts.append(f"{low if low == high else f'{low} to {high}'} times nearer than the next")
    return f"{', '.join(parts)}, {at_order}. "


def _sentence(at_order: str, rows: pd.DataFrame, known: Mapping[Any, Any]) -> str:
    name = "the reference" if known["reference"] == "reference" else known["reference"]
    closest, compared = _nearest(rows), int(rows["distance"].notna().sum())
    if compared == 0:
        return f"No mesh could be compared with {name}."
    if closest is None:
        return f"No distance to {name} is above its error {at_order}: the meshes may be equal to it."
    best, rivals = closest
    # Numbers stay on one line of the sentence.
    amount = percent(best["relative"], best["relative_error"]).replace(" ", "\N{NO-BREAK SPACE}")
    who = rivals[0] if len(rivals) == 1 else f"one of {few_of(rivals)}"
    doubt = f", and the errors leave open whether {who} is nearer" if rivals else ""
    worst = DEVIATION.text(best).replace(" ", "\N{NO-BREAK SPACE}")
    deviation = (
        f" The largest deviation of {best['mesh']} is {worst}\N{NO-BREAK SPACE}{known['unit']}." if worst else ""
    )
    if compared == 1:
        return f"{best['mesh']} differs from {name} by {amount} {at_order}.{deviation}"
    nearest = f"Of {compared:,} meshes, {best['mesh']} is nearest to {name} {at_order}"
    return f"{nearest}: it differs by {amount}{doubt}.{deviation}"


def _sizes(rows: pd.DataFrame) -> list[list[str]]:
    """Return the labels of meshes of about as many triangles, where these are of several families."""
    known = rows[rows["triangles"] > 0].sort_values("triangles", kind="stable")
    sizes: list[pd.DataFrame] = []
    while len(known):
        is_same = known["triangles"] <= _SAME_SIZE * known["triangles"].iloc[0]
        sizes.append(known[is_same])
        known = known[~is_same]
    return [size["mesh"].tolist() for size in sizes if size["family"].nunique() > 1]


def _nearest_rows(rows: pd.DataFrame, at_sizes: Sequence[pd.DataFrame]) -> Iterator[TableRow]:
    yield _nearest_row("nearest of all", rows)
    for members in at_sizes:
        low, high = int(members["triangles"].min()), int(members["triangles"].max())
        counts = f"{low:,}" if low == high else f"{low:,} to {high:,}"
        yield _nearest_row(f"{counts} triangles", members)


def _nearest_row(label: str, members: pd.DataFrame) -> TableRow:
    if (closest := _nearest(members)) is None:
        is_known = members["distance"].notna().any()
        return _absent(label, "no distance is above its error" if is_known else "no distance is known")
    best, rivals = closest
    return _row(label, best, f"errors leave open {few_of(rivals)}" if rivals else _lead(best, members))


def _nearest(frame: pd.DataFrame) -> tuple[pd.Series, tuple[str, ...]] | None:
    """Return the nearest mesh of one order, and labels that may be nearer; None if all are below their errors.

    None may be nearer if the distance with its error is below those of all others less their errors, resolved or not.
    """
    rows = frame[frame["distance"].notna()].sort_values("distance", kind="stable")
    if not rows["resolved"].any():
        return None
    best, others = rows.iloc[0], rows.iloc[1:]
    # An unknown error leaves everything open.
    is_farther = (others["distance"] - others["error"]).clip(lower=0) > best["distance"] + best["error"]
    return best, tuple(others["mesh"][~is_farther])


def _lead(best: pd.Series, members: pd.DataFrame) -> str:
    """Return by how much the nearest mesh is nearer than the next one of another family, of its size if there is one.

    Where that has another number of triangles, the remark has it.
    """
    others = members[(members["family"] != best["family"]) & members["distance"].notna()]
    counts = np.maximum(others["triangles"].astype(float), 1.0) / max(best["triangles"], 1)
    of_size = others[counts.between(1 / _SAME_SIZE, _SAME_SIZE)]
    if not len(others):
        return ""
    rivals = of_size if len(of_size) else others
    second = rivals.loc[rivals["distance"].idxmin()]
    size = "" if second["triangles"] in (0, best["triangles"]) else f" of {second['triangles']:,} triangles"
    nearer = f"nearer than {second['mesh']}{size}"
    if not best["resolved"]:
        return f"below its error, {nearer}"
    ratio = second["distance"] / best["distance"]
    if ratio == 1:
        return nearer.replace("nearer than", "as near as")
    return f"{times(ratio)} times {nearer}" if ratio < 100 else f"far {nearer}"


def _smallest_rows(rows: pd.DataFrame, families: Sequence[str]) -> Iterator[TableRow]:
    for bound in _BOUNDS:
        frame = smallest_of(rows, bound)
        for row in frame[frame["family"].isin(families)].to_dict(orient="records"):
            label, text = f"below {100 * bound:g} %: {row['family']}", remark(row, few_of(row["undecided"]))
            yield _row(label, row, text) if row["mesh"] else _absent(label, f"none; {text}")


def _doubtful_rows(rows: pd.DataFrame, failed: Mapping[str, str]) -> Iterator[TableRow]:
    """Yield the meshes whose distances have larger errors than the study requests, and those that failed."""
    if (is_short := _is_above_rtol(rows)).any():
        yield _absent("above rtol", few_of(rows["mesh"][is_short].tolist()))
    if failed:
        yield {**_absent("missing", few_of(list(failed))), "reasons": "failed"}


def counted(rows: pd.DataFrame) -> pd.DataFrame:
    """Return whether each row of `table` has a distance, lacks one, and has one above rtol; their sums are totals."""
    known = rows["distance"].notna()
    return pd.DataFrame(dict(zip(TOTALS, (known, ~known, _is_above_rtol(rows)), strict=True)))


def _is_above_rtol(rows: pd.DataFrame) -> pd.Series:
    return rows["resolved"].astype(bool) & ~rows["within"].astype(bool) & rows["distance"].notna()


def _row(label: str, mesh: Mapping[str, Any] | pd.Series, remark: str) -> TableRow:
    numbers = {name: mesh[name] for name in ("mesh", "relative", "relative_error", "triangles")}
    return {"verdict": label, **numbers, "remark": remark}


def _absent(label: str, text: str) -> TableRow:
    return {"verdict": label, "absent": text}


def format_verdict(store: AnyStore, style: Format = "text", orders: Sequence[float] | None = None) -> str:
    """Return the verdict on each object of a study, for people that of few objects, or a row for each of many."""
    stores, for_programs, sections = stores_of(store), {}, list[Section]()
    if len(stores) > _MOST_WHOLE and style not in ("csv", "json"):
        return format_objects(store, style, orders)
    for name, frame in (frames := tables_of(store, orders)).items():
        reasons = frame[frame["status"] != "complete"].drop_duplicates("mesh").set_index("mesh")["reason"]
        # Orders are written as in captions of tables and in options.
        sentences, rows, omitted = study_verdict(frame, reasons.to_dict(), "{:g}".format)
        names = ("order", "verdict", *frame.filter(_OF_NEAREST), "triangles", "remark", "absent")
        for_programs[name] = pd.DataFrame(rows, columns=[*names]).astype({"triangles": "Int64"})
        full = [{"remark": row.get("absent"), **row, "absent": ""} for row in rows]
        sections += [Section(f"Object {name}")] if name else []
        sections.append(Section(sentences=[line for sentence in sentences for line in wrapped(sentence)]))
        sections += [
            Section(f"Verdict at order {order:g}", [(VERDICT_COLUMNS, [row for row in full if row["order"] == order])])
            for order in frame["order"].drop_duplicates()
        ]
        notes, known = [f"Only {omitted} are shown."] if omitted else [], remarks(as_tree(stores[name]), frame)
        notes += known[:_MOST_REMARKS]
        notes += [f"and {len(known) - _MOST_REMARKS:,} more remarks"] if len(known) > _MOST_REMARKS else []
        sections.append(Section(sentences=notes))
    return rendered(style, joined(for_programs), sections, notes_of_left_out(store, frames))


def format_objects(
    store: AnyStore, style: Format = "text", orders: Sequence[float] | None = None, *, most: int | None = None
) -> str:
    """Return a row for each object, the worst ones first, or at most some of them.

    Those are first that lack most meshes, and then those whose nearest mesh is farthest from its reference.
    """
    frames = tables_of(store, orders)
    rows = pd.concat({name: frame.filter(_OF_OBJECTS) for name, frame in frames.items()}, names=["object"])
    rows = rows.reset_index("object").reset_index(drop=True)
    keys = ["order", "object"]
    totals = rows[keys].join(counted(rows)).groupby(keys, sort=False).sum()
    known = rows[rows["relative"].notna()]
    nearest = known.loc[known.groupby(keys)["relative"].idxmin()].set_index(keys).filter(_OF_NEAREST)
    frame = totals.join(nearest).fillna({"mesh": ""}).reset_index()[[*keys, *nearest, *TOTALS]]
    frame = frame.sort_values(["missing", "relative"], ascending=False, kind="stable")
    sections, more = [] if len(frame) else [Section(sentences=[ALONE])], list[str]()
    place = str(source_of(store) or "STORE" if isinstance(store, xr.DataTree) else store)
    worst = [shlex.quote(f"{place}/{name}") for name in frame["object"][:1] if name]
    one = [f"more on an object: sobolev-batch table verdict {name}" for name in worst]
    unit = f"; deviations are in {next(iter(frames.values())).attrs['unit']}" if DEVIATION.name in frame else ""
    for order, of_order in frame.groupby("order", sort=False):
        shown = of_order.to_dict(orient="records")[:most]
        columns = [one for one in _OBJECT_COLUMNS if one.format is not count or any(row[one.name] for row in shown)]
        sections.append(Section(f"Objects at order {order:g}, the worst first{unit}", [(columns, shown)]))
        if len(shown) < len(of_order):
            more = [f"{len(of_order) - len(shown):,} more: sobolev-batch table objects {shlex.quote(place)}"]
    return rendered(style, frame, sections, [*more, *one, *notes_of_left_out(store, frames)])
