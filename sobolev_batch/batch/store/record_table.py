"""Tables of records: an array of strings with one record of each row, in JSON, in a chunk of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, TypeVar

from sobolev_batch.batch.store.hierarchy import LABELS, ROOT, Hierarchy
from sobolev_batch.batch.store.layout import Layout
from sobolev_batch.batch.store.records import JsonRecord
from sobolev_batch.errors import DamageError

R = TypeVar("R", bound=JsonRecord)


class RecordTable(Generic[R]):
    """Records of one kind in a store.

    Args:
        hierarchy: Hierarchy of the store.
        name: Path of their array.
        kind: Class of the records.
    """

    def __init__(self, hierarchy: Hierarchy, name: str, kind: type[R]) -> None:
        self.name = name
        self._hierarchy = hierarchy
        self._kind = kind

    def create(self, rows: int) -> None:
        """Create the array, or extend it; existing records stay."""
        if not self._hierarchy.has(self.name):
            layout = Layout()
            layout.add_array(self.name, str, (rows,), (1,), ("mesh",))
            self._hierarchy.publish(layout.keys(self.name), last=f"{self.name}/{ROOT}")
        elif self._hierarchy.array(self.name).shape[0] < rows:
            self._hierarchy.resize(self.name, (rows,))

    def read(self) -> list[R | None]:
        """Return the record of each row, or None if it has none that can be read."""
        return self.examine()[0]

    def read_row(self, row: int) -> R | None:
        """Return the record of one row, or None if it has none that can be read."""
        try:
            return self._kind.from_json(str(self._hierarchy.read(self.name, row)), row)
        except DamageError:
            return None

    def damaged(self) -> dict[int, str]:
        """Return the damage of each record that cannot be read."""
        return self.examine()[1]

    def write(self, row: int, record: R | None) -> None:
        """Write the record of a row, or erase it."""
        self._hierarchy.write(self.name, row, "" if record is None else record.to_json(row))

    def remove(self) -> None:
        """Remove all records."""
        self._hierarchy.remove(self.name)

    def examine(self) -> tuple[list[R | None], dict[int, str]]:
        """Return the record of each row, as `read` does, and the damage of those that cannot be read."""
        records: list[R | None] = [None] * self._hierarchy.array(LABELS).shape[0]
        damage = {}
        for row, line in enumerate(self._lines()):
            try:
                if isinstance(line, DamageError):
                    raise line
                records[row] = self._kind.from_json(line, row)
            except DamageError as error:
                damage[row] = error.what
        return records, damage

    def _lines(self) -> Sequence[str | DamageError]:
        if not self._hierarchy.has(self.name):
            return ()
        try:
            return self._hierarchy.read_strings(self.name)
        except DamageError:
            # At least one of them; read each by itself to see which.
            return [self._line(row) for row in range(self._hierarchy.array(self.name).shape[0])]

    def _line(self, row: int) -> str | DamageError:
        try:
            return str(self._hierarchy.read(self.name, row))
        except DamageError as error:
            return error
