"""The source `files`: paths, globs and where they lead, installed distributions; names and fingerprints."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from sobolev_batch.errors import MeshError, StudyError
from sobolev_batch.sources import files
from sobolev_batch.sources.files import file_digest
from sobolev_batch.sources.names import caseless_key
from tests.support.members import listed, loaded, members
from tests.support.mesh_files import OFF_BOX
from tests.support.shapes import BOX_AREA


def names_of(folder: Path, *paths: str) -> list[str]:
    return [member.name for member in members({"source": "files", "paths": list(paths)}, folder)]


def refused(folder: Path, *paths: str) -> str:
    with pytest.raises(StudyError) as caught:
        names_of(folder, *paths)
    message = str(caught.value)
    assert message.startswith("paths: ")
    assert message.isprintable()
    return message


def put(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(OFF_BOX)


@pytest.mark.parametrize(
    ("files", "names"),
    [
        # Sorted by path and named by stem.
        (["b.off", "a.off.gz", "C.OFF", "10.off", "9.off"], ["10", "9", "C", "a", "b"]),
        # Where stems are alike, file names; where those are alike, paths.
        (["a.off", "a.obj", "b.off"], ["a.obj", "a.off", "b"]),
        (["c.off", "c.off.gz"], ["c.off", "c.off.gz"]),
        (["one/A.off", "two/a.off", "two/b.off"], ["/one/A.off", "/two/a.off", "b"]),
        (["a.off", "a.obj", "a.off.obj"], None),
        (["a.ply", "a.off", "a.ply.gz", "x/a.off", "a.ply.off"], None),
        (["a.off", "a.obj", "a.off.GZ"], None),
    ],
    ids=str,
)
def test_names_are_short_and_never_alike(tmp_path: Path, files: list[str], names: list[str] | None) -> None:
    put(tmp_path, *files)
    found = names_of(tmp_path, *files)
    assert len({caseless_key(name) for name in found}) == len(files)
    assert all(one.endswith(end) for one, end in zip(found, names or found, strict=True)), found
    assert all(len(one) == len(end) for one, end in zip(found, names or found, strict=True) if "/" not in end), found


def test_paths_start_at_the_folder_unless_they_are_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/")
    put(tmp_path, "study/deep/one.off", "elsewhere/two.off")
    for path in ("deep/one.off", str(tmp_path / "elsewhere/two.off"), "../elsewhere/two.off"):
        (member,) = members({"source": "files", "paths": [path]}, tmp_path / "study")
        assert loaded(member).area == BOX_AREA


def test_a_named_file_may_be_missing_until_it_is_read(tmp_path: Path) -> None:
    (member,) = members({"source": "files", "paths": ["missing.off"]}, tmp_path)
    assert listed((member,)) == [("missing", -1)]
    for use in (member.load, member.fingerprint):
        with pytest.raises(MeshError, match=re.escape(f"{tmp_path / 'missing.off'}: cannot be read: No such file")):
            use()


@pytest.mark.parametrize(
    "stem", ["a\nb", "a\x1b[2Jb", "a\u202eb", "a\u200bb", "a\u2028b", " a", "a\\b", "a\x85b", "\udcff"]
)
def test_stems_that_would_be_misleading_labels_are_refused(tmp_path: Path, stem: str) -> None:
    try:
        put(tmp_path, f"{stem}.off")
    except OSError:
        pytest.skip("this file system has no such names")
    # What is no Unicode cannot be named in a study, but a glob finds it.
    for path in ("*.off", f"{stem}.off")[: 1 if stem == "\udcff" else 2]:
        message = refused(tmp_path, path)
        assert "is no label: it " in message
        assert message.endswith("; rename the file")


@pytest.mark.parametrize(
    ("globs", "names"),
    [
        (["*.off"], "ab"),
        (["?.o*"], "abc"),
        (["[bc].*"], "bc"),
        (["**/*.off"], "abde"),
        (["deep/**"], "de"),
        (["deep/*/*.off"], "d"),
        ([".*.off"], [".hidden"]),
        # What two of them find is there once.
        (["a.off", "*.off", "[a].off", "./a.off"], "ab"),
    ],
)
def test_globs_find_files_in_order(tmp_path: Path, globs: list[str], names: Sequence[str]) -> None:
    # The wildcards in the name of the folder are letters.
    folder = tmp_path / "run [1] *"
    put(folder, "b.off", "a.off", "c.obj", "deep/e.off", "deep/deeper/d.off", ".hidden.off", ".deep/f.off")
    (folder / "folder.off").mkdir()
    assert names_of(folder, *globs) == list(names)


def test_globs_follow_links_to_files_but_none_in_circles(tmp_path: Path) -> None:
    put(tmp_path, "elsewhere/b.off", *(f"study/{'d/' * depth}a{depth}.off" for depth in range(4)))
    (tmp_path / "study/b.off").symlink_to("../elsewhere/b.off")
    for name in ("one", "two"):
        (tmp_path / "study/d" / name).symlink_to(".")
    assert sorted(names_of(tmp_path / "study", "**/*.off")) == ["a0", "a1", "a2", "a3", "b"]
    assert names_of(tmp_path, "study/../elsewhere/*.off") == ["b"]


NO_MATCH = "matches no file below .* correct it, or put files there$"
TWINS = "differ only in case or in the encoding of accents; rename one$"


@pytest.mark.parametrize(
    ("files", "path", "message"),
    [
        *((["a.off", "folder/b.txt"], glob, NO_MATCH) for glob in ("*.ply", "none/*.off", "fold*", "a[.off", "**/c/*")),
        (["a.off"], "a**", "the glob 'a\\*\\*' is none: Invalid pattern"),
        *(([f"{one}.off", f"{other}.off"], "*.off", TWINS) for one, other in (("A", "a"), ("STRASSE", "straße"))),
        (["caf\u00e9.off", "cafe\u0301.off"], "*.off", TWINS),
        ([], "s3://bucket/*.ply", "'s3://bucket/\\*.ply' is a URL, and meshes are read from files"),
        ([], "a\0b.off", "NUL"),
        ([], "a\0*.off", "NUL"),
        ([], "x" * 5000 + ".off", "1000 are allowed"),
    ],
)
def test_paths_that_name_no_files_or_twins_are_refused(
    tmp_path: Path, files: list[str], path: str, message: str
) -> None:
    put(tmp_path, *files)
    if len({*tmp_path.iterdir()}) < len(files):
        pytest.skip("this file system does not tell them apart")
    assert re.search(message, refused(tmp_path, path))


def fingerprint(tmp_path: Path, name: str) -> dict[str, Any]:
    (member,) = members({"source": "files", "paths": [name]}, tmp_path)
    return dict(member.fingerprint())


def test_the_fingerprint_of_a_file_is_that_of_its_bytes(tmp_path: Path) -> None:
    path = tmp_path / "box.off"
    found: list[dict[str, Any]] = []
    # One coordinate of the same length, a line feed more, and the file as it was, much older.
    for content in (OFF_BOX, OFF_BOX.replace(b"4.0", b"4.5", 1), OFF_BOX + b"\n", OFF_BOX):
        path.write_bytes(content)
        os.utime(path, (len(found), 0))
        found.append(fingerprint(tmp_path, "box.off"))
    assert found[0] == found[3]
    assert found[0] not in found[1:3]


def test_the_fingerprint_of_a_file_is_not_that_of_its_name_but_of_its_format(tmp_path: Path) -> None:
    names = ("box.off", "deep/box.off", "OTHER.OFF", "2026.01.31.off", "box.ply")
    put(tmp_path, *names)
    *same, other = (fingerprint(tmp_path, name) for name in names)
    assert all(one == same[0] != other for one in same)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which the distribution `shapes-for-tests` is installed."""
    site = tmp_path / "site"
    info = site / "shapes_for_tests-3.4.dist-info"
    info.mkdir(parents=True)
    put(site / "shapes" / "data", "box.off", "unrecorded.off", "tetrahedron.off")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: shapes-for-tests\nVersion: 3.4\n")
    (info / "RECORD").write_text("shapes/data/box.off,,\nshapes/data/tetrahedron.off,,\n")
    # Importing it would be an error.
    (site / "shapes" / "__init__.py").write_text("raise RuntimeError('imported')\n")
    monkeypatch.syspath_prepend(str(site))
    return site


def test_files_of_a_distribution_are_found_without_importing_it(installed: Path, tmp_path: Path) -> None:
    paths = ["shapes/data/tetrahedron.off", "shapes/data/box.off"]
    table = {"source": "files", "distribution": "shapes-for-tests", "paths": paths}
    found = members(table, tmp_path / "nowhere")
    assert listed(found) == [("box", -1), ("tetrahedron", -1)]
    assert loaded(found[0]).area == BOX_AREA
    # What it is called and where it lies does not matter.
    (tmp_path / "copy.off").write_bytes(OFF_BOX)
    assert dict(found[0].fingerprint()) == fingerprint(tmp_path, "copy.off")


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("name", "path", "message"),
    [
        *(
            ("shapes-for-tests", path, f"the distribution 'shapes-for-tests' 3.4 contains no file {path!r}")
            for path in ("shapes/data/unrecorded.off", "box.off", "shapes/data/*.off", "shapes/data")
        ),
        ("no-such-distribution-anywhere", "a.off", "is not installed; install it"),
    ],
)
def test_a_distribution_has_only_the_files_that_it_recorded(tmp_path: Path, name: str, path: str, message: str) -> None:
    with pytest.raises(StudyError, match=re.escape(message)):
        members({"source": "files", "distribution": name, "paths": [path]}, tmp_path)


FRAMES = ["s1_t10.off", "s1_t2.5.off", "s1_t0.off"]


@pytest.mark.parametrize(
    ("files", "times", "names", "found"),
    [
        (FRAMES, "names", ["s1_t0", "s1_t2.5", "s1_t10"], [0.0, 2.5, 10.0]),
        (FRAMES, [3, 1.5, 2], ["s1_t2.5", "s1_t10", "s1_t0"], [1.5, 2.0, 3.0]),
        (FRAMES, None, ["s1_t0", "s1_t10", "s1_t2.5"], [None] * 3),
        (["t_1e-3.off", "t_2.5E+2.off", "t-7.off"], "names", ["t_1e-3", "t-7", "t_2.5E+2"], [1e-3, 7.0, 250.0]),
    ],
)
def test_times_come_from_names_or_from_a_list(
    tmp_path: Path, files: list[str], times: Any, names: list[str], found: list[float | None]
) -> None:
    put(tmp_path, *files)
    table = {"source": "files", "paths": ["*.off"], **({} if times is None else {"times": times})}
    assert [(member.name, member.time) for member in members(table, tmp_path)] == list(zip(names, found, strict=True))


@pytest.mark.parametrize(
    ("glob", "times", "message"),
    [
        ("*.off", [1, 2], "times: 2 times are given for 3 files; give one for each"),
        ("*.off", "names", r"the name of the file 'c\.off' has no number; list the times instead"),
        ("[ab]1.off", "names", "several files have the time 1"),
        ("*.off", "Names", "must be a list of numbers"),
        ("*.off", [], "must be a list of numbers"),
        ("*.off", [0, 1, "2"], "each time must be a finite number"),
    ],
)
def test_times_that_do_not_belong_to_files_are_refused(tmp_path: Path, glob: str, times: Any, message: str) -> None:
    put(tmp_path, "a1.off", "b1.off", "c.off")
    with pytest.raises((StudyError, ValidationError), match=message):
        members({"source": "files", "paths": [glob], "times": times}, tmp_path)


@pytest.mark.parametrize(("settled_ns", "reads"), [(-(10**18), 1), (10**18, 3)])
def test_a_file_is_hashed_again_where_it_may_have_changed(
    settled_ns: int, reads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashed, path = [], tmp_path / "a.off"

    def counted(*arguments: Any) -> Any:
        hashed.append(arguments)
        return hash_file(*arguments)

    hash_file = hashlib.file_digest
    monkeypatch.setattr(files, "_SETTLED_NS", settled_ns)
    monkeypatch.setattr(hashlib, "file_digest", counted)
    path.write_bytes(OFF_BOX)
    assert len({file_digest(path) for _ in range(3)}) == 1
    assert len(hashed) == reads
    # Of the same length, an hour later.
    first, other = file_digest(path), OFF_BOX.replace(b"1", b"2", 1)
    path.write_bytes(other)
    os.utime(path, (later := path.stat().st_mtime + 3600, later))
    assert file_digest(path) == hashlib.sha256(other).hexdigest() != first
