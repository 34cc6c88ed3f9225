"""The page of one comparison: what its charts hold, and how a browser and paper show it."""

from __future__ import annotations

import base64
import json
import re
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

import sobolev_batch as sb
from tests.support.browser import browser
from tests.support.commands import call

NAME = "scan 7 of part C <b>&$^$.off"


def made_page(folder: Path, *options: str, status: int = 0) -> Path:
    """The page of a ball with a spike against a smaller ball, both away from the origin."""
    ball = sb.shapes.icosphere(3)
    vertices = 10.5 * ball.vertices
    vertices[0] *= 1.2
    sb.write_mesh(sb.Mesh(vertices + 1000, ball.triangles), folder / NAME)
    sb.write_mesh(sb.Mesh(10 * ball.vertices + 1000, ball.triangles), folder / "in.off")
    done = call("compare", NAME, "in.off", "--unit", "mm", "--report", "page.html", *options, folder=folder)
    assert done.returncode == status, done.stderr
    # Its path is the last line, also after a verdict.
    assert done.stdout.splitlines()[-1] == "page.html"
    return folder / "page.html"


def data_of(page: Path) -> dict[str, Any]:
    found = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(), re.S)
    data: dict[str, Any] = json.loads(found[0])
    return data


@pytest.mark.slow
def test_its_charts_hold_what_was_measured(tmp_path: Path) -> None:
    data = data_of(made_page(tmp_path))
    assert data["pair"]["signed"] is True
    # Colours tell most of the area apart, and not the spike from all else.
    assert 0.5 <= data["pair"]["limit"] < 1.0
    assert max(data["histogram"]["x"]) == pytest.approx(2.6, rel=0.04)
    # The tip of the spike, with the third axis upwards, and from the middle of the reference.
    tip = 1.26 * np.array(sb.shapes.icosphere(3).vertices[0]) * 10
    assert sorted(data["pair"]["place"]) == pytest.approx(sorted(tip), abs=1e-2)
    x, shares = np.array(data["histogram"]["x"]), np.array(data["histogram"]["shares"])
    assert shares.sum(axis=1) == pytest.approx(1.0, abs=1e-3)
    # All of the first mesh is outside of the second one, which is inside of the first.
    assert shares[0][x < -0.1].sum() == shares[1][x > 0.1].sum() == 0
    assert sum(data["bands"]["shares"]) == pytest.approx(1.0, abs=1e-2)
    assert data["bands"]["texts"][0].startswith("> ")


@pytest.mark.slow
def test_a_verdict_has_a_page(tmp_path: Path) -> None:
    page = made_page(tmp_path, "--within", "1mm", "--order=-4", status=1).read_text()
    assert "not within 1 mm" in page
    assert "at order -4" in page
    done = call("compare", "in.off", NAME, "--within", "1%", "--report", "other.html", folder=tmp_path)
    assert (done.returncode, done.stdout.splitlines()[-1]) == (1, "other.html")
    assert (tmp_path / "other.html").exists()


@pytest.mark.slow
def test_meshes_without_sides_have_distances_without_signs(tmp_path: Path) -> None:
    ball = sb.shapes.icosphere(2)
    mixed = sb.Mesh(ball.vertices, np.vstack([ball.triangles[:1, ::-1], ball.triangles[1:]]))
    sb.write_mesh(mixed, tmp_path / "mixed.off")
    sb.write_mesh(sb.Mesh(1.1 * ball.vertices, ball.triangles), tmp_path / "ball.off")
    assert call("compare", "mixed.off", "ball.off", "--report", "page.html", folder=tmp_path).returncode == 0
    data = data_of(tmp_path / "page.html")
    assert data["pair"]["signed"] is False
    assert min(data["histogram"]["x"]) > 0


@pytest.mark.all
def test_places_beyond_the_colours_have_the_last_colour(tmp_path: Path) -> None:
    ball = sb.shapes.icosphere(4)
    # A hill whose sides are steep, so that all of it but a rim is farther away than a hundredth of its height.
    hill = np.clip(3 * (ball.vertices[:, 0] - 0.6), 0.0, 0.5)
    sb.write_mesh(sb.Mesh(ball.vertices * (1 + hill[:, None]), ball.triangles), tmp_path / "hill.off")
    sb.write_mesh(ball, tmp_path / "ball.off")
    arguments = ("hill.off", "ball.off", "--within", "0.005", "--report", "page.html")
    assert call("compare", *arguments, folder=tmp_path).returncode == 1
    with browser(tmp_path / "profile") as reader:
        reader.open_report(tmp_path / "page.html")
        chart = reader.driver.find_element("id", "chart-pair").screenshot_as_png
    # The ball, left of the colours: all of what is inside of the hill, but for its rim, is as blue as the farthest.
    pixels = np.hsplit(imread(BytesIO(chart))[:, :-65], 2)[1]
    red, blue = pixels[..., 0], pixels[..., 2]
    assert np.mean(red[blue - red > 0.1] < 0.3) > 0.9


@pytest.mark.all
def test_a_browser_and_one_sheet_of_paper_show_it(tmp_path: Path) -> None:
    page = made_page(tmp_path, "--within", "1mm", status=1)
    with browser(tmp_path / "profile") as reader:
        for width in (1280, 768, 390):
            reader.open_report(page, width=width)
            assert reader.tell("document.documentElement.scrollWidth") <= width
            first, second = reader.texts("header.page p")[1:3]
            assert first.startswith(f"{NAME}: not within 1 mm: largest deviation 2.")
            assert second.startswith(f"The largest deviation of {NAME} and in.off from each other is 2.")
            assert reader.tell("document.querySelectorAll('#chart-pair canvas').length") >= 2
            assert reader.tell("[...document.querySelectorAll('.chart:has(svg)')].length") == 3
            assert len(reader.texts("#table-distances tbody th")) == 7
        assert reader.complaints() == []
        assert set(reader.requests()) == {page.as_uri()}
        reader.driver.execute_script("dispatchEvent(new Event('beforeprint'))")
        for across, down in ((8.27, 11.69), (8.5, 11.0)):
            printed = reader.command("Page.printToPDF", paperWidth=across, paperHeight=down, preferCSSPageSize=True)
            assert len(re.findall(rb"/Type\s*/Page\b", base64.b64decode(printed["data"]))) == 1
