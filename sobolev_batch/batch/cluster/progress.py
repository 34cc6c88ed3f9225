"""Progress: the steps of a run, for those who watch it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from sobolev_batch.batch.store.records import Record


@dataclass(frozen=True)
class Progress:
    """One step forward.

    Attributes:
        stage: "cluster" once there is one, "fields" while meshes are transformed, "reduction" while
            tables are made, "comparisons" while meshes are compared with the reference.
        done, total: steps of the stage.
        label: of the mesh that was finished, or the address of the cluster's dashboard; else empty.
        record: of that mesh.
    """

    stage: Literal["cluster", "fields", "reduction", "comparisons"]
    done: int
    total: int
    label: str = ""
    record: Record | None = None


Notify = Callable[[Progress], None]
