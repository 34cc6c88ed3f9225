"""Sources in general: the registry, parameters, promises of every member; and closed forms with their levels."""

from __future__ import annotations

import json
import pickle
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from sobolev_batch import Mesh
from sobolev_batch.errors import StudyError
from sobolev_batch.shapes import Ellipsoid, Sphere, Torus, icosphere
from sobolev_batch.sources import registry as sources
from sobolev_batch.sources.registry import ExpectedSize, Member, Source, parse_source
from tests.support.members import BALL, KINDS, listed, loaded, members
from tests.support.mesh_files import OFF_BOX

COARSER = {"source": "icosphere", "levels": [2]}
SPHERE: dict[str, Any] = {"source": "sphere", "radius": 2, "center": [1, 2.5, -3]}
EGG: dict[str, Any] = {"source": "ellipsoid", "axes": [3, 2, 1], "center": [0.0, 0.5, 0.0]}
RING: dict[str, Any] = {"source": "torus", "R": 2, "r": 0.5, "center": [0.0, 0.5, 0.0]}


class Cubes(Source):
    """A source of another package."""

    count: int

    def members(self, folder: Path) -> tuple[Member, ...]:
        return tuple(sources.parse_source(BALL).members(folder) * self.count)


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An installed distribution that brings sources: one that works and some that do not."""
    info = tmp_path / "cubes_for_tests-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: cubes-for-tests\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(
        "[sobolev_batch.sources]\n"
        f"cubes = {__name__}:Cubes\n"
        "absent-module = no_such_module_anywhere:Cubes\n"
        f"absent-class = {__name__}:NoSuchClass\n"
        f"a-function = {__name__}:members\n"
        f"other-class = {__name__}:Path\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    sources.sources_by_name.cache_clear()
    yield
    sources.sources_by_name.cache_clear()


@pytest.mark.usefixtures("plugin")
def test_other_packages_add_sources() -> None:
    assert listed(members({"source": "cubes", "count": 2})) == [("3", 3), ("3", 3)]
    with pytest.raises(StudyError, match="known are a-function, absent-class, absent-module, command, cubes"):
        parse_source({"source": "nothing"})
    with pytest.raises(ValidationError, match="count"):
        parse_source({"source": "cubes"})


@pytest.mark.usefixtures("plugin")
@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("absent-module", "'absent-module' cannot be loaded: .*no_such_module"),
        ("absent-class", "'absent-class' cannot be loaded: .*NoSuchClass"),
        ("a-function", f"'a-function' is not a subclass of Source: {__name__}:members"),
        ("other-class", f"'other-class' is not a subclass of Source: {__name__}:Path"),
    ],
)
def test_entry_points_that_are_no_sources_are_named(name: str, problem: str) -> None:
    with pytest.raises(StudyError, match=f"source {problem}"):
        parse_source({"source": name})


NO_LEVELS: dict[str, list[Any]] = {
    "levels": [None, [], 3],
    "levels.0": [["3"], [1.0], [-1]],
    "levels.1": [[1, True], [0, 13]],
}
NO_COUNTS: dict[str, list[Any]] = {
    "triangles": [None, []],
    "triangles.0": [["80"]],
    "triangles.1": [[80, 3]],
    "mesh": ["a.ply"],
    "mesh.levels.0": [{"source": "icosphere", "levels": ["1"]}],
    "target": [80],
}
COUNTS, RADII = {"mesh": BALL, "triangles": [80]}, {"R": 1.0, "r": 0.4}
# For each source, the rest of its table, and by the place that is refused the values, None for a key that is missing.
BAD: list[tuple[str, dict[str, Any], dict[str, list[Any]]]] = [
    ("icosphere", {"levels": [1]}, {**NO_LEVELS, "level": [1]}),
    (
        "sphere",
        {},
        {
            "radius": ["1", True, 0, -1.0, float("nan"), float("inf")],
            "center": [[0.0] * 4],
            "center.2": [[0.0, 0.0]],
            "center.1": [[0.0, "0", 0.0]],
            "center.0": [[float("nan"), 0.0, 0.0]],
        },
    ),
    ("ellipsoid", {"axes": [1.0, 1.0, 1.0]}, {"axes": [None], "axes.2": [[1.0, 1.0, 0.0]], "levels.0": [[-1]]}),
    ("torus", {**RADII, "levels": [1]}, {"r": [None, 0.0], "radius": [1.0], "around": [2], "across": [6.0]}),
    (
        "files",
        {"paths": ["a.ply"]},
        {"paths": [[], "a.ply"], "paths.0": [[""]], "distribution": [7], "path": ["a.ply"]},
    ),
    ("decimate", COUNTS, {**NO_COUNTS, "radius": [0.0, "1", True], "keep_boundary": [1, "yes"]}),
    ("remesh", COUNTS, NO_COUNTS),
    ("spherical-levels", {"mesh": BALL, "sphere": BALL, "levels": [1]}, {"sphere": [None, "a.ply"], **NO_LEVELS}),
    (
        "flow",
        {"mesh": BALL, "times": [0.0]},
        {"times": [[], [0.0, True], [1.0, 1.0]], "period": [0.0, "5"], "strength": [True]},
    ),
]


@pytest.mark.parametrize(
    ("table", "place", "value"),
    [({"source": name, **rest}, place, value) for name, rest, bad in BAD for place in bad for value in bad[place]],
    ids=str,
)
def test_bad_parameters_are_refused_where_they_stand(table: dict[str, Any], place: str, value: Any) -> None:
    with pytest.raises(ValidationError) as caught:
        parse_source(
            {key: found for key, found in {**table, place.partition(".")[0]: value}.items() if found is not None}
        )
    places = {".".join(map(str, error["loc"])) for error in caught.value.errors()}
    # A list whose only entry is bad may be called empty besides.
    assert place in places
    assert places <= {place, place.rsplit(".", 1)[0]}


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"source": "files"}, "either paths, such as .* or a list of meshes is needed, and not both"),
        ({"source": "files", "paths": ["a.ply"], "meshes": "list.csv"}, "and not both"),
        ({"source": "files", "meshes": "list.csv", "times": [1.0]}, "distribution and times belong to paths"),
        (
            {"source": "files", "meshes": "list.csv", "distribution": "nilearn"},
            "distribution and times belong to paths",
        ),
        ({"source": "ellipsoid", "axes": [1.0, 1.0, 1e200]}, "three numbers between 1e-150"),
        ({"source": "torus", "R": 1.0, "r": 1.0}, "0 < r < R"),
        ({"source": "torus", "R": 1.0, "r": 0.4, "levels": [0, 12]}, "level 12 of 12 x 6 cells has 2415919104"),
    ],
)
def test_parameters_that_do_not_fit_each_other_are_refused(table: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        parse_source(table)


@pytest.mark.parametrize("name", ["decimate", "remesh", "spherical-levels"])
@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        ({"paths": ["a.ply"]}, "source is missing; add it, such as"),
        *(
            ({"source": x}, re.escape(f"no source is named {x!r}"))
            for x in ("nothing", None, 3, ["files"], "Files", "")
        ),
    ],
)
def test_nested_sources_must_be_named_and_exist(name: str, mesh: dict[str, Any], message: str) -> None:
    for table in (mesh, {"source": name, "mesh": mesh, "triangles": [80]}):
        with pytest.raises(StudyError, match=message):
            parse_source(table)


@pytest.mark.parametrize("kind", KINDS)
def test_sources_survive_pickling_and_a_dump_tells_everything_of_them(kind: str) -> None:
    source = parse_source(KINDS[kind])
    assert pickle.loads(pickle.dumps(source)) == source
    given = {key: value for key, value in KINDS[kind].items() if not isinstance(value, dict)} | {"source": None}
    assert given.items() <= (json.loads(source.model_dump_json()) | {"source": None}).items()


def test_fingerprints_of_different_sources_differ(tmp_path: Path) -> None:
    (tmp_path / "box.off").write_bytes(OFF_BOX)
    tables = [table for kind, table in KINDS.items() if kind != "remesh"]
    found = [dict(member.fingerprint()) for table in tables for member in members(table, tmp_path)]
    assert len({json.dumps(fingerprint, sort_keys=True) for fingerprint in found}) == len(found) > len(tables)


def test_smooth_surfaces_are_one_member_each() -> None:
    (ball,), (egg,), (ring,) = members(SPHERE), members(EGG), members(RING)
    assert listed((ball, egg, ring)) == [("sphere", -1), ("ellipsoid", -1), ("torus", -1)]
    assert ball.load() == Sphere(2.0, (1.0, 2.5, -3.0))
    assert ball.fingerprint() == {"sphere": [2.0, 1.0, 2.5, -3.0]}
    assert egg.load() == Ellipsoid((3.0, 2.0, 1.0), (0.0, 0.5, 0.0))
    assert ring.load() == Torus(2.0, 0.5, (0.0, 0.5, 0.0))
    assert egg.fingerprint() == {"ellipsoid": [3.0, 2.0, 1.0, 0.0, 0.5, 0.0]}
    assert ring.fingerprint() == {"torus": [2.0, 0.5, 0.0, 0.5, 0.0]}
    assert egg.expected_size() == ring.expected_size() == ExpectedSize()


def test_levels_go_from_coarse_to_fine_and_once_each() -> None:
    egg, ring = Ellipsoid((3.0, 2.0, 1.0), (0.0, 0.5, 0.0)), Torus(2.0, 0.5, (0.0, 0.5, 0.0))
    cases: list[tuple[dict[str, Any], list[tuple[int, Mesh]]]] = [
        ({**EGG, "levels": [3, 1, 1]}, [(1, egg.mesh(1)), (3, egg.mesh(3))]),
        ({**RING, "levels": [2, 0], "around": 10, "across": 4}, [(0, ring.mesh(10, 4)), (2, ring.mesh(40, 16))]),
        ({**RING, "levels": [0]}, [(0, ring.mesh(12, 6))]),
        ({"source": "icosphere", "levels": [3, 0, 3, 2]}, [(level, icosphere(level)) for level in (0, 2, 3)]),
    ]
    for table, expected in cases:
        found = members(table)
        assert listed(found) == [(str(level), level) for level, _ in expected]
        assert [loaded(member).digest for member in found] == [mesh.digest for _, mesh in expected]
        assert [member.expected_size().triangles for member in found] == [len(mesh.triangles) for _, mesh in expected]


@pytest.mark.parametrize(
    ("table", "changes"),
    [
        (EGG, [{"axes": [3, 1, 2]}, {"axes": [3, 2, 1.0000001]}, {"center": [0.0, 0.0, 0.5]}]),
        ({**EGG, "levels": [1]}, [{"axes": [3, 1, 2]}, {"center": [0.0, 0.0, 0.5]}, {"levels": [2]}]),
        (RING, [{"R": 3}, {"r": 0.6}, {"center": [0.0, 0.0, 0.5]}]),
        ({**RING, "levels": [1]}, [{"R": 3}, {"r": 0.6}, {"levels": [2]}, {"around": 13}, {"across": 7}]),
        (KINDS["flow"], [{"times": [0.25]}, {"strength": 2.0}, {"period": 5.0}, {"mesh": COARSER}]),
        (KINDS["spherical-levels"], [{"levels": [2]}, {"sphere": COARSER}, {"mesh": COARSER}]),
        (KINDS["decimate"], [{"triangles": [81]}, {"mesh": COARSER}]),
        pytest.param(
            KINDS.get("fit"),
            [{"order": -3.0}, {"steps": 4}, {"smoothing": 1.0}, {"keep_boundary": True}, {"target": SPHERE}],
            marks=pytest.mark.extras,
        ),
    ],
    ids=str,
)
def test_every_parameter_is_part_of_the_fingerprint(table: dict[str, Any], changes: list[dict[str, Any]]) -> None:
    found = [members({**table, **change})[0].fingerprint_digest() for change in ({}, *changes)]
    assert len(set(found)) == len(found)
    assert members(dict(table))[0].fingerprint_digest() == found[0]
