"""A study against an earlier one of the same objects, and as text: which methods came nearer."""

from collections.abc import Sequence
from itertools import chain

import numpy as np
import pandas as pd
import xarray as xr

from sobolev_batch.errors import InputError
from sobolev_batch.extras.leagues import statistics
from sobolev_batch.extras.leagues.league import ENDS, RELATIVE, chosen_methods, interval_text, orders_of
from sobolev_batch.norms.accuracy.tolerance import NEXT_TO_EQUAL
from sobolev_batch.parameters import as_names
from sobolev_batch.sources.names import quoted
from sobolev_batch.tables import Format
from sobolev_batch.tables.convergence import table
from sobolev_batch.tables.open import AnyStores, as_tree, finished_group, reference_of, root_attribute, stores_of
from sobolev_batch.tables.rendering import Column, Section, rendered
from sobolev_batch.tables.text import number_text, wrapped
from sobolev_batch.transform.lattice import Orders

_NOTE = """\
A ratio below 1 says that the new study is better: nearer to the references, or less of another
number. It is the geometric mean over the {units}, with its 95 % interval. The verdict is that of
the permutation test of pairs, at the level of 5 % for all methods together."""
# These tell the rows that two studies have in common.
_KEYS = ["order", "mesh"]
_COLUMNS = (
    Column("method", "method"),
    Column("y", "by"),
    Column("verdict", "verdict"),
    Column("ratio", "new/old", number_text),
    Column("low", "95 % interval", interval_text(number_text), "high"),
    Column("p", "p", "{:.2g}".format),
    Column("meshes", "meshes"),
    Column("worst_ratio", "largest new/old", lambda ratio, mesh: f"{number_text(ratio)}, {mesh}", "worst"),
)


def compare_studies(
    new: AnyStores,
    old: AnyStores,
    order: Orders | None = None,
    *,
    y: str | Sequence[str] = RELATIVE,
    methods: str | Sequence[str] | None = None,
) -> pd.DataFrame:
    """Compare the distances of two studies of the same objects, such as those of two releases of a remesher.

    Meshes of the same label are compared, by the ratio of their distances to the same reference. Relative distances
    below 1e-5 count as 1e-5, since they tell of rounding.

    Args:
        new: Store of the new study, of several objects or of one; or stores of single objects by their names.
        old: Store of the old study, likewise.
        order: One of the stores' orders, or several; default all that both have.
        y: What to compare, one or several columns of `table` of which less is better: "relative", "hausdorff",
            "make_seconds", "triangles" (of searched families) and so on.
        methods: Names of the families to compare; default all.

    Returns:
        A row for each y, order and method (family): y, order, method; objects and meshes, their numbers; ratio, the
        geometric mean of the ratios of new to old numbers, with the ends low and high of its interval over the objects,
        or over the meshes of a single object; p, the p-value of the paired permutation test, adjusted for the number of
        methods (Holm); verdict, "nearer" or "farther" by this test at the level of 5 %, else "undecided"; worst, the
        mesh whose number grew most, and worst_ratio, by how much. A y that is the same at all orders has rows at the
        first one. The attribute `lost` of the frame has the labels of meshes that the old study has and the new one
        lacks.

    Raises:
        InputError: The studies have no mesh in common, or no such method; or an object has another reference or unit of
            length.
        StoreError: A location has no store.

    >>> import sobolev_batch as sb
    >>> same = sb.compare_studies("storage/icosphere.zarr", "storage/icosphere.zarr", -10)
    >>> same[["method", "meshes", "ratio", "verdict"]].to_dict("records")
    [{'method': 'icosphere', 'meshes': 4, 'ratio': 1.0, 'verdict': 'undecided'}]
    """
    if not (columns := as_names(y)):
        raise InputError("y names no column to compare; leave it out, or name one")
    news, olds = stores_of(new), stores_of(old)
    common = [name for name in news if name in olds]
    if not common:
        for stores in (news, olds):
            if "" in stores:
                as_tree(stores[""])  # It says where there is no store.
        raise InputError(
            f"the studies share no object: the new one has {quoted([*news])}, the old one {quoted([*olds])}"
        )
    lost = [f"{name} (all of it)" for name in olds if name not in news]
    trees = {name: (as_tree(news[name]), as_tree(olds[name])) for name in common}
    tables = {name: [table(tree, order) for tree in pair] for name, pair in trees.items()}
    chosen = chosen_methods(chain(*tables.values()), methods)
    frames = []
    for name, pair in tables.items():
        now, before = trees[name]
        if now.attrs["similarity"] != before.attrs["similarity"] or _identity(now) != _identity(before):
            what = f"{name or 'the studies'}: different references or units of length cannot be compared"
            raise InputError(f"{what}; give both the same [reference] and [scaling]")
        new_rows, old_rows = (frame[frame["family"].isin(chosen)] for frame in pair)
        frames += [_joined(name, new_rows, old_rows, column, lost) for column in columns]
    joined = pd.concat(frames, ignore_index=True)
    if joined.empty:
        raise InputError("the studies have no mesh in common that both have computed at the same order")
    result = pd.DataFrame(
        {"y": name, "order": s, "method": method, **_change(meshes)}
        for (name, s, method), meshes in joined.groupby(["y", "order", "family"], sort=False)
    )
    result["p"] = result.groupby(["y", "order"], sort=False)["p"].transform(lambda p: statistics.adjusted(p.to_numpy()))
    words = np.where(result["ratio"] < 1, "nearer", "farther")
    result.insert(9, "verdict", np.where(result["p"] < statistics.SIGNIFICANCE, words, "undecided"))
    result.attrs["lost"] = tuple(dict.fromkeys(lost))
    return result


def _joined(name: str, new: pd.DataFrame, old: pd.DataFrame, y: str, lost: list[str]) -> pd.DataFrame:
    """Return the meshes that two tables of an object have in common, with logarithms of ratios of a column.

    Labels of the others that the old one has are added to those that are lost.
    """
    first, second = (_numbers(frame[frame["order"].isin(orders_of([frame], y))], y) for frame in (new, old))
    both = first.merge(second, on=_KEYS, suffixes=("", "_old"))
    gone = second["mesh"][~second["mesh"].isin(first["mesh"])].unique()
    lost += [f"{name}/{mesh}".lstrip("/") for mesh in gone]
    ratios, errors = np.log(both["value"] / both["value_old"]), both["log_error"] + both["log_error_old"]
    return both.assign(y=y, object=name, log_ratio=ratios, log_error=errors)


def _identity(tree: xr.DataTree) -> str:
    """Return what tells the reference from others: the digest of its mesh, or the keys of a surface in closed form."""
    digest = str(finished_group(tree, "meshes")["digest"].sel(mesh=reference_of(tree)).item())
    return digest or repr(sorted(root_attribute(tree, "study")["table"]["reference"].items()))


def _numbers(frame: pd.DataFrame, y: str) -> pd.DataFrame:
    values, errors = statistics.numbers_of(frame, y)
    if y == RELATIVE:
        values = np.maximum(values, NEXT_TO_EQUAL)
        # An object that both studies reproduce must not hide what changed for all others.
        errors = np.minimum(errors, values - NEXT_TO_EQUAL)
    errors = statistics.errors_of_logarithms(values, errors)
    return frame[[*_KEYS, "family"]].assign(value=values, log_error=errors)[np.isfinite(values)]


def _change(meshes: pd.DataFrame) -> dict[str, object]:
    by_object = meshes.groupby("object", sort=False)[["log_ratio", "log_error"]].mean()
    units = by_object if len(by_object) > 1 else meshes
    ratios, errors = units["log_ratio"].to_numpy(), units["log_error"].to_numpy()
    worst = meshes.loc[meshes["log_ratio"].idxmax()]
    return {
        "objects": len(by_object),
        "meshes": len(meshes),
        **dict(zip(("ratio", *ENDS), np.exp(statistics.interval(ratios, errors)), strict=True)),
        "p": statistics.sign_flip_test(ratios, errors),
        "worst": f"{worst['object']}/{worst['mesh']}".lstrip("/"),
        "worst_ratio": float(np.exp(worst["log_ratio"])),
    }


def format_changes(changes: pd.DataFrame, style: Format = "text") -> str:
    """Return the result of `compare_studies` as text."""
    sections = [
        Section(f"New study against the old one at order {order:g}", [(_COLUMNS, rows)])
        for order, rows in changes.groupby("order", sort=False)
    ]
    units = "objects" if (changes["objects"] > 1).all() else "meshes"
    notes = wrapped(_NOTE.format(units=units))
    least = statistics.least_objects(changes["method"].nunique())
    if (changes[units] < least).any():
        notes.append(f"With fewer than {least} {units}, the test decides nothing; look at the intervals.")
    notes += [f"{label} is in the old study, and missing in the new one." for label in changes.attrs.get("lost", ())]
    return rendered(style, changes, sections, notes)
