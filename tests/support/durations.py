"""Seconds that each file of tests took when they were last recorded, by `make durations`."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

RECORD = Path(__file__).parents[1] / "durations.tsv"


def recorded_seconds() -> dict[str, float]:
    """Seconds by the path of a file from the root of the repository, with those of its fixtures."""
    lines = (line for line in RECORD.read_text().splitlines() if not line.startswith("#"))
    return {name: float(seconds) for seconds, name in (line.split("\t") for line in lines)}


def record(seconds: Mapping[str, float]) -> None:
    today = datetime.now(UTC).date()
    head = f"# make test on {os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}, {today}\n"
    rows = sorted(seconds.items(), key=lambda row: (-round(row[1], 1), row[0]))
    RECORD.write_text(head + "".join(f"{number:.1f}\t{name}\n" for name, number in rows))


def summary(seconds: Mapping[str, float], count: int = 10) -> list[str]:
    """Lines with the files that took longest, beside what was recorded."""
    recorded = recorded_seconds()
    slowest = sorted(seconds, key=seconds.__getitem__, reverse=True)[:count]
    return [f"{seconds[name]:7.1f} s, recorded {recorded.get(name, 0.0):7.1f} s  {name}" for name in slowest]
