"""Build the documentation as HTML: python docs/build.py site.

The API comes from its docstrings, other pages from this folder. Pages work from disk and make no requests. A link to a
missing file stops the build.
"""

from __future__ import annotations

import inspect
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
# Modules of public names, in the order of the pages.
MODULES = ("extras.plot", "shapes", "extras.fitting", "sources", "testing", "result_types", "errors")
APIS = (API, *(f"{API}.{name}" for name in MODULES))

# Pages by group, as in the README; the API follows the pages of the reference.
GROUPS = {
    "": ("README",),
    "Learn": ("docs/tutorial", "docs/walkthroughs", "workflows/README"),
    "Reference": (
        *("docs/studies", "docs/remeshers", "docs/leagues", "docs/commands", "docs/formats", "docs/surfaces"),
        *("docs/store", "docs/queries", "docs/testing", "docs/tolerance", "docs/fitting", "docs/moving"),
    ),
    "Operate": ("docs/clusters", "docs/scale", "docs/reliability"),
    "Project": (
        *("docs/numerics", "docs/design", "benchmarks/RESULTS", "docs/stability"),
        *("CONTRIBUTING", "SECURITY", "CHANGELOG"),
    ),
}
ADDRESSES = {
    "README": "index.html",
    "workflows/README": "workflows.html",
    "benchmarks/RESULTS": "benchmarks.html",
    "CONTRIBUTING": "contributing.html",
    "SECURITY": "security.html",
    "CHANGELOG": "changelog.html",
}
PAGES = {
    f"{name}.md": ADDRESSES.get(name) or f"{name.removeprefix('docs/')}.html"
    for names in GROUPS.values()
    for name in names
}


def build(output: Path) -> None:
    """Write all pages into a folder, which is created if necessary."""
    output.mkdir(parents=True, exist_ok=True)
    texts = {source: (ROOT / source).read_text(encoding="utf-8") for source in PAGES}
    titles = {source: re.match(r"# (.+)", text) for source, text in texts.items()}
    pdoc.render.configure(
        docformat="google", search=False, show_source=False, template_directory=ROOT / "docs" / "templates"
    )
    pages = {PAGES[source]: title[1] if title else source for source, title in titles.items()}
    groups = {
        group: {PAGES[f"{name}.md"]: pages[PAGES[f"{name}.md"]] for name in names} for group, names in GROUPS.items()
    }
    packages = {name: import_module(name) for name in APIS}
    for package in packages.values():
        inspect.getmembers(package)  # pdoc sees only names that were asked for once
    modules = {name: Module(package) for name, package in packages.items()}
    addresses = {name: f"{name.replace('.', '/')}.html" for name in modules}
    groups["Reference"] |= {
        address: name.replace(API, "API").replace(".extras", "").replace(".", ": ")
        for name, address in addresses.items()
    }
    for name, module in modules.items():
        up = "../" * name.count(".")
        env.globals["groups"] = {
            group: {up + address: title for address, title in entries.items()} for group, entries in groups.items()
        }
        write(output / addresses[name], pdoc.render.html_module(module, modules))
    env.globals["groups"] = groups
    page = env.get_template("page.html.jinja2")
    for source, text in texts.items():
        rendered, address = to_html(text), PAGES[source]
        body = re.sub(r'(href|src)="([^"]+)"', partial(relocated, source, output), str(rendered))
        contents = getattr(rendered, "toc_html", None)
        write(output / address, page.render(title=pages[address], body=body, contents=contents))
    shutil.copytree(ROOT / "docs" / "pictures", output / "pictures", dirs_exist_ok=True)


def relocated(source: str, output: Path, link: re.Match[str]) -> str:
    """Return a link of a page with its address in the output folder, or that of the file in the repository."""
    kind, address = link.groups()
    if re.match(r"[a-z]+:|#", address):
        return link[0]
    target, _, section = address.partition("#")
    path = (ROOT / source).parent.joinpath(target).resolve()
    if not path.exists():
        raise FileNotFoundError(f"{source} has a link to {target}, which does not exist; correct the link")
    name = path.relative_to(ROOT).as_posix()
    if name.startswith("docs/pictures/"):
        relocation = name.removeprefix("docs/")
    else:
        relocation = PAGES.get(name) or relpath(path, output)
    return f'{kind}="{relocation}{"#" * bool(section)}{section}"'


def write(path: Path, text: str) -> None:
    """Write one page."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    build(Path(sys.argv[1]))
