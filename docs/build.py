"""The API from its docstrings, and the pages of this folder, as HTML: python docs/build.py site.

Pages are opened from disk and ask nobody for anything. A link to a file that is not there ends it.
"""

from __future__ import annotations

import re
import shutil
import sys
from functools import partial
from importlib import import_module
from os.path import relpath
from pathlib import Path

import pdoc
from pdoc.doc import Module
from pdoc.render import env
from pdoc.render_helpers import to_html

ROOT = Path(__file__).resolve().parents[1]
API = "sobolev_batch"
# Addresses of pages by their sources, in the order in which they are listed.
PAGES = {
    "README.md": "index.html",
    **{
        f"docs/{name}.md": f"{name}.html"
        for name in (
            *("tutorial", "studies", "surfaces", "queries", "store", "numerics"),
            *("clusters", "scale", "reliability", "stability", "design"),
        )
    },
    "workflows/README.md": "workflows.html",
    "benchmarks/RESULTS.md": "benchmarks.html",
    "CHANGELOG.md": "changelog.html",
}


def build(output: Path) -> None:
    """Write all pages into a folder, which is made where it is not there."""
    output.mkdir(parents=True, exist_ok=True)
    texts = {source: (ROOT / source).read_text(encoding="utf-8") for source in PAGES}
    titles = {source: re.match(r"# (.+)", text) for source, text in texts.items()}
    pdoc.render.configure(
        docformat="google", search=False, show_source=False, template_directory=ROOT / "docs" / "templates"
    )
    pages = {PAGES[source]: title[1] if title else source for source, title in titles.items()}
    env.globals["pages"] = {**pages, f"{API}.html": "API"}
    module = Module(import_module(API))
    write(output / f"{API}.html", pdoc.render.html_module(module, {API: module}))
    page = env.get_template("page.html.jinja2")
    for source, text in texts.items():
        found, address = to_html(text), PAGES[source]
        body = re.sub(r'(href|src)="([^"]+)"', partial(located, source, output), str(found))
        contents = getattr(found, "toc_html", None)
        write(output / address, page.render(title=pages[address], body=body, contents=contents))
    shutil.copytree(ROOT / "docs" / "pictures", output / "pictures", dirs_exist_ok=True)


def located(source: str, output: Path, link: re.Match[str]) -> str:
    """A link of a page as it is from its place among the others, or to the file in the repository."""
    kind, address = link.groups()
    if re.match(r"[a-z]+:|#", address):
        return link[0]
    target, _, section = address.partition("#")
    path = (ROOT / source).parent.joinpath(target).resolve()
    if not path.exists():
        raise FileNotFoundError(f"{source} has a link to {target}, which is not there")
    name = path.relative_to(ROOT).as_posix()
    if name.startswith("docs/pictures/"):
        there = name.removeprefix("docs/")
    else:
        there = PAGES.get(name) or relpath(path, output)
    return f'{kind}="{there}{"#" * bool(section)}{section}"'


def write(path: Path, text: str) -> None:
    """One page."""
    path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    build(Path(sys.argv[1]))
