"""Tables of distances to the reference, with observed rates, and the sizes of meshes that rates are over."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from sobolev_batch.errors import InputError
from sobolev_batch.geometry.proximity import METRICS, OF_ONE_MESH
from sobolev_batch.norms.columns import parts_as_variables
from sobolev_batch.norms.estimate import AREA_AND_SHAPE, PARTS
from sobolev_batch.shown import few_of
from sobolev_batch.sources.programs import Cost
from sobolev_batch.tables import Format
from sobolev_batch.tables.open import (
    AnyStore,
    AnyStores,
    as_tree,
    doubts_of,
    finished_group,
    has_objects,
    metadata_of,
    objects_of,
    reference_of,
    stores_of,
    study_unit,
    unit_of,
)
from sobolev_batch.tables.other_orders import order_note, table_at
from sobolev_batch.tables.rendering import Column, Section, filled, machine_table, rendered
from sobolev_batch.tables.text import between, count, percent, with_error, wrapped
from sobolev_batch.transform.lattice import Orders

ALONE = "The study has its reference alone: there is nothing to compare."
# What a remesher may break.
CONNECTION_COLUMNS = (
    Column("components", "components", "{:,.0f}".format),
    Column("euler_characteristic", "Euler", "{:,.0f}".format),
    Column("boundary_edges", "open edges", "{:,.0f}".format),
    Column("nonmanifold_edges", "non-manifold", "{:,.0f}".format),
    Column("inconsistent_edges", "flipped", "{:,.0f}".format),
    Column("zero_area_triangles", "degenerate", "{:,.0f}".format),
)
# Integers, or missing where a mesh failed.
_COUNTS = ("triangles", "vertices", *(column.name for column in CONNECTION_COLUMNS))
_ABOUT = ("family", "name", "level", "rank", "ordered_by", "status", "reason", "remark", *_COUNTS, "seconds")
_NUMBERS = (
    *("edge_length", "distance", "error", *PARTS, "relative", "relative_error", *AREA_AND_SHAPE),
    *("rate", "rate_error", "resolved", "within"),
)
# Of meshes that a program or function made.
_MADE = tuple(item.name for item in fields(Cost))
# What the rows of all objects have besides.
_OF_ALL = ("object", "reference", "unit_length")
_NOTE = """\
Relative distances are fractions of the reference's norm. Errors are meant as bounds, the sums of truncation
(frequencies beyond the highest one), aliasing (spacing of the lattice), discretisation (quadrature and NUFFT) and
chance (random frequencies, if the study samples octaves). A distance marked * is not larger than its error, and gives
no rate. The column "area" is the share of the squared distance that a change of total area alone explains."""
_UNIT_NOTE = """\
Edges and other lengths are in {}.
Sobolev distances are computed in {}."""
_PROXIMITY_NOTE = """\
Other distances are the same at all orders. They are those of points to the other mesh, the larger of both directions.
The Hausdorff distance is between the bounds; other numbers are those of sampled points, with standard errors. The bias
is the mean distance of points of the mesh, positive outside of the reference and negative inside. Chamfer is the sum of
the mean distances of both directions. Normals are compared as lines."""
_ACCURACY_NOTE = """\
The study requests an error of at most {rtol:g} of each distance; a distance marked ! has a larger one."""

MESH = Column("mesh", "mesh", kind="label")
TRIANGLES = Column("triangles", "triangles", count)
_COLUMNS = (
    MESH,
    TRIANGLES,
    Column("edge_length", "edge", "{:.4g}".format),
    Column("relative", "relative", percent, "relative_error", is_marked=True),
    Column("rate", "rate", with_error, "rate_error"),
    Column("area_fraction", "area", lambda fraction: f"{100 * fraction:.0f} %"),
    Column("distance", "distance", with_error, "error"),
)
DEVIATION = Column("hausdorff", "largest deviation", between, "hausdorff_upper")
_METRIC_COLUMNS = (
    Column("hausdorff", "Hausdorff", between, "hausdorff_upper"),
    Column("mean", "mean ± s.e.", with_error, "mean_error"),
    Column("rms", "RMS ± s.e.", with_error, "rms_error"),
    Column("bias", "bias ± s.e.", with_error, "bias_error"),
    *(Column(f"p{percent}", f"{percent} % ≤", "{:.3g}".format) for percent in (50, 95, 99)),
    Column("chamfer", "Chamfer ± s.e.", with_error, "chamfer_error"),
    Column("fscore", "F-score", lambda score: f"{100 * score:.1f} %"),
    Column("normal_mean", "normals", "{:.2g}°".format),
    Column("normal_max", "largest", "{:.2g}°".format),
    Column("volume", "volume", "{:.4g}".format),
    Column("smallest_angle", "angles ≥", "{:.2g}°".format),
    Column("aspect_ratio", "aspect ≤", "{:.3g}".format),
)


def table(store: AnyStore, order: Orders | None = None) -> pd.DataFrame:
    """Return the convergence table of a store in long form: one row for each mesh and order.

    Args:
        store: Path, URL or opened DataTree of the store. Rows of several objects begin with a column object.
        order: One order s < -1/2, or several; default all of the store. Others than those are computed from the stored
            fields, which takes about as long as reading them.

    Returns:
        One row for each mesh and order. Lengths of a mesh are in the study's unit. The columns:

        - order, mesh, family, name, level; rank, the place in the family from coarse to fine, and ordered_by, what
          decides on it (level, triangles, names or time);
        - status, reason (of a failure), remark (on its making), triangles, vertices, seconds (of computing), and
          edge_length (mean); the metadata that the study gives its meshes; what a remesher may break, by the names of
          `Mesh.counts`: components, euler_characteristic, boundary_edges, nonmanifold_edges, inconsistent_edges and
          zero_area_triangles; make_seconds, make_cpu_seconds, make_peak_bytes and exit_status, where programs made it;
        - distance (to the reference), error and its parts truncation, aliasing, discretisation and statistical;
          relative and relative_error (over the norm of the reference);
        - area_part and shape_part: what a change of total area alone explains of the distance, and the rest. Their
          squares add up to its square. area_part_error and shape_part_error are their errors;
        - rate, the observed order of convergence, and rate_error: distance ~ edge_length^rate;
        - resolved (the distance exceeds its error) and within (the error is as small as the study requests);
        - where the study requests [proximity]: the numbers of its metrics, by their names in `proximity`, and volume,
          smallest_angle and aspect_ratio; their lengths are in the unit of the files.

        Numbers of a mesh that failed are NaN. The frame's ``attrs`` have the reference's label, the ``unit`` of the
        files and, where there are any, the study's rtol, the names of ``metadata``, and as ``computed`` the orders
        computed from the fields. Those of several objects have what these share, and as ``left_out`` the names of
        objects without tables.

    Raises:
        InputError: The store has no tables yet.
        OrderError: An order is not below -1/2.
        DamageError: An order is to be computed, and a field is not what was stored.
        StoreError: The location has no store of a study.

    >>> import sobolev_batch as sb
    >>> frame = sb.table("storage/icosphere.zarr", order=-10)
    >>> frame.attrs["reference"]
    'reference'
    >>> frame.set_index("mesh")["rate"].round(1).to_dict()
    {'icosphere/0': nan, 'icosphere/1': 2.0, 'icosphere/2': 2.0, 'icosphere/3': 2.0}
    >>> frame[["components", "euler_characteristic"]].value_counts().to_dict()
    {(1, 2): 4}
    """
    frames = tables_of(store, order)
    return joined(frames, left_out(store, frames))


def tables_of(store: AnyStores, order: Orders | None = None) -> dict[str, pd.DataFrame]:
    """Return the rows of `table` of each object that has any, by its name, "" for an only one; InputError if none has.

    The root of a store has the rows of all objects at the orders of the study; others come from the stores of objects.
    """
    if not isinstance(store, Mapping) or isinstance(store, xr.DataTree):
        tree = as_tree(store)
        if not has_objects(tree):
            return {"": _table(tree, order)}
        if "convergence" in tree.children:
            stored = finished_group(tree, "convergence", load=False)["order"].values
            if order is None or np.isin(order, stored).all():
                return _divided(_rows(tree, order))
    trees = {name: as_tree(place) for name, place in stores_of(store).items()}
    if not (finished := {name: tree for name, tree in trees.items() if "convergence" in tree.children}):
        raise InputError("there are no tables yet: run the study to its end")
    return {name: _table(tree, order) for name, tree in finished.items()}


def _table(tree: xr.DataTree, order: Orders | None) -> pd.DataFrame:
    frame = _rows(tree, order)
    frame.attrs["reference"] = reference_of(tree)
    frame.attrs["unit_length"] = unit_of(tree)[1]
    return frame


def _rows(tree: xr.DataTree, order: Orders | None) -> pd.DataFrame:
    """Return the rows of all meshes but references, of an object or, with its name and unit, of all objects."""
    meshes, of_all = finished_group(tree, "meshes"), has_objects(tree)
    convergence = table_at(tree, "convergence", order)
    labels = convergence["mesh"].values
    others = labels != (convergence["reference"].values if of_all else reference_of(tree))
    about = [key for key in (*_ABOUT, *_MADE, *metadata_of(tree)) if key in meshes]
    columns = {"mesh": labels[others], **{key: meshes[key].values[others] for key in about}}
    if of_all:
        columns = {**{key: meshes[key].values[others] for key in _OF_ALL}, **columns}
    nearness = {}
    if "proximity" in tree.children:
        # Some objects may lack it, and texts have no missing value.
        proximity = finished_group(tree, "proximity").reset_coords(drop=True).reindex(mesh=labels[others])
        asked = [f"{name}{way}" for name in _metrics_of(tree) for way in ("", "_forward", "_backward")]
        nearness = {name: proximity[name].values for name in asked if name in proximity}
        nearness |= {name: meshes[name].values[others] for name in asked if name in OF_ONE_MESH}
        if "volume" in nearness:
            unit_length = meshes["unit_length"].values[others] if of_all else unit_of(tree)[1]
            nearness["volume"] = nearness["volume"] * unit_length**3
    frames = []
    for s in dict.fromkeys(convergence["order"].values.tolist()):
        row = parts_as_variables(convergence.sel(order=s))
        # Tables of older versions lack some.
        numbers = {key: row[key].values[others] for key in _NUMBERS if key in row}
        frames.append(pd.DataFrame({"order": s, **columns, **numbers, **nearness}))
    counts = {name: "Int64" for name in _COUNTS if name in about}
    frame = pd.concat(frames, ignore_index=True).astype(counts)
    frame.loc[frame["status"] != "complete", [*counts]] = pd.NA
    frame.attrs = {key: convergence.attrs[key] for key in ("rtol", "computed") if key in convergence.attrs}
    if known := metadata_of(tree):
        frame.attrs["metadata"] = known
    frame.attrs["unit"] = unit_of(tree)[0]
    return frame


def _divided(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return the rows of each object by its name, without what others alone have."""
    frames, known = {}, rows.attrs.get("metadata", ())
    objects, references, unit_lengths = (rows[key].tolist() for key in _OF_ALL)
    labels = [label[len(f"{name}/") :] for label, name in zip(rows["mesh"], objects, strict=True)]
    # A copy has all columns of a type in one array, from which rows are taken at once.
    without = rows.drop(columns=[*_OF_ALL]).assign(mesh=pd.Series(labels, dtype=rows["mesh"].dtype)).copy()
    for name, places in rows.groupby("object", sort=False).indices.items():
        frame = without.take(places).reset_index(drop=True)
        begin, first = len(f"{name}/"), places[0]
        own = [key for key in known if not frame[key].isin(["", np.nan]).all()]
        if len(own) < len(known):
            frame = frame.drop(columns=[key for key in known if key not in own])
        frame.attrs = {**rows.attrs, "reference": references[first][begin:], "unit_length": float(unit_lengths[first])}
        if known:
            frame.attrs["metadata"] = own
        frames[str(name)] = frame
    return frames


def joined(frames: Mapping[str, pd.DataFrame], left_out: Sequence[str] = ()) -> pd.DataFrame:
    """Return the rows of several objects after each other, named in the first column; those of an only one alone.

    The frame's attributes are those that all objects share, and the names of objects that are left out.
    """
    if "" in frames:
        return frames[""]
    frame = pd.concat(frames, names=["object", "row"]).reset_index(level="object").reset_index(drop=True)
    first, *others = (one.attrs for one in frames.values())
    frame.attrs = {key: value for key, value in first.items() if all(one.get(key) == value for one in others)}
    frame.attrs |= {"left_out": [*left_out]} if left_out else {}
    return frame


def left_out(store: AnyStores, frames: Mapping[str, pd.DataFrame]) -> list[str]:
    """Return the names of the objects of a store that have no rows."""
    return [name for name in objects_of(store) if name not in frames]


def notes_of_left_out(store: AnyStores, frames: Mapping[str, pd.DataFrame]) -> list[str]:
    """Return a sentence on the objects of a store that have no rows, by lines; nothing where all have some."""
    names = left_out(store, frames)
    count = f"{len(names):,} of {len(names) + len(frames):,}"
    left = f"{count} objects {'is' if len(names) == 1 else 'are'} left out, without tables"
    return wrapped(f"{left}: {few_of(names)}. The command status tells why.") if names else []


def format_table(store: AnyStores, style: Format = "text", orders: Sequence[float] | None = None) -> str:
    """Return the convergence tables of a store, or of several objects by their names, as text."""
    frames = tables_of(store, orders)
    if style in ("csv", "json"):
        return machine_table(joined(frames), style)
    stores = stores_of(store)
    trees = {name: as_tree(stores[name]) for name in frames}
    sections = (part for name, frame in frames.items() for part in _sections(name, trees[name], frame))
    notes = notes_of_left_out(store, frames) + _notes([*trees.values()], list(frames.values()))
    return rendered(style, joined(frames), sections, notes)


def _sections(name: str, tree: xr.DataTree, frame: pd.DataFrame) -> Iterator[Section]:
    if name:
        yield Section(f"Object {name}")
    marked = with_remarks(frame)
    # Meshes in the order of their names have no rates.
    columns = [one for one in _COLUMNS if one.name != "rate" or frame["rate"].notna().any()]
    for order, rows in marked.groupby("order", sort=False):
        yield Section(f"Sobolev distance of order {order:g} to {frame.attrs['reference']}", [(columns, rows)])
    once = marked.drop_duplicates("mesh")
    if "proximity" in tree.children:
        yield Section("Other distances, the same at all orders", [((MESH, *_METRIC_COLUMNS), once)])
    connection = [column for column in CONNECTION_COLUMNS if column.name in frame]
    if once[[column.name for column in connection]].nunique().gt(1).any():
        yield Section("How triangles are connected", [((MESH, *connection), once)])
    if "computed" in frame.attrs:
        yield Section(sentences=order_note(tree, frame.attrs["computed"]))
    yield Section(sentences=[ALONE] if frame.empty else remarks(tree, frame))


def _metrics_of(tree: xr.DataTree) -> list[str]:
    """Return the names of the numbers, besides Sobolev distances, that the study shows in its tables."""
    metrics = finished_group(tree, "proximity").attrs["metrics"] if "proximity" in tree.children else []
    return [name for metric in metrics for name in METRICS.get(metric, ())]


def page_columns(rows: Sequence[Mapping[Any, Any]]) -> list[Column]:
    """Return the columns that rows for a page, which may be narrow, have."""
    columns = filled([*_COLUMNS, *_METRIC_COLUMNS], rows)
    return sorted(columns, key=lambda column: (column is not MESH, not column.is_marked))


def with_remarks(frame: pd.DataFrame) -> pd.DataFrame:
    """Return rows of `table` with edges in the unit of the files, shares of area, marks, and why they are absent."""
    resolved, within = (frame[name].astype(bool) for name in ("resolved", "within"))
    shares = (frame["area_part"] / frame["distance"].where(frame["distance"] > 0)) ** 2
    return frame.assign(
        edge_length=frame["edge_length"] * frame.attrs["unit_length"],
        area_fraction=shares.where(resolved),
        mark=np.where(~resolved, "below its error", np.where(within, "", "above rtol")),
        absent=frame["status"].where(frame["status"] != "complete", ""),
    )


def _notes(trees: Sequence[xr.DataTree], frames: Sequence[pd.DataFrame]) -> list[str]:
    notes = wrapped(_NOTE) + wrapped(" ".join(unit_notes(trees)))
    if any("proximity" in tree.children for tree in trees):
        notes += wrapped(_PROXIMITY_NOTE)
    for rtol in dict.fromkeys(frame.attrs["rtol"] for frame in frames if "rtol" in frame.attrs):
        notes += wrapped(_ACCURACY_NOTE.format(rtol=rtol))
    return notes


def unit_notes(trees: Sequence[xr.DataTree]) -> list[str]:
    """Return the units of lengths and of distances in the tables of open stores, each in a sentence."""
    units, studies = sorted({unit_of(tree)[0] for tree in trees}), {study_unit(tree) for tree in trees}
    own = studies.pop() if len(studies) == 1 else "units of their own for each object"
    return _UNIT_NOTE.format(", ".join(units), own).splitlines()


def remarks(tree: xr.DataTree, frame: pd.DataFrame) -> list[str]:
    """Return why meshes of an object are missing or lack a number, and what makes one doubt others."""
    rows = frame.drop_duplicates("mesh")
    failures = [f"{row.mesh} failed: {row.reason}" for row in rows.query("status == 'failed'").itertuples(index=False)]
    if missing := int((rows["status"] == "missing").sum()):
        failures.append(f"{missing:,} of {len(rows):,} meshes are not computed; run the whole study to add them")
    if "proximity" in tree.children:
        reasons = finished_group(tree, "proximity")["reason"].to_series()
        failures += [f"{mesh} has no proximity: {reason}" for mesh, reason in reasons.items() if reason]
    return [*failures, *(f"{mesh}: {doubt}" for mesh, doubt in doubts_of(tree).items())]
