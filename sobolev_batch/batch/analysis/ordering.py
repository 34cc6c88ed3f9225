"""The order of meshes in tables: families as in the study, and within each from coarse to fine."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.study.plan import Row
from sobolev_batch.batch.study.study import Study
from sobolev_batch.batch.workspace import Workspace
from sobolev_batch.surfaces.sources.names import natural_key

Criterion = Literal["level", "triangles", "names", "time"]


# Between numbers of triangles of a family that goes from coarse to fine: then edges differ by a tenth.
_SMALLEST_STEP = 1.2
# Meshes of about one size in such a family, on average.
_MOST_OF_ONE_SIZE = 10


@dataclass(frozen=True)
class TableOrder:
    """The order of the rows of a store in its tables.

    Attributes:
        rows: Numbers of the rows, in this order.
        ranks: Place of each of them in its family, from 0.
        criteria: What orders the family of each of them.
    """

    rows: tuple[int, ...]
    ranks: tuple[int, ...]
    criteria: tuple[Criterion, ...]

    @classmethod
    def from_workspace(cls, workspace: Workspace) -> Self:
        """Return the order of the meshes that the study of a workspace has."""
        families: dict[str, list[int]] = {row.family: [] for row in workspace.plan.rows}
        for i, row in workspace.rows.items():
            families[row.family].append(i)
        placed: list[tuple[int, int, Criterion]] = []
        for family, numbers in families.items():
            rows = {i: workspace.rows[i] for i in numbers}
            records = [workspace.records[i] for i in numbers]
            criterion = _criterion(workspace.plan.study, family, list(rows.values()), records)
            keys = {i: _key(criterion, row, workspace.records[i]) for i, row in rows.items()}
            placed += ((i, rank, criterion) for rank, i in enumerate(sorted(keys, key=keys.__getitem__)))
        return cls(
            tuple(i for i, _, _ in placed),
            tuple(rank for _, rank, _ in placed),
            tuple(criterion for _, _, criterion in placed),
        )

    def families_with_rates(self, rows: Mapping[int, Row]) -> dict[str, list[int]]:
        """Return the places in this order of the meshes of each family that goes from coarse to fine."""
        families: dict[str, list[int]] = {}
        for place, (i, criterion) in enumerate(zip(self.rows, self.criteria, strict=True)):
            if criterion in ("level", "triangles"):
                families.setdefault(rows[i].family, []).append(place)
        return families


def _criterion(study: Study, family: str, rows: Sequence[Row], records: Sequence[Record | None]) -> Criterion:
    chosen = next((one.order_by for one in study.families if one.name == family), None)
    if chosen is not None:
        return chosen
    if any(row.member.time is not None for row in rows):
        return "time"
    if all(row.member.level >= 0 for row in rows):
        return "level"
    counts = [one.facts.triangles for one in records if one is not None and one.status == "complete"]
    return "names" if len(counts) > 1 and not _are_graded(counts) else "triangles"


def _are_graded(counts: Sequence[int]) -> bool:
    """Tell whether meshes go from coarse to fine: scans of one object, or copies with noise, do not."""
    steps, largest = 0, 0.0
    for count in sorted(counts):
        if count > _SMALLEST_STEP * largest:
            steps, largest = steps + 1, float(count)
    # A few of other sizes may be parts of the object.
    return steps > 1 and _MOST_OF_ONE_SIZE * steps >= len(counts)


def _key(criterion: Criterion, row: Row, record: Record | None) -> tuple[Any, ...]:
    """Return what a row is sorted by; where it is equal, names decide."""
    name = natural_key(row.member.name)
    if criterion == "time":
        return math.inf if row.member.time is None else row.member.time, name
    if criterion == "level":
        return row.member.level, name
    if criterion == "triangles":
        # A mesh that failed has no triangles that are known.
        is_known = record is not None and record.status == "complete"
        return record.facts.triangles if record is not None and is_known else math.inf, name
    return (name,)
