"""Guards are found, taken out and missed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.mutants.__main__ import guards_of, killer_of, mirrors_of

SOURCE = '''"""Roots."""


def root(number):
    "√"
    if (number
            < 0):
        raise ValueError(number)
    if number == 1:
        return 1
    require_number(number)
    return number ** 0.5


def require_number(number):
    if not isinstance(number, int | float):
        raise TypeError(number)
'''
TEST = """
import pytest
from package.layer.roots import root


def test_root():
    with pytest.raises(ValueError):
        root(-1.0)
"""


def test_guards_are_conditions_that_raise_and_calls_that_check() -> None:
    found = {guard.line: guard for guard in guards_of(SOURCE, "roots.py")}
    assert {line: guard.text for line, guard in sorted(found.items())} == {
        6: "number < 0",
        11: "require_number(number)",
        16: "not isinstance(number, int | float)",
    }
    assert "if None:" in found[6].without
    assert "    None\n    return number" in found[11].without


@pytest.mark.process
@pytest.mark.all
def test_a_guard_without_a_test_survives(tmp_path: Path) -> None:
    module, test = tmp_path / "package" / "layer" / "roots.py", tmp_path / "tests" / "layer" / "test_roots.py"
    for path, content in ((module, SOURCE), (test, TEST)):
        path.parent.mkdir(parents=True)
        path.write_text(content)
    name = "package/layer/roots.py"
    assert mirrors_of(tmp_path, name) == ["tests/layer/test_roots.py", "tests/layer"]
    held, _, unheld = sorted(guards_of(SOURCE, name), key=lambda guard: guard.line)
    assert killer_of(tmp_path, held) == "FAILED tests/layer/test_roots.py::test_root"
    assert killer_of(tmp_path, unheld) == ""
    assert module.read_text() == SOURCE
