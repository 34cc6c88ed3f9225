"""The smallest mesh of each family that is certainly near enough to the reference."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pandas as pd
import xarray as xr

from sobolev_batch.errors import InputError
from sobolev_batch.parameters import fraction
from sobolev_batch.results.open import AnyStore, as_tree
from sobolev_batch.results.tables.convergence import table
from sobolev_batch.results.tables.defaults import Format
from sobolev_batch.results.tables.formatting import Digits
from sobolev_batch.results.tables.text import machine_table, printed_table, prose
from sobolev_batch.spectral.shells import Orders

_NUMBERS = ["relative", "relative_error"]
_COLUMNS = ["mesh", "triangles", *_NUMBERS, "nearest", *(f"nearest_{name}" for name in _NUMBERS), "undecided"]
_NOTE = """\
A mesh is below the bound if its relative distance and the error of that are together.
Meshes that are smaller, and that the errors leave open, are named as undecided."""

_UNKNOWN: dict[str, Any] = {"mesh": "", "triangles": pd.NA, "relative": math.nan, "relative_error": math.nan}


def smallest_below(store: AnyStore, relative: float | str, order: Orders | None = None) -> pd.DataFrame:
    """Return the mesh with the fewest triangles in each family whose relative distance is certainly below a bound.

    Args:
        store: Path, URL or opened DataTree of the store.
        relative: Bound on the relative distance with its error, such as 0.01 or "1%".
        order: One of the store's orders, or several; default all.

    Returns:
        One row for each order and family with meshes of triangles: order, family, mesh (empty if none is below the
        bound), its triangles, relative and relative_error (missing likewise); nearest (the mesh of the family with the
        smallest distance), nearest_relative and nearest_relative_error; undecided (meshes with fewer triangles of
        which the errors leave open whether they are below the bound, separated by commas). The frame's ``attrs`` have
        the reference's label and the bound.

    Raises:
        InputError: The store has no tables yet, lacks an order, or has no meshes of triangles, or the bound is not
            positive.
        StoreError: The location has no store of a study.

    >>> import sobolev_batch as sb
    >>> frame = sb.smallest_below("storage/icosphere.zarr", "5%", order=-10)
    >>> frame[["family", "mesh", "triangles"]].values.tolist()
    [['icosphere', 'icosphere/2', 320]]
    """
    most = fraction(relative)
    frame = table(as_tree(store), order)
    if not (frame["triangles"] > 0).any():
        raise InputError("the smallest mesh has the fewest triangles, and no surface of the store is known to have any")
    found = smallest_of(frame, most)
    found["undecided"] = found["undecided"].map(", ".join)
    return found


def smallest_of(frame: pd.DataFrame, most: float) -> pd.DataFrame:
    """Return the smallest mesh of each family below a bound, of rows of `table`; see `smallest_below`.

    The labels in `undecided` are tuples here. There are no rows for families without meshes of triangles.
    """
    with_triangles = frame[frame["triangles"] > 0]
    rows = [
        {"order": s, "family": family, **_smallest(members, most)}
        for (s, family), members in with_triangles.groupby(["order", "family"], sort=False)
    ]
    found = pd.DataFrame(rows, columns=["order", "family", *_COLUMNS]).astype({"triangles": "Int64"})
    found.attrs = {"reference": frame.attrs["reference"], "below": most}
    return found


def format_smallest(
    tree: xr.DataTree, style: Format = "text", orders: Sequence[float] | None = None, *, below: float | str
) -> str:
    """Return the smallest meshes below a bound as text; see `smallest_below`."""
    frame = smallest_below(tree, below, orders)
    if style in ("csv", "json"):
        return machine_table(frame, style)
    sections = []
    for order, rows in frame.groupby("order", sort=False):
        amount = f"{100 * frame.attrs['below']:g} %"
        caption = f"Smallest mesh below {amount} of the norm of {frame.attrs['reference']}, order {order:g}"
        cells = [_cells(row) for row in rows.to_dict(orient="records")]
        separator = "\n" if style == "latex" else "\n\n"
        headers = ["family", "mesh", "triangles", "relative", "remark"]
        sections.append(separator.join([prose([caption], style), printed_table(cells, headers, style)]))
    return "\n\n".join([*sections, prose(_NOTE.splitlines(), style)])


def _smallest(members: pd.DataFrame, most: float) -> dict[str, Any]:
    """Return the row of one family at one order."""
    lowest, highest = (members["relative"] + sign * members["relative_error"] for sign in (-1, 1))
    below = members[highest < most].sort_values(["triangles", "relative"])
    best = _UNKNOWN if below.empty else below.iloc[0]
    # An unknown error leaves everything open.
    is_open = members["relative"].notna() & ~(highest < most) & ~(lowest >= most)
    is_fewer = True if below.empty else members["triangles"] < best["triangles"]
    nearest = members.loc[members["relative"].idxmin()] if members["relative"].notna().any() else _UNKNOWN
    return {
        **{name: best[name] for name in ("mesh", "triangles", *_NUMBERS)},
        "nearest": nearest["mesh"],
        **{f"nearest_{name}": nearest[name] for name in _NUMBERS},
        "undecided": tuple(members.loc[is_open & is_fewer, "mesh"]),
    }


def _cells(row: dict[str, Any]) -> list[str]:
    """Return the cells of a family."""
    undecided = [f"undecided: {row['undecided']}"] if row["undecided"] else []
    if row["mesh"]:
        amount = Digits.percent(row["relative"], row["relative_error"]).together
        return [row["family"], row["mesh"], f"{row['triangles']:,}", amount, "; ".join(undecided)]
    nearest = Digits.percent(row["nearest_relative"], row["nearest_relative_error"]).together
    remarks = [f"nearest: {row['nearest']}, {nearest}"] if row["nearest"] else ["no distance is known"]
    return [row["family"], "none", "", "", "; ".join([*remarks, *undecided])]
