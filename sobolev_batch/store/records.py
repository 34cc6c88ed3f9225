"""Records in a store: of the computation of each surface, and of the objects of a study.

A record is a chunk, which its task writes. After a run they lie in pages: on object storage each chunk is a request.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from itertools import groupby
from typing import Any, ClassVar, Generic, Literal, Self, TypeVar, cast

from sobolev_batch.errors import DamageError
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.sources.programs import Cost
from sobolev_batch.store.checked import largest_chunk_bytes
from sobolev_batch.store.layout import PAGE, RECORD, Store
from sobolev_batch.store.lock import Time
from sobolev_batch.store.metadata import chunk_shape, damaged_record, record_in
from sobolev_batch.transform.fourier import NUMERICS_VERSION

_log = logging.getLogger(__name__)

# This JSON takes the place of a record that a page holds and that counts no more.
_WITHDRAWN = "null"


@dataclass(frozen=True)
class Facts:
    """Properties of a surface, found when it was transformed.

    Attributes:
        vertices, triangles: Counts; zero for a surface that is no mesh.
        area: Total area in the study's unit of length, squared.
        edge_length_mean, edge_length_max: Lengths of triangle sides, in the study's unit; NaN without triangles.
        zero_area_triangles, duplicate_triangles, boundary_edges, nonmanifold_edges, inconsistent_edges, components,
        euler_characteristic: See `Mesh.counts`.
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
    components: int = 0
    euler_characteristic: int = 0
    volume: float = float("nan")
    smallest_angle: float = float("nan")
    aspect_ratio: float = float("nan")
    digest: str = ""
    points: int = 0

    @classmethod
    def of_surface(cls, surface: Surface, points: int) -> Self:
        """Return the facts of a surface and its quadrature points."""
        if not isinstance(surface, Mesh):
            return cls(area=surface.area, points=points)
        mean_length, longest = surface.edge_length_range
        return cls(
            vertices=len(surface.vertices),
            triangles=len(surface.triangles),
            area=surface.area,
            edge_length_mean=mean_length,
            edge_length_max=longest,
            volume=surface.volume,
            smallest_angle=float(surface.smallest_angles.min()),
            aspect_ratio=float(surface.aspect_ratios.max()),
            digest=surface.digest,
            points=points,
            **surface.counts,
        )


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


class _Line:
    """A record as one line of JSON, which begins with its row: records of rows may trade places."""

    __pydantic_config__: ClassVar[Any] = {"extra": "forbid"}

    def to_json(self, row: int) -> str:
        return json.dumps({"row": row, **asdict(cast(Any, self))})

    @classmethod
    def from_json(cls, text: str, row: int) -> Self | None:
        """Return the record of a row that a line holds, if any; DamageError where it holds something else."""
        if text in ("", _WITHDRAWN):
            return None
        name = "a completion record"
        try:
            table = dict(json.loads(text))
        except (ValueError, TypeError, RecursionError) as error:
            raise damaged_record(name, f"no table: {error}", text) from error
        if (stored_row := table.pop("row", None)) != row:
            raise damaged_record(name, f"it is that of row {stored_row!r}", text)
        return record_in(cls, table, name)


@dataclass(frozen=True)
class Record(_Line):
    """Completion record of one surface, written after everything else of it.

    Attributes:
        key: Key of the row when the surface was computed: a digest of all that its field depends on.
        status: "complete" or "failed".
        reason: Reason of the failure; empty otherwise.
        remark: What one should know of how the surface was made; empty where that is nothing.
        quality: Data of the field from which errors of norms are computed, see `Quality.to_json`.
        checksums: Checksums of the field's blocks, see `Fields.write`; others mean damage, or another task's field.
        worker: Address of the worker that finished it.
        finished: Time at which it was finished, in UTC.
        proximity: Hausdorff and Chamfer distances from the reference, where the study requests them.
        cost: What making the surface took, where that is known.
        numerics: Version of the numerics of the worker that computed it.
    """

    key: str
    status: Literal["complete", "failed"]
    reason: str = ""
    remark: str = ""
    facts: Facts = Facts()
    quality: str = ""
    checksums: tuple[int, ...] = ()
    seconds: float = 0.0
    worker: str = ""
    backend: str = ""
    finished: Time | Literal[""] = ""
    proximity: ProximityRecord | None = None
    cost: Cost | None = None
    numerics: int = NUMERICS_VERSION

    def completes(self, key: str) -> bool:
        """Return whether the field with this key exists already."""
        return self.status == "complete" and bool(key) and self.key == key


@dataclass(frozen=True)
class ObjectRecord(_Line):
    """Record of an object in the store of a study, once its run has ended.

    Attributes:
        key: Digest of all that its tables depend on, where nothing of it is missing; else empty.
        reason: Why it could not be carried out; empty otherwise.
        complete, total: Number of its surfaces that are computed, and of all, or 1 where they cannot be listed.
        failed: Reason for each surface that could not be computed, by label.
        not_compared: Reason for each surface without the Hausdorff and Chamfer distances that the study requests.
        imprecise: Largest relative error of the distances of each mesh that miss the accuracy requested.
        lost_records: Labels of surfaces that the tables list, and whose completion records are gone, or others.
        has_tables: True if readers find its tables.
        settings: Settings of the study by which its rows in the tables of all were made.
        finished: Time at which its run ended, in UTC.
    """

    key: str = ""
    reason: str = ""
    complete: int = 0
    total: int = 1
    failed: Mapping[str, str] = field(default_factory=dict)
    not_compared: Mapping[str, str] = field(default_factory=dict)
    imprecise: Mapping[str, float] = field(default_factory=dict)
    lost_records: tuple[str, ...] = ()
    has_tables: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)
    finished: Time | Literal[""] = ""

    @property
    def failures(self) -> int:
        """Number of surfaces that could not be computed: all of an object that could not be carried out."""
        return self.total if self.reason else len(self.failed)


RecordType = TypeVar("RecordType", Record, ObjectRecord)


@dataclass(frozen=True)
class Records(Generic[RecordType]):
    """The records of the rows of a store, alone and in pages: of surfaces, or of the objects of a study at its root."""

    store: Store
    type: type[RecordType] = Record  # type: ignore[assignment]  # of surfaces, unless others are asked for

    def examine(self) -> tuple[list[RecordType | None], dict[int, str]]:
        """Return the completion record of each row, None if it has none that can be read, and the damage of those."""
        records: list[RecordType | None] = [None] * self.store.document(RECORD)["shape"][0]
        own = [row for row in self.store.stored_chunks(RECORD) if row < len(records)]
        lines, damage = self._lines(PAGE, range(len(records))) | self._lines(RECORD, own), {}
        for row, line in lines.items():
            try:
                if isinstance(line, DamageError):
                    raise line
                records[row] = self.type.from_json(line, row)
            except DamageError as error:
                damage[row] = error.what
        return records, damage

    def _lines(self, name: str, rows: Sequence[int]) -> dict[int, str | DamageError]:
        """Return the texts of rows, which begin with a chunk, or the damage of their chunk."""
        if not rows:
            return {}
        (step,) = chunk_shape(self.store.document(name))
        try:
            return dict(zip(rows, map(str, self.store.read(name, list(rows)).tolist()), strict=True))
        except DamageError as error:
            if len(rows) <= step:
                return dict.fromkeys(rows, error)
        # Each chunk is read by itself to see which.
        parts = (rows[start : start + step] for start in range(0, len(rows), step))
        return {row: line for part in parts for row, line in self._lines(name, part).items()}

    def read(self) -> tuple[RecordType | None, ...]:
        """Return the completion record of each row, or None if it has none that can be read."""
        records, damage = self.examine()
        names, path = self.store.names_of_rows(len(records)) if damage else (), self.store.path
        for row, what in damage.items():
            _log.warning("%s: the record of %s is damaged and counts as not there: %s", path, names[row], what)
        return tuple(records)

    def read_one(self, row: int, *, of_this_run: bool = False) -> RecordType | None:
        """Return the completion record of a row, or None if none can be read; those of this run are in no page yet."""
        with suppress(DamageError):
            line = str(self.store.read(RECORD, row))
            if not line and not of_this_run:
                line = str(self.store.read(PAGE, row))
            return self.type.from_json(line, row)
        return None

    def write(self, row: int, record: RecordType | None) -> None:
        """Write the completion record of a row, or withdraw it: one chunk, replaced as a whole."""
        self.store.write(RECORD, [row], [_WITHDRAWN if record is None else record.to_json(row)])

    def collect(self, records: Sequence[RecordType | None]) -> list[int]:
        """Collect the records of rows in pages, each of rows that all have one, and remove their own chunks.

        If the process ends in between, the chunks beside a page count.

        Returns:
            Rows that keep their own chunks, as these are.
        """
        (step,), kept = chunk_shape(self.store.document(PAGE)), list[int]()
        most_bytes = largest_chunk_bytes(self.store.document(PAGE))
        for page, stored in groupby(self.store.stored_chunks(RECORD), key=lambda row: row // step):
            start, own = page * step, list(stored)
            of_page = records[start : start + step]
            lines = [record.to_json(start + i) for i, record in enumerate(of_page) if record]
            # In a folder, few records are as quick to read, and less is lost with one of them.
            fewest = 1 if self.store.location.scheme else step
            if fewest <= len(of_page) == len(lines) and sum(map(len, lines)) < most_bytes // 2:
                self.store.write(PAGE, [page], lines)
                self.store.location.discard(*(f"{RECORD}/c/{row}" for row in own))
            else:
                kept += own
        return kept
