"""Guards of modules, and their sources without one of them."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_IS_CHECK = re.compile("_?(require|check)(_|$)")


@dataclass(frozen=True)
class Guard:
    """A condition that ends in an exception, or a call that may raise one and does nothing else.

    Attributes:
        path: Path of the module, from the root of the repository.
        line: Its first line.
        text: Its condition or call.
        start: Place of the text in the module, in bytes.
        end: Place after the text.
        replacement: What the text is replaced by.
    """

    path: str
    line: int
    text: str
    start: int
    end: int
    replacement: str

    def taken_out(self, source: bytes) -> bytes:
        """Return the source of its module without it."""
        return source[: self.start] + self.replacement.encode() + source[self.end :]


def guards(root: Path, below: str) -> Iterator[Guard]:
    """Yield the guards of the modules below a folder of a repository, or of one module."""
    folder = root / below
    for path in sorted(folder.rglob("*.py")) if folder.is_dir() else [folder]:
        yield from guards_of(path.read_bytes(), str(path.relative_to(root)))


def guards_of(source: bytes, path: str) -> Iterator[Guard]:
    """Yield the guards of a module in the order of its syntax tree."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def guard(node: ast.expr, replacement: str) -> Guard:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        start, end = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
        text = " ".join(source[start:end].decode().split())
        return Guard(path, node.lineno, text, start, end, replacement)

    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.If) and any(isinstance(statement, ast.Raise) for statement in node.body):
            yield guard(node.test, "False")
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call) and _is_check(node.value.func):
            yield guard(node.value, "None")


def _is_check(function: ast.expr) -> bool:
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
    return _IS_CHECK.match(name) is not None
