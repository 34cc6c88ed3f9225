"""The workspace of a run: a store, and how much of a plan it holds."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from sobolev_batch.store.create import prepare_store
from sobolev_batch.store.field_arrays import Fields
from sobolev_batch.store.layout import QUALITY, Store
from sobolev_batch.store.location import Location
from sobolev_batch.store.records import Record, Records
from sobolev_batch.store.stored_tables import hide_tables
from sobolev_batch.study.plan import Plan, Row

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Workspace:
    """A store and the plan that is carried out in it.

    Attributes:
        store: Store, laid out for the plan.
        labels: Label of each row of the store.
        rows: Rows of the plan, by their number in the store. The store may have others, of meshes that the study
            has lost: their fields stay, in case the meshes come back.
        records: Completion record of each row of the store, kept up to date; None without one.
    """

    store: Store
    plan: Plan
    labels: tuple[str, ...]
    rows: Mapping[int, Row]
    records: list[Record | None]

    @classmethod
    def for_plan(cls, store: Store, plan: Plan) -> Self:
        """Return the workspace of a store that is laid out for a plan."""
        by_label, labels = {row.label: row for row in plan.rows}, store.labels()
        rows = {i: by_label[label] for i, label in enumerate(labels) if label in by_label}
        return cls(store, plan, labels, rows, list(Records(store).read()))

    @classmethod
    def prepared(cls, location: Location, plan: Plan) -> Self:
        """Create or open the store of a plan; see `prepare_store`."""
        return cls.for_plan(prepare_store(location, plan), plan)

    @property
    def reference(self) -> int:
        """Row of the reference."""
        return self.labels.index(self.plan.reference)

    @property
    def complete(self) -> dict[int, Record]:
        """Records of the study's rows whose fields are stored."""
        return {i: record for i, record in complete_records(self.records).items() if i in self.rows}

    @property
    def pending(self) -> list[int]:
        """Rows whose fields are to be computed."""
        records = {i: self.records[i] for i, row in self.rows.items() if row.is_chosen}
        return [i for i, record in records.items() if record is None or not record.completes(self.rows[i].key)]

    @property
    def failures(self) -> dict[str, str]:
        """Reason of each row without a field, by its label; those that a run leaves out have not failed."""
        return {
            row.label: record.reason if record else "not computed"
            for row, record in ((row, self.records[i]) for i, row in self.rows.items())
            if (record is None and row.is_chosen) or (record is not None and record.status == "failed")
        }

    def withdraw_lost_fields(self) -> None:
        """Withdraw the records of fields that are not in the store, or not as a whole."""
        complete = self.complete
        if complete:
            whole = Fields(self.store).complete_rows()
            self.withdraw((i for i in complete if i not in whole), "it is not there, or not all of it")

    def withdraw(self, rows: Iterable[int], reason: str) -> None:
        """Withdraw the records of damaged fields, which makes them pending."""
        for i in rows:
            _log.warning("the field of %s is damaged (%s) and is computed again", self.rows[i].label, reason)
            Records(self.store).write(i, None)
            self.records[i] = None

    def withdraw_results_of(self, rows: Sequence[int]) -> None:
        """Withdraw the tables and qualities that follow from fields which are about to be replaced."""
        replaced = {i for i in rows if self.records[i] is not None}
        if replaced:
            hide_tables(self.store)
            qualities = [
                record.quality if record and i not in replaced else "" for i, record in enumerate(self.records)
            ]
            self.store.write(QUALITY, ..., np.array(qualities, dtype=object))


def complete_records(records: Sequence[Record | None]) -> dict[int, Record]:
    """Return the records that are complete, by their rows."""
    return {row: record for row, record in enumerate(records) if record is not None and record.status == "complete"}


def failed_proximities(labels: Mapping[int, str], records: Mapping[int, Record]) -> dict[str, str]:
    """Return why distances could not be measured, by the labels of the meshes."""
    return {
        labels[row]: f"no proximity: {record.proximity.reason}"
        for row, record in records.items()
        if record.proximity is not None and record.proximity.reason
    }
