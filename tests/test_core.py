"""A copy of the package without its extras: studies, comparisons and tables work, and the tests of the core pass."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import sys
from pathlib import Path

import pytest

from tests.support.commands import finished
from tests.support.repository import PACKAGE, ROOT

# What the core's folders promise without a process of their own.
FOLDERS = ("geometry/test_mesh.py", "transform", "norms", "sources", "study", "store", "tables", "batch", "testing")
COMMANDS = """
import json
from pathlib import Path
from tests.support.commands import call, write_inputs

store = "storage/cli.zarr"
names = ("run study.toml --workers 1", f"table {store}", f"status {store}", "compare 1.off 3.off --order -4", "--help",
         f"plot {store}", f"table league {store}", "compare 1.off 3.off --align", "compare 1.off 3.off --witness w.png")
if __name__ == "__main__":
    write_inputs(Path())
    done = {name: call(*name.split()) for name in names}
    print(json.dumps({name: [one.returncode, one.stdout, one.stderr] for name, one in done.items()}))
"""


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package and its tests, both without the extras."""
    folder = tmp_path_factory.mktemp("core")
    left_out = shutil.ignore_patterns("extras", "__pycache__")
    for source in (PACKAGE, ROOT / "tests", ROOT / "docs", ROOT / "workflows"):
        shutil.copytree(source, folder / source.name, ignore=left_out)
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


def environment(copy: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(copy)}


@pytest.mark.process
def test_commands_of_the_core_work_and_others_say_what_is_missing(copy: Path, tmp_path: Path) -> None:
    (tmp_path / "commands.py").write_text(COMMANDS)
    done = finished(sys.executable, "commands.py", cwd=tmp_path, env=environment(copy))
    assert done.returncode == 0, done.stderr
    run, table, status, compare, helps, *lacking = json.loads(done.stdout).values()
    for returned, _, errors in (run, table, status, compare, helps):
        assert returned == 0, errors
    assert re.search(r"^ico/1 +80 +0\.5823 +\S+ % ± ", table[1], re.M)
    assert "ico/1 is nearest to the reference" in " ".join(run[1].split())
    assert "3 of 3 complete" in status[1]
    assert compare[1].startswith("1.off differs from 3.off by ")
    assert "  compare " in helps[1]
    assert "  plot " not in helps[1]
    for returned, printed, errors in lacking:
        assert (returned, printed) == (2, "")
        assert re.search(r"needs sobolev_batch\.extras\.\S+, and sobolev_batch\.extras is not installed$", errors)


def test_tests_of_the_core_that_call_an_extra_are_marked() -> None:
    """The next test finds more, and takes minutes. Tests with a client start processes."""
    stub = ast.parse((PACKAGE / "__init__.pyi").read_bytes())
    imports = [one for one in stub.body if isinstance(one, ast.ImportFrom) and str(one.module).startswith("extras")]
    names = {alias.asname or alias.name for one in imports for alias in one.names}
    assert {"fit", "fitting", "league", "plot"} <= names
    for folder in FOLDERS:
        place = ROOT / "tests" / folder
        for file in [place] if place.is_file() else place.rglob("test_*.py"):
            module = ast.parse(file.read_bytes())
            for test in [one for one in module.body if isinstance(one, ast.FunctionDef)]:
                marks = " ".join(map(ast.unparse, [*test.decorator_list, test.args]))
                used = {one.attr for one in ast.walk(test) if isinstance(one, ast.Attribute) and is_package(one.value)}
                is_left_out = re.search(r"mark\.(extras|all|process|slow)|\bclient\b", marks)
                assert is_left_out or not used & names, (file, test.name)


def is_package(node: ast.expr) -> bool:
    return isinstance(node, ast.Name) and node.id == "sb"


@pytest.mark.all
def test_the_tests_of_the_core_pass(copy: Path) -> None:
    chosen = [f"tests/{name}" for name in FOLDERS]
    words = ["-q", "-p", "no:cacheprovider", "-m", "not (all or process or slow or extras)", *chosen]
    done = finished(sys.executable, "-m", "pytest", *words, cwd=copy, env=environment(copy))
    assert done.returncode == 0, done.stdout[-5000:]
    passed = re.search(r"(\d+) passed", done.stdout)
    assert passed is not None
    assert int(passed[1]) > 1000
