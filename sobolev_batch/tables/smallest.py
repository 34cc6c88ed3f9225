"""The smallest mesh of each family whose relative distance is below a bound."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from sobolev_batch.errors import InputError
from sobolev_batch.parameters import fraction
from sobolev_batch.tables import Format
from sobolev_batch.tables.convergence import MESH, TRIANGLES, joined, left_out, notes_of_left_out, tables_of
from sobolev_batch.tables.open import AnyStore
from sobolev_batch.tables.rendering import Column, Section, rendered
from sobolev_batch.tables.text import percent, wrapped
from sobolev_batch.transform.lattice import Orders

_RELATIVE = ["relative", "relative_error"]
_NOTE = """\
A mesh is below the bound if its relative distance plus the error of that is.
Smaller meshes of which the errors leave that open are named."""

_UNKNOWN: dict[str, Any] = {"mesh": "", "triangles": pd.NA, "relative": math.nan, "relative_error": math.nan}
_NAMES = [*_UNKNOWN, "nearest", *(f"nearest_{name}" for name in _RELATIVE), "undecided"]
_COLUMNS = (
    Column("family", "family"),
    MESH,
    TRIANGLES,
    Column("relative", "relative", percent, "relative_error"),
    Column("remark", "remark", kind="text"),
)


def smallest_below(store: AnyStore, relative: float | str, order: Orders | None = None) -> pd.DataFrame:
    """Return the mesh with the fewest triangles in each family whose relative distance is certainly below a bound.

    Args:
        store: Path, URL or opened DataTree of the store. Of several objects, each row begins with its object.
        relative: Bound on the relative distance with its error, such as 0.01 or "1%".
        order: One of the store's orders, or several; default all.

    Returns:
        One row for each order and family with meshes of triangles: order, family, mesh (empty if none is below the
        bound), its triangles, relative and relative_error (missing likewise); nearest (the mesh of the family with the
        smallest distance), nearest_relative and nearest_relative_error; undecided (meshes with fewer triangles of
        which the errors leave open whether they are below the bound, separated by commas). The frame's ``attrs`` have
        the reference's label and the bound, and of several objects as ``left_out`` the names of those without tables.

    Raises:
        InputError: The store has no tables yet, no such order or no triangles, or the bound is not between 0 and 1.
        StoreError: The location has no store of a study.

    >>> import sobolev_batch as sb
    >>> frame = sb.smallest_below("storage/icosphere.zarr", "5%", order=-10)
    >>> frame[["family", "mesh", "triangles"]].values.tolist()
    [['icosphere', 'icosphere/2', 320]]
    """
    frames = _of_objects(store, relative, order)
    return joined(frames, left_out(store, frames))


def _of_objects(store: AnyStore, relative: float | str, order: Orders | None) -> dict[str, pd.DataFrame]:
    if (most := fraction(relative)) >= 1:
        raise InputError(f"a bound is a fraction of the norm below 1, such as '1%', found {relative!r}")
    frames = tables_of(store, order)
    if not any((frame["triangles"] > 0).any() for frame in frames.values()):
        raise InputError("the smallest mesh has the fewest triangles, and no surface of the store is known to have any")
    found = {name: smallest_of(frame, most) for name, frame in frames.items()}
    return {name: frame.assign(undecided=frame["undecided"].map(", ".join)) for name, frame in found.items()}


def smallest_of(frame: pd.DataFrame, most: float) -> pd.DataFrame:
    """Return the smallest mesh of each family of triangles below a bound, of rows of `table`; see `smallest_below`."""
    rows = []
    for (order, family), members in frame[frame["triangles"] > 0].groupby(["order", "family"], sort=False):
        lowest, highest = (members["relative"] + sign * members["relative_error"] for sign in (-1, 1))
        below, is_known = members[highest < most].sort_values(["triangles", "relative"]), members["relative"].notna()
        best = _UNKNOWN if below.empty else below.iloc[0]
        nearest = members.loc[members["relative"].idxmin()] if is_known.any() else _UNKNOWN
        # An unknown error leaves everything open.
        is_open = is_known & ~(highest < most) & ~(lowest >= most)
        undecided = members[is_open if below.empty else is_open & (members["triangles"] < best["triangles"])]
        numbers = *(best[name] for name in _UNKNOWN), *(nearest[name] for name in ("mesh", *_RELATIVE))
        rows.append([order, family, *numbers, tuple(undecided["mesh"])])
    smallest = pd.DataFrame(rows, columns=["order", "family", *_NAMES]).astype({"triangles": "Int64"})
    smallest.attrs = {"reference": frame.attrs["reference"], "below": most}
    return smallest


def format_smallest(store: AnyStore, style: Format, orders: Sequence[float] | None, *, below: float | str) -> str:
    """Return the smallest meshes below a bound as text; see `smallest_below`."""
    frames, amount, sections = _of_objects(store, below, orders), f"{100 * fraction(below):g} %", list[Section]()
    for name, frame in frames.items():
        sections += [Section(f"Object {name}")] if name else []
        for order, rows in frame.groupby("order", sort=False):
            caption = f"Smallest mesh below {amount} of the norm of {frame.attrs['reference']}, order {order:g}"
            records = rows.to_dict(orient="records")
            cells = [{**row, "mesh": row["mesh"] or "none", "remark": remark(row, row["undecided"])} for row in records]
            sections.append(Section(caption, [(_COLUMNS, cells)]))
    return rendered(style, joined(frames), sections, notes_of_left_out(store, frames) + wrapped(_NOTE))


def remark(row: Mapping[Any, Any], undecided: str) -> str:
    """Return the nearest mesh of a family without one below the bound, and those that are undecided."""
    amount = percent(row["nearest_relative"], row["nearest_relative_error"])
    nearest = f"{row['nearest']} has {amount}" if row["nearest"] else "no distance is known"
    return "; ".join(filter(None, ("" if row["mesh"] else nearest, undecided and f"errors leave open {undecided}")))
