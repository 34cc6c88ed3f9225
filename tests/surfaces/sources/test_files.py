"""The source `files`: paths, globs, installed distributions; names and fingerprints."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from sobolev_batch import MeshError, Study, StudyError
from sobolev_batch.surfaces.sources.files import file_digest
from tests.support.members import listed, loaded, members
from tests.support.mesh_files import box_scene, off
from tests.support.shapes import BOX_AREA, BOX_TRIANGLES, BOX_VERTICES, TETRAHEDRON_TRIANGLES, TETRAHEDRON_VERTICES

OFF_BOX = off(BOX_VERTICES, BOX_TRIANGLES)
OFF_TETRAHEDRON = off(TETRAHEDRON_VERTICES, TETRAHEDRON_TRIANGLES)


def test_files_are_sorted_by_path_and_named_by_stem(tmp_path: Path) -> None:
    for name in ("b.off", "a.off.gz", "C.OFF", "10.off", "9.off"):
        (tmp_path / name).write_bytes(OFF_BOX)
    found = members({"source": "files", "paths": ["b.off", "a.off.gz", "C.OFF", "10.off", "9.off"]}, tmp_path)
    assert listed(found) == [("10", -1), ("9", -1), ("C", -1), ("a", -1), ("b", -1)]


def test_paths_start_at_the_folder_unless_they_are_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/")
    study, elsewhere = tmp_path / "study", tmp_path / "elsewhere"
    (study / "deep").mkdir(parents=True)
    elsewhere.mkdir()
    (study / "deep" / "one.off").write_bytes(OFF_BOX)
    (elsewhere / "two.off").write_bytes(OFF_BOX)
    paths = ["deep/one.off", str(elsewhere / "two.off"), "../elsewhere/two.off"]
    for path in paths:
        (member,) = members({"source": "files", "paths": [path]}, study)
        assert loaded(member).area == BOX_AREA


def test_a_named_file_may_be_missing_until_it_is_read(tmp_path: Path) -> None:
    (member,) = members({"source": "files", "paths": ["missing.off"]}, tmp_path)
    assert member.name == "missing"
    for use in (member.load, member.fingerprint):
        with pytest.raises(MeshError, match=re.escape(f"{tmp_path / 'missing.off'}: cannot be read: No such file")):
            use()


def names_of(tmp_path: Path, *files: str) -> list[str]:
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(OFF_BOX)
    return [member.name for member in members({"source": "files", "paths": list(files)}, tmp_path)]


def test_stems_that_collide_give_way_to_file_names_and_then_to_paths(tmp_path: Path) -> None:
    assert names_of(tmp_path, "a.off", "a.obj", "b.off") == ["a.obj", "a.off", "b"]
    assert names_of(tmp_path, "c.off", "c.off.gz") == ["c.off", "c.off.gz"]
    found = names_of(tmp_path, "one/a.off", "two/a.off", "two/b.off")
    assert found[2] == "b"
    assert [name.endswith(path) for name, path in zip(found, ["one/a.off", "two/a.off"], strict=False)] == [True] * 2


@pytest.mark.parametrize(
    "files",
    [
        ["a.off", "a.obj", "a.off.obj"],
        ["a.ply", "a.off", "a.ply.gz", "x/a.off", "a.ply.off"],
        ["a.off", "a.obj", "a.off.GZ"],
    ],
    ids=str,
)
def test_names_are_never_alike(tmp_path: Path, files: list[str]) -> None:
    found = names_of(tmp_path, *files)
    assert len(set(found)) == len(files)


def fingerprint(tmp_path: Path, name: str) -> dict[str, Any]:
    (member,) = members({"source": "files", "paths": [name]}, tmp_path)
    return dict(member.fingerprint())


def test_the_fingerprint_of_a_file_is_that_of_its_bytes(tmp_path: Path) -> None:
    path = tmp_path / "box.off"
    path.write_bytes(OFF_BOX)
    before = fingerprint(tmp_path, "box.off")
    assert file_digest(path) in before.values()
    os.utime(path, (0, 0))
    assert fingerprint(tmp_path, "box.off") == before
    # One coordinate of the same length.
    path.write_bytes(OFF_BOX.replace(b"4.0", b"4.5", 1))
    assert fingerprint(tmp_path, "box.off") != before
    path.write_bytes(OFF_BOX + b"\n")
    assert fingerprint(tmp_path, "box.off") != before
    path.write_bytes(OFF_BOX)
    assert fingerprint(tmp_path, "box.off") == before


@pytest.mark.parametrize("name", ["other.off", "deep/box.off", "OTHER.OFF", "box.v2.off", "2026.01.31.off"])
def test_the_fingerprint_of_a_file_is_not_that_of_its_name(tmp_path: Path, name: str) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "box.off").write_bytes(OFF_BOX)
    shutil.copy(tmp_path / "box.off", tmp_path / name)
    assert fingerprint(tmp_path, name) == fingerprint(tmp_path, "box.off")


def test_the_same_bytes_in_another_format_are_another_surface(tmp_path: Path) -> None:
    for name in ("box.off", "box.ply", "box.off.gz"):
        (tmp_path / name).write_bytes(OFF_BOX)
    found = [json.dumps(fingerprint(tmp_path, name)) for name in ("box.off", "box.ply", "box.off.gz")]
    assert len(set(found)) == 3


def test_the_fingerprint_covers_files_that_a_gltf_file_refers_to(tmp_path: Path) -> None:
    scene = box_scene()
    (tmp_path / "box.gltf").write_bytes(scene.gltf("data.bin"))
    (tmp_path / "data.bin").write_bytes(scene.blob)
    (member,) = members({"source": "files", "paths": ["box.gltf"]}, tmp_path)
    before, area = dict(member.fingerprint()), loaded(member).area
    (tmp_path / "data.bin").write_bytes(scene.blob.replace(np.float32(4).tobytes(), np.float32(8).tobytes()))
    assert loaded(member).area > area
    assert dict(member.fingerprint()) != before


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which the distribution `shapes-for-tests` is installed."""
    site = tmp_path / "site"
    info = site / "shapes_for_tests-3.4.dist-info"
    (site / "shapes" / "data").mkdir(parents=True)
    info.mkdir()
    (site / "shapes" / "data" / "box.off").write_bytes(OFF_BOX)
    (site / "shapes" / "data" / "tetrahedron.off").write_bytes(OFF_TETRAHEDRON)
    (site / "shapes" / "data" / "unrecorded.off").write_bytes(OFF_BOX)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: shapes-for-tests\nVersion: 3.4\n")
    (info / "RECORD").write_text("shapes/data/box.off,,\nshapes/data/tetrahedron.off,,\n")
    # Importing it would be an error.
    (site / "shapes" / "__init__.py").write_text("raise RuntimeError('imported')\n")
    monkeypatch.syspath_prepend(str(site))
    return site


def test_files_of_a_distribution_are_found_without_importing_it(installed: Path, tmp_path: Path) -> None:
    table = {
        "source": "files",
        "distribution": "shapes-for-tests",
        "paths": ["shapes/data/tetrahedron.off", "shapes/data/box.off"],
    }
    found = members(table, tmp_path / "nowhere")
    assert listed(found) == [("box", -1), ("tetrahedron", -1)]
    assert loaded(found[0]).area == BOX_AREA
    # What it is called and where it lies does not matter.
    (tmp_path / "copy.off").write_bytes(OFF_BOX)
    assert dict(found[0].fingerprint()) == fingerprint(tmp_path, "copy.off")


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("path", ["shapes/data/unrecorded.off", "box.off", "shapes/data/*.off", "shapes/data"])
def test_a_distribution_has_only_the_files_that_it_recorded(tmp_path: Path, path: str) -> None:
    message = f"the distribution 'shapes-for-tests' 3.4 contains no file {path!r}"
    with pytest.raises(StudyError, match=re.escape(message)):
        members({"source": "files", "distribution": "shapes-for-tests", "paths": [path]}, tmp_path)


@pytest.mark.parametrize("name", ["no-such-distribution-anywhere", ""])
def test_a_distribution_must_be_installed(tmp_path: Path, name: str) -> None:
    # An empty name may be refused as a parameter already.
    with pytest.raises((StudyError, ValidationError), match=r"install|distribution"):
        members({"source": "files", "distribution": name, "paths": ["a.off"]}, tmp_path)


def _frames(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).write_bytes(off([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]))


def test_times_come_from_names_or_from_a_list(tmp_path: Path) -> None:
    _frames(tmp_path, "s1_t10.off", "s1_t2.5.off", "s1_t0.off")
    table = {"source": "files", "paths": ["*.off"]}
    found = [(member.name, member.time) for member in members({**table, "times": "names"}, tmp_path)]
    assert found == [("s1_t0", 0.0), ("s1_t2.5", 2.5), ("s1_t10", 10.0)]
    found = [(member.name, member.time) for member in members({**table, "times": [3, 1.5, 2]}, tmp_path)]
    assert found == [("s1_t2.5", 1.5), ("s1_t10", 2.0), ("s1_t0", 3.0)]
    assert all(member.time is None for member in members(table, tmp_path))


def test_times_in_names_may_have_powers_of_ten(tmp_path: Path) -> None:
    _frames(tmp_path, "t_1e-3.off", "t_2.5E+2.off", "t-7.off")
    found = members({"source": "files", "paths": ["*.off"], "times": "names"}, tmp_path)
    assert [member.time for member in found] == [1e-3, 7.0, 250.0]


@pytest.mark.parametrize("times", ["Names", [], 3, [0, 1, "2"]])
def test_times_of_another_kind_are_refused(times: Any) -> None:
    with pytest.raises(StudyError, match=r"times: (must be a list of numbers|each time must be a finite number)"):
        Study.from_table(
            {
                "study": {"name": "moving"},
                "lattice": {"xi_max": 2.0, "M": 8},
                "norm": {"orders": [-2.0]},
                "reference": {"source": "sphere"},
                "family": [{"name": "frames", "source": "files", "paths": ["*.off"], "times": times}],
            }
        )


def test_times_that_do_not_belong_to_files_are_refused(tmp_path: Path) -> None:
    _frames(tmp_path, "a1.off", "b1.off", "c.off")
    with pytest.raises(StudyError, match="times: 2 times are given for 3 files; give one for each"):
        members({"source": "files", "paths": ["*.off"], "times": [1, 2]}, tmp_path)
    with pytest.raises(StudyError, match=r"the name of the file 'c\.off' has no number; list the times instead"):
        members({"source": "files", "paths": ["*.off"], "times": "names"}, tmp_path)
    with pytest.raises(StudyError, match="several files have the time 1"):
        members({"source": "files", "paths": ["[ab]1.off"], "times": "names"}, tmp_path)
