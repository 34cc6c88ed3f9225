"""The checkout that the tests run in: its pages, and what its modules import."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import sobolev_batch

ROOT = Path(__file__).parents[2]
PACKAGE = Path(sobolev_batch.__file__).parent


def blocks(path: str, language: str) -> list[str]:
    """The fenced blocks of a page that are in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", (ROOT / path).read_text(encoding="utf-8"), re.M | re.S)


def imported(path: Path) -> set[str]:
    """The names of the modules that a module imports."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    return names
