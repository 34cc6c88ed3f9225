"""Notebooks, run cell by cell in a process of their own, as a kernel does."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

# Like a kernel: cells share their names, __main__ has no file, and the value of a last expression is shown as HTML.
_KERNEL = """
import ast, json, sys
names = {"__name__": "__main__"}
for number, cell in enumerate(json.loads(sys.stdin.read())):
    tree = ast.parse(cell, f"cell {number}")
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) and not cell.rstrip().endswith(";") else None
    exec(compile(tree, f"cell {number}", "exec"), names)
    if last is not None:
        value = eval(compile(ast.Expression(last.value), f"cell {number}", "eval"), names)
        if value is not None:
            show = getattr(value, "_repr_html_", None)
            print(show() if show else repr(value))
    print(f"[end of cell {number}]", flush=True)
"""


def code_cells(path: Path) -> list[str]:
    """Return the sources of a notebook's code cells."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def run_notebook(path: Path, folder: Path) -> list[str]:
    """Run a notebook in a folder, and return what each of its code cells prints and shows.

    Raises:
        AssertionError: A cell fails, or warns.
    """
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", _KERNEL],
        input=json.dumps(code_cells(path)),
        capture_output=True,
        text=True,
        cwd=folder,
        check=False,
        env={**os.environ, "MPLBACKEND": "Agg", "TMPDIR": str(folder)},
    )
    assert done.returncode == 0, done.stderr
    outputs = done.stdout.split("[end of cell ")
    return [outputs[0], *(output.partition("]\n")[2] for output in outputs[1:-1])]
