"""`make docs` builds every page without a broken link; the map of the code and the citation match the package."""

from __future__ import annotations

import html
import inspect
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import click
import pytest
import yaml

from sobolev_batch.cli import cli
from tests.support.repository import MODULES, PACKAGE, ROOT, public_names


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-W", "error", str(ROOT / "docs" / "build.py"), str(folder)]
    completed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False)
    assert completed.returncode == 0, completed.stderr
    assert completed.stderr == ""
    return folder


def words(text: str) -> list[str]:
    return re.findall(r"\w+", html.unescape(re.sub("<[^>]+>", " ", text)))


def documented(value: Any) -> list[str]:
    """Return the docstring of a function, or those of a class and its public methods and properties."""
    members = vars(value).items() if inspect.isclass(value) else ()
    public = [member for name, member in members if not name.startswith("_")]
    found = [value, *(m for m in public if inspect.isroutine(m) or isinstance(m, property))]
    texts = [inspect.getdoc(member) for member in found]
    assert all(texts), value
    return [text for text in texts if text]


def test_every_public_name_has_an_example() -> None:
    for value in public_names().values():
        assert ("" if isinstance(value, type) and issubclass(value, Exception) else ">>>") in value.__doc__, value


@pytest.mark.process
@pytest.mark.all
def test_every_public_name_is_there_with_its_text(site: Path) -> None:
    sections = {}
    for prefix, path in {
        "": PACKAGE.name,
        **{f"{name}.": module.__name__.replace(".", "/") for name, module in MODULES.items()},
    }.items():
        page = (site / f"{path}.html").read_text(encoding="utf-8")
        # From one name to the next, methods and attributes included.
        for name, section in re.findall(r'<section id="(\w+)">(.*?)</section>', page, re.DOTALL):
            sections[prefix + name] = section
    assert sorted(sections) == sorted(public_names())
    for name, value in public_names().items():
        rendered = " ".join(words(sections[name]))
        for text in documented(value):
            for line in text.splitlines():
                if not re.fullmatch(r"(Args|Attributes|Returns|Raises|Source):", line):
                    assert " ".join(words(line)) in rendered, (name, line)
    # Sections of docstrings became lists, and one name leads to another.
    assert "<li><strong>rtol:</strong>" in sections["distance"]
    assert 'href="#fourier_transform"' in sections["norm"]
    assert "tree.sobolev.distance(-2)" in sections["result_types.StoreAccessor"]


@pytest.mark.all
def test_every_page_is_there_and_asks_nobody(site: Path) -> None:
    pages = {path.relative_to(site).as_posix(): path.read_text(encoding="utf-8") for path in site.rglob("*.html")}
    for source in (ROOT / "docs").glob("*.md"):
        assert f"{source.stem}.html" in pages, source
    for name, page in pages.items():
        assert not re.search(r'(?:src=|<link[^>]*href=|url\()"?https?:', page), name
        for link, section in re.findall(r'(?:href|src)="([^"#]*)(?:#([^"]*))?"', page):
            if not link.startswith(("https:", "data:")):
                target = (site / name).parent.joinpath(link).resolve() if link else site / name
                assert target.exists(), (name, link)
                assert not section or f'id="{section}"' in target.read_text(encoding="utf-8"), (name, link, section)


def design() -> str:
    return (ROOT / "docs" / "design.md").read_text(encoding="utf-8")


def test_the_map_names_every_module_and_no_other() -> None:
    rows = re.findall(r"^\| `([\w/]+)` \| .* \| (.+) \|$", design(), re.MULTILINE)
    # What a module holds may stand in parentheses behind it.
    named = [(folder, re.sub(r"\(.*?\)", "", names)) for folder, names in rows]
    mapped = [f"{folder}/{module}" for folder, names in named for module in re.findall(r"`(\w+)`", names)]
    # The package's own modules are in the row of its name.
    mapped = [name.removeprefix(f"{PACKAGE.name}/") for name in mapped]
    files = [path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py") if not path.stem.startswith("__")]
    modules = {path.with_suffix("").as_posix() for path in files}
    lacking, invented = sorted(modules - set(mapped)), sorted(set(mapped) - modules)
    assert not lacking, f"modules that the map lacks: {lacking}"
    assert not invented, f"modules of the map that do not exist: {invented}"
    assert len(mapped) == len(set(mapped))


def test_paths_in_the_design_exist() -> None:
    paths = re.findall(r"`([\w.]+/[\w./]+)`", design())
    assert len(paths) > 30
    places = {path: (ROOT / path, PACKAGE / path, PACKAGE / f"{path}.py") for path in paths}
    missing = [path for path, candidates in places.items() if not any(place.exists() for place in candidates)]
    assert not missing


def test_the_versions_of_stored_results_are_those_of_the_code() -> None:
    sources = "\n".join(path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py"))
    text = (ROOT / "docs" / "stability.md").read_text(encoding="utf-8")
    for name in ("Schema", "Numerics"):
        (version,) = re.findall(rf"^{name.upper()}_VERSION = (\d+)$", sources, re.MULTILINE)
        assert f"- **{name} version**, {version} now:" in text


def test_every_command_is_listed_with_its_functions() -> None:
    text = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| .* \| (.+) \|$", text, re.MULTILINE)
    assert sorted(command for command, _ in rows) == cli.list_commands(click.Context(cli))
    for _, functions in rows:
        assert set(re.findall(r"`sb\.([\w.]+)`", functions)) <= {*public_names(), *MODULES}


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert [citation[key] for key in ("title", "version", "license", "authors")] == [
        project[key] for key in ("name", "version", "license", "authors")
    ]
    (paper,) = citation["references"]
    assert paper["authors"][0]["family-names"] == "Koga"
    numerics = (ROOT / "docs" / "numerics.md").read_text(encoding="utf-8")
    assert paper["title"] in " ".join(numerics.split())


def test_each_promise_names_its_tests() -> None:
    text = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+)°? \|.*\|([^|]*)\|$", text, re.MULTILINE)
    assert sorted(int(number) for number, _ in rows) == list(range(1, 29))
    for number, tests in rows:
        named = re.findall(r"`([\w/]+\.py)`", tests)
        assert named, number
        for name in named:
            assert (ROOT / "tests" / name).exists(), name
