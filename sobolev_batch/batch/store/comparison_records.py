"""Notes: per surface and kind of comparison what came out, written after everything else of it.

Like a completion record, a note is a chunk of its own, replaced as a whole, and says by its key what went in.
"""

from __future__ import annotations

import json
from collections.abc import Container, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Literal, Self

from sobolev_batch.batch.store.records import Status
from sobolev_batch.batch.store.store import RECORDS, Store
from sobolev_batch.errors import DamageError

Kind = Literal["witness", "proximity"]
KINDS: tuple[Kind, ...] = ("witness", "proximity")


@dataclass(frozen=True)
class ComparisonRecord:
    """The outcome of one comparison of a mesh with the reference.

    Attributes:
        key: what went in.
        status: "complete" or "failed".
        reason: why it failed; empty otherwise.
        numbers: what came out.
        checksum: of the witness function's values; 0 where there are none.
        seconds: time spent in its task.
    """

    key: str
    status: Status
    reason: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)
    checksum: int = 0
    seconds: float = 0.0

    def to_json(self) -> str:
        """The note as one line of JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self | None:
        """The note that a line holds, or None where nothing was written.

        Raises:
            DamageError: the line is not a note.
        """
        try:
            return cls(**json.loads(text)) if text else None
        except (ValueError, TypeError) as error:
            raise DamageError(f"a note is damaged ({error}): {text[:80]!r}", str(error)) from error

    def completes(self, key: str) -> bool:
        """Whether a comparison with this key need not be made."""
        return self.status == "complete" and self.key == key


@dataclass(frozen=True)
class ComparisonRecords:
    """The notes of one kind in a store."""

    store: Store
    kind: Kind

    @property
    def name(self) -> str:
        """The path of their array."""
        return f"{RECORDS}/{self.kind}"

    def lay_out(self, rows: int) -> None:
        """Make room for so many surfaces; notes that are there stay."""
        if not self.store.has(self.name):
            self.store.create_texts(self.name, rows, chunk=1)
        elif self.store.array(self.name).shape[0] < rows:
            self.store.resize(self.name, (rows,))

    def read(self) -> list[ComparisonRecord | None]:
        """All notes, in the order of the store's rows; None where there is none that can be read."""
        return self._examine()[0]

    def damaged(self) -> dict[int, str]:
        """What is wrong with the note of each row that has one which cannot be read."""
        return self._examine()[1]

    def write(self, row: int, note: ComparisonRecord | None) -> None:
        """Write the note of a row, or withdraw it."""
        array = self.store.array(self.name)
        with self.store.location.access("written"):
            array[row] = "" if note is None else note.to_json()

    def remove(self) -> None:
        """Take all of them away."""
        self.store.remove(self.name)

    def _examine(self) -> tuple[list[ComparisonRecord | None], dict[int, str]]:
        if not self.store.has(self.name):
            return [None] * len(self.store.labels()), {}
        lines: Sequence[str | DamageError]
        try:
            lines = self.store.texts(self.name)
        except DamageError:
            # One of them at least: which, is seen one by one.
            lines = [self._line(row) for row in range(self.store.array(self.name).shape[0])]
        notes: list[ComparisonRecord | None] = [None] * len(self.store.labels())
        damaged = {}
        for row, line in enumerate(lines):
            try:
                if isinstance(line, DamageError):
                    raise line
                notes[row] = ComparisonRecord.from_json(line)
            except DamageError as error:
                damaged[row] = error.what
        return notes, damaged

    def _line(self, row: int) -> str | DamageError:
        try:
            return str(self.store.read(self.name, row))
        except DamageError as error:
            return error


def shortcomings(
    labels: Sequence[str], notes: Mapping[Kind, Sequence[ComparisonRecord | None]], rows: Container[int]
) -> dict[str, str]:
    """What meshes lack that could not be compared, and why, by their labels.

    Args:
        labels: of all rows of a store.
        notes: of all rows, for each kind of comparison that was asked for.
        rows: of the meshes that there are fields of.
    """
    found: dict[str, str] = {}
    for kind, of_kind in notes.items():
        for row, note in enumerate(of_kind):
            if note is not None and note.status == "failed" and row in rows:
                lack = f"no {kind}: {note.reason}"
                found[labels[row]] = f"{found[labels[row]]}; {lack}" if labels[row] in found else lack
    return found
