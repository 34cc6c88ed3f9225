"""The conformance check: sources of the package pass it, sources that break a promise are told which."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from pydantic import ConfigDict

from sobolev_batch import (
    ExpectedSize,
    Member,
    Mesh,
    MeshError,
    Source,
    Sphere,
    StudyError,
    check_source,
    icosphere,
)
from sobolev_batch.surfaces.sources.registry import parse_source
from tests.support.members import KINDS
from tests.support.mesh_files import off
from tests.support.shapes import BOX_TRIANGLES, BOX_VERTICES

OFF_BOX = off(BOX_VERTICES, BOX_TRIANGLES)
BAD_BOX = off(BOX_VERTICES, [[0, 1, 99]])
MISSING: dict[str, Any] = {"source": "files", "paths": ["missing.off"]}
FINE: dict[str, Any] = {"source": "icosphere", "levels": [5]}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "box.off").write_bytes(OFF_BOX)
    (tmp_path / "bad.off").write_bytes(BAD_BOX)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_sources_of_the_package_conform(folder: Path, kind: str) -> None:
    if kind == "remesh":
        pytest.importorskip("pyacvd", reason="remeshing needs the extra `studies`")
    check_source(parse_source(KINDS[kind]), folder)


def test_predicted_sizes_of_larger_meshes_are_held_against_them(folder: Path) -> None:
    check_source(parse_source(FINE), folder)
    check_source(parse_source({"source": "decimate", "mesh": FINE, "triangles": [15_000]}), folder)


@pytest.mark.parametrize(
    "broken",
    [
        MISSING,
        {"source": "files", "paths": ["bad.off"]},
        {"source": "files", "paths": ["*.stl"]},
        {"source": "decimate", "mesh": MISSING, "triangles": [80]},
        {"source": "decimate", "mesh": {"source": "sphere"}, "triangles": [80]},
        {"source": "spherical-levels", "mesh": MISSING, "sphere": MISSING, "levels": [1]},
    ],
    ids=str,
)
def test_broken_inputs_end_in_orderly_errors(folder: Path, broken: dict[str, Any]) -> None:
    check_source(parse_source(KINDS["files"]), folder, broken=[parse_source(broken)])


@dataclass(frozen=True)
class BallMember(Member):
    """A member that keeps its promises; subclasses break one each."""

    radius: float = 1.0

    def load(self) -> Any:
        return Sphere(self.radius)

    def fingerprint(self) -> Any:
        return {"ball": self.radius}


class Balls(Source):
    """A source that keeps its promises; subclasses break one each."""

    member_type: ClassVar[type[BallMember]] = BallMember

    def members(self, folder: Path) -> Any:
        return self.member_type("one", -1, 1.0), self.member_type("two", -1, 2.0)


class TakesAnyKey(Balls):
    model_config = ConfigDict(extra="ignore")


class CanBeChanged(Balls):
    model_config = ConfigDict(frozen=False)


class NamesNoDistribution(Balls):
    @property
    def libraries(self) -> tuple[str, ...]:
        return ("no-such-distribution-anywhere",)


class RaisesAnything(Balls):
    def members(self, folder: Path) -> Any:
        raise KeyError("nothing")


class ListsNothing(Balls):
    def members(self, folder: Path) -> Any:
        return ()


class ListsNoMembers(Balls):
    def members(self, folder: Path) -> Any:
        return ["one"]


class ComputesAtOnce(Balls):
    def members(self, folder: Path) -> Any:
        return (self.member_type(str(len(icosphere(0).triangles)), -1),)


class ListsInAnyOrder(Balls):
    calls: ClassVar[list[int]] = []

    def members(self, folder: Path) -> Any:
        self.calls.append(0)
        return super().members(folder)[:: 1 if len(self.calls) % 2 else -1]


class RepeatsNames(Balls):
    def members(self, folder: Path) -> Any:
        return self.member_type("One", -1, 1.0), self.member_type("one", -1, 2.0)


class HasBadNames(Balls):
    def members(self, folder: Path) -> Any:
        return (self.member_type("a\nb", -1),)


class HasBadLevels(Balls):
    def members(self, folder: Path) -> Any:
        return (self.member_type("one", -2),)


class WithoutFingerprints(Balls):
    @dataclass(frozen=True)
    class Each(BallMember):
        def fingerprint(self) -> Any:
            return {"ball": 1}

    member_type = Each


class WithFingerprintsBeyondJson(Balls):
    @dataclass(frozen=True)
    class Each(BallMember):
        def fingerprint(self) -> Any:
            return {"ball": {self.radius}}

    member_type = Each


class WithUnstableFingerprints(Balls):
    @dataclass(frozen=True)
    class Each(BallMember):
        def fingerprint(self) -> Any:
            return {"ball": id(self)}

    member_type = Each


class Unpicklable(Balls):
    @dataclass(frozen=True)
    class Each(BallMember):
        def __reduce__(self) -> Any:
            raise TypeError("it holds a handle")

    member_type = Each


class RelativePaths(Balls):
    @dataclass(frozen=True)
    class Each(BallMember):
        def load(self) -> Any:
            return Sphere(1.0 if Path("box.off").exists() else 2.0)

    member_type = Each


@dataclass(frozen=True)
class CarryingMember(BallMember):
    values: bytes = bytes(2 << 20)


class CarriesItsSurface(Balls):
    member_type = CarryingMember


class MakesSomethingElse(Balls):
    @dataclass(frozen=True)
    class Each(BallMember):
        def load(self) -> Any:
            return np.eye(3)

    member_type = Each


class Random(Balls):
    @dataclass(frozen=True)
    class Each(BallMember):
        def load(self) -> Any:
            return Mesh(np.random.default_rng().normal(size=(3, 3)), [[0, 1, 2]])

    member_type = Each


class Large(Balls):
    @dataclass(frozen=True)
    class Each(BallMember):
        def load(self) -> Any:
            return Mesh(self.radius * icosphere(5).vertices, icosphere(5).triangles)

    member_type = Each


class LargeAndLight(Large):
    @dataclass(frozen=True)
    class Each(Large.Each):
        def expected_size(self) -> ExpectedSize:
            return ExpectedSize(20_480, 1e3)

    member_type = Each


@pytest.mark.parametrize(
    ("source_type", "problem"),
    [
        (TakesAnyKey, "it takes unknown keys; keep extra='forbid' in its model_config"),
        (CanBeChanged, "it can be changed; keep frozen=True in its model_config"),
        (NamesNoDistribution, "libraries has 'no-such-distribution-anywhere', which is not installed"),
        (RaisesAnything, "members() raises KeyError: 'nothing'"),
        (ListsNothing, "it returns (), expected a tuple of at least one Member"),
        (ListsNoMembers, "it returns ['one'], expected a tuple of at least one Member"),
        (ComputesAtOnce, "it makes a mesh; leave that to Member.load"),
        (ListsInAnyOrder, "members() lists [('one', -1), ('two', -1)] first and [('two', -1), ('one', -1)] next"),
        (RepeatsNames, "members() returns the names 'One', 'one', which are the same but for case and accents"),
        (HasBadNames, "has a name that is no label: it holds the invisible character U+000A"),
        (HasBadLevels, "the member 'one' has the level -2, expected an integer from -1"),
        (WithoutFingerprints, "the members 'one' and 'two' have equal fingerprints and different surfaces"),
        (WithFingerprintsBeyondJson, "the member 'one' raises TypeError: Object of type set is not JSON serializable"),
        (WithUnstableFingerprints, "the member 'one' has another fingerprint when it is listed again"),
        (Unpicklable, "the member 'one' raises TypeError: it holds a handle"),
        (RelativePaths, "makes another surface or fingerprint after pickling, in another working directory"),
        (CarriesItsSurface, "bytes when it is pickled, 1048576 are allowed; make its surface in load()"),
        (MakesSomethingElse, "makes a ndarray, expected a Mesh, Sphere, Ellipsoid, Torus or ParametrisedSurface"),
        (Random, "makes another surface or fingerprint after pickling"),
        (Large, "predicts 0 triangles and makes 20480; predict them in expected_size()"),
        (LargeAndLight, "predicts 1000 bytes for making a mesh of 737328; predict the peak of its memory"),
    ],
)
def test_broken_promises_are_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, source_type: type[Balls], problem: str
) -> None:
    monkeypatch.chdir(folder)
    with pytest.raises(AssertionError) as caught:
        check_source(source_type(), folder)
    assert problem in str(caught.value)
    assert str(caught.value).startswith(f"{source_type.__name__} breaks ")


def test_promises_that_are_kept_raise_nothing(folder: Path) -> None:
    check_source(Balls(), folder)


@pytest.mark.parametrize("error", [MeshError, StudyError, ValueError])
def test_surfaces_that_cannot_be_made_are_problems(folder: Path, error: type[Exception]) -> None:
    class Failing(Balls):
        def members(self, folder: Path) -> Any:
            raise error("not today")

    with pytest.raises(AssertionError, match=f"members\\(\\) raises {error.__name__}: not today"):
        check_source(Failing(), folder)
    if error is StudyError:
        check_source(Balls(), folder, broken=[Failing()])
    else:
        with pytest.raises(AssertionError, match=f"the broken source .* raises {error.__name__}: not today"):
            check_source(Balls(), folder, broken=[Failing()])


def test_a_broken_source_must_not_make_surfaces(folder: Path) -> None:
    with pytest.raises(AssertionError, match=r"the broken source .* makes the surface 'one'; expected a MeshError"):
        check_source(Balls(), folder, broken=[Balls()])
