"""The report of a collection, in a real browser."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner

import sobolev_batch as sb
from sobolev_batch import InputError
from sobolev_batch.cli import cli
from sobolev_batch.results.report import content as content_module
from sobolev_batch.results.report.build import make_report
from sobolev_batch.results.tables.league import leagues_of
from tests.support.browser import Browser, browser
from tests.support.studies import GONE, balls, method_rows, methods_of, small_table

TABLES = ["league", "pairs", "objects", "failed"]
SCRIPT = "<script>window.ran=1</script>"


@pytest.fixture(scope="module")
def store() -> str:
    """Two spheres by two methods, and an object that has lost its reference."""
    study = {"name": "balls", "title": f"Balls {SCRIPT}"}
    table = small_table(study=study, object=[*balls(ball=1.0, large=1.1), GONE], family=methods_of("=egg"))
    place = "memory://balls-report.zarr"
    assert list(sb.run(sb.StudyCollection.from_table(table), place).failed) == ["gone"]
    return place


@pytest.fixture(scope="module")
def page(store: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("collection") / "report.html"
    done = CliRunner().invoke(cli, ["report", store, "--output", str(path)])
    assert done.stdout.strip() == str(path)
    assert f"left out: single meshes: each object has a report of its own, such as that of {store}/ball" in done.stderr
    return path


@pytest.fixture(scope="module")
def reader(page: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("profile")) as found:
        found.open_report(page)
        yield found


def test_the_page_opens_with_the_league(reader: Browser, page: Path, store: str) -> None:
    assert reader.requests() == [page.as_uri()]
    assert reader.complaints() == []
    assert reader.tell("window.ran === undefined")
    (league, _) = sb.league(store)
    best = league.table["method"].iloc[0]
    assert reader.texts(".lead")[0].startswith(f"The intervals do not separate {best} and ")
    shown = reader.texts("#table-league tbody:not([hidden]) th.label")
    assert shown == league.table["method"].tolist()
    assert reader.tell("document.querySelector('main table').id") == "table-league"
    assert reader.tell("[...document.querySelectorAll('table')].map(e => e.dataset.name)") == TABLES
    drawn = reader.tell("document.getElementById('chart-league').data.map(line => line.y.length)")
    assert drawn == [5, 5]
    assert reader.relative_columns() == {"table-league": True, "table-objects": True}
    assert reader.texts("#failed tbody th") == ["gone"]
    assert reader.texts("#table-objects tbody:not([hidden]) th.label") == ["ball", "large"]


@pytest.mark.slow
def test_a_collection_without_league_says_why(store: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise InputError("no object has all of the methods <a>")

    monkeypatch.setattr(content_module, "leagues_of", refuse)
    text = make_report(store)[0]
    assert "<strong>There is no league.</strong> no object has all of the methods &lt;a&gt;" in text
    assert "left out: methods cannot be compared" in text
    assert 'id="table-objects"' in text
    # At every order.
    assert text.count("Methods cannot be compared over the objects.") == 2


def test_meshes_of_a_collection_are_shown_by_the_report_of_an_object(store: str) -> None:
    with pytest.raises(InputError, match=f"in the report of one object, such as {store}/ball"):
        make_report(store, witnesses=["ico/1"])


SEPARATED = "a is nearest to the references over 8 objects at order −2: it differs by 0.5 %."
OPEN = "The intervals do not separate {} over {} objects at order −2. a has the smallest mean, 0.5 %."


@pytest.mark.parametrize(
    ("factors", "objects", "sentence"),
    [
        ({"b": 2.0, "a": 1.0}, 8, SEPARATED),
        ({"a": 1.0}, 2, "a differs from the references by 0.5 % over 2 objects at order −2."),
        ({"b": 2.0, "a": 1.0}, 1, "a is nearest on o0 at order −2: it differs by 0.5 %. One object ranks no methods."),
        ({"a": 1.0, "b": 1.0, "c": 2.0}, 8, OPEN.format("a and b", 8)),
        (dict.fromkeys("abcde", 1.0), 2, OPEN.format("5 of 5 methods", 2)),
    ],
)
def test_a_sentence_says_which_method_is_nearest(factors: dict[str, float], objects: int, sentence: str) -> None:
    rows = method_rows({method: {n: factor / n for n in (100, 400)} for method, factor in factors.items()})
    tables = {f"o{i}": rows for i in range(objects)}
    (league,) = leagues_of(tables, list(tables))
    assert content_module.sentence_of(league) == sentence
