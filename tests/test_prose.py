"""Turns of phrase that make prose hard to read do not become more, in the package and in its pages."""

from __future__ import annotations

import re

import pytest

from tests.support.repository import PACKAGE, ROOT

# Each with the number of places that have it still. It may only fall: write another sentence.
PATTERNS = {
    "so many, so much": (r"\bso (?:many|much)\b", 32),
    "a genitive at the beginning": (
        r"(?:^|[.:;]\s+)Of (?:an?|the|its|this|these|those|each|every|all)\b[^.;:\n]*, ",
        7,
    ),
    "of which, of whom": (r"\bof wh(?:ich|om)\b", 28),
    "is there, stands in, for a position": (r"\b(?:is|are) there\b|\bstands? (?:in|on|at|beside|under|there)\b", 31),
    "can be had": (r"\bbe had\b", 7),
    "falls short": (r"\bfalls? short\b", 15),
    "a study or an option asks for": (r"\bask(?:s|ed) for\b", 73),
    "as far as": (r"\bas far as\b", 16),
    "too at the end": (r", too\b", 13),
}


@pytest.mark.parametrize("name", PATTERNS)
def test_no_more_places_have_a_pattern(name: str) -> None:
    pattern, most = PATTERNS[name]
    places = [
        f"{path.relative_to(ROOT)}:{text.count(chr(10), 0, match.start()) + 1}"
        for path in sorted([*PACKAGE.rglob("*.py"), *(ROOT / "docs").glob("*.md"), ROOT / "README.md"])
        for text in [path.read_text(encoding="utf-8")]
        for match in re.finditer(pattern, text, re.MULTILINE)
    ]
    assert len(places) <= most, f"{name}, in {len(places)} places where {most} are allowed: {', '.join(places)}"
