"""Turns of phrase that make prose hard to read are in no module, message or page."""

from __future__ import annotations

import re

import pytest

from tests.support.repository import PACKAGE, ROOT

# By what to write in their place.
PATTERNS = {
    "a number, or 'this many'": r"\bso (?:many|much)\b",
    "the subject first": r"(?:^|[.:;]\s+)Of (?:an?|the|its|this|these|those|each|every|all)\b[^.;:\n]*, ",
    "a second sentence, or 'whose'": r"\bof wh(?:ich|om)\b",
    "'exists', 'holds', 'is'": r"\b(?:is|are) there\b|\bstands? (?:in|on|at|beside|under|there)\b",
    "'attainable'": r"\bbe had\b",
    "'misses', 'below the target'": r"\bfalls? short\b",
    "'requests', 'requires'": r"\bask(?:s|ed) for\b",
    "'where', or a distance": r"\bas far as\b",
    "'also'": r", too(?=[.;:)]|$)",
}


@pytest.mark.parametrize("remedy", PATTERNS)
def test_no_place_has_a_pattern(remedy: str) -> None:
    places = [
        f"{path.relative_to(ROOT)}:{text.count(chr(10), 0, match.start()) + 1}: {match[0].strip()!r}"
        for path in sorted([*PACKAGE.rglob("*.py"), *(ROOT / "docs").glob("*.md"), ROOT / "README.md"])
        for text in [path.read_text(encoding="utf-8")]
        for match in re.finditer(PATTERNS[remedy], text, re.MULTILINE)
    ]
    assert not places, f"write {remedy} in place of\n" + "\n".join(places)
