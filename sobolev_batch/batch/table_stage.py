"""Tables from stored fields: computed by tasks of the cluster, and written to the store."""

from collections.abc import Sequence
from dataclasses import dataclass

import xarray as xr

from sobolev_batch.batch.cluster.execution import Cluster, Stages, Task, result_from, wait_for
from sobolev_batch.errors import DamageError
from sobolev_batch.norms.estimate import NormEstimate
from sobolev_batch.sources.registry import digest_of
from sobolev_batch.store import layout
from sobolev_batch.store.workspace import Workspace
from sobolev_batch.tables.all_objects import Tables
from sobolev_batch.tables.evaluator import Evaluator
from sobolev_batch.tables.pairs import Pairs, fill_tile
from sobolev_batch.tables.results import Placed, coordinates_of, meshes_table, table_order, tables_from_spectra
from sobolev_batch.tables.stored_spectra import fill_chunk, spectrum_keys, stale_chunks

# Raise it whenever tables hold something that those of older versions lack: they are then made again.
TABLES_VERSION = 22


@dataclass(frozen=True)
class Tabulated:
    """Content of new tables: distances to the reference, and the tables that the root of a study repeats."""

    distances: NormEstimate
    tables: Tables


def tabulate_fields(cluster: Cluster, workspace: Workspace) -> Stages[Tabulated | None]:
    """Write the tables, and return what they hold, or None where the tables were there."""
    placed = table_order(workspace)
    digest = _digest(workspace, placed)
    if are_tabulated(workspace, digest):
        return None
    store, plan, complete = workspace.store, workspace.plan, workspace.complete
    qualities = {row: record.quality for row, record in complete.items()}
    checksums = {row: record.checksums for row, record in complete.items()}
    evaluator = Evaluator.for_fields(store, plan.choice, plan.study.orders, qualities, checksums, workspace.reference)
    # A larger task is tried all the same, with nothing beside it.
    projected_bytes = min(evaluator.task_bytes, cluster.workers.largest_allowed_bytes)
    keys, meshes = spectrum_keys(_record_keys(workspace), workspace.reference), meshes_table(workspace, placed)
    chunks = stale_chunks(store, keys)
    pairs, tiles, replaced = _pairs(workspace), list[tuple[int, int]](), list[str]()
    if pairs is not None:
        # Readers find all tables of one state, or none.
        replaced = layout.hide_tables(store)
        pairs.lay_out(coordinates_of(meshes, plan.study.orders))
        tiles = pairs.stale()
    advance = cluster.count_steps("tables", len(chunks) + len(tiles))
    parts = ((evaluator.only(rows), n, {row: keys[row] for row in rows if row in keys}) for n, rows in chunks.items())
    of_spectra = (Task(fill_chunk, part, projected_bytes, stage="spectra") for part in parts)
    yield from wait_for(cluster, of_spectra, lambda _: advance("", None), projected_bytes)
    if pairs is not None:
        # Pairs wait for all spectra, from which their row of the reference comes.
        own_pairs = ((pairs.only(tile), tile) for tile in tiles)
        of_tiles = ((evaluator.only(own.keys), own, tile) for own, tile in own_pairs)
        of_pairs = (Task(fill_tile, of_tile, projected_bytes, stage="pairs") for of_tile in of_tiles)
        yield from wait_for(cluster, of_pairs, lambda _: advance("", None), projected_bytes)
    last = Task(write_results, (workspace, evaluator, meshes, digest, replaced), projected_bytes, stage="tables")
    tabulated: Tabulated
    tabulated, store.metadata = yield from result_from(cluster, last)
    return tabulated


def write_results(
    workspace: Workspace, evaluator: Evaluator, meshes: xr.Dataset, digest: str, replaced: Sequence[str]
) -> tuple[Tabulated, layout.Metadata]:
    """Write the tables that follow from stored spectra, the same each time, and return also the metadata then."""
    store, plan = workspace.store, workspace.plan
    distances, tables = tables_from_spectra(evaluator, meshes, plan.reference, plan.study.accuracy)
    numerics = sorted({record.numerics for record in workspace.complete.values()})
    tables["convergence"].attrs |= {"digest": digest, layout.NUMERICS: numerics}
    replaced = [*replaced, *(layout.hide_tables(store) if _pairs(workspace) is None else ())]
    store.write(layout.QUALITY, [0], workspace.qualities)
    layout.write_table(store, "meshes", meshes)
    layout.write_table(store, "norms", tables["norms"])
    if layout.PAIRS_KEYS not in store.documents:
        if store.stored_document(layout.PAIRS_KEYS) is not None:
            store.location.remove(layout.DISTANCES)
        layout.write_table(store, layout.DISTANCES, tables["distances"])
    # This is written last: its digest says that all tables belong to the fields that are stored.
    layout.write_table(store, "convergence", tables["convergence"])
    for name in set(replaced) - store.documents.keys():
        store.location.remove(name)
    store.consolidate()
    return Tabulated(distances, {"meshes": meshes, "convergence": tables["convergence"]}), store.metadata


def _pairs(workspace: Workspace) -> Pairs | None:
    """Return the distances of all pairs, if the study requests them: of the meshes in the order of their rows."""
    if (study := workspace.plan.study).pairs != "all":
        return None
    rows = tuple(sorted(workspace.rows))
    return Pairs(workspace.store, rows, _record_keys(workspace), study.orders, workspace.reference)


def _record_keys(workspace: Workspace) -> dict[int, str]:
    return {row: record.key for row, record in workspace.complete.items()}


def are_tabulated(workspace: Workspace, digest: str = "") -> bool:
    """Return True where the tables of a store belong to its fields and to the plan, by their digest if it is known."""
    attributes = layout.table_attributes(workspace.store, "convergence")
    if attributes is None or attributes.get("digest") != (digest or _digest(workspace, table_order(workspace))):
        return False
    if stale_chunks(workspace.store, spectrum_keys(_record_keys(workspace), workspace.reference)):
        return False
    pairs = _pairs(workspace)
    if pairs is not None and (layout.PAIRS_KEYS not in workspace.store.documents or pairs.stale()):
        return False
    try:
        return list(workspace.store.read_strings(layout.QUALITY)) == workspace.qualities
    except DamageError:
        return False


def _digest(workspace: Workspace, placed: Sequence[Placed]) -> str:
    plan, rows = workspace.plan, []
    for i, _, _ in placed:
        row, record = workspace.rows[i], workspace.records[i]
        state = (record.key, record.status, record.reason, record.remark) if record else ()
        rows.append([row.label, row.family, row.member.time, row.member.metadata, *state])
    inputs = {
        "version": TABLES_VERSION,
        "rows": rows,
        "orders": plan.study.orders,
        "pairs": plan.study.pairs,
        "reference": plan.reference,
        "order_by": {family.name: family.order_by for family in plan.study.object.families},
    }
    return digest_of(inputs)
