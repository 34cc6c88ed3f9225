"""The time that a run of a study will take, predicted from what its fields cost and how fast the workers are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from distributed import Client

from sobolev_batch.batch.cluster.workers import Workers, worker_slowness
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.study.plan import Plan, Row
from sobolev_batch.results.tables.formatting import duration
from sobolev_batch.spectral.octaves.costs import SurfaceSize
from sobolev_batch.spectral.transform.transform import field_seconds, slowness

# Time to describe and record a surface, and that of each of its triangles.
_ROW_SECONDS, _TRIANGLE_SECONDS = 0.1, 5e-6
# Processor time to start a process with all libraries, and the time until a cluster of them is there.
_PROCESS_SECONDS, _CLUSTER_SECONDS = 4.0, 6.0
# Stored fields tell the speed if there are as many.
_FEWEST_RECORDS = 3


@dataclass(frozen=True)
class Forecast:
    """Time that a run will take.

    Attributes:
        surfaces: Number of surfaces whose fields are missing.
        processor_seconds: Processor time of all tasks and processes.
        seconds: Time from the start to the end, if the workers have their cores for themselves.
        threads: Number of tasks that run at once.
        basis: What the speed was measured by.
    """

    surfaces: int
    processor_seconds: float
    seconds: float
    threads: int
    basis: str

    @classmethod
    def for_plan(
        cls, plan: Plan, stored: Mapping[str, Record], workers: Workers, client: Client | None, planning_seconds: float
    ) -> Self:
        """Predict the time of a run.

        Args:
            plan: Plan of the study.
            stored: Records of fields that are stored, and not to be computed again, by label.
            workers: Workers to compute on.
            client: Client of their cluster; None if the run starts them on this machine.
            planning_seconds: Time of planning, which a run does again; 0 where it takes the choice of its store.
        """
        predicted = {row.label: _row_seconds(plan, row) for row in plan.rows}
        missing = [row.label for row in plan.rows if row.label not in stored]
        if not missing:
            return cls(0, 0.0, 0.0, workers.threads, "")
        if len(stored) >= _FEWEST_RECORDS:
            spent = sum(record.seconds for record in stored.values())
            factor = spent / sum(predicted[label] for label in stored)
            basis = f"the {len(stored)} fields that are stored"
        elif client is None:
            factor, basis = slowness(), "a transform on this machine"
        else:
            factor, basis = worker_slowness(client, workers.members[0].address), "a transform on a worker"
        times = [factor * predicted[label] for label in missing]
        processes = 0.0 if client else _PROCESS_SECONDS * (1 + len(workers.members))
        start = 0.0 if client else _CLUSTER_SECONDS
        return cls(
            len(missing),
            planning_seconds + processes + sum(times),
            planning_seconds + start + max(sum(times) / workers.threads, *times),
            workers.threads,
            basis,
        )

    @property
    def lines(self) -> tuple[str, ...]:
        """The forecast as ``sobolev-batch plan`` shows it."""
        if not self.surfaces:
            return ("nothing is missing",)
        total, processor = (duration(seconds, digits=2) for seconds in (self.seconds, self.processor_seconds))
        missing = f"{self.surfaces} missing field{'s' * (self.surfaces != 1)}"
        tasks = f"{self.threads} task{'s' * (self.threads != 1)} at once"
        return (
            f"about {total} for {missing}, with {tasks}",
            f"{processor} of processor time; the speed is that of {self.basis}",
        )


def _row_seconds(plan: Plan, row: Row) -> float:
    """Return the predicted time of a row's tasks, on the machine that constants were measured on."""
    expected = row.member.expected_size()
    size = SurfaceSize(expected.triangles, plan.reference_area)
    # An accuracy takes coarser settings where it can; what they save is little beside octaves.
    transform = field_seconds(expected.triangles, plan.reference_area, plan.lattice, plan.transform)
    octaves = () if plan.tail is None else plan.tail.octaves
    sampling = sum(size.sampling_seconds(octave) for octave in octaves)
    return _ROW_SECONDS + _TRIANGLE_SECONDS * expected.triangles + expected.seconds + transform + sampling
