"""How far the study of a store is, told from the store alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.timestamps import age_seconds
from sobolev_batch.batch.store.comparison_records import KINDS, ComparisonRecords, missing_comparisons
from sobolev_batch.batch.store.heartbeat import LOST_AFTER_SECONDS
from sobolev_batch.batch.store.records import RunRecord
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.store.tables import Tables

_SUBMITTED_PATIENCE_SECONDS = 600.0


@dataclass(frozen=True)
class Status:
    """How far a study is.

    Attributes:
        store: where it is.
        complete: how many surfaces are computed.
        total: how many there are.
        failed: the reason for each that could not be computed.
        not_compared: for each that is computed, and lacks its witness function or Hausdorff and Chamfer distances
            all the same, which of them and why.
        run: the record of the latest run, if there is one.
        reduced: whether there are tables.
        silence_seconds: since the latest sign of life of a run that goes on, else 0.
    """

    store: str
    complete: int
    total: int
    failed: dict[str, str]
    not_compared: dict[str, str]
    run: RunRecord | None
    reduced: bool
    silence_seconds: float

    @classmethod
    def of(cls, place: str | Path | Location) -> Status:
        """Read the status of a store.

        Raises:
            StoreError: no store is there.
        """
        store = Store.open(place)
        labels, records, run = store.labels(), store.records(), store.read_run()
        # Where a study asks for none, nothing is looked for.
        asked = {kind: ComparisonRecords(store, kind) for kind in KINDS}
        notes = {kind: records.read() for kind, records in asked.items() if records.name in store.documents}
        complete = {row for row, record in enumerate(records) if record is not None and record.status == "complete"}
        return cls(
            str(place),
            len(complete),
            len(labels),
            {
                label: record.reason
                for label, record in zip(labels, records, strict=True)
                if record is not None and record.status == "failed"
            },
            missing_comparisons(labels, notes, complete),
            run,
            Tables(store).attributes("convergence") is not None,
            age_seconds(run.seen) if run is not None and run.state in ("submitted", "running") else 0.0,
        )

    @property
    def going_on(self) -> bool:
        """Whether something is still to be expected."""
        return self.run is not None and self.run.state in ("submitted", "running") and not self.lost

    @property
    def lost(self) -> bool:
        """Whether a run began that does not give signs of life any more."""
        if self.run is None or self.run.state not in ("submitted", "running"):
            return False
        # What was submitted may wait for a busy cluster, and nobody beats for it.
        patience = LOST_AFTER_SECONDS if self.run.state == "running" else _SUBMITTED_PATIENCE_SECONDS
        return self.silence_seconds > patience

    def lines(self) -> Iterator[str]:
        """For people."""
        waiting = self.total - self.complete - len(self.failed)
        yield f"{self.store}: {self.complete} of {self.total} complete, {len(self.failed)} failed, {waiting} to go"
        for label, reason in self.failed.items():
            yield f"{label}: {reason}"
        for label, reason in self.not_compared.items():
            yield f"{label}: {reason}"
        if self.run is not None:
            yield from self._run_lines(self.run)
        if not self.reduced:
            yield "no tables yet" if self.going_on else "no tables yet: run the study to its end"

    def _run_lines(self, run: RunRecord) -> Iterator[str]:
        where = f"by {run.driver}, begun {run.started}"
        if run.state == "submitted":
            yield f"submitted {_span(self.silence_seconds)} ago, no worker has taken it up yet; {where}"
            if self.lost:
                yield f"if that cluster is gone, submit the study again after: sobolev-batch release {self.store}"
        elif run.state == "running":
            yield f"running: {run.stage or 'planning'}; {where}, last sign of life {_span(self.silence_seconds)} ago"
            if run.error:
                yield run.error
            if self.lost:
                yield "the process that drove it is probably gone; run or submit the study again, it goes on from here"
                yield f"if that says that the store is taken: sobolev-batch release {self.store}"
        elif run.state == "failed":
            yield f"the latest run failed: {run.error}; {where}, ended {run.seen}"
        else:
            yield f"done; {where}, ended {run.seen}"


def _span(seconds: float) -> str:
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 0):.0f} s"
