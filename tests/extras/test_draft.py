"""First study files for folders of meshes: what is the reference, what a family, and that they run."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pytest

import sobolev_batch as sb
from sobolev_batch.extras import draft
from sobolev_batch.sources.files import FileMember
from sobolev_batch.study.study import StudyObject, as_study
from tests.support.commands import call

# The reference last in each, since it has the most triangles.
ONE_OBJECT: dict[str, tuple[list[str], str, dict[str, list[str]]]] = {
    "names": (
        ["even_80.ply", "even_320.ply", "odd.ply", "quick_1k2.obj", "quick_2.5k.obj", "statue_original.ply"],
        "statue_original.ply",
        {"even": ["even_80", "even_320"], "meshes": ["odd"], "quick": ["quick_1k2", "quick_2.5k"]},
    ),
    "folders": (
        ["a/1.ply", "a/2.ply", "b/x/1.stl", "b/x/2.obj.gz", "scan.ply"],
        "scan.ply",
        {"a": ["1", "2"], "b x": ["1", "2"]},
    ),
    "one folder": (["out/p-1.ply", "out/p-2.ply", "out/q-1.ply", "out/q-2.ply", "ref.ply"], "ref.ply", {
        "p": ["p-1", "p-2"],
        "q": ["q-1", "q-2"],
    }),
    "hostile": (
        [
            *("[a] 'b'/*.ply", "[a] 'b'/?.ply", '[a] \'b\'/"q" {x}.ply'),
            *("reference/ünï 💥.ply", "reference/Ground-Truth [1].ply"),
        ],
        "reference/Ground-Truth [1].ply",
        {"[a] 'b'": ["*", "?", '"q" {x}'], "reference 2": ["ünï 💥"]},
    ),
    "alike": (["a/b/1.ply", "a b/2.ply", "scan.ply"], "scan.ply", {
        "a b": ["2"],
        "a b 2": ["1"],
    }),
    "alone": (["object 12.ply"], "object 12.ply", {"quadric decimation": ["80", "160", "320", "640"]}),
}  # fmt: skip

# References, and the files of their methods.
SEVERAL_OBJECTS: dict[str, tuple[list[str], str]] = {
    "methods": (["objects/big cow.ply", "objects/cow.ply"], "out/{method}/{object}_{size}.ply"),
    "objects": (["big cow/ground truth.ply", "cow/ground truth.ply"], "{object}/{method}/{size}.ply"),
    "names": (["big cow_original.ply", "cow_original.ply"], "{object}_{method}_{size}.ply"),
    "folders of objects": (
        ["objects/big cow/original.ply", "objects/cow/original.ply"],
        "objects/{object}/{method}_{size}.ply",
    ),
    "names in any folder": (["in/big cow.ply", "in/cow.ply"], "out/{object}_{method}_{size}.ply"),
    "methods first": (["Big Cow.ply", "COW.ply"], "{method}/{method}_{object}_{size}.ply"),
    "sizes first": (["in/Big cow.ply", "in/cow.ply"], "{size}_{object}_{method}.ply"),
    "folders of sizes": (["in/big cow.ply", "in/cow.ply"], "out/{method}/{object}/{size}.ply"),
    "of one name": (["big cow/scan.ply", "cow/scan.ply"], "{object}/{method}_{size}.ply"),
    "beside others": (["big cow/big cow.ply", "cow/Cow.ply"], "{object}/{method}_{size}.ply"),
    "hostile": (["[o]/originals/big cow.ply", "[o]/originals/cow.ply"], "[o]/*{method}?/{object}_{size}.ply"),
}


def write(path: Path, level: int) -> None:
    """Write a sphere, in whatever format the name says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    plain = path.with_suffix("") if path.suffix == ".gz" else path
    sb.write_mesh(sb.shapes.icosphere(level), plain)
    if plain != path:
        path.write_bytes(gzip.compress(plain.read_bytes()))
        plain.unlink()


@pytest.mark.parametrize("function", [sb.init_study, partial(sb.report, "storage/no.zarr")])
def test_what_is_no_path_is_refused_by_its_type(function: Callable[[Any], object]) -> None:
    with pytest.raises(sb.errors.InputError, match=r"^a path is a text or a pathlib\.Path, found int$"):
        function(7)


def files_of(one: StudyObject) -> dict[str, dict[str, str]]:
    """Return the path of each member of each family, below the folder of the meshes; empty if it is no file."""
    folder = (one.folder / "meshes").absolute()
    return {
        family.name: {
            member.name: member.path.relative_to(folder).as_posix() if isinstance(member, FileMember) else ""
            for member in family.source.members(one.folder)
        }
        for family in one.families
    }


def drafted(folder: Path, *paths: str) -> tuple[Sequence[str], Mapping[str, StudyObject]]:
    """Return the summary and the objects of a draft for several objects, whose references come last."""
    for number, path in enumerate(paths):
        write(folder / "meshes" / path, 1 + (number >= len(paths) - 2))
    draft = sb.init_study(folder / "meshes", folder / "study.toml")
    return draft.summary, as_study(draft.path).objects


@pytest.mark.parametrize("layout", ONE_OBJECT)
def test_reference_and_families(tmp_path: Path, layout: str) -> None:
    paths, reference, families = ONE_OBJECT[layout]
    for path in paths:
        write(tmp_path / "meshes" / path, 3 if path == reference else 1)
    draft = sb.init_study(tmp_path / "meshes", tmp_path / "study.toml")
    study = sb.Study.from_toml(draft.path)
    assert not draft.left_out
    assert draft.summary[0] == f"reference meshes/{reference}, 1,280 triangles"
    (found,) = study.object.reference.members(tmp_path)  # type: ignore[union-attr]
    assert isinstance(found, FileMember)
    assert found.path == (tmp_path / "meshes" / reference).absolute()
    assert {name: set(members) for name, members in files_of(study.object).items()} == {
        name: set(members) for name, members in families.items()
    }


@pytest.mark.parametrize("layout", SEVERAL_OBJECTS)
def test_several_objects(tmp_path: Path, layout: str) -> None:
    references, template = SEVERAL_OBJECTS[layout]
    own = {
        template.format(object=one, method=method, size=size): (one, method)
        for one, method, size in product(("cow", "big cow"), ("even", "quick"), (80, 320))
    }
    summary, studies = drafted(tmp_path, *own, *references)
    families = {(one, family): paths for one in studies for family, paths in files_of(studies[one]).items()}
    found = {
        path: (one.lower(), family.strip("*?")) for (one, family), paths in families.items() for path in paths.values()
    }
    assert (found, summary[0].lower()) == (own, "2 objects: big cow, cow")
    # A list names each mesh, where names follow no pattern.
    is_listed = "[objects]" in (tmp_path / "study.toml").read_text("utf-8")
    assert is_listed == (layout in ("methods first", "sizes first", "beside others", "hostile"))


@pytest.mark.parametrize(("level", "is_paired"), [(2, False), (3, True)])
def test_files_of_one_name_belong_together_where_one_is_finer(tmp_path: Path, level: int, is_paired: bool) -> None:
    for number in range(3):
        write(tmp_path / f"a/part_{number}.ply", 2)
        write(tmp_path / f"b/part_{number}.ply", level)
    summary = sb.init_study(tmp_path, tmp_path / "study.toml").summary
    assert (summary[0] == "3 objects: part_0, part_1, part_2") == is_paired


@pytest.mark.parametrize(("lacking", "level", "found"), [("5", 2, 5), ("45", 3, 1), ("345", 2, 1)])
def test_objects_need_no_other_mesh_if_most_have_one(tmp_path: Path, lacking: str, level: int, found: int) -> None:
    for number in "012345":
        write(tmp_path / f"in/part_{number}.ply", level if number in lacking else 2)
        if number not in lacking:
            write(tmp_path / f"out/part_{number}_low.ply", 1)
    draft = sb.init_study(tmp_path, tmp_path / "study.toml")
    assert len(as_study(draft.path).objects) == found
    reason = "no other mesh belongs to it by name, nor it to one"
    assert draft.left_out == (dict.fromkeys(["in/part_5.ply"], reason) if found > 1 else {})


@pytest.mark.parametrize("lacking", [1, 2])
@pytest.mark.parametrize("template", ["originals/{}.ply", "{}_original.ply", "{}/original.ply"])
def test_originals_without_other_meshes_are_named(tmp_path: Path, template: str, lacking: int) -> None:
    names = ("bell", "cow", "egg")
    for number, name in enumerate(names):
        write(tmp_path / template.format(name), 2)
        if number >= lacking:
            write(tmp_path / f"mmg/{name}_80.ply", 1)
    found = sb.init_study(tmp_path, tmp_path / "study.toml")
    assert [*as_study(found.path).objects] == [*names[lacking:]]
    reason = "no other mesh belongs to it by name, nor it to one"
    assert found.left_out == {template.format(name): reason for name in names[:lacking]}


def test_names_that_are_dates_are_those_of_a_family(tmp_path: Path) -> None:
    for name in ("original.ply", "scans/2026-11-30_01.ply", "scans/2026-11-30_02.ply", "scans/2026-12-01_01.ply"):
        write(tmp_path / name, 1 + (name == "original.ply"))
    found = sb.init_study(tmp_path, tmp_path / "study.toml")
    assert [family.name for family in as_study(found.path).object.families] == ["scans"]


@pytest.mark.parametrize("template", ["originals/{}.ply", "{}_original.ply", "{}/original.ply"])
def test_originals_alone_are_compared_with_their_decimations(tmp_path: Path, template: str) -> None:
    for level, name in enumerate(("cow", "cowboy"), start=2):
        write(tmp_path / "meshes" / template.format(name), level)
    found = sb.init_study(tmp_path / "meshes", tmp_path / "study.toml")
    assert found.summary == ("2 objects: cow, cowboy, each compared with decimated versions of itself",)
    assert found.left_out == {}
    for name, one in as_study(found.path).objects.items():
        (reference,) = one.reference.members(tmp_path)  # type: ignore[union-attr]
        assert reference.name == Path(template.format(name)).stem
        assert [*one.members] == [*(f"quadric decimation/{count}" for count in (20, 40, 80, 160)), "reference"]


def test_a_folder_called_originals_holds_objects_of_their_own(tmp_path: Path) -> None:
    """Meshes as fine as each other, in another folder, are taken for one object; then the draft asks."""
    for folder, name in product(("scans", "Originals"), ("scan_1", "scan_2")):
        write(tmp_path / folder / f"{name}.ply", 2)
    one, several = (sb.init_study(tmp_path / folder, tmp_path / f"{folder}.toml") for folder in ("scans", "Originals"))
    assert [*as_study(one.path).objects] == [""]
    assert "objects of their own? if so, move them into a folder called originals, and init that" in str(one)
    assert [*as_study(several.path).objects] == ["scan_1", "scan_2"]
    assert "objects of their own" not in str(several)
    for name in ("cow.ply", "cow_80.ply", "pig.ply", "pig_80.ply"):
        write(tmp_path / "objects" / name, 1 + ("_" not in name))
    with_versions = sb.init_study(tmp_path / "objects", tmp_path / "objects.toml")
    assert [*as_study(with_versions.path).objects] == ["cow", "pig"]


def test_originals_alone_whose_names_follow_no_pattern_need_other_meshes(tmp_path: Path) -> None:
    for path in ("originals/cow.ply", "originals/egg.obj"):
        write(tmp_path / path, 2)
    with pytest.raises(sb.errors.StudyError, match=r"originals alone .*; add meshes .* such as METHOD/cow_500\.ply"):
        sb.init_study(tmp_path, tmp_path / "study.toml")


def test_meshes_far_larger_than_their_reference_are_named(tmp_path: Path) -> None:
    for number in range(2):
        write(tmp_path / f"in/part_{number}.ply", 2)
        write(tmp_path / f"out/part_{number}_low.ply", 1)
    ball = sb.shapes.icosphere(1)
    sb.write_mesh(sb.Mesh(25.4 * ball.vertices, ball.triangles), tmp_path / "out/part_1_low.ply")
    draft = sb.init_study(tmp_path, tmp_path / "study.toml")
    assert list(draft.doubtful) == ["out/part_1_low.ply"]
    assert "doubtful: out/part_1_low.ply: it is 25.4 times as large" in str(draft)


@pytest.mark.parametrize(
    ("template", "method"), [("{}_500.ply", "meshes"), ("{}/500.ply", "meshes"), ("out/{}.ply", "out")]
)
def test_meshes_of_no_method(tmp_path: Path, template: str, method: str) -> None:
    paths = {one: template.format(one) for one in ("big cow", "cow")}
    summary, studies = drafted(tmp_path, *paths.values(), "big cow_original.ply", "cow_original.ply")
    assert {one: [*files_of(study)[method].values()] for one, study in studies.items()} == {
        one: [path] for one, path in paths.items()
    }
    assert summary == ("2 objects: big cow, cow", f"method {method}: 2 meshes")


def test_a_file_is_not_compared_with_the_references_of_all_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    named = product(range(40), ("original", "a", "b"))
    sizes = {PurePosixPath(f"cow {number}/{name}.ply"): 80 + len(name) for number, name in named}
    equal, compared = PurePosixPath.__eq__, list[object]()

    def noted(path: PurePosixPath, other: object) -> bool:
        compared.append(other)
        return equal(path, other)

    monkeypatch.setattr(PurePosixPath, "__eq__", noted)
    references = draft._references(sizes)
    assert len(draft._families(sizes, references)) == 80
    assert len(compared) < 3 * len(sizes)


def test_links_to_files_count_and_those_to_folders_do_not(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    for path, level in (("elsewhere/far.ply", 1), ("in/original.ply", 2), ("in/own/near.ply", 1)):
        write(tmp_path / path, level)
    (folder / "out").symlink_to(tmp_path / "elsewhere")
    (folder / "own" / "a.ply").symlink_to("near.ply")
    (folder / "far.ply").symlink_to(tmp_path / "elsewhere" / "far.ply")
    draft = sb.init_study(folder, tmp_path / "study.toml")
    assert draft.summary[1:] == ("family meshes: 1 mesh, 80 triangles", "family own: 2 meshes, 80 triangles")


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    write(tmp_path / "in" / "original.ply", 3)
    write(tmp_path / "in" / "old.zarr" / "mesh.ply", 4)
    write(tmp_path / "in" / "made-meshes" / "3023ee15.ply", 4)
    for name in ("scan_1.ply", "scan_2.ply", "{object}.ply", "Scan_1.ply", "\x1b[31mred.ply"):
        write(tmp_path / "in" / name, 1)
    for name in ("scan_3.ply", "notes.txt"):
        (tmp_path / "in" / name).write_text("nothing")
    draft = sb.init_study(tmp_path / "in", tmp_path / "study.toml")
    assert sorted(draft.left_out) == ["\x1b[31mred.ply", "scan_1.ply", "scan_3.ply", "{object}.ply"]
    assert "left out: scan_3.ply: " in str(draft)
    assert "differs from that of 'Scan_1.ply' only in case" in draft.left_out["scan_1.ply"]
    assert r"left out: \x1b[31mred.ply: its name" in str(draft)
    text = draft.path.read_text(encoding="utf-8")
    assert '    "in/Scan_1.ply",\n    "in/scan_2.ply",\n' in text
    # What the file offers is valid too.
    offers = [line.removeprefix("# ") for line in text.splitlines() if not line.startswith("# More")]
    (tmp_path / "more.toml").write_text("\n".join(line for line in offers if not line.startswith(("`", "Compare"))))
    more = sb.Study.from_toml(tmp_path / "more.toml")
    assert more.proximity is not None
    assert more.proximity.metrics == ("hausdorff", "chamfer")
    assert [family.name for family in more.object.families] == ["meshes", "quadric decimation"]


def test_folders_without_meshes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(sb.errors.StudyError, match="no such folder"):
        sb.init_study(tmp_path / "nowhere", tmp_path / "study.toml")
    (tmp_path / "a.ply").write_text("nothing")
    with pytest.raises(sb.errors.StudyError, match=r"no mesh file that can be read: a\.ply: no PLY header"):
        sb.init_study(tmp_path, tmp_path / "study.toml")
    assert not (tmp_path / "study.toml").exists()
    sb.write_mesh(sb.Mesh(np.eye(4, 3), [[0, 1, 2], [3, 1, 0], [3, 2, 1], [3, 0, 2]]), tmp_path / "b.ply")
    with pytest.raises(
        sb.errors.StudyError, match=r"^b\.ply is the only mesh that can be read, and too small to decimate"
    ):
        sb.init_study(tmp_path, tmp_path / "study.toml")
    write(tmp_path / "c.ply", 1)
    with pytest.raises(sb.errors.StudyError, match="the study cannot be written there: No such file"):
        sb.init_study(tmp_path, tmp_path / "nowhere" / "study.toml")


@pytest.mark.slow
def test_the_command_writes_a_study_that_runs_and_keeps_it(tmp_path: Path) -> None:
    write(tmp_path / "original.ply", 2)
    for level in (0, 1):
        write(tmp_path / f"ball {level}.ply", level)
    done = call("init", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "family ball: 2 meshes, 20 to 80 triangles" in done.stdout
    assert done.stdout.endswith("next: sobolev-batch plan study.toml\n      sobolev-batch run study.toml\n")
    summary = sb.run(sb.Study.from_toml(tmp_path / "study.toml"), "memory://first-study.zarr", workers=1)
    assert len(summary.computed) == 3
    assert not summary.imprecise
    written = (tmp_path / "study.toml").read_text(encoding="utf-8")
    done = call("init", folder=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "error: study.toml exists already; name another file, or move it away\n"
    assert (tmp_path / "study.toml").read_text(encoding="utf-8") == written
