"""Progress: the steps of a run, for those who watch it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from sobolev_batch.batch.store.records import Record

Stage = Literal["cluster", "fields", "reduction", "proximity"]


@dataclass(frozen=True)
class Progress:
    """One step of a run.

    Attributes:
        stage: "cluster" once there is one, "fields" while meshes are transformed, "reduction" while
            tables are computed, "proximity" while Hausdorff and Chamfer distances are measured.
        done, total: Steps of the stage.
        label: Label of the mesh that was finished, or address of the cluster's dashboard; else empty.
        record: Completion record of that mesh.
        part: Object of a collection that is worked on, and its number, such as "cow, 2 of 8"; else empty.
    """

    stage: Stage
    done: int
    total: int
    label: str = ""
    record: Record | None = None
    part: str = ""


Notify = Callable[[Progress], None]


class Steps:
    """The steps of one stage, counted and reported."""

    def __init__(self, notify: Notify, stage: Stage, total: int) -> None:
        """Report that the stage begins."""
        self._notify, self._stage, self._total, self._done = notify, stage, total, 0
        notify(Progress(stage, 0, total))

    def advance(self, label: str = "", record: Record | None = None) -> None:
        """Report one more step."""
        self._done += 1
        self._notify(Progress(self._stage, self._done, self._total, label, record))
