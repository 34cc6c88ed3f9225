"""Names that files of meshes may have, and where globs may lead."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from sobolev_batch import StudyError
from sobolev_batch.surfaces.sources.names import caseless_key
from sobolev_batch.surfaces.sources.registry import parse_source
from tests.support.mesh_files import off
from tests.support.shapes import BOX_TRIANGLES, BOX_VERTICES

OFF_BOX = off(BOX_VERTICES, BOX_TRIANGLES)


def names_of(folder: Path, *paths: str) -> list[str]:
    return [member.name for member in parse_source({"source": "files", "paths": list(paths)}).members(folder)]


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


def test_files_in_different_folders_or_formats_are_told_apart(tmp_path: Path) -> None:
    put(tmp_path, "one/A.off", "two/a.off", "b.off", "b.obj")
    labels = names_of(tmp_path, "**/*.o*")
    assert [label.rsplit("/", 2)[1:] for label in labels if label.endswith(("/A.off", "/a.off"))] == [
        ["one", "A.off"],
        ["two", "a.off"],
    ]
    assert {"b.off", "b.obj"} < set(labels)
    assert len({caseless_key(label) for label in labels}) == len(labels) == 4


@pytest.mark.parametrize(("one", "other"), [("A", "a"), ("caf\u00e9", "cafe\u0301"), ("STRASSE", "straße")])
def test_twins_in_one_folder_are_refused(tmp_path: Path, one: str, other: str) -> None:
    put(tmp_path, f"{one}.off", f"{other}.off")
    if len(list(tmp_path.iterdir())) < 2:
        pytest.skip("this file system does not tell them apart")
    message = refused(tmp_path, "*.off")
    assert "differ only in case or in the encoding of accents; rename one" in message
    assert one in message
    assert other in message


def test_globs_do_not_leave_their_folder_through_links(tmp_path: Path) -> None:
    put(tmp_path, "study/meshes/a.off", "elsewhere/secret.off")
    folder = tmp_path / "study"
    (folder / "meshes" / "link.off").symlink_to("../../elsewhere/secret.off")
    for glob in ("meshes/*.off", "**/*.off", "meshes/l*"):
        message = refused(folder, glob)
        assert "a link out of" in message
        assert "secret.off" in message
        assert message.endswith("name such files by their paths")
    # A path that is named is meant, wherever it leads.
    assert names_of(folder, "meshes/link.off", "../elsewhere/secret.off") == ["secret", "link"]
    (folder / "meshes" / "link.off").unlink()
    # A link within the folder leads to nothing that was not there.
    (folder / "meshes" / "inner.off").symlink_to("a.off")
    assert names_of(folder, "meshes/*.off") == ["a", "inner"]


def test_globs_do_not_leave_their_folder_through_linked_folders(tmp_path: Path) -> None:
    put(tmp_path, "study/a.off", "elsewhere/secret.off")
    folder = tmp_path / "study"
    (folder / "up").symlink_to("../elsewhere")
    assert names_of(folder, "**/*.off") == ["a"]
    assert "a link out of" in refused(folder, "*/*.off")
    assert "goes back up behind a wildcard" in refused(folder, "u*/../../elsewhere/*.off")
    # What stands before the wildcard is named by the study, and therefore meant.
    assert names_of(folder, "up/*.off") == names_of(folder, "../elsewhere/*.off") == ["secret"]
    assert names_of(folder, f"{tmp_path}/elsewhere/*.off") == ["secret"]


def test_loops_of_links_and_repeated_wildcards_end(tmp_path: Path) -> None:
    put(tmp_path, *(f"{'d/' * depth}a{depth}.off" for depth in range(12)))
    for name in ("one", "two"):
        (tmp_path / "d" / name).symlink_to(".")
    assert len(names_of(tmp_path, "**/*.off")) == 12
    assert len(names_of(tmp_path, "/".join(["**"] * 12) + "/*.off")) == 12


@pytest.mark.parametrize("glob", ["*.ply", "none/*.off", "fold*", "*" * 300 + "z", "a[.off", "**/none/*", "a*\n"])
def test_globs_that_match_nothing_are_refused(tmp_path: Path, glob: str) -> None:
    put(tmp_path, "a.off", "folder/b.txt")
    message = refused(tmp_path, "a.off", glob)
    assert f"matches no file below {tmp_path}" in message
    assert message.endswith("correct it, or put files there")


def test_paths_that_no_file_can_have_are_refused(tmp_path: Path) -> None:
    assert "NUL" in refused(tmp_path, "a\0b.off")
    assert "NUL" in refused(tmp_path, "a\0*.off")
    assert "1000 are allowed" in refused(tmp_path, "x" * 5000 + ".off")
