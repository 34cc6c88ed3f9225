"""Records in a store: of the computation of each surface, and of the latest run."""

from __future__ import annotations

import json
from collections.abc import Hashable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from typing import Any, ClassVar, Literal, Self, TypeVar, cast

from pydantic import ConfigDict, TypeAdapter, ValidationError

from sobolev_batch.errors import DamageError
from sobolev_batch.sources.mesh_cache import Cost
from sobolev_batch.store.lock import Time

Status = Literal["complete", "failed"]
RunState = Literal["submitted", "running", "done", "failed"]

_ROW = "row"
# In JSON, in place of a record that a page holds and that counts no more.
WITHDRAWN = "null"
Kind = TypeVar("Kind")
_adapter = cache(TypeAdapter)


def record_from_table(kind: type[Kind], table: Any, name: str) -> Kind:
    """Return the record that a table holds."""
    try:
        record: Kind = _adapter(cast(Hashable, kind)).validate_python(table)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        problem = ": ".join(filter(None, (".".join(map(str, first["loc"])), first["msg"])))
        raise _damage(name, problem, table) from error
    return record


def _damage(name: str, problem: str, content: object) -> DamageError:
    return DamageError(f"{name} is damaged ({problem}): {str(content)[:80]!r}; run the study again", problem)


@dataclass(frozen=True)
class Facts:
    """Properties of a surface, found when it was transformed.

    Attributes:
        vertices, triangles: Counts; zero for a surface that is no mesh.
        area: Total area in the study's unit of length, squared.
        edge_length_mean, edge_length_max: Lengths of triangle sides, in the study's unit; NaN without triangles.
        zero_area_triangles, duplicate_triangles, boundary_edges, nonmanifold_edges, inconsistent_edges: See
            `Mesh.counts`.
        volume: Enclosed volume, see `Mesh.volume`.
        smallest_angle: Smallest angle of all triangles, in degrees.
        aspect_ratio: Largest aspect ratio of all triangles, see `Mesh.aspect_ratios`.
        digest: SHA-256 of vertices and triangles in the study's unit; empty without triangles.
        points: Number of quadrature points; zero for a closed form.
    """

    vertices: int = 0
    triangles: int = 0
    area: float = float("nan")
    edge_length_mean: float = float("nan")
    edge_length_max: float = float("nan")
    zero_area_triangles: int = 0
    duplicate_triangles: int = 0
    boundary_edges: int = 0
    nonmanifold_edges: int = 0
    inconsistent_edges: int = 0
    volume: float = float("nan")
    smallest_angle: float = float("nan")
    aspect_ratio: float = float("nan")
    digest: str = ""
    points: int = 0


@dataclass(frozen=True)
class ProximityRecord:
    """The usual distances of a mesh from the reference, see `proximity`.

    Attributes:
        key: Digest of all that they depend on.
        reason: Reason of a failure; empty otherwise.
        numbers: What `proximity` returns, in the unit of length of the files; empty after a failure.
    """

    key: str
    reason: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)
    seconds: float = 0.0

    def completes(self, key: str) -> bool:
        """Return whether the distances with this key were measured."""
        return not self.reason and self.key == key


@dataclass(frozen=True)
class Record:
    """Completion record of one surface, written after everything else of it.

    It is stored as one line of JSON, which begins with its row: records of rows may trade places.

    Attributes:
        key: Key of the row when the surface was computed: a digest of all that its field depends on.
        status: "complete" or "failed".
        reason: Reason of the failure; empty otherwise.
        quality: Data of the field from which errors of norms are computed, see `Quality.to_json`.
        checksums: Checksums of the field's blocks, see `Store.write_field`. A field with others is damaged, or was
            written by another task.
        worker: Address of the worker that finished it.
        finished: Time at which it was finished, in UTC.
        proximity: Hausdorff and Chamfer distances from the reference, where the study requests them.
        cost: What making the surface took, where that is known.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    key: str
    status: Status
    reason: str = ""
    facts: Facts = Facts()
    quality: str = ""
    checksums: tuple[int, ...] = ()
    seconds: float = 0.0
    worker: str = ""
    backend: str = ""
    finished: Time | Literal[""] = ""
    proximity: ProximityRecord | None = None
    cost: Cost | None = None

    def completes(self, key: str) -> bool:
        """Return whether the field with this key exists already."""
        return self.status == "complete" and bool(key) and self.key == key

    def to_json(self, row: int) -> str:
        """Return the record of a row as one line of JSON."""
        return json.dumps({_ROW: row, **asdict(self)})

    @classmethod
    def from_json(cls, text: str, row: int) -> Self | None:
        """Return the record of a row that a line holds, if any; DamageError where it holds something else."""
        if text in ("", WITHDRAWN):
            return None
        name = "a completion record"
        try:
            table = dict(json.loads(text))
        except (ValueError, TypeError, RecursionError) as error:
            raise _damage(name, f"no table: {error}", text) from error
        stored_row = table.pop(_ROW, None)
        record = record_from_table(cls, table, name)
        if stored_row != row:
            raise _damage(name, f"it is that of row {stored_row!r}", text)
        return record


@dataclass(frozen=True)
class RunRecord:
    """State of the latest run of a study.

    Attributes:
        state: "submitted" until a worker starts it, then "running", "done" or "failed".
        driver: Description of the driver: its process and host, and its cluster.
        started: Time of the start, in UTC.
        seen: Time of the driver's latest heartbeat, in UTC.
        error: Reason of the failure, or obstacle to the run; empty otherwise.
    """

    state: RunState
    driver: str
    started: Time
    seen: Time
    stage: str = ""
    error: str = ""
