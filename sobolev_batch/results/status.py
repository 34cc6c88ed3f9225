"""Progress of the study of a store, read from the store alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from sobolev_batch.batch.storage.timestamps import age_seconds
from sobolev_batch.batch.store.comparison_records import KINDS, ComparisonRecords, failed_comparisons
from sobolev_batch.batch.store.heartbeat import LOST_AFTER_SECONDS
from sobolev_batch.batch.store.records import RunRecord
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.store.tables import Tables
from sobolev_batch.batch.workspace import complete_records
from sobolev_batch.results.open import AnyStore, location_of
from sobolev_batch.results.tables.formatting import duration

_SUBMITTED_PATIENCE_SECONDS = 600.0


@dataclass(frozen=True)
class Status:
    """Progress of a study; ``print(status)`` shows what ``sobolev-batch status`` shows.

    Attributes:
        store: Path or URL of the store.
        complete: Number of surfaces that are computed.
        total: Number of surfaces of the study.
        failed: Reason for each surface that could not be computed, by label.
        not_compared: For each surface that is computed but lacks its witness function or its Hausdorff and Chamfer
            distances: which of them, and why.
        run: Record of the latest run, or None.
        reduced: True once the store has tables.
        silence_seconds: Seconds since the latest sign of life of a run that goes on, else 0.

    >>> import sobolev_batch as sb
    >>> study = sb.Study.from_table({
    ...     "study": {"name": "spheres"},
    ...     "lattice": {"xi_max": 2.0, "M": 16},
    ...     "norm": {"orders": [-2.0]},
    ...     "reference": {"source": "sphere"},
    ...     "family": [{"name": "ico", "source": "icosphere", "levels": [0, 1]}],
    ... })
    >>> summary = sb.run(study, "memory://progress.zarr")
    >>> status = sb.status("memory://progress.zarr")
    >>> status.complete, status.total, status.failed
    (3, 3, {})
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
    def of(cls, store: AnyStore) -> Status:
        """Return the status of a store; see `sobolev_batch.status`."""
        place = location_of(store)
        opened = Store.open(place)
        labels, records, run = opened.labels(), opened.records(), opened.read_run()
        # Nothing is read of comparisons that the study does not ask for.
        comparisons = {kind: ComparisonRecords(opened, kind) for kind in KINDS}
        notes = {kind: records.read() for kind, records in comparisons.items() if records.name in opened.documents}
        complete = complete_records(records)
        return cls(
            str(place),
            len(complete),
            len(labels),
            {
                label: record.reason
                for label, record in zip(labels, records, strict=True)
                if record is not None and record.status == "failed"
            },
            failed_comparisons(labels, notes, complete),
            run,
            Tables(opened).attributes("convergence") is not None,
            age_seconds(run.seen) if run is not None and run.state in ("submitted", "running") else 0.0,
        )

    @property
    def waiting(self) -> int:
        """Number of surfaces that are neither computed nor failed."""
        return self.total - self.complete - len(self.failed)

    @property
    def going_on(self) -> bool:
        """True while a run was submitted or is running, and shows signs of life."""
        return self.run is not None and self.run.state in ("submitted", "running") and not self.lost

    @property
    def lost(self) -> bool:
        """True if a run began and shows no signs of life any more."""
        if self.run is None or self.run.state not in ("submitted", "running"):
            return False
        # A submitted study may wait for a busy cluster, and has no heartbeat until then.
        patience = LOST_AFTER_SECONDS if self.run.state == "running" else _SUBMITTED_PATIENCE_SECONDS
        return self.silence_seconds > patience

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def lines(self) -> Iterator[str]:
        """Yield the lines that ``sobolev-batch status`` prints."""
        yield (
            f"{self.store}: {self.complete} of {self.total} complete, {len(self.failed)} failed, {self.waiting} to go"
        )
        for label, reason in (*self.failed.items(), *self.not_compared.items()):
            yield f"{label}: {reason}"
        if self.run is not None:
            yield from self._run_lines(self.run)
        if not self.reduced:
            yield "no tables yet" if self.going_on else "no tables yet: run the study to its end"

    def _run_lines(self, run: RunRecord) -> Iterator[str]:
        start = f"by {run.driver}, begun {run.started}"
        age = f"{duration(round(self.silence_seconds))} ago"
        if run.state == "submitted":
            yield f"submitted {age}, no worker has taken it up yet; {start}"
            if self.lost:
                yield f"if that cluster is gone, submit the study again after: sobolev-batch release {self.store}"
        elif run.state == "running":
            yield f"running: {run.stage or 'planning'}; {start}, last sign of life {age}"
            if run.error:
                yield run.error
            if self.lost:
                yield "its process is probably gone; run or submit the study again, and it continues from the store"
                yield f"if the store turns out to be locked: sobolev-batch release {self.store}"
        elif run.state == "failed":
            yield f"the latest run failed: {run.error}; {start}, ended {run.seen}"
        else:
            yield f"done; {start}, ended {run.seen}"


def status(store: AnyStore) -> Status:
    """Return how far the study of a store is, and what failed and why.

    Args:
        store: Path, URL or opened DataTree of the store. Its study may be running.

    Raises:
        StoreError: The location has no store of a study, or cannot be reached.

    >>> import sobolev_batch as sb
    >>> found = sb.status("storage/icosphere.zarr")
    >>> found.complete, found.total, found.failed, found.going_on
    (5, 5, {}, False)
    >>> print(found)  # doctest: +ELLIPSIS
    storage/icosphere.zarr: 5 of 5 complete, 0 failed, 0 to go
    done; by process ...
    """
    return Status.of(store)
