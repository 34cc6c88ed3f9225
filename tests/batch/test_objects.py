"""Runs of several objects: a group of the store for each, and one that cannot be carried out stops no other."""

from __future__ import annotations

import json
import shlex
import shutil
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tomli_w
import xarray as xr
import zarr
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.store.latest_run import RunRecord
from sobolev_batch.store.layout import Store
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import Lock, locked
from sobolev_batch.store.objects import Objects
from sobolev_batch.store.records import ObjectRecord, Records
from sobolev_batch.study.plan import Plan, make_plan
from sobolev_batch.tables import conclusion
from sobolev_batch.tables.conclusion import format_objects, format_verdict
from sobolev_batch.tables.convergence import format_table, tables_of
from sobolev_batch.tables.smallest import format_smallest
from tests.support.commands import call
from tests.support.stores import flip
from tests.support.studies import GONE, balls, methods_of, small_table


def study_of(objects: list[dict[str, Any]], name: str = "small") -> sb.Study:
    return sb.Study.from_table(small_table(study={"name": name}, object=objects, family=methods_of()))


LABELS = ("ico/1", "ico/2", "egg/1", "egg/2", "reference")


@pytest.fixture
def changeable(store: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(store, tmp_path / "a copy.zarr"))


@pytest.fixture(scope="module")
def store(threads: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The store of three objects, of which one has lost its reference."""
    path = tmp_path_factory.mktemp("objects") / "balls.zarr"
    summary = sb.run(study_of([*balls(a=1.0), GONE, *balls(b=1.1)]), path, threads)
    assert set(summary.computed) == {f"{name}/{label}" for name in "ab" for label in LABELS}
    assert list(summary.failed) == ["gone"]
    assert "10 computed, 0 reused, 5 failed" in str(summary)
    assert "the reference cannot be made: nowhere.ply" in summary.failed["gone"].replace(str(Path.cwd()) + "/", "")
    return path


def test_each_object_has_a_store_of_its_own(store: Path, threads: Client, tmp_path: Path) -> None:
    alone = sb.Study.from_table(study_of(balls(b=1.1)).object.table)
    sb.run(alone, tmp_path / "alone.zarr", threads)
    ours, own = (sb.table(path).drop(columns="seconds") for path in (store / "b", tmp_path / "alone.zarr"))
    assert ours.equals(own)
    tree = xr.open_datatree(store, engine="zarr", consolidated=False)
    assert tree["a/convergence"]["distance"].sizes == {"mesh": 5, "order": 2}
    assert json.loads(tree.attrs["study"])["objects"] == ["a", "gone", "b"]


def test_objects_without_tables_are_named_beside_those_of_others(store: Path) -> None:
    frame, smallest = sb.table(store), sb.smallest_below(store, "5%")
    # What all objects share, without the units in which each was computed.
    assert frame.attrs == {"reference": "reference", "left_out": ["gone"]} | {
        key: frame.attrs[key] for key in ("unit", "unit_length") if key in frame.attrs
    }
    assert smallest.attrs == {"reference": "reference", "below": 0.05, "left_out": ["gone"]}
    texts = (
        format_table(store),
        format_verdict(store),
        format_objects(store),
        format_smallest(store, "text", None, below=0.05),
    )
    for text in texts:
        assert text.count("1 of 3 objects is left out, without tables: gone.") == 1
    assert "left_out" not in sb.table(store / "a").attrs
    assert "left out" not in format_smallest(store / "a", "text", None, below=0.05)


def test_what_is_damaged_is_named_with_its_object(changeable: Path) -> None:
    sound = sb.verify(changeable)
    assert (sound.is_sound, sound.complete, sound.total) == (True, 10, 10)
    assert {name: one.total for name, one in sound.objects.items()} == {"a": 5, "gone": 0, "b": 5}
    flip(changeable / "b/fourier/fourier/c/1/0/0/0")
    done = call("verify", changeable)
    assert done.returncode == 1
    *objects, damaged, last = done.stdout.splitlines()
    assert objects == [
        "a: 5 of 5 surfaces complete, their fields read back",
        "gone: it has no results yet",
        "b: 5 of 5 surfaces complete, their fields read back",
    ]
    assert damaged.startswith("b/ico/2: ")
    assert last == "damaged: 1 surface and 0 arrays of tables; run the study again to repair it"


def test_damage_that_is_found_in_one_object_is_repaired_by_a_run_of_all(changeable: Path, threads: Client) -> None:
    flip(changeable / "b/fourier/fourier/c/1/0/0/0")
    assert list(sb.verify(changeable / "b").fields) == ["ico/2"]
    assert sb.run(study_of([*balls(a=1.0), GONE, *balls(b=1.1)]), changeable, threads).computed == ("b/ico/2",)
    assert sb.verify(changeable).is_sound


def test_objects_that_were_altered_or_traded_are_damage(changeable: Path) -> None:
    before, root = sb.table(changeable), changeable / "zarr.json"
    for damaged in ("", root.read_text().replace(r"\"objects\": [\"a\", ", r"\"objects\": [\"../a\", ")):
        root.write_text(damaged)
        with pytest.raises(sb.errors.DamageError):
            sb.status(changeable)
        Objects.prepared(Location.parse(changeable), study_of([*balls(a=1.0), GONE, *balls(b=1.1)]))
        pd.testing.assert_frame_equal(sb.table(changeable), before)
    for names in (("a", "other"), ("b", "a"), ("other", "b")):
        (changeable / names[0]).rename(changeable / names[1])
    require_named_damage(changeable, ["a", "b"], "not that of the object 'a'")


def test_tables_of_all_that_another_program_wrote_are_made_again(changeable: Path, threads: Client) -> None:
    before, root = sb.table(changeable), changeable / "zarr.json"
    # As some versions of xarray store booleans.
    root.write_text(root.read_text().replace('"data_type": "bool"', '"data_type": "int8"'))
    assert sb.status(changeable).complete == 10
    assert call("verify", changeable).returncode in (0, 1)
    for command in ("prune", "unlock"):
        assert call(command, changeable).returncode == 0
    assert sb.run(study_of([*balls(a=1.0), GONE, *balls(b=1.1)]), changeable, threads).computed == ()
    pd.testing.assert_frame_equal(sb.table(changeable), before)
    root.write_text(
        root.read_text().replace('"data_type": "bool"', '"data_type": "int8"').replace(r"[\"a\", ", r"[\"../a\", ")
    )
    with pytest.raises(sb.errors.StoreError, match=r"an object has the name '\.\./a': it holds '/'"):
        sb.status(changeable)


@pytest.mark.parametrize("text", [None, "[]"])
def test_an_object_whose_records_are_listed_no_more_is_repaired(
    text: str | None, changeable: Path, threads: Client
) -> None:
    document = changeable / "b/records/zarr.json"
    document.unlink()
    if text is not None:
        document.write_text(text)
    assert list(sb.verify(changeable).tables) == ["b/records"]
    assert sb.run(study_of([*balls(a=1.0), GONE, *balls(b=1.1)]), changeable, threads).computed == ()
    assert sb.verify(changeable).is_sound


@pytest.mark.parametrize("kind", ["array", "group", "objects", "link", "file"])
def test_what_lies_at_the_place_of_an_object_and_is_not_its_store_is_named(
    kind: str, changeable: Path, threads: Client
) -> None:
    before, place, study = sb.table(changeable), changeable / "b", study_of(balls(a=1.0, b=1.1, c=1.2))
    elsewhere = place.rename(changeable.parent / "elsewhere")
    if kind == "array":
        zarr.create_array(place, shape=(2,), dtype="float64")
    elif kind == "group":
        zarr.create_group(place)
    elif kind == "objects":
        shutil.copytree(changeable, place)
    elif kind == "link":
        place.symlink_to(elsewhere)
    else:
        place.write_text("")
    inside = {path: path.stat().st_mtime_ns for path in elsewhere.rglob("*")}
    found = sb.verify(changeable)
    assert ([*found.tables], found.objects["a"].is_sound) == (["b/zarr.json"], True)
    assert {*sb.status(changeable).failed} >= {"b"}
    assert {*sb.plan(study, changeable, threads).objects} >= {"a", "c"}
    done = sb.run(study, changeable, threads)
    assert ({label[0] for label in done.computed}, [*done.failed]) == ({"c"}, ["b"])
    assert str(place) in done.failed["b"]
    assert {path: path.stat().st_mtime_ns for path in elsewhere.rglob("*")} == inside
    shutil.rmtree(place) if kind in ("array", "group", "objects") else place.unlink()
    elsewhere.rename(place)
    assert sb.run(study, changeable, threads).computed == ()
    after = sb.table(changeable)
    pd.testing.assert_frame_equal(after[after["object"] != "c"].reset_index(drop=True), before)


def test_an_object_that_lost_its_root_is_damage(changeable: Path, threads: Client) -> None:
    before = sb.table(changeable)
    (changeable / "b/zarr.json").unlink()
    pd.testing.assert_frame_equal(sb.table(changeable), before)
    require_named_damage(changeable, ["b"], "zarr.json, the metadata at the root, is gone")
    (changeable / "zarr.json").write_text("")
    assert sb.run(study_of([*balls(a=1.0), GONE, *balls(b=1.1)]), changeable, threads).computed == ()
    pd.testing.assert_frame_equal(sb.table(changeable), before)


def test_a_root_that_is_damaged_is_made_again_beside_objects_that_the_study_has_lost(
    changeable: Path, threads: Client
) -> None:
    sb.run(study_of(balls(b=1.1)), changeable, threads)
    (changeable / "zarr.json").write_text("")
    assert sb.run(study_of(balls(b=1.1)), changeable, threads).computed == ()
    require_rows(changeable, "b")
    (changeable / "zarr.json").write_text("")
    (changeable / "a").rename(changeable / "c")
    with pytest.raises(sb.errors.StoreError, match="the folder is not empty and holds no store"):
        sb.run(study_of(balls(b=1.1)), changeable, threads)


def test_an_object_whose_store_is_gone_is_damage(changeable: Path, threads: Client) -> None:
    before, total = sb.table(changeable), sb.status(changeable).total
    shutil.rmtree(changeable / "b")
    with pytest.raises(sb.errors.DamageError, match=r"b: its store is gone, .* run the study again"):
        format_table(changeable)
    status = sb.status(changeable)
    assert ({*status.failed}, status.complete, status.total) == ({"b", "gone"}, 5, total)
    assert "its store is gone" in sb.verify(changeable).tables["b/zarr.json"]
    assert len(sb.run(study_of([*balls(a=1.0), GONE, *balls(b=1.1)]), changeable, threads).computed) == 5
    pd.testing.assert_frame_equal(sb.table(changeable).drop(columns="seconds"), before.drop(columns="seconds"))


def require_named_damage(path: Path, objects: list[str], what: str) -> None:
    """Check that no reader of all objects passes over those whose stores cannot be read."""
    with pytest.raises(sb.errors.DamageError, match=what):
        sb.table(path, -4)
    verified = sb.verify(path)
    assert [*verified.tables] == [f"{name}/zarr.json" for name in objects]
    assert what in verified.tables[f"{objects[0]}/zarr.json"]
    # Their records were withdrawn.
    status = sb.status(path)
    assert {*status.failed, *status.not_begun} == {*objects, "gone"}
    assert what in status.failed[objects[0]]


def test_tables_of_a_study_are_those_of_its_objects(store: Path) -> None:
    joined = sb.table(store, -3)
    assert joined.columns[0] == "object"
    for name, of_object in joined.groupby("object"):
        assert of_object.drop(columns="object").reset_index(drop=True).equals(sb.table(store / str(name), -3))
    text = call("table", store, "--order", "-3").stdout
    assert [text.count(part) for part in ("Object ", "Relative distances are fractions")] == [2, 1]
    assert call("table", store, "--format", "csv").stdout.startswith("object,order,mesh")
    refused = call("table", "matrix", store)
    assert refused.returncode == 2
    assert "name that of one, such as" in refused.stderr


@pytest.mark.slow
def test_a_plan_goes_on_past_an_object_that_cannot_be(tmp_path: Path) -> None:
    path = tmp_path / "study.toml"
    made = study_of([*balls(a=1.0), GONE, *balls(b=1.1)])
    plan = sb.plan(made, tmp_path / "s.zarr")
    assert list(plan.objects) == ["a", "b"]
    assert plan.objects["b"].store == str(tmp_path / "s.zarr" / "b")
    assert plan.total_bytes == 2 * plan.objects["a"].total_bytes
    assert "the reference cannot be made" in plan.refused["gone"]
    # A row for each object, and all of the one that takes longest.
    longest = max(plan.objects, key=lambda name: plan.objects[name].processor_seconds)
    rows = [line.split()[0] for line in str(plan).splitlines() if line.startswith(("a ", "b "))]
    assert sorted(rows) == ["a", "b"]
    assert rows[0] == longest
    assert f"\n{longest}:\nmemory:" in str(plan)
    assert str(plan).count("memory: ") == 1
    path.write_text(tomli_w.dumps(made.table))
    done = call("plan", path, "--store", tmp_path / "s.zarr")
    assert done.returncode == 3
    heads = [line for line in done.stdout.splitlines() if line.startswith(("a:", "gone:", "b:"))]
    assert heads[0].startswith("gone: the reference cannot be made")
    assert len(heads) == 2
    done = call("plan", path, "--store", tmp_path / "s.zarr", "--format", "json")
    table = json.loads(done.stdout)
    assert (done.returncode, list(table["objects"]), list(table["refused"])) == (3, ["a", "b"], ["gone"])
    assert table["total_bytes"] == sum(one["total_bytes"] for one in table["objects"].values())


def test_runs_tell_of_themselves_while_they_plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[bool, int, int]] = []

    def planned(*arguments: Any) -> Plan:
        status = sb.status("memory://planned.zarr")
        seen.append((status.going_on, status.complete, status.waiting))
        return make_plan(*arguments)

    monkeypatch.setattr("sobolev_batch.store.workspace.make_plan", planned)
    sb.run(study_of([GONE, {**GONE, "name": "too"}]), "memory://planned.zarr", workers=1)
    assert [one[:2] for one in seen] == [(True, 0), (True, 0)]
    ended = sb.status("memory://planned.zarr")
    assert (ended.going_on, ended.waiting, {*ended.failed}) == (False, 0, {"gone", "too"})


def test_what_a_cluster_lacks_is_no_fault_of_its_objects(changeable: Path, threads: Client) -> None:
    before, objects = sb.table(changeable), [*balls(a=1.0), *balls(b=1.1), *balls(c=1.2)]
    of_gpu = sb.Study.from_table(
        small_table(study={"name": "small"}, object=objects, family=methods_of(), transform={"backend": "gpu"})
    )
    with pytest.raises(sb.errors.ClusterError, match="requests backend 'gpu'"):
        sb.run(of_gpu, changeable, threads)
    pd.testing.assert_frame_equal(sb.table(changeable), before)


def test_one_lock_keeps_all_objects(changeable: Path) -> None:
    with locked(Location.parse(changeable), Lock.of_this_process()):
        for use in (sb.verify, sb.unlock):
            for place in (changeable, changeable / "b"):
                with pytest.raises(sb.errors.LockError):
                    use(place)
        with pytest.raises(sb.errors.LockError, match=f"sobolev-batch unlock '{changeable}'"):
            sb.verify(changeable)
    assert sb.verify(changeable / "b").is_sound


def test_one_lock_keeps_all_objects_where_their_tables_are_damaged(changeable: Path) -> None:
    flip(changeable / "convergence/relative/c/0/0")
    with locked(Location.parse(changeable), Lock.of_this_process()):
        for use in (sb.verify, sb.unlock):
            with pytest.raises(sb.errors.LockError):
                use(changeable / "b")
    flip(changeable / "b/convergence/relative/c/0/0")
    assert not sb.verify(changeable / "b").is_sound


def test_the_status_is_that_of_the_run(changeable: Path) -> None:
    store = Store(changeable)
    ended = RunRecord.read(store)
    assert ended is not None
    ended = replace(ended, started="2020-01-01T00:00:00Z", seen="2020-01-01T00:00:00Z", error="no disk")
    replace(ended, state="failed").write(store)
    failed = sb.status(changeable)
    assert not failed.lost
    assert "the latest run failed: no disk" in str(failed)
    replace(ended, state="running").write(store)
    lost = sb.status(changeable)
    assert lost.lost
    assert f"unlock '{changeable}'" in str(lost)


def test_a_second_run_computes_what_is_new(changeable: Path, threads: Client) -> None:
    summary = sb.run(study_of(balls(a=1.0, b=1.1, c=1.2)), changeable, threads)
    assert set(summary.computed) == {f"c/{label}" for label in LABELS}
    assert summary.failed == {}
    with pytest.raises(sb.errors.StoreError, match="it holds the store of another study, 'small', not 'other'"):
        sb.run(study_of(balls(a=1.0), "other"), changeable, threads)
    # An object has no store of its own to be named or removed, and the same command would not go on.
    other = {"study": {"name": "small"}, "object": balls(a=1.0), "family": methods_of()}
    before = (changeable / "zarr.json").read_bytes()
    for change, difference in (
        ({"lattice": {"xi_max": 3.0, "M": 4}}, "a lattice of .*, not xi_max 3 and M 4"),
        ({"transform": {"dtype": "complex64"}}, "dtype 'complex128', not 'complex64'"),
        ({"lattice": None, "accuracy": {"rtol": 0.1}}, r"a lattice of xi_max \S+ and M \d+, not an accuracy"),
    ):
        message = f"{changeable}: it holds a store of another study, with {difference}. Name another store, or remove"
        with pytest.raises(sb.errors.StoreError, match=rf"^{message} this one$"):
            sb.run(sb.Study.from_table(small_table(**other, **change)), changeable, threads)
        assert (changeable / "zarr.json").read_bytes() == before


@pytest.mark.extras
def test_a_league_needs_no_more_than_the_store(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leagues = sb.league(store)
    assert [one.order for one in leagues] == [-10.0, -3.0]
    assert leagues[1].table["method"].tolist() == ["ico", "egg"]
    assert leagues[1].objects[:2] == ("a", "b")
    # A tree that is open is a mapping too, whose groups are no objects.
    assert [repr(one) for one in sb.league(sb.open_store(store))] == [repr(one) for one in leagues]
    frame = sb.compare_studies(store, store, -3)
    assert frame["ratio"].tolist() == [1.0, 1.0]
    with pytest.raises(sb.errors.StoreError, match="it does not exist"):
        sb.compare_studies(store, store / "no.zarr")
    assert set(frame["verdict"]) == {"undecided"}
    # Twice as many triangles are worse, at all orders alike; the exit status says so.
    more = sb.open_store(store / "a").load()
    more["meshes"] = xr.DataTree(more["meshes"].to_dataset().assign_coords(triangles=2 * more["meshes"]["triangles"]))
    frame = sb.compare_studies({"a": more}, {"a": store / "a"}, y=("relative", "triangles"))
    grown = frame[frame["y"] == "triangles"].set_index("method")["ratio"].to_dict()
    assert (len(frame), grown) == (6, {"ico": pytest.approx(2.0), "egg": pytest.approx(2.0)})
    with monkeypatch.context() as patched:
        patched.setattr("sobolev_batch.extras.leagues.changes.compare_studies", lambda *_, **__: frame)
        for words, status in (([], 0), (["--most", "2.1"], 0), (["--most", "1.05"], 1)):
            done = call("table", "league", store, "--against", store, *words)
            assert (done.returncode, "egg: triangles grew 2 times in the mean" in done.stderr) == (status, bool(status))
        frame.attrs["lost"] = ("a/ico/1",)
        done = call("table", "league", store, "--against", store)
        assert (done.returncode, "a/ico/1 is in the old study, and missing in the new one." in done.stdout) == (1, True)
        frame.attrs["lost"] = ()
        frame.loc[0, "verdict"] = "farther"
        assert call("table", "league", store, "--against", store).returncode == 1
    # What an earlier study has and a new one lacks.
    one, both = {"a": store / "a"}, {"a": store / "a", "b": store / "b"}
    assert sb.compare_studies(one, both, -3).attrs["lost"] == ("b (all of it)",)
    assert sb.compare_studies(both, one, -3).attrs["lost"] == ()
    convergence = more["convergence"].to_dataset()
    known = convergence["relative_error"].where(convergence["mesh"] != "ico/1")
    more["convergence"] = xr.DataTree(convergence.assign(relative_error=known))
    # An error that nothing bounds leaves the interval open.
    changes = sb.compare_studies({"a": more}, one, -3).set_index("method")
    assert changes.loc["ico", ["low", "high"]].tolist() == [0.0, np.inf]
    # An object that both studies reproduce up to rounding has not changed, and hides no change of others.
    tiny = {"relative": 0 * known + 1e-6, "relative_error": 0 * known.fillna(0) + 1e-5}
    cube, grown = sb.open_store(store / "b").load(), sb.open_store(store / "a").load()
    cube["convergence"] = xr.DataTree(cube["convergence"].to_dataset().assign(tiny))
    grown["convergence"] = xr.DataTree(convergence.assign(relative=2 * convergence["relative"]))
    changes = sb.compare_studies({"a": grown, "b": cube}, {"a": store / "a", "b": cube}, -3).set_index("method")
    assert np.isfinite(changes.loc["egg", ["low", "high"]].astype(float)).all()
    more["convergence"] = xr.DataTree(convergence.where(convergence["mesh"] != "ico/1"))
    assert sb.compare_studies({"a": more}, one, -3).attrs["lost"] == ("a/ico/1",)
    of_eggs = sb.compare_studies({"a": more}, one, -3, methods="egg")
    assert (of_eggs["method"].tolist(), of_eggs.attrs["lost"]) == (["egg"], ())
    with pytest.raises(sb.errors.InputError, match="no method is named 'icos'; known are ico, egg"):
        sb.compare_studies(one, one, methods=["icos"])
    with pytest.raises(sb.errors.StoreError, match="does not hold several objects"):
        sb.league(store / "a")
    with pytest.raises(sb.errors.StoreError, match="nowhere"):
        sb.league({"a": store / "a", "b": store / "nowhere"})


@pytest.mark.extras
@pytest.mark.parametrize(
    "changes",
    [{"reference": {"source": "ellipsoid", "axes": [1.0, 1.0, 0.9]}}, {"scaling": {"mode": "fixed", "scale": 0.5}}],
)
def test_other_references_and_units_are_told_apart(
    changes: dict[str, Any], store: Path, store_path: Path, threads: Client
) -> None:
    sb.run(sb.Study.from_table(small_table(family=methods_of(), **changes)), store_path, threads)
    assert len(sb.compare_studies(store_path, store_path, -3)) == 2
    with pytest.raises(sb.errors.InputError, match="different references or units"):
        sb.compare_studies(store_path, store / "a", -3)


def test_a_finished_object_costs_no_look_at_its_store(
    changeable: Path, threads: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = study_of(balls(a=1.0, b=1.1))
    sb.run(study, changeable, threads)
    looked: list[str] = []
    read = Location.read

    def counted(location: Location, key: str, most_bytes: int | None = None) -> bytes | None:
        looked.append(str(location))
        return read(location, key, most_bytes)

    monkeypatch.setattr(Location, "read", counted)
    summary = sb.run(study, changeable)
    assert set(summary.reused) == {f"{name}/{label}" for name in "ab" for label in LABELS}
    assert not [place for place in looked if place != str(changeable)]
    assert sb.status(changeable).complete == 10
    # What another version of a file or of the study would change is computed again, and what was removed.
    shutil.rmtree(changeable / "b")
    assert {label[0] for label in sb.run(study, changeable, threads).computed} == {"b"}


def test_rows_for_programs_open_no_store_of_an_object(changeable: Path) -> None:
    for name in "ab":
        shutil.rmtree(changeable / name)
    rows = pd.read_csv(StringIO(format_table(changeable, "csv")))
    assert rows["object"].drop_duplicates().tolist() == ["a", "b"]


def test_objects_come_and_go(changeable: Path, threads: Client) -> None:
    sb.run(study_of(balls(b=1.1)), changeable, threads)
    assert sb.status(changeable).total == 5
    back = sb.run(study_of(balls(d=1.3, b=1.1, a=1.0)), changeable, threads)
    assert {label[0] for label in back.computed} == {"d"}
    assert {label[0] for label in back.reused} == {"a", "b"}
    assert sb.run(study_of(balls(b=1.1)), changeable, threads).computed == ()
    (changeable / "notes").mkdir()
    zarr.create_group(changeable / "foreign")
    shutil.copytree(changeable / "b", changeable / "copy of b")
    for theirs in "a", "":
        # What somebody keeps in the store of an object is not removed with it.
        (changeable / "d" / "notes.txt").touch() if theirs else (changeable / "d" / "notes.txt").unlink()
        done = call("prune", changeable, "--yes")
        assert done.stdout.startswith("objects that are no longer in the study: ")
        assert ("notes.txt in it is not the store's" in done.stderr) == bool(theirs)
        assert {"a", "d"} & {path.name for path in changeable.iterdir()} == ({"d"} if theirs else set())
    assert all((changeable / name).is_dir() for name in ("notes", "foreign", "copy of b"))
    assert sb.verify(changeable).is_sound
    with pytest.raises(sb.errors.StoreError, match="the store of several objects; name that of one"):
        sb.run(sb.Study.from_table(small_table()), changeable, threads)


def require_rows(path: Path, *names: str) -> None:
    """Check that plain xarray finds the rows of these objects at the root, in this order, as the objects have them."""
    dataset = xr.open_dataset(path, group="convergence", engine="zarr")
    assert list(dict.fromkeys(dataset["object"].values.tolist())) == list(names)
    for name in names:
        own = xr.open_dataset(path / name, group="convergence", engine="zarr")
        found = dataset.isel(mesh=np.flatnonzero(dataset["object"] == name))
        assert found["mesh"].values.tolist() == [f"{name}/{label}" for label in own["mesh"].values]
        for variable in ("distance", "error_part", "triangles", "family"):
            np.testing.assert_array_equal(found[variable].values, own[variable].values)


def test_the_root_has_the_rows_of_all_objects(changeable: Path, threads: Client) -> None:
    """Whatever objects came, went, changed places, or were computed again."""
    sb.run(study_of(balls(a=1.0, b=1.1)), changeable, threads)
    require_rows(changeable, "a", "b")
    sb.run(study_of(balls(b=1.1, d=1.2)), changeable, threads)
    require_rows(changeable, "b", "d")
    changed = study_of(balls(b=1.1, d=1.3, a=1.0))
    assert {label[0] for label in sb.run(changed, changeable, threads).computed} == {"d"}
    require_rows(changeable, "b", "d", "a")
    assert sb.run(study_of(balls(a=1.0, b=1.1, d=1.3)), changeable, threads).computed == ()
    require_rows(changeable, "a", "b", "d")
    assert sb.verify(changeable).is_sound


def test_metadata_may_be_numbers_of_one_object_and_texts_of_another(threads: Client, tmp_path: Path) -> None:
    sb.write_mesh(sb.shapes.icosphere(1), tmp_path / "ball.ply")
    for name, effort in {"a": "7.5", "b": "high", "d": "8"}.items():
        (tmp_path / f"{name}.csv").write_text(f"path,effort\nball.ply,{effort}\n")
    family = [{"name": "f", "source": "files", "meshes": "{object}.csv"}]
    table = small_table(object=balls(a=1.0, b=1.1, c=1.2, d=1.3), family=family)
    (tmp_path / "c.csv").write_text("path\nball.ply\n")
    sb.run(sb.Study.from_table(table, folder=tmp_path), tmp_path / "s.zarr", threads)
    rows = xr.open_dataset(tmp_path / "s.zarr", group="convergence", engine="zarr")
    assert rows["effort"].values.tolist() == ["7.5", "", "high", "", "", "", "8", ""]
    assert sb.table(tmp_path / "s.zarr/a")["effort"].dtype == float


def test_a_run_that_was_killed_before_the_tables_of_all_goes_on(
    changeable: Path, threads: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = study_of(balls(a=1.05, e=1.25, b=1.1))

    def killed(*arguments: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("sobolev_batch.batch.run.write_all", killed)
        with pytest.raises(KeyboardInterrupt):
            sb.run(study, changeable, threads)
    # Rows of a at other orders would be those of another state than its rows at the root.
    assert set(sb.table(changeable, -5.0)["object"]) == {"b"}
    # Nor does what it left between a file and its name, or listed no more, stay for ever.
    partial = f"zarr.{32 * '0'}.partial"
    leftovers = [changeable / name for name in (partial, f"meshes/{partial}", "proximity/zarr.json")]
    for path in leftovers:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    assert sb.run(study, changeable, threads).computed == ()
    require_rows(changeable, "a", "e", "b")
    assert not any(path.exists() for path in leftovers)


def test_a_change_that_is_taken_back_after_an_interrupted_run_leaves_no_trace(
    changeable: Path, threads: Client
) -> None:
    study = study_of(balls(a=1.0, b=1.1))
    sb.run(study, changeable, threads)

    def interrupt(progress: Progress) -> None:
        if progress.stage == "fields" and progress.done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sb.run(study_of(balls(a=1.3, b=1.1)), changeable, threads, on_progress=interrupt)
    assert {label[0] for label in sb.run(study, changeable, threads).computed} == {"a"}
    require_rows(changeable, "a", "b")


def test_records_of_objects_that_changed_are_written_no_more_often_than_is_safe(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path, keys, write = "memory://written records.zarr", list[bool](), Records.write

    def counted(records: Records[Any], row: int, record: Any) -> None:
        if isinstance(record, ObjectRecord):
            keys.append(bool(record.key))
        write(records, row, record)

    sb.run(study_of(balls(a=1.0, b=1.1)), path)
    monkeypatch.setattr(Records, "write", counted)
    sb.run(study_of(balls(a=1.05, b=1.1)), path)
    # Before it is begun, and before its rows are at the root; then the page of all has its key.
    assert keys == [False, False]
    keys.clear()
    sb.run(study_of(balls(a=1.05, b=1.1)), path)
    assert keys == []


def test_a_run_of_a_part_takes_objects_families_or_members(changeable: Path, threads: Client) -> None:
    sb.run(study_of(balls(a=1.0, b=1.1)), changeable, threads)
    before = sb.table(changeable).set_index(["object", "order", "mesh"])["distance"]
    study = study_of(balls(a=1.0, b=1.1, p=1.25, q=1.3))
    for only, computed in (
        (["p/ico"], {"p/ico/1", "p/ico/2", "p/reference"}),
        (["p"], {"p/egg/1", "p/egg/2"}),
        ("q/egg/1", {"q/egg/1", "q/reference"}),
    ):
        assert set(sb.run(study, changeable, threads, only=only).computed) == computed
    # What a run leaves out stays as it was.
    rows = sb.table(changeable).set_index(["object", "order", "mesh"])
    assert list(rows.index.unique("object")) == ["a", "b", "p", "q"]
    pd.testing.assert_series_equal(rows["distance"].loc[before.index], before)
    assert rows.loc["q", "status"].value_counts().to_dict() == {"missing": 6, "complete": 2}
    assert set(sb.run(study, changeable, threads).computed) == {"q/ico/1", "q/ico/2", "q/egg/2"}
    with pytest.raises(sb.errors.StudyError, match="no object, family or member of the study is 'r'"):
        sb.run(study, changeable, threads, only=["r"])


def test_a_part_is_found_however_its_accents_are_encoded(tmp_path: Path, threads: Client) -> None:
    composed, decomposed = "caf\u00e9", "cafe\u0301"
    table = small_table(object=balls(**{composed: 1.0}), family=methods_of(decomposed))
    study = sb.Study.from_table(table)
    for only, count in ((decomposed, 5), (f"{decomposed}/{composed}/1", 2), (f"*/{composed}/?", 3)):
        path = tmp_path / f"{count}.zarr"
        assert len(sb.run(study, path, threads, only=[only]).computed) == count


def test_a_part_that_cannot_be_listed_says_why(tmp_path: Path, threads: Client) -> None:
    files = [{"name": "scans", "source": "files", "paths": ["no/*.ply"]}]
    study = sb.Study.from_table(small_table(object=balls(a=1.0), family=files), folder=tmp_path)
    failed = sb.run(study, tmp_path / "s.zarr", threads, only=["a"]).failed
    assert "matches no file" in failed["a"]


@pytest.mark.parametrize(("orders", "kept"), [([-3.0, -10.0], "ab"), ([-4.0, -2.0], "b")])
def test_numbers_of_a_part_have_the_orders_of_its_study(
    orders: list[float], kept: str, changeable: Path, threads: Client, caplog: pytest.LogCaptureFixture
) -> None:
    """Those of the objects that it leaves out, at the root, are not taken for numbers at other orders."""
    study = study_of(balls(a=1.0, b=1.1))
    changed = sb.Study.from_table({**study.table, "norm": {"orders": orders}})
    before = sb.table(changeable).set_index(["object", "order", "mesh"])["distance"]
    sb.run(changed, changeable, threads, only=["b"])
    rows = sb.table(changeable).set_index(["object", "order", "mesh"])["distance"]
    assert rows.index.unique("object").tolist() == list(kept)
    assert ("left out lack an order" in caplog.text) == (kept == "b")
    assert rows.index.unique("order").tolist() == orders
    if kept == "ab":
        pd.testing.assert_series_equal(rows, before.loc[rows.index])
    else:
        pd.testing.assert_series_equal(
            rows.loc["b"], sb.table(changeable / "b").set_index(["order", "mesh"])["distance"]
        )
    caplog.clear()
    sb.run(changed, changeable, threads)
    require_rows(changeable, "a", "b")
    assert "left out" not in caplog.text


CARRIED = [{"name": "carried", "source": "flow", "mesh": "ball", "times": [0.1]}]


@pytest.mark.parametrize(
    ("first", "own"),
    [
        ({}, {"scaling": {"mode": "fixed", "scale": 0.5}}),
        ({}, {"transform": {"eps": 1e-7}}),
        *(
            ({"mesh": {"ball": {"source": "icosphere", "levels": [1]}}, "family": CARRIED}, own)
            for own in (
                {"mesh": {"ball": {"source": "icosphere", "levels": [2]}}},
                {"family": [CARRIED[0] | {"strength": 1.0}]},
            )
        ),
    ],
)
def test_no_table_mixes_rows_of_other_settings(
    first: dict[str, Any], own: dict[str, Any], changeable: Path, threads: Client, caplog: pytest.LogCaptureFixture
) -> None:
    objects = [{**one, "scaling": own["scaling"]} if "scaling" in own else one for one in balls(a=1.0, b=1.1)]
    study, other = (
        sb.Study.from_table({**study_of(ones).table, **first, **changes})
        for ones, changes in ((balls(a=1.0, b=1.1), {}), (objects, own))
    )
    sb.run(study, changeable, threads)
    before = sb.table(changeable).drop(columns="seconds")
    sb.run(other, changeable, threads, only=["b"])
    assert "1 objects that this run left out, such as 'a', have rows of other settings" in caplog.text
    require_rows(changeable, "b")
    assert sb.status(changeable).not_listed == ("a",)
    assert "objects without rows in the tables of all: 1, such as 'a'; run" in str(sb.status(changeable))
    # Nor do those of orders that are computed from the stores of objects.
    assert set(sb.table(changeable, -5.0)["object"]) == {"b"}
    caplog.clear()
    assert {label[0] for label in sb.run(other, changeable, threads).computed} == {"a"}
    require_rows(changeable, "a", "b")
    assert sb.status(changeable).not_listed == ()
    # What is of the same settings stays.
    sb.run(other, changeable, threads, only=["a"])
    require_rows(changeable, "a", "b")
    assert "left out" not in caplog.text
    sb.run(study, changeable, threads)
    pd.testing.assert_frame_equal(sb.table(changeable).drop(columns="seconds"), before)


def test_objects_that_a_part_with_fewer_orders_left_out_have_all_again(changeable: Path, threads: Client) -> None:
    study = study_of(balls(a=1.0, b=1.1))
    sb.run(study, changeable, threads)
    sb.run(sb.Study.from_table({**study.table, "norm": {"orders": [-3.0]}}), changeable, threads, only=["b"])
    assert sb.run(study, changeable, threads).computed == ()
    require_rows(changeable, "a", "b")


def test_a_run_of_a_part_may_be_the_first_with_other_distances(tmp_path: Path, threads: Client) -> None:
    objects = [{"name": name, "reference": {"source": "icosphere", "levels": [2]}} for name in "ab"]
    table = small_table(object=objects, family=methods_of())
    sb.run(sb.Study.from_table(table), tmp_path / "s.zarr", threads)
    sb.run(sb.Study.from_table(table | {"proximity": {"points": 50}}), tmp_path / "s.zarr", threads, only=["b"])
    assert sb.table(tmp_path / "s.zarr").groupby("object")["hausdorff"].count().to_dict() == {"a": 0, "b": 8}


def test_objects_that_no_run_has_come_to_are_not_begun(tmp_path: Path, threads: Client) -> None:
    path = tmp_path / "s.zarr"
    sb.run(study_of(balls(a=1.0, b=1.1, c=1.2)), path, threads, only=["b", "c/ico"])
    found = sb.status(path)
    assert (found.not_begun, found.failed) == (("a",), {})
    assert (found.complete, found.total, found.is_incomplete) == (8, 10, True)
    assert "8 of 10 complete, 0 failed, 2 to go; objects not begun: 1" in str(found)


def test_an_object_that_cannot_be_carried_out_hides_no_tables(store: Path, tmp_path: Path, threads: Client) -> None:
    found = sb.status(store)
    assert (found.has_tables, list(found.failed)) == (True, ["gone"])
    assert "10 of 15 complete, 5 failed, 0 to go" in str(found)
    assert "no tables" not in str(found)
    sb.run(study_of([GONE]), tmp_path / "gone.zarr", threads)
    assert "no tables yet" in str(sb.status(tmp_path / "gone.zarr"))


@pytest.mark.extras
def test_stores_without_an_object_in_common_are_not_compared(store: Path, tmp_path: Path, threads: Client) -> None:
    sb.run(study_of([GONE]), tmp_path / "gone.zarr", threads)
    with pytest.raises(sb.errors.InputError, match=r"the new one has \['a'\], the old one \[\]"):
        sb.compare_studies({"a": store / "a"}, tmp_path / "gone.zarr")


@pytest.mark.parametrize("left", [{}, {"b": 1.1}])
def test_no_table_has_an_object_that_could_not_be_carried_out(
    left: dict[str, float], changeable: Path, threads: Client
) -> None:
    """Its store has numbers of an earlier reference."""
    sb.run(study_of([{**GONE, "name": "a"}, *balls(**left)]), changeable, threads)
    for order in (None, -4):
        if left:
            assert sb.table(changeable, order)["object"].unique().tolist() == ["b"]
        else:
            with pytest.raises(sb.errors.InputError, match="there are no tables yet"):
                sb.table(changeable, order)


@pytest.mark.process
def test_a_run_without_any_tables_says_so_and_ends_with_status_3(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(tomli_w.dumps(study_of([GONE, {**GONE, "name": "lost"}]).table))
    done = call("run", tmp_path / "study.toml", "--store", tmp_path / "s.zarr", "--workers", "1")
    assert (done.returncode, done.stdout.startswith("no league: there are no tables yet")) == (3, True)


@pytest.mark.process
def test_a_run_of_several_objects_says_why_meshes_failed(tmp_path: Path) -> None:
    lost = {"name": "lost", "source": "files", "paths": ["nowhere.ply"]}
    table = small_table(object=[*balls(a=1.0, b=1.1), GONE], family=[*methods_of(), lost])
    (tmp_path / "study.toml").write_text(tomli_w.dumps(table))
    done = call("run", tmp_path / "study.toml", "--store", tmp_path / "s.zarr", "--workers", "1")
    told = [line for line in done.stderr.splitlines() if line.startswith("a/lost/nowhere, b/lost/nowhere: ")]
    assert (done.returncode, len(told)) == (3, 1)


def test_verdicts_and_smallest_meshes_are_those_of_each_object(store: Path) -> None:
    smallest = sb.smallest_below(store, "50%", -3.0)
    assert smallest["object"].unique().tolist() == ["a", "b"]
    verdicts = pd.read_csv(StringIO(format_verdict(store, "csv")))
    for name in "ab":
        for all_rows, own in (
            (smallest, sb.smallest_below(store / name, "50%", -3.0)),
            (verdicts, pd.read_csv(StringIO(format_verdict(store / name, "csv")))),
        ):
            rows = all_rows[all_rows["object"] == name].drop(columns="object").reset_index(drop=True)
            pd.testing.assert_frame_equal(rows, own, check_dtype=False)
        assert format_verdict(store / name) in format_verdict(store)
    text = format_smallest(store, "text", None, below=0.5)
    assert text.index("Object a") < text.index("Smallest mesh below 50 %") < text.index("Object b")


def test_the_verdict_on_many_objects_has_a_line_for_each_the_worst_first(store_path: Path, threads: Client) -> None:
    radii = {"big one": 1.2, "b": 1.0, "c": 1.1, "d": 0.5}
    sb.run(study_of(balls(**radii)), store_path, threads)
    text = format_verdict(store_path)
    assert text == format_objects(store_path)
    lines = text.splitlines()
    worst = min(radii, key=lambda name: next(n for n, line in enumerate(lines) if line.startswith(f"{name} ")))
    assert lines[-1].endswith(f": sobolev-batch table verdict {shlex.quote(f'{store_path}/{worst}')}")
    assert set(pd.read_csv(StringIO(format_verdict(store_path, "csv")))["object"]) == {*radii}


def test_objects_are_listed_from_the_worst_one(store: Path) -> None:
    rows = pd.read_csv(StringIO(format_objects(store, "csv", [-3.0])))
    assert rows["object"].tolist() == rows.sort_values("relative", ascending=False)["object"].tolist()
    table = sb.table(store, -3.0)
    for _, row in rows.iterrows():
        of_object = table[(table["object"] == row["object"]) & (table["mesh"] != "reference")]
        assert row["relative"] == pytest.approx(of_object["relative"].min(), rel=1e-14)
        assert (row["meshes"], row["missing"]) == (len(of_object), 0)
    assert f"{len(rows) - 1} more: sobolev-batch table objects {store}" in format_objects(store, most=1)
    assert "deviation" not in format_objects(store)


def test_the_largest_deviation_of_the_nearest_mesh_is_told(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = tables_of(store)
    for frame in frames.values():
        frame["hausdorff"], frame["hausdorff_upper"], frame.attrs["unit"] = frame["relative"], frame["relative"], "mm"
    monkeypatch.setattr(conclusion, "tables_of", lambda *_: frames)
    assert "; deviations are in mm" in format_objects(store)
    rows = pd.read_csv(StringIO(format_objects(store, "csv")))
    assert (rows["hausdorff"] == rows["relative"]).all()
