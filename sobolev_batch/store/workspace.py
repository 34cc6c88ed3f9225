"""What a store has of a study, and what is missing; and the workspace of a run, which fills it."""

import logging
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from sobolev_batch.errors import DamageError, StoreError
from sobolev_batch.store.create import labels_for, prepare_store
from sobolev_batch.store.field_arrays import Fields
from sobolev_batch.store.layout import QUALITY, Store, hide_tables, stored_choice, table_attributes
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import utc_now
from sobolev_batch.store.records import ObjectRecord, Record, Records
from sobolev_batch.study.plan import Plan, Row, make_plan
from sobolev_batch.study.study import Study

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Contents:
    """Rows that a store has of a study, and that are missing: for plans, runs, status, verification and pruning.

    Attributes:
        labels: Label of each row of the store.
        rows: Rows of the plan, by their number in the store; None each where no plan is at hand. The store may have
            others, of meshes that the study has lost: their fields stay, in case the meshes come back.
        records: Completion record of each row of the store, kept up to date; None without one.
    """

    store: Store
    labels: Sequence[str]
    rows: Mapping[int, Row | None]
    records: list[Record | None]

    @classmethod
    def of_store(cls, store: Store) -> Self:
        """Return the contents of a store without a plan of its study."""
        labels, removed = store.labels(), store.removed
        rows = dict.fromkeys(i for i, label in enumerate(labels) if label not in removed)
        return cls(store, labels, rows, list(Records(store).read()))

    @property
    def complete(self) -> dict[int, Record]:
        """Records of the study's rows whose fields are stored."""
        return {i: record for i, record in complete_records(self.records).items() if i in self.rows}

    @property
    def qualities(self) -> list[str]:
        """Quality of each row's field, of which readers find a copy beside the fields; empty without a field."""
        return [record.quality if record else "" for record in self.records]

    def withdraw(self, rows: Iterable[int], damage: str = "") -> None:
        """Withdraw the records of rows, whose fields may be damaged: a run computes those again."""
        for i in rows:
            if damage:
                _log.warning("the field of %s is damaged (%s) and is computed again", self.labels[i], damage)
            Records(self.store).write(i, None)
            self.records[i] = None

    def tally(self, imprecise: Mapping[str, float] | None = None) -> ObjectRecord:
        """Return what the store has and lacks, as the record of its object.

        A run that has just written the tables knows which distances are imprecise, and that no record was lost since.
        """
        complete, found = self.complete, ((self.labels[i], self.records[i]) for i in self.rows)
        is_compared = self.store.attributes()["study"]["table"].get("proximity") is not None
        measured = ((self.labels[i], record.proximity) for i, record in complete.items() if is_compared)
        return ObjectRecord(
            complete=len(complete),
            total=len(self.rows),
            failed={label: one.reason for label, one in found if one and one.status == "failed"},
            not_compared={label: f"no proximity: {one.reason}" for label, one in measured if one and one.reason},
            imprecise=imprecise or {},
            lost_records=tuple(self.labels[row] for row in self.unlike_tables) if imprecise is None else (),
            has_tables=self.has_tables,
            finished=utc_now(),
        )

    @property
    def has_tables(self) -> bool:
        """True where readers find tables; those may be of other fields, see `unlike_tables`."""
        return table_attributes(self.store, "convergence") is not None

    @property
    def unlike_tables(self) -> dict[int, str]:
        """Difference of the records of the study's rows from those that the tables were made from, by row."""
        return {i: how for i, how in rows_unlike_tables(self.store, self.records).items() if i in self.rows}


@dataclass(frozen=True, eq=False)
class Workspace(Contents):
    """A store and the plan that is carried out in it."""

    rows: Mapping[int, Row]
    plan: Plan

    def __getstate__(self) -> dict[str, Any]:
        # A store travels to other processes without its metadata, which a workspace needs there.
        return {**vars(self), "metadata": self.store.metadata}

    def __setstate__(self, state: dict[str, Any]) -> None:
        metadata = state.pop("metadata")
        vars(self).update(state)
        self.store.metadata = metadata

    @classmethod
    def for_plan(cls, store: Store, plan: Plan) -> Self:
        """Return the workspace of a store for a plan, whose rows it need not have all."""
        by_label, records = {row.label: row for row in plan.rows}, list(Records(store).read())
        # A run takes the field of a mesh that has another name by now.
        labels = labels_for(plan, store.labels(), records, is_trusted=True)[: len(records)]
        rows = {i: by_label[label] for i, label in enumerate(labels) if label in by_label}
        return cls(store, labels, rows, records, plan)

    @classmethod
    def found(cls, location: Location, plan: Plan) -> Self | None:
        """Return the workspace of a store that need not be there, or not be finished."""
        store = Store(location)
        if not store.exists() or store.is_unfinished:
            return None
        store.attributes()
        return cls.for_plan(store, plan)

    @classmethod
    def prepared(cls, location: Location, plan: Plan) -> Self:
        """Create or open the store of a plan, and withdraw the records of lost fields; see `prepare_store`.

        StoreError where a run of a part, with other settings, would lose the fields that it leaves out.
        """
        with suppress(DamageError):  # It is made again.
            present = None if all(row.is_chosen for row in plan.rows) else cls.found(location, plan)
            # None has the settings of now, and not only some have another file.
            if present is not None and present.outdated and not present.stored:
                raise StoreError(
                    f"{location}: settings or the reference have changed, and {len(present.outdated)} fields that this "
                    f"run of a part leaves out would be lost, such as {present.labels[present.outdated[0]]}; run all "
                    "of the study, or name another store"
                )
        workspace = cls.for_plan(prepare_store(location, plan), plan)
        if complete := workspace.complete:
            whole = Fields(workspace.store).complete_rows()
            workspace.withdraw((i for i in complete if i not in whole), "it is not there, or not all of it")
        return workspace

    @classmethod
    def of_study(cls, study: Study, location: Location) -> Self:
        """Plan a study of one object and prepare its store, which this process or its run has locked."""
        workspace = cls.prepared(location, make_plan(study, stored_choice(location)))
        if workspace.pending and study.cache is not None and study.cache.versions_changed():
            # A program of another version makes other meshes: the study is listed again.
            return cls.prepared(location, make_plan(study.with_cache(study.cache), stored_choice(location)))
        return workspace

    @property
    def reference(self) -> int:
        """Row of the reference."""
        return self.labels.index(self.plan.reference)

    @property
    def stored(self) -> dict[int, Record]:
        """Records of the rows whose fields are those that the plan asks for."""
        return {i: record for i, record in self.complete.items() if record.completes(self.rows[i].key)}

    @property
    def pending(self) -> list[int]:
        """Rows whose fields are to be computed."""
        stored = self.stored
        return [i for i, row in self.rows.items() if row.is_chosen and i not in stored]

    @property
    def outdated(self) -> list[int]:
        """Rows whose fields are not those that the plan asks for, and are not to be computed."""
        stored = self.stored
        return [i for i in self.complete if i not in stored and not self.rows[i].is_chosen]

    def put_in_order(self) -> None:
        """Collect records in pages, and remember what tables hold: later runs take fewer requests."""
        Records(self.store).collect(self.records)
        self.store.remember()

    def withdraw_results_of(self, rows: Sequence[int]) -> None:
        """Withdraw the tables and qualities that follow from fields which are about to be replaced.

        Fields that are outdated, and stay, are as good as missing: no table may mix them with others.
        """
        others = self.outdated
        if replaced := {*others, *(i for i in rows if self.records[i] is not None)}:
            hide_tables(self.store)
            qualities = ["" if i in replaced else quality for i, quality in enumerate(self.qualities)]
            self.store.write(QUALITY, [0], qualities)
        self.withdraw(others)


def complete_records(records: Sequence[Record | None]) -> dict[int, Record]:
    """Return the records that are complete, by their rows."""
    return {row: record for row, record in enumerate(records) if record is not None and record.status == "complete"}


def rows_unlike_tables(store: Store, records: Sequence[Record | None]) -> dict[int, str]:
    """Return how records differ from those that the tables were made from, by their rows."""
    if table_attributes(store, "convergence") is None:
        return {}
    columns = (np.asarray(store.read(f"meshes/{name}")).tolist() for name in ("row", "status", "key"))
    unlike = {}
    for row, status, key in zip(*columns, strict=True):
        record = records[row] if 0 <= row < len(records) else None
        if record is None and status != "missing":
            unlike[row] = "its completion record is missing"
        elif record is not None and (record.status, record.key) != (status, key):
            unlike[row] = "its completion record is not the one that the tables were made from"
    return unlike
