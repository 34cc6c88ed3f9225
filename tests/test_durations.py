"""The recorded time of the tests stays within its budget. `make durations` records it anew; this times nothing."""

from __future__ import annotations

from tests.support.durations import recorded_seconds
from tests.support.repository import ROOT

# Of three processes for two cores.
MOST_SECONDS, MOST_SECONDS_OF_A_FILE = 2100.0, 135.0


def test_the_suite_is_within_its_budget() -> None:
    recorded = recorded_seconds()
    assert sum(recorded.values()) <= MOST_SECONDS
    assert max(recorded.values()) <= MOST_SECONDS_OF_A_FILE, max(recorded, key=recorded.__getitem__)


def test_every_file_is_recorded() -> None:
    files = {file.relative_to(ROOT).as_posix() for file in (ROOT / "tests").rglob("test_*.py")}
    assert recorded_seconds().keys() <= files
    unrecorded = {
        name
        for name in files - recorded_seconds().keys()
        if "pytestmark = pytest.mark.all" not in (ROOT / name).read_text()
    }
    assert not unrecorded, "run `make durations`"
