"""The conformance check: sources of the package pass it, sources that break a promise are told which."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from pydantic import ConfigDict

from sobolev_batch import Mesh
from sobolev_batch.shapes import Sphere, icosphere
from sobolev_batch.sources import ExpectedSize, Member, Source, check_source
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


def test_predicted_sizes_of_larger_meshes_are_held_against_them(folder: Path) -> None:
    check_source(parse_source(FINE), folder)
    check_source(parse_source({"source": "decimate", "mesh": FINE, "triangles": [15_000]}), folder)


@dataclass(frozen=True)
class BallMember(Member):
    """A member that keeps its promises, unless it has a fault."""

    radius: float = 1.0
    fault: str = ""
    values: bytes = b""

    def load(self) -> Any:
        match self.fault:
            case "relative path":
                return Sphere(1.0 if Path("box.off").exists() else 2.0)
            case "array":
                return np.eye(3)
            case "random":
                return Mesh(np.random.default_rng().normal(size=(3, 3)), [[0, 1, 2]])
            case "large" | "large and light":
                return Mesh(self.radius * icosphere(5).vertices, icosphere(5).triangles)
        return Sphere(self.radius)

    def fingerprint(self) -> Any:
        faults = {"one fingerprint": 1, "beyond JSON": {self.radius}, "unstable": id(self)}
        return {"ball": faults.get(self.fault, self.radius)}

    def expected_size(self) -> ExpectedSize:
        return ExpectedSize(20_480, 1e3) if self.fault == "large and light" else ExpectedSize()

    def __getstate__(self) -> Any:
        if self.fault == "handle":
            raise TypeError("it holds a handle")
        return self.__dict__


class Balls(Source):
    fault: str = ""
    calls: ClassVar[list[int]] = []

    def members(self, folder: Path) -> Any:
        values = bytes(2 << 20) if self.fault == "heavy" else b""
        one, two = (BallMember(name, -1, size, self.fault, values) for name, size in (("one", 1.0), ("two", 2.0)))
        match self.fault:
            case "KeyError":
                raise KeyError("nothing")
            case "nothing":
                return ()
            case "computes":
                return (BallMember(str(len(icosphere(0).triangles)), -1),)
            case "any order":
                self.calls.append(0)
                return (one, two) if len(self.calls) % 2 else (two, one)
            case "names":
                return one, BallMember("One", -1, 2.0)
            case "line feed":
                return (BallMember("a\nb", -1),)
        return one, two


class TakesAnyKey(Balls):
    model_config = ConfigDict(extra="ignore")


class CanBeChanged(Balls):
    model_config = ConfigDict(frozen=False)


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        (TakesAnyKey(), "takes unknown keys"),
        (CanBeChanged(), "can be changed"),
        (Balls(fault="KeyError"), r"members\(\) raises KeyError: 'nothing'"),
        (Balls(fault="nothing"), r"returns \(\), expected a tuple"),
        (Balls(fault="computes"), "makes a mesh; leave that to Member.load"),
        (Balls(fault="any order"), r"lists \[\('one', -1\), \('two', -1\)\] first"),
        (Balls(fault="names"), "'one', 'One', which are the same but for case"),
        (Balls(fault="line feed"), r"the invisible character U\+000A"),
        (Balls(fault="one fingerprint"), "'two' has the fingerprint of 'one' and another surface"),
        (Balls(fault="beyond JSON"), "not JSON serializable"),
        (Balls(fault="unstable"), "'one' has another fingerprint when it is listed again"),
        (Balls(fault="handle"), "TypeError: it holds a handle"),
        (Balls(fault="relative path"), "another surface or fingerprint after pickling, in another working directory"),
        (Balls(fault="heavy"), "bytes when it is pickled, 1048576 are allowed"),
        (Balls(fault="array"), "makes a ndarray, expected a Mesh"),
        (Balls(fault="random"), "another surface or fingerprint after pickling"),
        (Balls(fault="large"), "predicts 0 triangles and 0 bytes, and makes a mesh of 20480"),
        (Balls(fault="large and light"), "triangles and 1000 bytes, and makes a mesh of 20480 and 737328"),
    ],
    ids=lambda value: value.fault or type(value).__name__ if isinstance(value, Balls) else "",
)
def test_broken_promises_are_named(folder: Path, monkeypatch: pytest.MonkeyPatch, source: Balls, problem: str) -> None:
    monkeypatch.chdir(folder)
    with pytest.raises(AssertionError, match=rf"^{type(source).__name__} breaks (.|\n)*{problem}"):
        check_source(source, folder)
