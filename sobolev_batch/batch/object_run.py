"""The run of one object: a worker plans it, and does small work at once; larger work becomes tasks of the cluster.

Whoever drives the run computes nothing itself: it hands out tasks, and keeps what they have found.
"""

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any, Self

import numpy as np

from sobolev_batch import compiled
from sobolev_batch.batch.cluster.execution import Cluster, Stages, Task, carried_out, result_from
from sobolev_batch.batch.cluster.workers import Workers
from sobolev_batch.batch.field_costs import is_predictable, row_seconds, size_rows
from sobolev_batch.batch.field_stage import compute_fields
from sobolev_batch.batch.proximity_stage import have_proximities, measure_proximities
from sobolev_batch.batch.table_stage import TABLES_VERSION, Tabulated, are_tabulated, tabulate_fields
from sobolev_batch.errors import DamageError, InputError
from sobolev_batch.norms.accuracy.tolerance import NEXT_TO_EQUAL
from sobolev_batch.sources.registry import digest_of
from sobolev_batch.store.field_arrays import Fields
from sobolev_batch.store.layout import stored_choice
from sobolev_batch.store.location import Location
from sobolev_batch.store.metadata import SCHEMA_VERSION
from sobolev_batch.store.records import ObjectRecord, Record, Records
from sobolev_batch.store.workspace import Workspace
from sobolev_batch.study.plan import fingerprint_of
from sobolev_batch.study.study import Members, Study, StudyObject
from sobolev_batch.tables.all_objects import Tables, packed_tables, tables_in
from sobolev_batch.transform.fourier import NUMERICS_VERSION

_log = logging.getLogger(__name__)

# A study whose distances miss the accuracy requested is computed again on a larger lattice, this often in all.
_MOST_ROUNDS = 3
# Fields that turn out damaged are computed again; where that goes on, something destroys them.
_MOST_REPAIRS = 3
# The worker that plans an object does all its work where that is predicted to take less: a task costs milliseconds.
_SMALL_SECONDS = 2.0
# Sections of a study on which all numbers of an object depend; it may gain others, families and named meshes.
_SETTINGS = ("accuracy", "lattice", "transform", "scaling", "reference")
_VERSIONS = (SCHEMA_VERSION, NUMERICS_VERSION, TABLES_VERSION)
# Keys of a family whose numbers are no sizes.
_VECTORS = ("axes", "center", "direction")


@dataclass(frozen=True)
class Ended:
    """Result of the run of an object.

    Attributes:
        record: What its store is known to have.
        computed, reused: Labels of the surfaces whose fields were computed now, and were stored before.
        tables: Rows of the object in the tables of all, see `packed_tables`; None where they have not changed.
    """

    record: ObjectRecord
    computed: tuple[str, ...] = ()
    reused: tuple[str, ...] = ()
    tables: bytes | None = None

    @classmethod
    def of(cls, workspace: Workspace, computed: set[int], tables: Tables | None = None) -> Self:
        """Return how a run ended that has computed some rows, by what its workspace holds now, and new tables."""
        labels, complete = workspace.labels, workspace.complete
        one = workspace.plan.study.object
        record = replace(workspace.tally(imprecise=_imprecise(workspace)), settings=_settings_of(one))
        if record.complete == record.total and not record.not_compared:
            prints = {row.label: row.fingerprint for row in workspace.plan.rows}
            record = replace(record, key=object_key(one, one.members, prints))
        return cls(
            record,
            tuple(labels[i] for i in workspace.rows if i in computed and i in complete),
            tuple(labels[i] for i in workspace.rows if i not in computed and i in complete),
            _rows_of_all(workspace, tables),
        )


# How an object ended whose run a worker did by itself, and the record of each surface that was computed, by label.
Begun = tuple[Ended, Mapping[str, Record | None]]


def ended_before(study: Study, record: ObjectRecord | None) -> Ended | None:
    """Return how an object ended of which nothing is missing, by its record; None where anything might be."""
    if record is None or not record.key:
        return None
    with suppress(InputError):  # Its run says what cannot be listed.
        one, members = study.object, study.object.members
        prints = {label: fingerprint_of(label, member) for label, (_, member) in members.items()}
        if record.key == object_key(one, members, prints):
            return Ended(record, reused=tuple(members))
    return None


def _settings_of(one: StudyObject) -> dict[str, Any]:
    own = dict.fromkeys(_SETTINGS) | {name: one.table[name] for name in (*_SETTINGS, "proximity") if name in one.table}
    if "accuracy" in one.table:
        own["norm"] = one.table.get("norm")
    named = {f"mesh {name}": digest_of(entry) for name, entry in one.table.get("mesh", {}).items()}
    # A family may gain sizes.
    named |= {f"family {family['name']}": digest_of(_without_sizes(family)) for family in one.table["family"]}
    return {"versions": [*_VERSIONS], **own, **named}


def _without_sizes(family: Mapping[str, Any]) -> dict[str, Any]:
    lists = {key: value for key, value in family.items() if key not in _VECTORS and isinstance(value, list)}
    sizes = {key for key, value in lists.items() if all(isinstance(one, Real) for one in value)}
    return {key: value for key, value in family.items() if key not in sizes}


def has_rows_of_now(one: StudyObject, record: ObjectRecord | None) -> bool:
    """Tell whether the rows of an object in the tables of all were made by the settings that its study has now."""
    settings = {} if record is None else record.settings
    return bool(settings) and settings.items() <= {"proximity": None, **_settings_of(one)}.items()


def object_key(one: StudyObject, members: Members, prints: Mapping[str, str]) -> str:
    """Return a digest of all that the tables of an object depend on; empty where a file of it cannot be read."""
    if not all(prints.values()):
        return ""
    surfaces = [[label, family, mesh.time, mesh.metadata, prints[label]] for label, (family, mesh) in members.items()]
    return digest_of([*_VERSIONS, one.table, surfaces])


def ended_already(workspace: Workspace) -> Ended | None:
    """Return how an object ended in whose workspace nothing is missing; None where anything is."""
    if not lacks_nothing(workspace):
        return None
    # The last run may have been killed before it did so.
    workspace.put_in_order()
    return Ended.of(workspace, set())


def run_object(study: Study, root: Location, cluster: Cluster, workspace: Workspace | None = None) -> Stages[Ended]:
    """Run a study of one object in a locked store, in its workspace where that is at hand, else as a worker plans it.

    The worker that plans does small work at once. The store of an object with a name lies in that of all.
    """
    if workspace is None:
        location = root.below(study.object.name) if study.object.name else root
        workers = cluster.workers.with_backend(study.backend)
        advance = cluster.count_steps("lattice", 1)
        # Should the worker die, another one leaves the work to tasks.
        careful = Task(begin, (study, location, None), stage="plan")
        first = Task(begin, (study, location, workers.smallest), stage="object", divided=(careful,))
        begun: Begun | Workspace = yield from result_from(cluster, first)
        advance("", None)
        if not isinstance(begun, Workspace):
            ended, records = begun
            if records:
                advance = cluster.count_steps("fields", len(records))
            for label, record in records.items():
                advance(label, record)
            return ended
        workspace = begun
    return (yield from _compute(cluster, workspace))


def workspace_at_hand(study: Study, location: Location) -> Workspace | None:
    """Return the workspace of an only object where planning takes no more than reading its reference."""
    is_quick = study.accuracy is None or stored_choice(location) is not None
    return Workspace.of_study(study, location) if is_quick else None


def begin(study: Study, location: Location, workers: Workers | None) -> Begun | Workspace:
    """Plan a study of one object and prepare its store; compute what is missing where that is small.

    Digits do not depend on what else the process computes. Without workers, of which this one has no more memory than
    any, nothing is computed.
    """
    # A worker plans many objects, for which compiling pays.
    with compiled.by_itself(loops=True):
        workspace = Workspace.of_study(study, location)
    if (before := ended_already(workspace)) is not None:
        return before, {}
    if workers is None or not _is_small(workspace, workers):
        return workspace
    ended = carried_out(_compute(Cluster(None, workers), workspace))
    records = dict(zip(workspace.labels, Records(workspace.store).read(), strict=True))
    return ended, {label: records[label] for label in ended.computed}


def _is_small(workspace: Workspace, workers: Workers) -> bool:
    """Tell whether the missing work of an object takes so little time and memory that one task may do all of it."""
    plan, study = workspace.plan, workspace.plan.study
    rows = [workspace.rows[i] for i in workspace.pending]
    if study.backend == "gpu" or study.pairs == "all" or not all(map(is_predictable, rows)):
        return False
    sizes, refused = size_rows(plan, rows, workers)
    is_little = all(one.task_bytes <= workers.allowed_bytes_per_task for one in sizes.values())
    return not refused and is_little and sum(row_seconds(plan, row) for row in rows) < _SMALL_SECONDS


def _compute(cluster: Cluster, workspace: Workspace) -> Stages[Ended]:
    """Compute what a workspace lacks, on larger lattices until the accuracy is reached, and measure proximities."""
    rows, study = workspace.pending, workspace.plan.study
    workspace.withdraw_results_of(rows)
    computed: set[int] = set()
    for rounds_left in reversed(range(_MOST_ROUNDS)):
        repaired, tabulated = yield from _compute_repairing(cluster, workspace, rows)
        computed.update(rows, repaired)
        if not rounds_left or tabulated is None or study.accuracy is None:
            break
        if (choice := workspace.plan.choice.grown(tabulated.distances, study.orders, study.accuracy)) is None:
            break
        # A run of a part would lose the fields that it leaves out.
        stored = {workspace.labels[i] for i in workspace.complete}
        arguments = workspace.store.location, workspace.plan.with_choice(choice, stored)
        workspace = yield from result_from(cluster, Task(Workspace.prepared, arguments, stage="layout"))
        rows = workspace.pending
    yield from measure_proximities(cluster, workspace)
    workspace.put_in_order()
    return Ended.of(workspace, computed, None if tabulated is None else tabulated.tables)


def _compute_repairing(
    cluster: Cluster, workspace: Workspace, rows: Sequence[int]
) -> Stages[tuple[set[int], Tabulated | None]]:
    """Compute fields and tables, and damaged fields again; return their rows, and the tables if they are new."""
    repairs, repaired = 0, set[int]()
    while True:
        try:
            yield from compute_fields(cluster, workspace, rows)
            return repaired, (yield from tabulate_fields(cluster, workspace))
        except DamageError as error:
            if repairs == _MOST_REPAIRS:
                raise
            repairs += 1
            _log.warning("%s", error)
            # Where one is damaged, others may be.
            rows = yield from result_from(cluster, Task(_damaged_rows, (workspace,), stage="check"))
            workspace.withdraw(rows, "its values are not what was stored")
            repaired.update(rows)


def _damaged_rows(workspace: Workspace) -> list[int]:
    """Return the rows whose fields are not what their records say."""
    return [i for i, record in workspace.complete.items() if Fields(workspace.store).damage(i, record)]


def lacks_nothing(workspace: Workspace) -> bool:
    """Return True where nothing of a plan is missing in its store, or outdated: fields, tables, other distances."""
    return not (workspace.pending or workspace.outdated) and are_tabulated(workspace) and have_proximities(workspace)


def _rows_of_all(workspace: Workspace, tables: Tables | None) -> bytes | None:
    """Return the rows of an object in the tables of all objects; None for an only one, whose tables are at the root."""
    if not (study := workspace.plan.study).object.name:
        return None
    if tables is None or study.proximity is not None:
        tables = tables_in(workspace.store)
    return packed_tables(study.object.name, tables, 1 / workspace.plan.similarity.scale) if tables else None


def _imprecise(workspace: Workspace) -> dict[str, float]:
    """Return the largest relative error of each mesh whose distances miss the accuracy, by its label."""
    if workspace.plan.study.accuracy is None or not workspace.has_tables:
        return {}
    store, names = workspace.store, ("distance", "error", "relative", "within")
    distances, errors, relative, within = (np.asarray(store.read(f"convergence/{name}")) for name in names)
    # Of what is next to equal to the reference, no computation gives digits.
    short = ~within.astype(bool) & (relative > NEXT_TO_EQUAL)
    largest = np.divide(errors, distances, out=np.zeros_like(errors), where=short).max(axis=1).tolist()
    return {label: error for label, error in zip(store.read_strings("convergence/mesh"), largest, strict=True) if error}
