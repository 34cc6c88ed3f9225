"""Studies with several objects: how their objects and methods are found, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import tomli_w

import sobolev_batch as sb
from sobolev_batch.study.study import as_study
from tests.support.studies import small_table


def table(**changes: Any) -> dict[str, Any]:
    own = {
        "reference": {"source": "files", "paths": ["objects/{object}.ply"]},
        "family": [{"name": "{method}", "source": "files", "paths": ["out/{method}/{object}_*.ply"]}],
    }
    return small_table(**{**own, **changes})


ICO = [{"name": "ico", "source": "icosphere", "levels": [0]}]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = [
        *("objects/cow.ply", "objects/cow_2.ply", "objects/bee10.ply", "objects/bee9.ply"),
        *("out/quick/cow_100.ply", "out/quick/cow_200.ply", "out/quick/bee9_100.ply", "out/quick/bee10_100.ply"),
        *("out/quick/cow_2_100.ply", "out/even/cow_2_100.ply", "out/even/cow_100.ply", "out/even/bee9_100.ply"),
    ]
    for path in map(tmp_path.joinpath, made):
        path.parent.mkdir(parents=True, exist_ok=True)
        sb.write_mesh(sb.shapes.icosphere(0), path)
    return tmp_path


def methods(study: sb.Study) -> dict[str, list[str]]:
    return {name: [family.name for family in one.families] for name, one in study.objects.items()}


def files(study: sb.Study, folder: Path, name: str, method: str) -> list[str]:
    (family,) = (family for family in study.objects[name].families if family.name == method)
    return [member.name for member in family.source.members(folder)]


def test_files_give_objects_and_methods(folder: Path) -> None:
    found = sb.Study.from_table(table(), folder=folder)
    assert list(found.objects) == ["bee9", "bee10", "cow", "cow_2"]
    assert methods(found)["cow_2"] == ["even", "quick"]
    assert methods(found)["bee10"] == ["quick"]
    assert {name: one.lacking for name, one in found.objects.items() if one.lacking} == {"bee10": ("even",)}
    # One object's name begins with that of another: a file is of the longest name that fits.
    assert files(found, folder, "cow", "quick") == ["cow_100", "cow_200"]
    assert files(found, folder, "cow_2", "quick") == ["cow_2_100"]
    absolute = {"source": "files", "paths": [str(folder / "objects/{object}.ply")]}
    assert methods(sb.Study.from_table(table(reference=absolute), folder=folder)) == methods(found)


@pytest.mark.parametrize(
    ("template", "names"),
    [("{object}_{method}_80.ply", ["cow", "cow_big"]), ("{method}_{object}.ply", ["cow", "big_cow"])],
)
def test_a_file_is_of_the_object_with_the_longest_name_that_fits(
    tmp_path: Path, template: str, names: list[str]
) -> None:
    paths = {name: template.format(object=name, method="quick") for name in names}
    for path in (*paths.values(), *(f"{name}.off" for name in names)):
        sb.write_mesh(sb.shapes.icosphere(0), tmp_path / path)
    family = [{"name": "{method}", "source": "files", "paths": [template.replace("80", "*")]}]
    objects = [{"name": name} for name in names]
    references = {"source": "files", "paths": ["{object}.off"]}
    found = sb.Study.from_table(table(object=objects, family=family, reference=references), folder=tmp_path)
    assert methods(found) == {name: ["quick"] for name in names}
    assert {name: files(found, tmp_path, name, "quick") for name in names} == {
        name: [Path(path).stem] for name, path in paths.items()
    }


def test_a_star_may_follow_the_name_of_an_object(folder: Path) -> None:
    family = [{"name": "{method}", "source": "files", "paths": ["out/{method}/{object}*.ply"]}]
    found = sb.Study.from_table(table(family=family), folder=folder)
    assert files(found, folder, "cow", "even") == ["cow_100"]
    assert files(found, folder, "cow_2", "even") == ["cow_2_100"]


def test_files_of_longer_names_alone_are_no_files(folder: Path) -> None:
    (folder / "out/quick/cow_100.ply").unlink()
    (folder / "out/quick/cow_200.ply").unlink()
    family = [{"name": "quick", "source": "files", "paths": ["out/quick/{object}_*.ply"]}, *ICO]
    objects = [{"name": "cow"}, {"name": "cow_2"}]
    found = sb.Study.from_table(table(object=objects, family=family), folder=folder)
    assert {name: one.lacking for name, one in found.objects.items() if one.lacking} == {"cow": ("quick",)}
    with pytest.raises(sb.errors.StudyError, match="object 'cow': no family has a file of it"):
        sb.Study.from_table(table(object=objects, family=family[:1]), folder=folder)
    with pytest.raises(sb.errors.StudyError, match="family 'quick': no file that it names is of an object"):
        sb.Study.from_table(table(object=[{"name": "horse"}], family=family), folder=folder)


def test_objects_can_be_listed_with_references_and_scalings_of_their_own(folder: Path) -> None:
    ball = {"name": "ball", "reference": {"source": "sphere"}, "scaling": {"mode": "none"}}
    found = sb.Study.from_table(table(object=[{"name": "cow"}, ball], family=ICO), folder=folder)
    assert {name: one.scaling for name, one in found.objects.items()} == {"cow": None, "ball": sb.shapes.Similarity()}


def test_named_meshes_give_objects_too(folder: Path) -> None:
    found = sb.Study.from_table(
        table(
            mesh={"original": {"source": "files", "paths": ["objects/{object}.ply"]}},
            reference={"mesh": "original"},
            family=[{"name": "d", "source": "decimate", "mesh": "original", "triangles": [10]}],
        ),
        folder=folder,
    )
    assert methods(found) == {name: ["d"] for name in ("bee9", "bee10", "cow", "cow_2")}
    (member,) = found.objects["cow"].reference.members(folder)  # type: ignore[union-attr]
    assert member.name == "cow"


def test_a_list_gives_objects_methods_references_and_metadata(folder: Path) -> None:
    (folder / "lists").mkdir()
    (folder / "lists/meshes.csv").write_text(
        "object,method,path,method_seconds\n"
        "cow,reference,../objects/cow.ply,\ncow,quick,../out/quick/cow_100.ply,0.5\n"
        "bee,reference,../objects/bee9.ply,\nbee,quick,../out/quick/bee9_100.ply,0.25\n"
    )
    listed = small_table(objects={"meshes": "lists/meshes.csv"}, reference=None, family=None)
    found = sb.Study.from_table(listed, folder=folder)
    assert methods(found) == {"cow": ["quick"], "bee": ["quick"]}
    (member,) = found.objects["bee"].families[0].source.members(folder)
    assert member.metadata == (("method_seconds", 0.25),)
    frame = pd.DataFrame({"object": ["cow"], "method": ["quick"], "path": ["out/quick/cow_100.ply"]})
    found = sb.Study.from_table(table(objects={"meshes": frame}, family=[]), folder=folder)
    assert methods(found) == {"cow": ["quick"]}


def listed(name: str) -> dict[str, str]:
    return {"path": "a.ply", "object": name, "method": "m"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reference": {"source": "sphere"}, "object": []}, "object"),
        ({"object": 3}, "object must be a list, found 3"),
        ({"object": [{"name": 3}]}, r"\[\[object\]\] 1: name must be text in quotes, found 3"),
        ({"object": [{"name": "a/b"}]}, "holds none of|without / and"),
        ({"object": [{"name": ".a"}]}, r"does not begin with \. or __"),
        ({"object": [{"name": "cow"}, {"name": "COW"}]}, r"object: names must differ by more than case"),
        ({"object": [{"name": "cow", "colour": 1}]}, r"\[\[object\]\] 1 \(named 'cow'\): colour is unknown"),
        ({"objects": {"meshes": [{"path": "a.ply", "object": "cow"}]}}, "'a.ply' has no method"),
        ({"reference": {"source": "files", "paths": ["none/{object}.ply"]}}, "matches no file"),
        ({"reference": {"source": "files", "paths": ["{object}/{object}.ply"]}}, "one name; it stands for a part"),
        ({"norm": {"orders": [0.0]}}, r"^\[norm\]: the norm of a surface"),
        ({"object": [{"name": "cow", "scaling": {"mode": 1}}]}, r"^object 'cow': \[scaling\]: mode must be"),
        ({"objects": {"meshes": [listed("a/b")]}}, "named 'a/b'.*without / and"),
        ({"objects": {"meshes": [listed("zarr.json")]}}, r"not end with \.json"),
        (
            {"objects": {"meshes": [listed("cow"), listed("dog")]}, "object": [{"name": "cow"}]},
            r"\[objects\] lists 'dog'",
        ),
        ({"objects": 3}, "objects must be a table, found 3"),
        ({"objects": {"mesh": "a.csv"}}, r"\[objects\]: mesh must be called 'meshes'"),
        ({"family": 3}, "family must be a list, found 3"),
        ({"study": {}}, r"\[study\]: name is missing"),
        ({"reference": {"source": "sphere"}}, "a study of several objects has to name them"),
    ],
)
def test_refusals_name_the_place(folder: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(sb.errors.StudyError, match=message):
        sb.Study.from_table(table(**changes), folder=folder)


def test_a_study_file_is_read_as_what_it_is(folder: Path) -> None:
    for made, names in ((table(), ["bee9", "bee10", "cow", "cow_2"]), (small_table(), [""])):
        (folder / "study.toml").write_text(tomli_w.dumps(made))
        assert list(as_study(folder / "study.toml").objects) == names


def test_the_study_of_an_object_is_one_of_its_own(folder: Path) -> None:
    whole = sb.Study.from_table(table(), folder=folder)
    alone = whole.of_object("cow")
    again = sb.Study.from_table(alone.table, folder=folder)
    assert list(alone.object.members) == list(again.object.members)
    assert (alone.orders, again.orders, again.name) == (whole.orders, whole.orders, "small cow")
    with pytest.raises(ValueError, match="too many values"):
        _ = whole.object


@pytest.mark.parametrize(
    ("template", "path", "name"),
    [
        ("{object}_*.ply", "quadric_edge_100.ply", "quadric_edge"),
        ("a/**/{object}.ply", "a/b/c/x.ply", "x"),
        ("{object}/{object}-1.ply", "m/m-1.ply", "m"),
        ("m[0-9]/{object}.ply", "m3/y.ply", "y"),
        ("?/{object}.ply", "k/y.ply", "y"),
        ("{object}*.ply", "y_1.ply", "y_1"),
    ],
)
def test_placeholders_take_as_much_as_they_can(tmp_path: Path, template: str, path: str, name: str) -> None:
    (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / path).write_text("")
    found = sb.Study.from_table(table(reference={"source": "files", "paths": [template]}, family=ICO), folder=tmp_path)
    assert list(found.objects) == [name]


def test_a_family_may_be_of_the_mesh_with_the_name_of_the_object() -> None:
    table = {
        **small_table(reference=None),
        "mesh": {"ball": {"source": "icosphere", "levels": [2]}, "egg": {"source": "ellipsoid", "axes": [2, 1, 1]}},
        "object": [{"name": "ball", "reference": "ball"}, {"name": "egg", "reference": "egg"}],
        "family": [{"name": "carried", "source": "flow", "mesh": "{object}", "times": [0.1]}],
    }
    studies = sb.Study.from_table(table).objects
    assert {name: study.table["family"][0]["mesh"] for name, study in studies.items()} == {"ball": "ball", "egg": "egg"}
    table["family"][0]["mesh"] = "{object}s"
    with pytest.raises(sb.errors.StudyError, match="no mesh is named 'balls'; did you mean ball"):
        sb.Study.from_table(table)
