"""Reports of a small study with a failed mesh and hostile names, and of several objects, in a real browser."""

from __future__ import annotations

import json
import re
import shutil
import socket
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from distributed import Client
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

import sobolev_batch as sb
from sobolev_batch import Study, open_store, run
from sobolev_batch.cli import cli
from sobolev_batch.errors import DamageError, InputError, StoreError
from sobolev_batch.extras.figures import selection
from sobolev_batch.extras.figures.views import make_views
from sobolev_batch.extras.leagues.league import format_league, leagues_of
from sobolev_batch.extras.report import build, content
from sobolev_batch.extras.report.build import make_report
from sobolev_batch.shapes import icosphere
from sobolev_batch.store.layout import Store, hide_tables
from sobolev_batch.tables.convergence import tables_of
from sobolev_batch.tables.text import minus
from tests.support.browser import Browser, browser
from tests.support.stores import flip
from tests.support.studies import GONE, balls, method_rows, methods_of, small_table

SCRIPT = "<script>window.ran=1</script>"
IMAGE = '"><img src=x onerror="window.ran=2">'
# A slash is no part of a name, so that of a family the script stays open.
# A spreadsheet would take it for a formula, too.
FAMILY = '=ico <script>window.ran=3 "><img src=x onerror=window.ran=4> $^$ %{x}'


def table(folder: Path) -> dict[str, Any]:
    """Three icospheres, a file that is one, and one that is no mesh."""
    sb.write_mesh(icosphere(1), folder / "good.obj")
    (folder / "<b>bad<.ply").write_text(f"ply\nformat {IMAGE}{SCRIPT}\n")
    family = [
        {"name": FAMILY, "source": "icosphere", "levels": [0, 1, 2]},
        {"name": "files", "source": "files", "paths": ["*.obj", "*.ply"]},
    ]
    return small_table(study={"name": "hostile", "title": f"Title {SCRIPT}{IMAGE}"}, family=family)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("report")


_CHARTS = ("convergence", "matrix", "spectrum", "energy", "witness")


@pytest.fixture(scope="module")
def store(folder: Path) -> str:
    place = "memory://hostile.zarr"
    assert len(run(Study.from_table(table(folder), folder=folder), place).failed) == 1
    return place


@pytest.fixture(scope="module")
def page(store: str, folder: Path) -> Path:
    """What the command writes."""
    path = folder / "report.html"
    done = CliRunner().invoke(cli, ["report", store, "--output", str(path), "--folder", str(folder)])
    assert done.stdout.strip() == str(path)
    # By default those at the ends of each family.
    assert done.stderr.startswith("left out: witness functions: only 3 of 4 meshes are drawn; --mesh chooses them")
    return path


@pytest.fixture(scope="module")
def reader(page: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """The page on a desktop; tests that change it leave it as they found it."""
    with browser(tmp_path_factory.mktemp("profile")) as found:
        found.open_report(page)
        yield found


def test_page_loads_without_complaint_or_request(reader: Browser, page: Path, folder: Path) -> None:
    assert reader.requests() == [page.as_uri()]
    assert reader.complaints() == []
    drawn = reader.tell("[...document.querySelectorAll('.chart:has(svg)')].map(e => e.id)")
    assert drawn == [f"chart-{name}" for name in _CHARTS]
    assert page.stat().st_size < 4e6
    # The study can be run again.
    assert tomllib.loads(reader.tell("document.getElementById('study').textContent")) == table(folder)


def test_no_name_becomes_markup(reader: Browser) -> None:
    assert reader.tell("window.ran === undefined")
    assert reader.tell("document.title").startswith(f"Title {SCRIPT}{IMAGE}")
    assert reader.texts("h1") == [f"Title {SCRIPT}{IMAGE}"]
    assert reader.texts("#table-convergence tbody th.label")[0] == f"{FAMILY}/0"
    assert reader.tell("[...document.images].filter(e => !e.src.startsWith('data:')).length") == 0
    # Plotly takes some tags for markup.
    legend = reader.tell("[...document.querySelectorAll('.legendtext')].map(e => e.textContent)")
    assert f"{FAMILY[:20]}…{FAMILY[-19:]}" in legend
    assert reader.tell("document.querySelectorAll('script:not([type])').length") == 3


def test_failures_are_shown_with_their_reasons(reader: Browser) -> None:
    assert reader.texts("#failed tbody th") == ["files/<b>bad<"]
    assert "bad<.ply" in reader.texts("#failed td")[0]
    assert "1 mesh is missing" in reader.texts("header .warning")[0]
    assert reader.texts("#table-verdict tbody:not([hidden]) tr:last-child > *") == ["missing", "files/<b>bad<: see why"]
    rows = reader.texts("#table-convergence tbody:not([hidden]) tr")
    assert any("failed: see why" in row for row in rows)


def test_columns_sort_by_clicks_and_keys(reader: Browser) -> None:
    shown = "#table-convergence tbody:not([hidden]) tr:not(.of-order) > :nth-child(3)"
    last = "#table-convergence tbody:not([hidden]) tr:last-child td"
    button = reader.driver.find_elements(By.CSS_SELECTOR, "#table-convergence thead button")[2]
    reader.driver.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", button)
    button.click()
    assert (reader.texts(shown), reader.texts(last)) == (["20", "80", "80", "320"], ["failed: see why"])
    assert reader.tell("document.querySelectorAll('#table-convergence thead th')[2].ariaSort") == "ascending"
    button.send_keys(Keys.ENTER)
    assert (reader.texts(shown), reader.texts(last)) == (["320", "80", "80", "20"], ["failed: see why"])
    assert reader.tell("document.activeElement.closest('th').ariaSort") == "descending"


def test_the_order_switches_tables_and_charts(reader: Browser, store: str) -> None:
    frame = sb.table(store).dropna(subset="distance")
    for order, name in ((-10.0, "−10"), (-3.0, "−3")):
        assert reader.texts(".current-order b") == [name, name]
        assert f"at order {name}" in reader.texts(".lead")[0]
        here = frame[frame["order"] == order]
        cells = reader.texts("#table-convergence tbody:not([hidden]) td:not(.absent):nth-of-type(1)")
        shown = sorted(float(text.split()[0]) / 100 for text in cells)
        assert shown == pytest.approx(sorted(here["relative"]), rel=0.05)
        drawn = reader.tell("document.getElementById('chart-convergence').data[0].y")
        assert sorted(drawn) == pytest.approx(sorted(here[here["family"] == FAMILY]["relative"]), rel=1e-3)
        reader.driver.find_element(By.CSS_SELECTOR, "input[name=order]:checked").send_keys(Keys.ARROW_RIGHT)
    # Around to the first one.
    assert set(reader.texts(".current-order b")) == {"−10"}


def test_edges_have_one_unit_in_table_and_chart(store: str) -> None:
    tree = sb.open_store(store)
    tree.attrs["similarity"] = json.dumps({"scale": 0.02, "origin": [0, 0, 0]})
    data = build.chart_data(tree, None, [])
    frame = sb.table(store, -10).set_index("mesh")
    assert (data["edge_unit"], data["unit"]) == ("file units", "units of 50 file units")
    for line in data["convergence"][0]:
        assert line["x"] == pytest.approx(50 * frame["edge_length"][line["labels"]], rel=1e-3)


@pytest.mark.parametrize("width", [360, 390, 768, 1280])
def test_mesh_and_distance_are_seen_at_every_width(reader: Browser, page: Path, width: int) -> None:
    reader.open(page, width=width, height=740)
    assert reader.tell("innerWidth") == width
    assert reader.tell("document.documentElement.scrollWidth") <= width
    row = "#table-convergence tbody:not([hidden]) tr:not(.of-order) "
    if width > 700:
        assert reader.relative_columns() == {"table-verdict": True, "table-convergence": True}
        return
    # Each row is a card: its label, and below it each number with its name.
    assert not reader.tell("[...document.querySelectorAll('.scroll')].some(e => e.scrollWidth > e.clientWidth)")
    assert reader.texts("thead th") == []
    shown = f"[...document.querySelector('{row}').children].filter(e => e.offsetParent)"
    tops = reader.tell(f"{shown}.map(e => e.getBoundingClientRect().top)")
    assert len(tops) > 3
    assert tops == sorted(set(tops))
    names = reader.tell(f"[...document.querySelectorAll('{row} td')].map(e => getComputedStyle(e, '::before').content)")
    assert '"relative"' in names


def test_csv_has_all_orders_and_all_digits(reader: Browser, store: str, tmp_path: Path) -> None:
    names = {f"hostile-{name}.csv" for name in ("verdict", "convergence", "failed", "meshes")}
    assert reader.download_tables(tmp_path) == names
    frame = pd.read_csv(tmp_path / "hostile-convergence.csv").set_index(["order", "mesh"])
    known = sb.table(store)
    # Harmless in a spreadsheet.
    known["mesh"] = ["'" * label.startswith("=") + label for label in known["mesh"]]
    known = known.set_index(["order", "mesh"]).loc[frame.index]
    assert len(frame) == len(known) == 10
    numbers = ["relative", "relative_error", "distance", "error", "edge_length", "rate", "rate_error"]
    pd.testing.assert_frame_equal(frame[numbers], known[numbers], check_exact=True)
    assert frame["status"].xs("files/<b>bad<", level="mesh").tolist() == ["failed", "failed"]
    unresolved = frame["relative"] <= frame["relative_error"]
    assert (frame[unresolved]["status"] == "below its error").all()


def test_paper_and_browsers_without_scripts_show_every_order(reader: Browser, page: Path) -> None:
    def check() -> None:
        assert reader.texts("#table-convergence .of-order th") == ["order −10", "order −3"]
        assert len(reader.texts("#table-convergence tbody th.label")) == 10

    look = "[getComputedStyle(document.body).color, document.getElementById('chart-convergence').layout.font.color]"
    reader.command("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "dark"}])
    reader.wait(f'JSON.stringify({look}) === \'["rgb(230, 232, 234)","#e6e8ea"]\'')
    reader.command("Emulation.setEmulatedMedia", media="print")
    reader.driver.execute_script("dispatchEvent(new Event('beforeprint'))")
    assert reader.tell(look) == ["rgb(29, 35, 41)", "#1d2329"]
    assert reader.tell("document.querySelector('#chart-convergence svg').getBoundingClientRect().width") == 640
    check()
    reader.command("Emulation.setEmulatedMedia", media="", features=[])
    reader.command("Emulation.setScriptExecutionDisabled", value=True)
    try:
        reader.driver.get(page.as_uri())
    finally:
        reader.command("Emulation.setScriptExecutionDisabled", value=False)
    check()
    assert len(reader.texts(".no-chart")) == len(_CHARTS)
    assert reader.texts(".chart") == []


def test_page_can_be_found_through_without_eyes_and_mouse(reader: Browser, page: Path) -> None:
    def values(selector: str, name: str) -> list[str | None]:
        return list(reader.tell(f"[...document.querySelectorAll('{selector}')].map(e => e.getAttribute('{name}'))"))

    reader.open_report(page)
    parts = ("main", "nav", "header", "footer", "fieldset", "legend", "caption", "figcaption")
    assert all(values(part, "class") for part in parts)
    assert len(values("h1", "class")) == 1
    ids = values("[id]", "id")
    assert len(ids) == len(set(ids))
    assert {f"#{one}" for one in ids} >= set(values("a", "href"))
    assert all(values("[role=img]", "aria-label"))
    controls = "a[href], button, input:checked, [type=checkbox], select, [tabindex='0']"
    shown = f"[...document.querySelectorAll(`{controls}`)].filter(e => e.checkVisibility())"
    names = reader.tell(f"{shown}.map((e, i) => e.dataset.control = `${{i}}`)")
    walked = []
    for _ in names:
        ActionChains(reader.driver).send_keys(Keys.TAB).perform()
        walked.append(reader.tell("document.activeElement.dataset.control"))
    assert walked == names


@pytest.mark.slow
def test_only_meshes_that_were_computed_are_shown(store: str, folder: Path) -> None:
    tree = open_store(store)
    (view,), missing = make_views(tree, folder, ["files/good", "reference", "files/<b>bad<"])
    no_mesh = "a surface that is no mesh has no triangles"
    assert missing == {"reference": no_mesh, "files/<b>bad<": "its status is 'failed'"}
    assert (view.label, view.values.shape) == ("files/good", (2, len(view.vertices)))
    # An inscribed mesh has less area than the sphere everywhere.
    assert (view.values < 0).all()
    _, elsewhere = make_views(tree, folder / "results.zarr", ["files/good"])
    assert re.search("cannot be listed here: .* by --folder", elsewhere["files/good"])
    with pytest.raises(InputError, match="no mesh 'nobody'"):
        make_views(tree, folder, ["nobody"])


@pytest.mark.slow
def test_large_studies_are_cut_and_say_so(store: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, most in {
        "content.MOST_CONVERGENCE_ROWS": 6,
        "content.MOST_MESH_ROWS": 2,
        "build.MOST_MESHES": 3,
        "build.MOST_POINTS": 6,
    }.items():
        monkeypatch.setattr(f"sobolev_batch.extras.report.{name}", most)
    monkeypatch.setattr(selection, "MOST_SPECTRA", 2)
    page, omissions = make_report(store, folder=folder)
    for note in (
        "2 more rows are not shown here; <code>sobolev-batch table --format csv</code>",
        "4 more rows are not shown here",
        "The first 3 of 5 meshes are shown, including the reference",
        "2 of 4 meshes are shown, spread evenly through the study",
    ):
        assert note in page
    assert set(omissions) >= {
        "the table convergence: 2 more rows",
        "the table meshes: 4 more rows",
        "the chart of convergence: only 6 of 8 distances are drawn",
        "all pairs: only 3 of 5 meshes are shown",
        "spectra: only those of 2 of 4 meshes are shown",
    }


@pytest.mark.slow
def test_lacking_comparisons_have_a_section(store: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    status = replace(sb.status(store), not_compared={"files/good": "no proximity: <i>changed</i>"})
    monkeypatch.setattr(build, "status", lambda _: status)
    text, _ = make_report(store, folder=folder)
    assert "1 mesh lacks a comparison" in text
    assert text.count('href="#lacking"') == text.count('id="lacking"') == 1
    assert "no proximity: &lt;i&gt;changed&lt;/i&gt;" in text


@pytest.mark.all
def test_a_page_shows_one_state_of_a_store(copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def make_views_while_a_run_begins(*arguments: Any, **options: Any) -> Any:
        hide_tables(Store.open(copy))
        return make_views(*arguments, **options)

    monkeypatch.setattr(build, "make_views", make_views_while_a_run_begins)
    with pytest.raises(sb.errors.StoreError, match="a run has changed the store while it was read"):
        sb.report(copy, tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


@pytest.mark.slow
def test_what_is_missing_or_damaged_is_said(
    store: str, copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(StoreError, match="it holds no store of a study"):
        make_report(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(build, "make_report", lambda *_, **__: ("", ()))
        with pytest.raises(StoreError, match="cannot be written there"):
            sb.report(store, tmp_path / "nowhere" / "a.html")
    for chunk in (copy / "fourier" / "fourier" / "c").glob("*/*/*/*"):
        flip(chunk)
    for read in (make_report, sb.plot.spectrum):
        with pytest.raises(DamageError, match=f"{copy}: chunk .* of fourier/fourier is damaged .*verify names what"):
            read(copy)


@pytest.fixture(scope="module")
def objects() -> str:
    """Two spheres by two methods, and an object that has lost its reference."""
    study = {"name": "balls", "title": f"Balls {SCRIPT}"}
    made = small_table(study=study, object=[*balls(ball=1.0, large=1.1), GONE], family=methods_of("=egg"))
    place = "memory://balls-report.zarr"
    assert list(sb.run(sb.Study.from_table(made), place).failed) == ["gone"]
    return place


def test_the_page_of_several_objects_opens_with_the_league(objects: str, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    done = CliRunner().invoke(cli, ["report", objects, "--output", str(path)])
    assert done.stdout.strip() == str(path)
    left_out = "left out: single meshes: each object has a report of its own, such as that of "
    assert f"{left_out}{objects}/ball" in done.stderr
    (league, _) = sb.league(objects)
    methods = league.table["method"].tolist()
    with browser(tmp_path / "profile") as reader:
        reader.open_report(path)
        assert reader.requests() == [path.as_uri()]
        assert reader.complaints() == []
        assert reader.tell("window.ran === undefined")
        assert reader.texts(".lead")[0].startswith(f"The intervals do not separate {methods[0]} and ")
        assert reader.texts("#table-league tbody:not([hidden]) th.label") == methods
        names = reader.tell("[...document.querySelectorAll('main table')].map(e => e.dataset.name)")
        assert names == ["league", "pairs", "objects", "failed"]
        drawn = reader.tell("document.getElementById('chart-league').data.map(line => line.y.length)")
        assert drawn == [5, 5]
        assert reader.relative_columns() == {"table-league": True, "table-objects": True}
        assert reader.texts("#failed tbody th") == ["gone"]
        worst_first = [league.objects[place] for place in np.argsort(-league.values.min(axis=1))]
        assert reader.texts("#table-objects tbody:not([hidden]) th.label") == worst_first


def test_a_study_with_costs_has_its_league_by_cost(store: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert 'id="costs"' not in make_report(store)[0]
    for name in ("cost_leagues_of", "front_columns"):
        monkeypatch.setattr(content, name, partial(getattr(content, name), x="triangles"))
    text = make_report(store)[0]
    expected = sb.league(store, by="cost", x="triangles")
    data = json.loads(text.split('id="data">')[1].split("</script>")[0])["costs"]
    for league, drawn in zip(expected, data, strict=True):
        assert drawn["front"]["x"] == pytest.approx(league.means[league.means["front"]]["triangles"], rel=1e-3)
        assert sum(len(line["y"]) for line in drawn["lines"]) == len(league.means)
    table = text.split('id="table-cost-methods"')[1].split("</table>")[0]
    assert table.count('<th scope="row"') == sum(len(league.table) for league in expected)


def test_the_page_of_several_objects_has_their_largest_deviations(
    objects: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert 'id="table-deviations"' not in make_report(objects)[0]
    frames = tables_of(objects)
    for frame in frames.values():
        frame["hausdorff"], frame.attrs["unit"] = 10 / frame["triangles"], "mm"
        frame["hausdorff_upper"] = frame["hausdorff"]
    monkeypatch.setattr(content, "tables_of", lambda _: frames)
    shown = make_report(objects)[0].split('id="table-deviations"')[1].split("</table>")[0]
    (league,) = leagues_of(frames, [*frames], y="hausdorff")
    assert [float(key) for key in re.findall(r'<td data-label="hausdorff" data-key="(.*?)"', shown)] == pytest.approx(
        league.table["hausdorff"].tolist()
    )
    assert ", in mm" in shown


@pytest.mark.slow
def test_objects_without_league_say_why(objects: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise InputError("no object has all of the methods <a>")

    monkeypatch.setattr(content, "leagues_of", refuse)
    text = make_report(objects)[0]
    assert "<strong>There is no league.</strong> no object has all of the methods &lt;a&gt;" in text
    assert "left out: methods cannot be compared" in text
    assert 'id="table-objects"' in text
    assert text.count("Methods cannot be compared over the objects.") == 1


def test_objects_without_tables_are_missing(objects: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(content, "tables_of", lambda place: {"ball": tables_of(place)["ball"]})
    missing = make_report(objects)[0].split('id="table-failed"')[1].split("</table>")[0]
    assert re.findall(r'<th scope="row"[^>]*>(.*?)</th>', missing) == ["large", "gone"]
    assert "it has no tables yet; run the study again" in missing


def test_meshes_of_several_objects_are_shown_by_the_report_of_an_object(objects: str) -> None:
    with pytest.raises(InputError, match=f"in the report of one object, such as {objects}/ball"):
        make_report(objects, witnesses=["ico/1"])


SEPARATED = "a is nearest to the references over 8 objects at order −2: it differs by 0.5 %."
CHANCE = (
    "a has the smallest mean over 3 objects at order −2, 0.5 %, but the test of pairs does not tell it from all others."
)
OPEN = "The intervals do not separate {} over {} objects at order −2. a has the smallest mean, 0.5 %."


@pytest.mark.parametrize(
    ("factors", "objects", "sentence"),
    [
        ({"b": 2.0, "a": 1.0}, 8, SEPARATED),
        ({"b": 2.0, "a": 1.0}, 3, CHANCE),
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
    assert league.verdict(lambda order: minus(f"{order:g}")).replace("\xa0", " ") == sentence
    assert " ".join(format_league([league]).split()).startswith(sentence.replace("\N{MINUS SIGN}", "-"))
    # The legend has the order of the table.
    (lines,) = build.league_data([league], "", [])["league"]
    assert [line["family"] for line in lines] == league.table["method"].tolist()


class _Live(HTMLParser):
    """What a page may do beside showing its text: scripts, handlers, and addresses of other places."""

    def __init__(self) -> None:
        super().__init__()
        self.found, self.scripts = list[str](), 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.scripts += tag == "script"
        places = [f"{tag} {name}={value}" for name, value in attrs if name in ("src", "href", "action", "srcdoc")]
        self.found += [place for place in places if not re.search(r"=(#|data:(image/|,$))", place)]
        self.found += [f"{tag} {name}" for name, _ in attrs if name.startswith("on")]
        self.found += [tag] if tag in ("iframe", "object", "embed", "base", "form", "meta-refresh") else []


@pytest.mark.slow
def test_a_forged_store_makes_nothing_live_and_opens_no_place_that_it_names(tmp_path: Path, threads: Client) -> None:
    run(Study.from_table(small_table(compare=None)), tmp_path / "sound.zarr", threads)
    forged = Store(shutil.copytree(tmp_path / "sound.zarr", tmp_path / "forged.zarr"))
    study, versions = (forged.attributes()[name] for name in ("study", "versions"))
    nasty = f"a\x1b[31m\u202eb\x00{SCRIPT}{IMAGE}javascript:alert(1)"
    # Its meshes have the labels of those in the store.
    made = {"name": "ico", "source": "command", "command": ["cp", "{input}", "{output}", "{n}"], "n": [0, 1, 2, 3]}
    family = [{**made, "mesh": {"source": "icosphere", "levels": [1]}}]
    header = {**study["table"]["study"], "title": nasty, "length_unit": nasty}
    live = [_Live(), _Live()]
    live[0].feed(make_report(tmp_path / "sound.zarr")[0])
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0)
        place = f"http://127.0.0.1:{server.getsockname()[1]}/steal"
        for cache, table in (
            (f"simplecache::{place}", {**study["table"], "study": header}),
            (place, {**study["table"], "family": family}),
        ):
            attributes = {"title": nasty, "study": {**study, "name": nasty, "mesh_cache": cache, "table": table}}
            forged.documents[""]["attributes"] |= {**attributes, "versions": dict.fromkeys(versions, nasty)}
            forged.consolidate()
            html, _ = make_report(forged.location)
            live[1].feed(html)
            assert live[1].found == live[0].found == []
            assert not re.search("[\x00-\x08\x0b-\x1f\u202a-\u202e\u2066-\u2069]", html)
        assert live[1].scripts == 2 * live[0].scripts > 0
        write = tmp_path / "witness.ply"
        with pytest.raises(InputError):
            sb.write_witness(forged.location.name, "ico/2", write)
        with pytest.raises(BlockingIOError):
            server.accept()


def test_a_report_of_a_reference_alone_says_that_there_is_nothing_to_compare(
    store_path: Path, threads: Client, tmp_path: Path
) -> None:
    family, reference = [{"name": "ico", "source": "icosphere", "levels": [1]}], {"source": "family", "family": "ico"}
    sb.run(Study.from_table(small_table(reference=reference, family=family)), store_path, threads)
    sb.report(store_path, tmp_path / "page.html")
    assert "there is nothing to compare" in (tmp_path / "page.html").read_text(encoding="utf-8")
