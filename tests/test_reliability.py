"""docs/reliability.md names tests that exist."""

from __future__ import annotations

import re

from tests.support.repository import ROOT


def test_each_promise_names_its_tests() -> None:
    text = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+)°? \|.*\|([^|]*)\|$", text, re.MULTILINE)
    assert sorted(int(number) for number, _ in rows) == list(range(1, 27))
    for number, tests in rows:
        named = re.findall(r"`([\w/]+\.py)`", tests)
        assert named, number
        for name in named:
            assert (ROOT / "tests" / name).exists(), name
