"""The notebooks run from the first cell to the last, show what their texts say, and are kept without outputs."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path

import pytest

from tests.support.commands import finished
from tests.support.repository import ROOT

FOLDER = ROOT / "workflows" / "notebooks"
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
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def run_notebook(path: Path, folder: Path) -> list[str]:
    """Run a notebook in a folder, and return what each cell prints and shows; none may fail or warn."""
    environment = {**os.environ, "MPLBACKEND": "Agg", "TMPDIR": str(folder)}
    cells = json.dumps(code_cells(path))
    done = finished(sys.executable, "-W", "error", "-c", _KERNEL, input=cells, cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    outputs = done.stdout.split("[end of cell ")
    return [outputs[0], *(output.partition("]\n")[2] for output in outputs[1:-1])]


def shown(outputs: list[str], name: str, text: str) -> str:
    """Return what the only cell shows that holds a text."""
    (output,) = (
        output for cell, output in zip(code_cells(FOLDER / f"{name}.ipynb"), outputs, strict=True) if text in cell
    )
    return output


def cells_of_row(html: str, label: str) -> list[float]:
    (row,) = re.findall(rf"<th>{re.escape(label)}</th>(.*?)</tr>", html, re.DOTALL)
    return [float(number) for number in re.findall(r"<td>(.*?)</td>", row)]


@pytest.mark.parametrize("name", sorted(path.stem for path in FOLDER.glob("*.ipynb")))
def test_notebooks_are_linked_and_have_no_outputs(name: str) -> None:
    notebook = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    ids = [cell["id"] for cell in notebook["cells"]]
    assert len(set(ids)) == len(ids)
    for cell in notebook["cells"]:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None
    for page in ("README.md", "workflows/README.md"):
        assert f"notebooks/{name}.ipynb)" in (ROOT / page).read_text(encoding="utf-8")


@pytest.mark.all
def test_two_meshes(tmp_path: Path) -> None:
    outputs = run_notebook(FOLDER / "compare.ipynb", tmp_path)
    table = shown(outputs, "compare", "pd.DataFrame")
    relative, error, _, chamfer, hausdorff = cells_of_row(table, "twice")
    assert relative > 0.01 > 10 * error
    assert chamfer < 1e-12
    assert hausdorff < 1e-12
    assert cells_of_row(table, "coarser")[3] > 1e-3
    # The worst place lies in the patch.
    x, y, z = map(float, re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", shown(outputs, "compare", "argmax"))[:3])
    assert (x - 1.4) ** 2 + y**2 + z**2 < 0.15**2


@pytest.mark.all
def test_a_folder_of_meshes(tmp_path: Path) -> None:
    outputs = run_notebook(FOLDER / "study.ipynb", tmp_path)
    assert "family narrow: 3 meshes" in shown(outputs, "study", "init_study")
    assert "7 computed, 0 reused, 0 failed" in shown(outputs, "study", "workers=2")
    assert "0 computed, 7 reused, 0 failed" in shown(outputs, "study", "again = ")
    assert "the speed is that of" in shown(outputs, "study", "sb.plan")
    assert "even/even_32" in shown(outputs, "study", "sb.table")


@pytest.mark.all
def test_a_cluster(tmp_path: Path) -> None:
    outputs = run_notebook(FOLDER / "cluster.ipynb", tmp_path)
    assert "6 of 6 complete, 0 failed, 0 to go" in shown(outputs, "cluster", "going_on")
    ran = shown(outputs, "cluster", "sb.run")
    assert re.search(r"^dashboard: http://\S+\n0 of 2 transforms\n\[1/2\] finer/[56]: complete, ", ran)
    assert "2 computed, 6 reused, 0 failed" in ran
    assert "icosphere/4" in shown(outputs, "cluster", "sb.table")
