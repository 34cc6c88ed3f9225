"""The table: rows of two contestants' figures, their ratio, and the target it is held against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tabulate import tabulate

_HEADERS = ("item", "what", "ours", "other", "ratio", "target", "reached")


@dataclass(frozen=True)
class Target:
    """What a ratio should be.

    Attributes:
        limit: the ratio at the edge of success.
        at_least: whether success lies above the limit, as for a speed-up, or below it, as for a cost.
    """

    limit: float
    at_least: bool

    def reached_by(self, ratio: float) -> bool:
        """Whether a ratio is a success; NaN is none."""
        return ratio >= self.limit if self.at_least else ratio <= self.limit

    def __str__(self) -> str:
        return f"at {'least' if self.at_least else 'most'} {self.limit:.3g}"


def at_least(limit: float) -> Target:
    """The target of a speed-up."""
    return Target(limit, at_least=True)


def at_most(limit: float) -> Target:
    """The target of a cost or an error."""
    return Target(limit, at_least=False)


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        item: the number of the benchmark that it belongs to.
        what: what was compared.
        ours: the package's figure, with its unit.
        other: the other contestant's, likewise.
        ratio: of the two, in the direction that ``what`` or the target tells; None without one.
        target: for the ratio; None where it is only for information.
    """

    item: str
    what: str
    ours: str = ""
    other: str = ""
    ratio: float | None = None
    target: Target | None = None

    def cells(self) -> tuple[str, ...]:
        """The row as text, one string per column."""
        ratio = "" if self.ratio is None else f"{self.ratio:.3g}"
        target = "" if self.target is None else str(self.target)
        reached = ""
        if self.target is not None:
            reached = "not available" if self.ratio is None else ("no", "yes")[self.target.reached_by(self.ratio)]
        return self.item, self.what, self.ours, self.other, ratio, target, reached


def format_table(rows: Sequence[Row], style: str = "simple") -> str:
    """The rows under a header, in one of the styles of tabulate."""
    alignment = ("left", "left", "right", "right", "right", "left", "left")
    cells = [row.cells() for row in rows]
    return str(tabulate(cells, headers=_HEADERS, tablefmt=style, colalign=alignment, disable_numparse=True))


def as_seconds(value: float) -> str:
    """A time to four digits."""
    return f"{value:.4g} s"


def as_bytes(value: float) -> str:
    """A size to four digits, in decimal units."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if value >= size:
            return f"{value / size:.4g} {unit}"
    return f"{value:.0f} B"
