"""Completion records: what says that a mesh is done, written after everything else of it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any, Literal, Self

from sobolev_batch.errors import StoreError

Status = Literal["complete", "failed"]
RunState = Literal["submitted", "running", "done", "failed"]


@dataclass(frozen=True)
class Facts:
    """What was found out about a surface when it was transformed.

    Attributes:
        vertices, triangles: counts; zero for a surface that is no mesh.
        area: total area in the study's unit of length, squared.
        edge_length_mean, edge_length_max: over triangle sides, in the study's unit; NaN without.
        zero_area_triangles, duplicate_triangles, boundary_edges, nonmanifold_edges: see `MeshCounts`.
        digest: SHA-256 of vertices and triangles in the study's unit; empty without.
        points: quadrature points; zero without.
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
    digest: str = ""
    points: int = 0


@dataclass(frozen=True)
class Record:
    """The outcome of one mesh.

    Attributes:
        key: what went in: the row's key when the mesh was computed.
        status: "complete" or "failed".
        reason: why it failed; empty otherwise.
        facts: what came out.
        quality: what the errors of norms need to know of the field, see `Quality.to_json`.
        checksums: of the field's blocks, see `Store.write_field`; a field that has others was not written
            by the tasks that this record is of, or was damaged.
        seconds: time spent in its tasks.
        worker: address of the worker that finished it.
        backend: what computed the transform.
        finished: when, in UTC.
    """

    key: str
    status: Status
    reason: str = ""
    facts: Facts = Facts()
    quality: str = ""
    checksums: tuple[int, ...] = ()
    seconds: float = 0.0
    worker: str = ""
    backend: str = ""
    finished: str = ""

    def to_json(self) -> str:
        """The record as one line of JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self | None:
        """The record that a line holds, or None where nothing was written.

        Raises:
            StoreError: the line is not a record.
        """
        if not text:
            return None
        try:
            values: dict[str, Any] = json.loads(text)
            parts = {"facts": Facts(**values["facts"]), "checksums": tuple(values["checksums"])}
            return cls(**{**values, **parts})
        except (ValueError, TypeError, KeyError) as error:
            raise StoreError(f"a completion record is damaged ({error}): {text[:80]!r}") from error

    def completes(self, key: str) -> bool:
        """Whether a field with this key need not be computed."""
        return self.status == "complete" and bool(key) and self.key == key


@dataclass(frozen=True)
class RunRecord:
    """The latest run of a study, as far as its store knows.

    Attributes:
        state: "submitted" until a worker takes it up, "running", "done" or "failed".
        driver: what drives it: the process and its host, and the cluster it computes on.
        started: when, in UTC.
        seen: the latest sign of life of its driver, in UTC.
        stage: what it is doing.
        error: why it failed, or what keeps it from going on; empty otherwise.
    """

    state: RunState
    driver: str
    started: str
    seen: str
    stage: str = ""
    error: str = ""

    def to_table(self) -> dict[str, str]:
        """The record as JSON takes it."""
        return asdict(self)

    @classmethod
    def from_table(cls, table: dict[str, str]) -> Self:
        """The record that a table holds.

        Raises:
            StoreError: it is not one.
        """
        try:
            return cls(**table)  # type: ignore[arg-type]
        except TypeError as error:
            raise StoreError(f"the record of the latest run is damaged ({error}): {table}") from error
