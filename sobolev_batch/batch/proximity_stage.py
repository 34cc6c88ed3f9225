"""Hausdorff and other usual distances of meshes from the reference, where a study requests them.

A task measures those of a mesh, without fields, and adds them to the mesh's record. A table is made from the records.
"""

import logging
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import xarray as xr

from sobolev_batch import compiled
from sobolev_batch.batch.cluster.execution import Cluster, Stages, Task, Wave, describe_failure
from sobolev_batch.batch.field_costs import MESH_BYTES
from sobolev_batch.errors import InputError, MeshError, StoreError, one_line
from sobolev_batch.geometry import proximity
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Similarity
from sobolev_batch.norms.columns import describe
from sobolev_batch.sources.registry import digest_of
from sobolev_batch.store.layout import Store, table_attributes, write_table
from sobolev_batch.store.records import ProximityRecord, Record, Records
from sobolev_batch.store.workspace import Workspace
from sobolev_batch.study.plan import Row
from sobolev_batch.study.schema import ProximitySection
from sobolev_batch.tables.results import table_order

_log = logging.getLogger(__name__)

# Raise it whenever the distances come out differently: they are then measured again.
_VERSION = 10
# What a search has proved up to rounding still holds in the unit of the files.
_BELOW = 1 - 1e-9
_GROUP = "proximity"


def have_proximities(workspace: Workspace) -> bool:
    """Return True where the store has all distances that the study requests, and readers find them."""
    attributes, table = table_attributes(workspace.store, _GROUP), _table(workspace)
    if attributes is None or table is None:
        return attributes is table
    return bool(attributes.get("digest") == table.attrs["digest"]) and not _pending(workspace)


def measure_proximities(cluster: Cluster, workspace: Workspace) -> Stages[None]:
    """Measure the distances that the records lack, and write their table, or remove one that nobody requests."""
    requested = workspace.plan.study.proximity
    if requested is not None and (pending := _pending(workspace)):
        yield from _measure(cluster, workspace, requested, pending)
    if have_proximities(workspace):
        return
    workspace.store.remove(_GROUP)
    if (table := _table(workspace)) is not None:
        write_table(workspace.store, _GROUP, table)
        workspace.store.consolidate()


def _measure(cluster: Cluster, workspace: Workspace, requested: ProximitySection, keys: dict[int, str]) -> Stages[None]:
    similarity, complete, reference = workspace.plan.similarity, workspace.complete, workspace.reference
    tasks = []
    for i, key in keys.items():
        projected_bytes = 2 * proximity.POINT_BYTES * requested.points + proximity.WORKING_BYTES
        for row in (i, reference):
            triangles, size = complete[row].facts.triangles, workspace.rows[row].member.expected_size()
            projected_bytes += proximity.TRIANGLE_BYTES * triangles + max(size.projected_bytes, MESH_BYTES * triangles)
        pair = tuple((workspace.rows[row], complete[row].facts.digest) for row in (i, reference))
        arguments = workspace.store, i, complete[i], key, pair, similarity, requested
        label = workspace.labels[i]
        tasks.append(Task(measure_proximity, arguments, projected_bytes, row=i, label=label, stage="proximity"))
    advance = cluster.count_steps("proximity", len(tasks))

    def take(task: Task, record: Any) -> None:
        if not isinstance(record, Record):
            reason = describe_failure(record)
            _log.error("%s: no proximity: %s", task.label, reason)
            record = replace(complete[task.row], proximity=ProximityRecord(keys[task.row], reason))
            Records(workspace.store).write(task.row, record)
        workspace.records[task.row] = record
        advance(task.label, None)

    yield Wave(cluster, tasks, take, max(task.projected_bytes for task in tasks))


def measure_proximity(
    store: Store,
    row: int,
    record: Record,
    key: str,
    pair: Sequence[tuple[Row, str]],
    similarity: Similarity,
    requested: ProximitySection,
) -> Record:
    """Measure the distances of a mesh from the reference, and write its record with them, unless it has them.

    A mesh that cannot be measured does not raise: the reason is part of the record. The pair is the row of the mesh and
    that of the reference, each with the digest of the mesh whose field is stored. A StoreError is not the mesh's fault.
    """
    # Dask has a task done again whose worker was lost with the result.
    stored = Records(store).read_one(row)
    if stored is not None and (known := stored.proximity) is not None and known.key == key and not known.reason:
        return stored
    started = time.perf_counter()
    try:
        limit = None if requested.threshold is None else requested.threshold * similarity.scale
        # The bounds of a mesh that was searched are to prove what the search has proved.
        tolerance = dict(pair[0][0].member.metadata).get("target_tolerance")
        within = _BELOW * tolerance * similarity.scale if isinstance(tolerance, float) else None
        # Digits, and bounds with them, do not depend on what else the process computes.
        with compiled.by_itself(loops=True):
            meshes, points = (_load(*mesh, similarity) for mesh in pair), requested.points
            found, _ = proximity.proximity_and_deviations(*meshes, points=points, threshold=limit, within=within)
        lengths = {name: found[name] / similarity.scale for name in proximity.LENGTHS}
        measured = ProximityRecord(key, "", {**found, **lengths})
    except StoreError:
        raise
    except Exception as error:
        if not isinstance(error, InputError):
            _log.error("%s: proximity failed for a reason that is not its mesh's", pair[0][0].label, exc_info=error)
        measured = ProximityRecord(key, one_line(error))
    record = replace(record, proximity=replace(measured, seconds=time.perf_counter() - started))
    Records(store).write(row, record)
    return record


def _load(row: Row, digest: str, similarity: Similarity) -> Mesh:
    """Load the mesh of a row in the study's unit, where it is still the one whose field is stored."""
    surface = similarity.apply(row.member.load())
    if not isinstance(surface, Mesh) or surface.digest != digest:
        raise MeshError(f"{row.label} is not the mesh whose field is stored; has a file changed? Run the study again")
    return surface


def _requested(workspace: Workspace) -> dict[int, tuple[str, ProximityRecord | None]]:
    """Return the key of the distances of each mesh that the study requests, and what was measured of them, by row.

    The key is a digest of all that they depend on.
    """
    requested, complete, reference = workspace.plan.study.proximity, workspace.complete, workspace.reference
    if requested is None or reference not in complete:
        return {}
    settings = requested.points, requested.threshold, workspace.plan.similarity.scale
    found = {}
    for i, record in complete.items():
        # Closed forms have no triangles.
        if i != reference and record.facts.triangles:
            key = digest_of([_VERSION, record.facts.digest, complete[reference].facts.digest, *settings])
            found[i] = key, record.proximity if record.proximity and record.proximity.key == key else None
    return found


def _pending(workspace: Workspace) -> dict[int, str]:
    """Return the keys of the distances that are to be measured, by the rows of their meshes."""
    return {i: key for i, (key, record) in _requested(workspace).items() if record is None or record.reason}


def _table(workspace: Workspace) -> xr.Dataset | None:
    """Return the numbers of `proximity` (mesh), and `reason` where they are NaN; None where none are requested.

    They are in the order of tables, of the meshes as they are now, with a digest of all records.
    """
    if (requested := workspace.plan.study.proximity) is None:
        return None
    measured = _requested(workspace)
    records = {workspace.labels[i]: measured.get(i, ("", None))[1] for i, _, _ in table_order(workspace)}
    numbers = [record.numbers if record else {} for record in records.values()]
    columns: dict[str, Any] = {name: [one.get(name, np.nan) for one in numbers] for name in proximity.NUMBERS}
    columns["reason"] = np.array([record.reason if record else "" for record in records.values()], dtype=object)
    lines = [[label, record and asdict(record)] for label, record in records.items()]
    attributes = {
        "reference": workspace.plan.reference,
        "points": requested.points,
        "metrics": list(requested.metrics),
        "digest": digest_of([requested.metrics, lines]),
    }
    variables = {name: ("mesh", values) for name, values in columns.items()}
    table = xr.Dataset(variables, coords={"mesh": np.array([*records], dtype=object)}, attrs=attributes)
    return describe(table.set_coords("reason"))
