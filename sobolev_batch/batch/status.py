"""Progress of the study of a store, read from the store alone."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sobolev_batch.errors import DamageError
from sobolev_batch.shown import Shown
from sobolev_batch.sources.names import quoted
from sobolev_batch.store.latest_run import LOST_AFTER_SECONDS, RunRecord
from sobolev_batch.store.layout import Store
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import age_seconds, unlock_command
from sobolev_batch.store.objects import Objects, labelled
from sobolev_batch.store.records import ObjectRecord
from sobolev_batch.store.workspace import Contents
from sobolev_batch.tables.open import AnyStore, location_of
from sobolev_batch.tables.text import duration
from sobolev_batch.visible import visible

# Runs count as lost after this time. One that waits for a busy cluster has no heartbeat.
_PATIENCE_SECONDS = {"running": LOST_AFTER_SECONDS, "submitted": 600.0}
_FEWEST_FOR_RATE = 3


@dataclass(frozen=True)
class Status(Shown):
    """Progress of a study; ``print(status)`` shows what ``sobolev-batch status`` shows.

    Attributes:
        store: Path or URL of the store.
        complete: Number of surfaces that are computed.
        total: Number of surfaces of the study.
        failed: Reason for each surface that could not be computed, by label, or that of an object by its name.
        not_compared: Reason for each surface that is computed but lacks the Hausdorff and Chamfer distances that the
            study requests.
        run: Record of the latest run, or None.
        has_tables: True once the store has tables, of all objects that can be carried out.
        silence_seconds: Seconds since the latest sign of life of a run that goes on, else 0.
        rate: Surfaces that the latest run finishes in a second, as at the last of them; NaN before there are a few.
        lost_records: Labels of surfaces that the tables list, and whose completion records are gone, or others. A run
            that goes on computes them again.
        not_begun: Names of the objects that no run has come to; how many surfaces they have is not known.
        failures: Number of surfaces that could not be computed, those of whole objects too.
        not_listed: Names of the objects that have tables, but no rows in those of all: a run that goes on adds them at
            its end, and one of a part with other settings or orders took them out.

    >>> import sobolev_batch as sb
    >>> status = sb.status("storage/icosphere.zarr")
    >>> status.complete, status.total, status.failed
    (5, 5, {})
    """

    store: str
    complete: int
    total: int
    failed: dict[str, str]
    not_compared: dict[str, str]
    run: RunRecord | None
    has_tables: bool
    silence_seconds: float
    rate: float = math.nan
    lost_records: tuple[str, ...] = ()
    not_begun: tuple[str, ...] = ()
    failures: int = 0
    not_listed: tuple[str, ...] = ()

    @property
    def waiting(self) -> int:
        """Number of surfaces that are neither computed nor failed."""
        return self.total - self.complete - self.failures

    @property
    def seconds_left(self) -> float:
        """Seconds until all surfaces are finished, if they take as long as the last ones; NaN if that is unknown."""
        return self.waiting / self.rate if self.going_on else math.nan

    @property
    def progress(self) -> str:
        """Progress in one line, as ``sobolev-batch status --follow`` shows it."""
        parts = [f"{self.total - self.waiting} of {self.total} done", f"{self.failures} failed"]
        if self.not_begun:
            parts.append(f"objects not begun: {len(self.not_begun):,}")
        if self.run is not None and self.run.state == "submitted":
            parts.append("no worker has taken it up yet")
        elif self.waiting == 0:
            # A run tells its stage now and then, and its last fields may be stored since.
            stage = self.run.stage if self.run is not None and self.going_on else ""
            parts.append("tables follow" if "fields, " in stage else stage)
        elif math.isnan(self.seconds_left):
            parts.append("time left not known yet" if self.going_on else "")
        else:
            parts += [f"{60 * self.rate:.3g} a minute", f"about {duration(round(self.seconds_left))} left at this rate"]
        if self.run is not None and self.run.error:
            parts.append(self.run.error)
        return ", ".join(filter(None, parts))

    @property
    def going_on(self) -> bool:
        """True while a run was submitted or is running, and shows signs of life."""
        return self.run is not None and self.run.state in _PATIENCE_SECONDS and not self.lost

    @property
    def is_incomplete(self) -> bool:
        """True if no run goes on, and surfaces lack a record, or have another one than the tables were made from."""
        return not self.going_on and bool(self.waiting or self.lost_records or self.not_begun or self.not_listed)

    @property
    def lost(self) -> bool:
        """True if a run began and shows no signs of life any more."""
        return self.run is not None and self.silence_seconds > _PATIENCE_SECONDS.get(self.run.state, math.inf)

    def __str__(self) -> str:
        return "\n".join(map(visible, self.lines()))

    def lines(self) -> Iterator[str]:
        """Yield the lines that ``sobolev-batch status`` prints."""
        objects = f"; objects not begun: {len(self.not_begun):,}" if self.not_begun else ""
        counts = f"{self.complete} of {self.total} complete, {self.failures} failed, {self.waiting} to go"
        yield f"{self.store}: {counts}{objects}"
        lost = dict.fromkeys(self.lost_records, "its completion record is gone or another one; run the study again")
        for label, reason in (*self.failed.items(), *self.not_compared.items(), *lost.items()):
            yield f"{label}: {reason}"
        if self.not_listed and not self.going_on:
            few = f"{len(self.not_listed):,}, such as {quoted(self.not_listed[0])}"
            yield f"objects without rows in the tables of all: {few}; run the whole study"
        if self.run is not None:
            yield from self._run_lines(self.run)
        if not self.has_tables:
            yield "no tables yet" if self.going_on else "no tables yet: run the study to its end"

    def _run_lines(self, run: RunRecord) -> Iterator[str]:
        start = f"by {run.driver}, begun {run.started}"
        is_ahead = self.silence_seconds < -LOST_AFTER_SECONDS
        unlock = unlock_command(self.store)
        age = f"{duration(round(abs(self.silence_seconds)))} {'ahead of the clock here' if is_ahead else 'ago'}"
        if run.state == "submitted":
            yield f"submitted {age}, no worker has taken it up yet; {start}"
            if self.lost:
                yield f"if that cluster is gone, submit the study again after: {unlock}"
        elif run.state == "running":
            yield f"running: {run.stage or 'planning'}; {start}, last sign of life {age}"
            if run.error:
                yield run.error
            if is_ahead:
                yield f"whether it goes on is unknown; if it is gone: {unlock} --force"
            if self.lost:
                yield "its process is probably gone, or its clock is behind the one here"
                yield "run or submit the study again, and it continues from the store"
                yield f"if the store turns out to be locked: {unlock}"
        elif run.state == "failed":
            yield f"the latest run failed: {run.error}; {start}, ended {run.seen}"
        elif self.is_incomplete:
            yield f"ended {run.seen}, incomplete: run the study again; {start}"
        else:
            yield f"done; {start}, ended {run.seen}"


def _tallies(objects: Objects) -> Iterator[tuple[str, ObjectRecord]]:
    """Yield what is known of each object that is begun: by its record, or by its store before its run has ended."""
    recorded, present = objects.recorded(), objects.location.names()
    for name in objects.names:
        record = recorded.get(name)
        if record is None and name not in present:
            continue
        if record is None or (record.has_tables and name not in present):
            try:
                if (place := objects.existing_store(name)) is None:
                    continue
                record = Contents.of_store(Store.open(place)).tally()
            except DamageError as error:
                record = ObjectRecord(reason=str(error), total=1 if record is None else record.total)
        yield name, record


def _rate(finished: Sequence[str], run: RunRecord) -> float:
    """Return how many surfaces a run finishes in a second, from the later half of the moments when it finished one."""
    age = age_seconds(run.started)
    ages = sorted(one for one in map(age_seconds, filter(None, finished)) if one <= age)
    latest = ages[: max(_FEWEST_FOR_RATE, len(ages) // 2)]
    if len(latest) < _FEWEST_FOR_RATE or latest[-1] <= latest[0]:
        return math.nan
    return (len(latest) - 1) / (latest[-1] - latest[0])


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
    location = Location.parse(location_of(store))
    if (objects := Objects.read(location)) is not None:
        run = RunRecord.read(objects.records.store)
        tallies = dict(_tallies(objects))
        moments = [one.finished for one in tallies.values() for _ in range(one.complete)]
    elif Store(location).is_unfinished:
        # Its run plans, or was ended while it did.
        run, moments, tallies = RunRecord.read(Store(location)), [], {"": ObjectRecord()}
    else:
        opened = Store.open(location)
        run, contents = RunRecord.read(opened), Contents.of_store(opened)
        tallies = {"": contents.tally()}
        moments = [record.finished for record in contents.records if record is not None]
    refused = {name: one.reason for name, one in tallies.items() if one.reason}
    listed = tallies if objects is None else {**objects.tabulated, **refused}
    return Status(
        store=str(location_of(store)),
        complete=sum(one.complete for one in tallies.values()),
        total=sum(one.total for one in tallies.values()),
        failed=refused | labelled({name: one.failed for name, one in tallies.items()}),
        not_compared=labelled({name: one.not_compared for name, one in tallies.items()}),
        run=run,
        has_tables={one.has_tables for one in tallies.values() if not one.reason} == {True},
        silence_seconds=age_seconds(run.seen) if run is not None and run.state in _PATIENCE_SECONDS else 0.0,
        rate=math.nan if run is None else _rate(moments, run),
        lost_records=tuple(labelled({name: dict.fromkeys(one.lost_records) for name, one in tallies.items()})),
        not_begun=() if objects is None else tuple(name for name in objects.names if name not in tallies),
        failures=sum(one.failures for one in tallies.values()),
        not_listed=tuple(name for name, one in tallies.items() if one.has_tables and name not in listed),
    )
