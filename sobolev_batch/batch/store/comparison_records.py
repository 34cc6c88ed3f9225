"""Comparison records: the outcome of each comparison of a mesh with the reference, written last."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from sobolev_batch.batch.store.hierarchy import RECORDS, Hierarchy
from sobolev_batch.batch.store.record_table import RecordTable
from sobolev_batch.batch.store.records import JsonRecord, Status

Kind = Literal["witness", "proximity"]
KINDS: tuple[Kind, ...] = ("witness", "proximity")


@dataclass(frozen=True)
class ComparisonRecord(JsonRecord):
    """Outcome of one comparison.

    Attributes:
        key: Digest of all that the comparison depends on.
        status: "complete" or "failed".
        reason: Reason of the failure; empty otherwise.
        numbers: Results by name.
        checksum: Checksum of the values of the witness function; 0 for other comparisons.
        seconds: Time spent in its task.
    """

    kind = "comparison record"

    key: str
    status: Status
    reason: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)
    checksum: int = 0
    seconds: float = 0.0

    def completes(self, key: str) -> bool:
        """Return whether the comparison with this key exists already."""
        return self.status == "complete" and self.key == key


class ComparisonRecords(RecordTable[ComparisonRecord]):
    """Comparison records of one kind in a store."""

    def __init__(self, store: Hierarchy, kind: Kind) -> None:
        super().__init__(store, f"{RECORDS}/{kind}", ComparisonRecord)


def failed_comparisons(
    labels: Mapping[int, str], records: Mapping[Kind, Sequence[ComparisonRecord | None]], rows: Container[int]
) -> dict[str, str]:
    """Return the comparisons that failed, with their reasons, by the labels of the meshes.

    Args:
        labels: Label of each mesh by its row.
        records: Records of all rows, for each kind of comparison that the study asks for.
        rows: Rows of the meshes that have fields.
    """
    failures: dict[str, list[str]] = {}
    for kind, of_kind in records.items():
        for row, record in enumerate(of_kind):
            if record is not None and record.status == "failed" and row in rows:
                failures.setdefault(labels[row], []).append(f"no {kind}: {record.reason}")
    return {label: "; ".join(reasons) for label, reasons in failures.items()}
