"""Tables of an open store at orders that it lacks, computed from its spectra and fields."""

from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr

from sobolev_batch.errors import InputError
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.norms.columns import describe
from sobolev_batch.parameters import as_names
from sobolev_batch.sources.names import quoted
from sobolev_batch.store.layout import QUALITY
from sobolev_batch.store.records import Records
from sobolev_batch.store.workspace import complete_records, rows_unlike_tables
from sobolev_batch.tables.evaluator import Evaluator
from sobolev_batch.tables.open import finished_group, reference_of, require_unchanged, source_of, store_of
from sobolev_batch.tables.pairs import known_distances
from sobolev_batch.tables.results import table_of, tables_from_spectra
from sobolev_batch.tables.stored_spectra import spectrum_keys, stale_chunks
from sobolev_batch.transform.lattice import Orders, check_orders

Meshes = str | Sequence[str] | None


def stored_evaluator(tree: xr.DataTree, order: Orders, *meshes: str) -> tuple[Evaluator, list[int]]:
    """Return the evaluator of an open store for any orders, and the rows of some meshes.

    No record of other meshes is read, and distances are to the last one. Without labels, all records are read, and
    distances are to the reference. InputError where no mesh with a field has a label, DamageError where the record of a
    mesh is not the one that the tables were made from.
    """
    store, orders = store_of(tree), check_orders(order)
    labels, removed, chosen = store.labels(), store.removed, set(meshes)
    wanted = {i for i, label in enumerate(labels) if label not in removed and (not chosen or label in chosen)}
    read = {i: Records(store).read_one(i) for i in wanted} if meshes else dict(enumerate(Records(store).read()))
    records = [read[i] if i in wanted else None for i in range(len(labels))]
    for i, problem in (rows_unlike_tables(store, records) if wanted else {}).items():
        if i in wanted:
            raise store.damage(f"the field of {labels[i]}", problem, i)
    complete = complete_records(records)
    places = {label: row for row, label in enumerate(labels)}
    for mesh in meshes:
        if places.get(mesh) not in complete:
            raise _no_field(tree, mesh, labels[:3])
    rows, reference = [places[mesh] for mesh in meshes], store.reference
    qualities = {row: record.quality for row, record in complete.items()}
    checksums = {row: record.checksums for row, record in complete.items()}
    compared_with = rows[-1] if rows else None
    return Evaluator.for_fields(store, store.choice(), orders, qualities, checksums, reference, compared_with), rows


def _computed(tree: xr.DataTree, orders: tuple[float, ...], meshes: Meshes) -> dict[str, xr.Dataset]:
    """Return the tables of meshes at orders that an open store lacks, from spectra, by group."""
    store, reference = store_of(tree), reference_of(tree)
    table = finished_group(tree, "meshes", load=False)
    if meshes is not None:
        chosen = as_names(meshes)
        require_fields(tree, table, chosen)
        table = table.sel(mesh=list(dict.fromkeys([*chosen, reference])))
    complete = table.isel(mesh=table["status"].values == "complete")
    labels, complete_rows, own_keys = (complete[name].values.tolist() for name in ("mesh", "row", "key"))
    row_of_reference = dict(zip(labels, complete_rows, strict=True)).get(reference, -1)
    keys = spectrum_keys(dict(zip(complete_rows, own_keys, strict=True)), row_of_reference)
    if stale_chunks(store, keys):
        raise store.damage("a radial spectrum", "it is not that of the stored field")
    rows = sorted(keys)
    texts = np.asarray(store.read(QUALITY, rows)).tolist() if rows else []
    qualities = dict(zip(rows, texts, strict=True))
    evaluator = Evaluator.for_fields(store, store.choice(), orders, qualities, {}, row_of_reference)
    rtol = finished_group(tree, "convergence", load=False).attrs.get("rtol")
    return tables_from_spectra(evaluator, table, reference, None if rtol is None else Accuracy(rtol))[1]


def table_at(tree: xr.DataTree, group: str, order: Orders | None, meshes: Meshes = None) -> xr.Dataset:
    """Return the table convergence or norms of an open store at some orders, of the store or not, in memory.

    The attribute ``computed`` lists the orders that were computed from radial spectra. The table may have more meshes
    than those that are needed. DamageError where a field is not what was stored.
    """
    stored = finished_group(tree, group, load=False)
    return _at_orders(tree, stored, order, lambda new: _computed(tree, new, meshes)[group]).load()


def distances_at(tree: xr.DataTree, order: Orders | None) -> xr.Dataset:
    """Return the distances of a store's meshes, in the order of tables; lazily if it has all orders."""
    meshes = finished_group(tree, "meshes", load=False)
    labels = meshes["mesh"].values
    stored = finished_group(tree, "distances", load=False).drop_vars("key", errors="ignore").sel(mesh=labels)
    if stored.sizes["other"] != stored.sizes["mesh"]:
        return _at_orders(tree, stored, order, lambda new: _computed(tree, new, None)["distances"])

    def compute(others: tuple[float, ...]) -> xr.Dataset:
        evaluator, _ = stored_evaluator(tree, others)
        rows: list[int] = meshes["row"].values.tolist()
        found = known_distances(evaluator, rows, rows, set(evaluator.complete)).named("distance")
        return describe(table_of(found, meshes, others, "mesh", "other").assign_coords(other=labels))

    return _at_orders(tree, stored.sel(other=labels), order, compute)


def require_fields(tree: xr.DataTree, table: xr.Dataset, meshes: Sequence[str]) -> None:
    """Refuse labels of meshes that a table lacks, or that have no field."""
    labels, is_complete = table.indexes["mesh"], table["status"].values == "complete"
    for mesh, place in zip(meshes, labels.get_indexer(list(meshes)).tolist(), strict=True):
        if place < 0 or not is_complete[place]:
            raise _no_field(tree, mesh, labels[:3])


def _no_field(tree: xr.DataTree, mesh: str, known: Sequence[str]) -> InputError:
    return InputError(f"{source_of(tree)}: no mesh {quoted(mesh)} with a field; its labels begin {[*known]}")


def order_note(tree: xr.DataTree, orders: Sequence[float]) -> list[str]:
    """Return what orders that were computed from the fields rest on, as lines of a note of a table."""
    choice = store_of(tree).choice()
    frequencies = f"frequencies up to {choice.lattice.xi_max:g} on each axis"
    if choice.tail is not None:
        frequencies = f"{frequencies}, and samples in octaves up to {choice.tail.highest_frequency:.4g}"
    return [
        f"Not of the study, but computed now from its stored fields: order {', '.join(f'{s:g}' for s in orders)}.",
        f"They hold {frequencies}.",
        "What lies beyond is in the errors, which grow at orders nearer to -1/2.",
    ]


def _at_orders(
    tree: xr.DataTree, stored: xr.Dataset, order: Orders | None, compute: Callable[[tuple[float, ...]], xr.Dataset]
) -> xr.Dataset:
    """Return a table of an open store at some orders, or all of its own; those that it lacks are computed."""
    own: list[float] = stored["order"].values.tolist()
    chosen = own if order is None else list(check_orders(order))
    if not (others := tuple(dict.fromkeys(s for s in chosen if s not in own))):
        return stored.sel(order=chosen)
    computed, own = compute(others), [s for s in own if s in chosen]
    table = xr.concat(
        [*([stored.sel(mesh=computed["mesh"], order=own)] if own else []), computed],
        "order", data_vars="minimal", coords="minimal", compat="override", join="exact", combine_attrs="override",
    ).sel(order=chosen).load()  # fmt: skip
    # Both are of one state of the store.
    require_unchanged(tree)
    return table.assign_attrs({**stored.attrs, "computed": list(others)})
