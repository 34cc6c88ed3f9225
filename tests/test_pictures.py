"""The pictures of the pages are those that the command of today would draw."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest

from benchmarks import pictures as draw

PAGES = [*(draw.ROOT / "docs").glob("*.md"), draw.ROOT / "README.md"]


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="digests are those of the syntax trees of Python 3.11")
def test_pictures_are_drawn_from_the_studies_and_the_code_of_today() -> None:
    assert list(draw.stale()) == [], "these pictures are stale: make pictures"
    assert set(json.loads(draw.DIGESTS.read_text())) == set(draw.PICTURES)


def test_each_picture_is_on_a_page_and_small() -> None:
    pictures = {path.name: path.stat().st_size for path in draw.FOLDER.glob("*.png")}
    assert set(pictures) == {f"{name}.png" for name in draw.PICTURES}
    texts = [page.read_text(encoding="utf-8") for page in PAGES]
    shown = {Path(link).name for text in texts for link in re.findall(r"\(([\w./-]+\.png)\)", text)}
    assert shown == set(pictures)
    assert max(pictures.values()) <= draw.LARGEST_BYTES


MODULE = '''
from other import far

A = 1
B: int = 2

def used() -> int:
    return A

def drawn() -> int:
    """Draw."""
    return used() + far()

def other() -> int:
    return B
'''


@pytest.mark.parametrize(
    ("old", "new", "is_stale"),
    [
        pytest.param("A = 1", "A = 3", True, id="a constant that it uses"),
        pytest.param("return A", "return A + 1", True, id="a function that it uses"),
        pytest.param("B: int = 2", "B: int = 4", False, id="another constant"),
        pytest.param("return B", "return A", False, id="another function"),
        pytest.param('"""Draw."""', "# Draw.", False, id="prose"),
    ],
)
def test_a_picture_is_stale_where_what_draws_it_changed(
    old: str, new: str, is_stale: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(draw, "ROOT", tmp_path)
    monkeypatch.setattr(draw, "_DRAWING", ("module",))
    picture = draw.Picture(lambda *_: None, ("module:drawn",))
    digests = []
    for text in (MODULE, MODULE.replace(old, new)):
        (tmp_path / "module.py").write_text(text)
        digests.append(picture.digest)
    assert (digests[0] != digests[1]) == is_stale
