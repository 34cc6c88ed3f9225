"""The checkout that the tests run on: pages, and what modules import."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

from distributed import Client

import sobolev_batch as sb

ROOT = Path(__file__).parents[2]
PACKAGE = Path(sb.__file__).parent
# Those of public names, beside the package itself; without the extras there are fewer.
MODULES = {
    name: getattr(sb, name)
    for name in ("errors", "fitting", "plot", "result_types", "shapes", "sources", "testing")
    if name not in ("fitting", "plot") or (PACKAGE / "extras").exists()
}


def public_names() -> dict[str, Any]:
    """The public functions and classes, by their names below the package."""
    modules: dict[str, Any] = {"": sb, **{f"{name}.": module for name, module in MODULES.items()}}
    found = {prefix + name: getattr(module, name) for prefix, module in modules.items() for name in module.__all__}
    return {name: value for name, value in found.items() if name not in MODULES}


def blocks(path: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", (ROOT / path).read_text(encoding="utf-8"), re.M | re.S)


def imported(path: Path) -> set[str]:
    """The names that a module imports, with those of their modules, inside of functions too."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def install(site: Path, name: str, entry_points: str, module: str) -> None:
    """Install a distribution of one module into a folder that is on the path."""
    information = site / f"{name}-1.0.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(entry_points)
    (site / f"{name}.py").write_text(module)


def run_icospheres(folder: Path, client: Client) -> sb.Study:
    """Run workflows/icosphere.toml below a folder, with fewer levels on a smaller lattice."""
    text = (ROOT / "workflows" / "icosphere.toml").read_text(encoding="utf-8")
    small = text.replace("M = 128", "M = 48").replace("3, 4, 5, 6, 7]", "3]")
    assert small.count("M = 48") == 1
    for name in ("workflows", "storage"):
        (folder / name).mkdir()
    (folder / "workflows" / "icosphere.toml").write_text(small)
    study = sb.Study.from_toml(folder / "workflows" / "icosphere.toml")
    sb.run(study, folder / "storage" / "icosphere.zarr", client)
    return study


def run_blocks(path: str) -> dict[str, Any]:
    """Run the Python blocks of a page one after the other; what they leave behind."""
    found: dict[str, Any] = {}
    for block in blocks(path, "python"):
        exec(compile(block, path, "exec"), found)
    return found
