"""What notebooks show of objects: all of it, and nothing of it as markup."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest

import sobolev_batch as sb
from sobolev_batch.extras.leagues.league import leagues_of
from sobolev_batch.shown import together
from tests.support.studies import method_rows, small_table

HOSTILE = "<script>alert('&')</script>"
# Names of families hold no slash.
HOSTILE_NAME = "<b>&amp;"
TAGS = {"div", "strong", "table", "thead", "tbody", "tr", "th", "td"}


def shown(value: Any) -> tuple[list[str], str]:
    """Return the tags and the text of what a notebook shows of a value."""
    page = ElementTree.fromstring(value._repr_html_())
    tags = [element.tag for element in page.iter()]
    assert set(tags) <= TAGS
    return tags, "".join(page.itertext())


def summary() -> sb.result_types.Summary:
    failed = {f"{HOSTILE}/{number}": HOSTILE for number in range(30)}
    return sb.result_types.Summary(
        HOSTILE, ("a/1", "a/2"), ("a/3",), failed, {HOSTILE: HOSTILE}, {HOSTILE: 0.25}, len(failed)
    )


@pytest.mark.parametrize(
    ("value", "texts"),
    [
        (summary(), ["2 computed, 1 reused, 30 failed", f"{HOSTILE}/19: ", "and 10 more", "error of 25 %"]),
        (sb.result_types.StudyDraft(Path(HOSTILE), [HOSTILE], {HOSTILE: "damaged"}), [f"{HOSTILE}: damaged"]),
        (
            sb.result_types.Verification(HOSTILE, 3, 4, {HOSTILE: "gone"}, {"norm": HOSTILE}, withdrawn=True),
            ["damaged", "3 of 4", f"{HOSTILE}: gone", "run the study again to repair it"],
        ),
        (
            sb.result_types.Status(HOSTILE, 3, 5, {HOSTILE: HOSTILE}, {}, None, False, 0.0, failures=1),
            ["3 of 5 complete, 1 failed, 1 to go"],
        ),
        (sb.testing.Verdict("same", 9e-5, 1.1e-4, 1e-3, -2.0, 0.0, "lattice"), ["relative distance 0.010 % ± 0.001 %"]),
    ],
)
def test_texts_are_shown_and_never_run(value: Any, texts: list[str]) -> None:
    _, text = shown(value)
    for expected in texts:
        assert expected in text
    if isinstance(value, sb.testing.Verdict):
        return
    assert HOSTILE in text


def test_a_reason_of_many_meshes_is_told_once() -> None:
    assert together({**dict.fromkeys("abcde", "x"), "f": "y"}) == {"a, b, c and 2 more": "x", "f": "y"}


def test_a_plan_shows_its_lines() -> None:
    title = {"study": {"name": "small", "title": HOSTILE}}
    plan = sb.plan(sb.Study.from_table(small_table(**title)), "memory://html-plan.zarr")
    _, text = shown(plan)
    assert HOSTILE in text
    for line in str(plan).splitlines():
        assert line[15:] in text


def test_a_league_shows_both_tables() -> None:
    rows = method_rows({HOSTILE_NAME: {100: 0.1, 400: 0.03}, "b": {100: 0.2, 400: 0.05}})
    (league,) = leagues_of({"ball": rows, "large": rows}, ["ball", "large"])
    tags, text = shown(league)
    assert tags.count("table") == 2
    assert HOSTILE_NAME in text
    assert "over 2 objects" in text


def test_progress_is_told_and_shown_in_notebooks(monkeypatch: pytest.MonkeyPatch) -> None:
    pair = sb.shapes.icosphere(1), sb.shapes.icosphere(2)
    told: list[str] = []
    sb.distance(*pair, -2.0, rtol=1e-1, on_progress=told.append)
    assert told
    assert all(line.startswith("the distance: ") for line in told)
    shown: list[str] = []

    class Line:
        def update(self, data: dict[str, str], *, raw: bool) -> None:
            assert raw
            shown.append(data["text/plain"])

    notebook = SimpleNamespace(get_ipython=lambda: SimpleNamespace(kernel=True))
    monkeypatch.setitem(sys.modules, "IPython", notebook)
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=lambda *_, **__: Line()))
    sb.distance(*pair, -2.0, rtol=1e-1)
    assert shown == [*told, ""]
    shown.clear()
    sb.fit(*pair, -4.0, steps=2)
    assert [line for line in shown if line.startswith("step 1 of at most 2: ")]
    assert shown[-1] == ""
