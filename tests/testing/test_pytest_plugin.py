"""The plug-in of pytest: its fixture writes where surfaces differ, and it costs nothing where it is not used."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

import sobolev_batch as sb
from tests.support.repository import ROOT

pytestmark = pytest.mark.process

pytest_plugins = ["pytester"]

MODULE = "sobolev_batch.testing.pytest_plugin"
TESTS = """
import sobolev_batch as sb, pytest

def test_same(assert_same_surface):
    assert_same_surface(sb.shapes.icosphere(1), sb.shapes.icosphere(1))

@pytest.mark.parametrize("text", ["a/b", "c"])
def test_lost(assert_same_surface, text):
    sphere = sb.shapes.icosphere(2)
    assert_same_surface(sphere, sphere)
    assert_same_surface((sphere.vertices, sphere.triangles[30:]), sphere)
"""


@pytest.fixture(autouse=True)
def _without_other_plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    # The inner sessions run in this process, and import no libraries anew.
    assert sb.testing.assert_same_surface.__doc__
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")


@pytest.mark.parametrize(
    ("options", "folder"), [([], "temp/test_lost_*_0"), (["--sobolev-witness-folder=chosen/here"], "chosen/here")]
)
def test_files_lie_where_the_message_says(pytester: pytest.Pytester, options: list[str], folder: str) -> None:
    pytester.makepyfile(test_meshes=TESTS)
    pytester.path.joinpath("pytest.ini").write_text("[pytest]")
    pytester.makeconftest(f"pytest_plugins = [{MODULE!r}]")
    result = pytester.runpytest_subprocess(f"--basetemp={pytester.path}/temp", *options)
    result.assert_outcomes(passed=1, failed=2)
    files = sorted(file.name for file in pytester.path.glob(f"{folder}/*.ply"))
    # Of the second comparison of each test.
    assert [name.rpartition("-2-")[2] for name in files] == ["a.ply", "b.ply", "a.ply", "b.ply"]
    assert files[0].startswith("test-lost-a-b-")
    assert files[2].startswith("test-lost-c-")
    result.stdout.fnmatch_lines([f"E *AssertionError: different surfaces: *; witness: *{folder}/{files[0]} *"])
    assert "verdict.py" not in result.stdout.str()


def test_only_those_who_ask_for_it_load_it() -> None:
    project = tomllib.loads(Path(ROOT, "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert "pytest11" not in project.get("entry-points", {})
