"""The conformance check: sources of the package pass it, sources that break a promise are told which."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from sobolev_batch import Mesh
from sobolev_batch.shapes import Sphere
from sobolev_batch.sources import Member, Source, check_source
from sobolev_batch.sources.registry import parse_source
from tests.support.members import KINDS
from tests.support.mesh_files import OFF_BOX

FINE: dict[str, Any] = {"source": "icosphere", "levels": [5]}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "box.off").write_bytes(OFF_BOX)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_sources_of_the_package_conform(folder: Path, kind: str) -> None:
    check_source(parse_source(KINDS[kind]), folder)


@pytest.mark.slow
@pytest.mark.parametrize(
    "table", [*KINDS.values(), FINE, {"source": "decimate", "mesh": FINE, "triangles": [15_000]}], ids=str
)
def test_larger_meshes_are_predicted(folder: Path, table: dict[str, Any]) -> None:
    for member in parse_source(table).members(folder):
        size, mesh = member.expected_size(), member.load()
        if isinstance(mesh, Mesh) and len(mesh.triangles) > 10_000:
            assert 10 * size.triangles >= len(mesh.triangles)
            assert size.projected_bytes >= mesh.vertices.nbytes + mesh.triangles.nbytes


@dataclass(frozen=True)
class BallMember(Member):
    """A member that keeps its promises, unless it has a fault."""

    radius: float = 1.0
    fault: str = ""

    def load(self) -> Any:
        match self.fault:
            case "relative path":
                return Sphere(1.0 if Path("box.off").exists() else 2.0)
            case "random":
                return Mesh(np.random.default_rng().normal(size=(3, 3)), [[0, 1, 2]])
        return Sphere(self.radius)

    def fingerprint(self) -> Any:
        faults = {"one fingerprint": 1, "unstable": id(self)}
        return {"ball": faults.get(self.fault, self.radius)}


class Balls(Source):
    fault: str = ""
    calls: ClassVar[list[int]] = []

    def members(self, folder: Path) -> Any:
        one, two = (BallMember(name, -1, size, self.fault) for name, size in (("one", 1.0), ("two", 2.0)))
        match self.fault:
            case "nothing":
                return ()
            case "any order":
                self.calls.append(0)
                return (one, two) if len(self.calls) % 2 else (two, one)
            case "names":
                return one, BallMember("One", -1, 2.0)
            case "line feed":
                return (BallMember("a\nb", -1),)
        return one, two


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        (Balls(fault="nothing"), r"lists \[\] first"),
        (Balls(fault="any order"), r"lists \[\('one', -1\), \('two', -1\)\] first"),
        (Balls(fault="names"), "'one', 'One', which are the same but for case"),
        (Balls(fault="line feed"), r"the invisible character U\+000A"),
        (Balls(fault="one fingerprint"), "'two' has the fingerprint of 'one' and another surface"),
        (Balls(fault="unstable"), "'one' has another fingerprint when it is listed again"),
        (Balls(fault="relative path"), "another surface or fingerprint after pickling, in another working directory"),
        (Balls(fault="random"), "another surface or fingerprint after pickling"),
    ],
    ids=lambda value: value.fault if isinstance(value, Balls) else "",
)
def test_broken_promises_are_named(folder: Path, monkeypatch: pytest.MonkeyPatch, source: Balls, problem: str) -> None:
    monkeypatch.chdir(folder)
    with pytest.raises(AssertionError, match=rf"^{type(source).__name__} breaks (.|\n)*{problem}"):
        check_source(source, folder)
