"""`make docs` builds: every public name with its text, every page, no link that leads nowhere."""

from __future__ import annotations

import html
import inspect
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import sobolev_batch as sb
from tests.support.repository import ROOT


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-W", "error", str(ROOT / "docs" / "build.py"), str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return folder


def words(text: str) -> list[str]:
    """Without what Markdown makes of them."""
    return re.findall(r"\w+", html.unescape(re.sub("<[^>]+>", " ", text)))


def documented(value: Any) -> list[str]:
    """The docstring of a function, or those of a class and its public methods and properties."""
    members = vars(value).items() if inspect.isclass(value) else ()
    public = [member for name, member in members if not name.startswith("_")]
    found = [value, *(m for m in public if inspect.isroutine(m) or isinstance(m, property))]
    texts = [inspect.getdoc(member) for member in found]
    assert all(texts), value
    return [text for text in texts if text]


def test_every_public_name_is_there_with_its_text(site: Path) -> None:
    page = (site / "sobolev_batch.html").read_text(encoding="utf-8")
    # From one name to the next, methods and attributes included.
    sections = dict(re.findall(r'<section id="(\w+)">(.*?)</section>', page, re.DOTALL))
    assert sorted(sections) == sorted(sb.__all__)
    for name in sb.__all__:
        rendered = " ".join(words(sections[name]))
        for text in documented(getattr(sb, name)):
            for line in text.splitlines():
                if not re.fullmatch(r"(Args|Attributes|Returns|Raises|Source):", line):
                    assert " ".join(words(line)) in rendered, (name, line)
    # Sections of docstrings became lists, and one name leads to another.
    assert "<li><strong>rtol:</strong>" in sections["distance"]
    assert 'href="#fourier_transform"' in sections["norm"]
    assert "field.sobolev.norm(-2)" in sections["SobolevAccessor"]


def test_every_page_is_there_and_asks_nobody(site: Path) -> None:
    pages = {path.name: path.read_text(encoding="utf-8") for path in site.glob("*.html")}
    for source in (ROOT / "docs").glob("*.md"):
        assert f"{source.stem}.html" in pages, source
    for name, page in pages.items():
        assert not re.search(r'(?:src=|<link[^>]*href=|url\()"?https?:', page), name
        for link, section in re.findall(r'(?:href|src)="([^"#]*)(?:#([^"]*))?"', page):
            if not link.startswith(("https:", "data:")):
                assert (site / link).exists(), (name, link)
                assert not section or f'id="{section}"' in pages[link or name], (name, link, section)
