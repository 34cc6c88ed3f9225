"""Lists of meshes with metadata: CSV files, tables of a study, DataFrames."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.batch.prune import prune
from sobolev_batch.errors import StudyError
from sobolev_batch.sources.files import FileMember, FileSource, read_mesh_list
from sobolev_batch.store.location import Location
from tests.support.studies import small_table


def members(meshes: Any, folder: Path) -> list[FileMember]:
    found = FileSource(meshes=meshes).members(folder)
    return [member for member in found if isinstance(member, FileMember)]


def test_a_csv_file_gives_paths_names_times_and_metadata(tmp_path: Path) -> None:
    (tmp_path / "lists").mkdir()
    # As spreadsheets write it: a byte order mark, blanks, and cells that say nothing.
    (tmp_path / "lists/meshes.csv").write_text(
        "\ufeffpath, name, time, tool, method_seconds, note\na.ply, 007, 0.5, QEM, 3.5,\n../b.obj, , , 5, , 12\n",
        encoding="utf-8",
    )
    first, second = members("lists/meshes.csv", tmp_path)
    assert (first.name, first.time, first.path) == ("007", 0.5, tmp_path / "lists/a.ply")
    assert first.metadata == (("tool", "QEM"), ("method_seconds", 3.5))
    assert (second.name, second.time) == ("b", None)
    # A column with one text is of texts.
    assert second.metadata == (("tool", "5"), ("note", 12.0))
    assert second.path.resolve() == (tmp_path / "b.obj").resolve()


def test_tables_of_a_study_keep_their_order(tmp_path: Path) -> None:
    found = members([{"path": "b.ply", "seconds_of_method": 2}, {"path": "a.ply", "name": "x"}], tmp_path)
    assert [(member.name, member.metadata) for member in found] == [("b", (("seconds_of_method", 2.0),)), ("x", ())]
    for second in ({"path": "b.ply", "name": "a"}, {"path": "a.ply", "tool": 2}):
        with pytest.raises(StudyError, match="several are named 'a'"):
            members([{"path": "a.ply", "tool": 1}, second], tmp_path)


@pytest.mark.parametrize(
    ("meshes", "message"),
    [
        ([{"paths": "a.ply"}], "each mesh needs a path"),
        ([{"path": "a.ply", "name": " x"}], "which is no label: it begins or ends with a blank"),
        ([{"path": "a.ply", "time": "soon"}], "has the time 'soon'; a time is a number"),
        ([{"path": "a.ply", "colour": [1, 2]}], "colour of 'a.ply' must be a number or a line of text"),
        ([{"path": "http://host/a.ply"}], "'http://host/a.ply' is a URL, and meshes are read from files"),
        ([{"path": "a.ply", "a/b": 1}], "'a/b' cannot name metadata: it holds '/'"),
        ([], "must be the path of a CSV file"),
        (["a.ply"], "must be the path of a CSV file"),
    ],
)
def test_refused_lists_say_what_was_found(meshes: Any, message: str) -> None:
    table = small_table(family=[{"name": "f", "source": "files", "meshes": meshes}])
    with pytest.raises(StudyError, match=message):
        sb.Study.from_table(table)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("file,tool\na.ply,x\n", "needs a column path"),
        ("path\n", "a line for each mesh; found 0 lines"),
        ("", "cannot be read"),
        ('path\n"a\n', "cannot be read"),
        ("path,tool\n,x\n", "each mesh needs a path"),
        ("tool,path\nx,a.ply,1.5\n", "cannot be read: .*Expected 2 fields in line 2, saw 3"),
        ("path,tool,path\na.ply,x,b.ply\n", "has the column 'path' twice"),
        ("path,time\na.ply,0\nb.ply,x\n", "'b.ply' has the time 'x'; a time is a number"),
    ],
)
def test_csv_files_that_are_no_lists_are_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "meshes.csv").write_text(text)
    with pytest.raises(StudyError, match=f"'meshes.csv'.*{message}"):
        read_mesh_list(tmp_path / "meshes.csv")


def test_a_frame_loses_nothing() -> None:
    times, tiny = [1.23e-11, 2e-11], [3e-13, 1 / 3]
    day = pd.Timestamp("2026-01-31")
    paths = [Path("a.ply"), Path("b.ply")]
    frame = pd.DataFrame({"path": paths, "time": times, "tiny": tiny, "day": [day, pd.NaT], "name": [1234567, 8]})
    study = sb.Study.from_table(small_table(family=[{"name": "f", "source": "files", "meshes": frame}]))
    found = study.object.families[0].source.members(Path())
    assert [member.name for member in found] == ["1234567", "8"]
    assert [member.time for member in found] == times
    assert [dict(member.metadata)["tiny"] for member in found] == tiny
    assert [dict(member.metadata).get("day") for member in found] == ["2026-01-31T00:00:00", None]
    twice = pd.DataFrame([["a.ply", "b.ply"]], columns=["path", "path"])
    with pytest.raises(StudyError, match="has the column 'path' twice"):
        sb.Study.from_table(small_table(family=[{"name": "f", "source": "files", "meshes": twice}]))


@pytest.mark.slow
def test_metadata_become_coordinates_and_columns(tmp_path: Path) -> None:
    for level in (0, 1):
        sb.write_mesh(sb.shapes.icosphere(level), tmp_path / f"{level}.ply")
    frame = pd.DataFrame({"path": ["0.ply", "1.ply"], "effort": [1.0, 4.0], "tool": ["a", None]})
    study = sb.Study.from_table(
        small_table(family=[{"name": "f", "source": "files", "meshes": frame}]), folder=tmp_path
    )
    sb.run(study, "memory://mesh-lists.zarr", workers=1)
    convergence = sb.open_store("memory://mesh-lists.zarr")["convergence"].to_dataset()
    assert convergence["tool"].sel(mesh=["f/0", "f/1"]).values.tolist() == ["a", ""]
    np.testing.assert_array_equal(convergence["effort"], [1.0, 4.0, np.nan])
    assert sb.table("memory://mesh-lists.zarr", -3)["effort"].tolist() == [1.0, 4.0]


NAMES = ["tool seconds", "weight [kg]", "50%", "größe", "c", "a*b", "x?y#z", "<b>'&", "coordinates", "index"]


@pytest.mark.slow
def test_every_name_of_metadata_that_a_run_takes_is_read_by_all(tmp_path: Path, threads: Client) -> None:
    sb.write_mesh(sb.shapes.icosphere(1), tmp_path / "a.ply")
    meshes = [{"path": "a.ply", **dict.fromkeys(NAMES, 1.5), "in words": "a b"}]
    table = small_table(object=[{"name": "q%"}, {"name": "ü b"}], family=[_listed(meshes)])
    store = tmp_path / "x.zarr"
    sb.run(sb.Study.from_table(table, folder=tmp_path), store, threads)
    for place in (store, store / "q%"):
        assert sb.status(place).complete
        assert sb.verify(place).is_sound
        rows, frame = sb.open_store(place)["convergence"].to_dataset(), sb.table(place)
        for name in NAMES:
            assert (rows.coords[name].dims, 1.5 in rows[name].values) == (("mesh",), True)
            assert 1.5 in frame[name].tolist()
        assert "a b" in rows.coords["in words"].values
    assert not any(prune(Location.parse(store / "q%")).values())
    assert "tool seconds" in xr.open_dataset(store, group="convergence", engine="zarr").variables


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({".x": 1}, "it begins with ."),
        ({"__x": 1}, "it begins with __"),
        ({"zarr.json": 1}, "it ends with .json"),
        ({"😀" * 80: 1}, "it has 320 bytes, 255 are allowed"),
        ({"Family": 1}, "tables use that themselves"),
        ({"tool": 1, "Tool": 2}, "differ in case alone"),
    ],
)
def test_names_that_a_store_cannot_hold_are_refused_first(
    metadata: dict[str, Any], message: str, tmp_path: Path
) -> None:
    sb.write_mesh(sb.shapes.icosphere(1), tmp_path / "a.ply")
    table = small_table(family=[_listed([{"path": "a.ply", **metadata}])])
    with pytest.raises(StudyError, match=re.escape(message)):
        sb.run(sb.Study.from_table(table, folder=tmp_path), tmp_path / "x.zarr", workers=1)
    assert not (tmp_path / "x.zarr").exists()


def _listed(meshes: list[dict[str, Any]]) -> dict[str, Any]:
    return {"name": "f", "source": "files", "meshes": meshes}


def test_metadata_cannot_take_the_name_of_a_variable_of_tables(finished_store: Path, tmp_path: Path) -> None:
    tree = sb.open_store(finished_store)
    groups = [tree[name].to_dataset() for name in ("meshes", "norms", "distances", "convergence")]
    taken = {str(name) for group in groups for name in group.variables}
    sb.write_mesh(sb.shapes.icosphere(0), tmp_path / "a.ply")
    for name in taken - {"name", "time"}:
        meshes = [{"path": "a.ply", name: 1.0}]
        study = sb.Study.from_table(
            small_table(family=[{"name": "f", "source": "files", "meshes": meshes}]), folder=tmp_path
        )
        with pytest.raises(StudyError, match=f"have the name '{name}': tables use that"):
            sb.plan(study, "memory://nowhere.zarr")
