"""Stores that something else has damaged: named, never shown as data, and mended by a run."""

from __future__ import annotations

import json
import operator
import os
import shutil
from collections.abc import Callable, Iterator
from functools import partial, reduce
from pathlib import Path

import google_crc32c
import numpy as np
import pytest
from distributed import Client

from sobolev_batch import Study, matrix, norm, open_store, run, status, verify
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.errors import DamageError, StoreError
from sobolev_batch.store.latest_run import RunRecord
from sobolev_batch.store.layout import Store
from sobolev_batch.store.lock import utc_now
from sobolev_batch.tables.store_accessor import StoreAccessor
from tests.faults.conftest import LABELS
from tests.support.commands import call, write_toml
from tests.support.stores import assert_same_results, contents, delete, empty, flip, put_back, truncate
from tests.support.studies import small_table, variable

FIELD, RECORD = "fourier/fourier/c/{row}/0/0/0", "records/record/c/{row}"


def swap(chunk: Path) -> None:
    """Another mesh's field: its own checksum is right."""
    shutil.copy(chunk.parents[3] / "0/0/0/0", chunk)


Damage = Callable[[Path], None]
# Of a store and an earlier state of it.
Change = Callable[[Path, Path], None]


def at(key: str, damage: Damage) -> Change:
    return lambda store, earlier: damage(store / key)


def exchange(one: str, other: str) -> Change:
    def change(store: Path, earlier: Path) -> None:
        before = (store / one).read_bytes()
        (store / one).write_bytes((store / other).read_bytes())
        (store / other).write_bytes(before)

    return change


def restore(*names: str) -> Change:
    """Bring keys and groups back as a backup has them."""

    def change(store: Path, earlier: Path) -> None:
        for name in names:
            if (earlier / name).is_dir():
                shutil.rmtree(store / name)
                shutil.copytree(earlier / name, store / name)
            else:
                shutil.copyfile(earlier / name, store / name)

    return change


def relabel(store: Path, earlier: Path) -> None:
    """Write labels in another order. The keys in the records say which field is whose."""
    there = Store.open(store)
    there.write("fourier/mesh", [0], there.labels()[::-1])


def trade(store: Path, earlier: Path) -> None:
    for name in (FIELD, RECORD):
        exchange(name.format(row=1), name.format(row=2))(store, earlier)
    assert status(store).lost_records == LABELS[1:3]


SMALL: list[tuple[Damage, str]] = [
    (truncate, "convergence/distance/c/0/0"),
    (empty, "meshes/status/c/0"),
    (flip, "meshes/triangles/c/0"),
    (delete, "distances/error/c/0/0/0"),
    (flip, "fourier/xi_x/c/0"),
    (delete, "fourier/xi_y/c/0"),
    (delete, "fourier/mesh/c/0"),
    (delete, "spectra/octave/c/0"),
    (truncate, "fourier/quality/c/0"),
]
# Changes that do not touch each other, with the meshes and the tables that `verify` then names: None for any.
GROUPS: dict[str, list[tuple[Change, tuple[str, ...], set[str] | None]]] = {
    "fields": [
        (at(FIELD.format(row=row), damage), (LABELS[row],), set())
        for row, damage in ((1, swap), (0, empty), (2, delete), (3, flip), (4, truncate))
    ],
    "tables and coordinates": [(at(key, damage), (), {key.partition("/c/")[0]}) for damage, key in SMALL],
    "in another place or of an earlier state": [
        # Of equal length.
        (exchange("distances/error_part/c/0/0/0/1", "distances/error_part/c/0/0/0/2"), (), None),
        (exchange("meshes/edge_length_mean/c/0", "meshes/area/c/0"), (), None),
        (exchange("fourier/xi_x/c/0", "convergence/edge_length/c/0"), (), None),
        (restore("convergence/distance/c/0/0"), (), None),
        (restore("fourier/quality/c/0"), (), None),
        (relabel, (), None),
    ],
    "fields of two meshes": [(exchange(FIELD.format(row=1), FIELD.format(row=2)), LABELS[1:3], set())],
    "fields and records of two meshes": [(trade, LABELS[1:3], set())],
}


@pytest.fixture(scope="module")
def sound(finished_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(finished_store, tmp_path_factory.mktemp("damage") / "results.zarr"))


@pytest.fixture
def store(sound: Path) -> Iterator[Path]:
    """A finished store, whose files are put back after the test."""
    with put_back(sound):
        yield sound


@pytest.fixture(scope="module")
def earlier(sound: Path, threads: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same store before its fields were computed again, with other keys."""
    path = Path(shutil.copytree(sound, tmp_path_factory.mktemp("earlier") / "results.zarr"))
    run(Study.from_table(small_table(transform={"eps": 1e-7})), path, threads)
    return path


@pytest.fixture
def mended(store: Path, study: Study, finished_store: Path, threads: Client) -> Callable[..., None]:
    """A check that a run computes the given meshes of the store again, and leaves nothing damaged."""

    def check(*computed: str) -> None:
        assert sorted(run(study, store, threads).computed) == sorted(computed)
        assert verify(store).is_sound
        assert status(store).lost_records == ()
        assert_same_results(store, finished_store)

    return check


@pytest.mark.parametrize("group", GROUPS)
def test_each_change_is_named_and_a_run_mends_all(
    group: str, store: Path, earlier: Path, mended: Callable[..., None]
) -> None:
    for number, (change, meshes, tables) in enumerate(GROUPS[group]):
        with put_back(store):
            change(store, earlier)
            found = verify(store)
            assert tuple(found.fields) == meshes, number
            assert set(found.tables) == tables or (tables is None and found.tables), number
            assert found.withdrawn or not meshes
            assert found.total == 5
    for change, *_ in GROUPS[group]:
        change(store, earlier)
    found = verify(store)
    damaged = {mesh for _, meshes, _ in GROUPS[group] for mesh in meshes}
    assert set(found.fields) == damaged
    assert set(found.tables) >= {name for *_, tables in GROUPS[group] for name in tables or ()}
    mended(*damaged)
    field = variable(open_store(store), "fourier", "fourier").sel(mesh="ico/2")
    assert np.isfinite(norm(field, -3.0)["error"].item())


def test_damaged_tables_are_never_read(store: Path) -> None:
    for damage, key in (*SMALL, (delete, "spectra/norm/c/0/0"), (delete, "spectra/key/c/0")):
        with put_back(store):
            damage(store / key)
            with pytest.raises(DamageError):
                [node.to_dataset().load() for node in open_store(store).subtree]


@pytest.mark.parametrize(
    ("damage", "pairs", "row"),
    [(truncate, "all", 1), (empty, "reference", 4), (flip, "all", 4), (delete, "reference", 1), (swap, "all", 1)],
)
def test_a_tabulation_names_the_mesh_and_computes_it_again(
    damage: Damage, pairs: str, row: int, store: Path, threads: Client, caplog: pytest.LogCaptureFixture
) -> None:
    damage(store / FIELD.format(row=row))
    # New orders need all fields and no transform.
    study = Study.from_table(small_table(norm={"orders": [-4.0]}, compare={"pairs": pairs}))
    assert run(study, store, threads).computed == (LABELS[row],)
    assert f"the field of {LABELS[row]} is damaged" in caplog.text
    assert np.isfinite(variable(open_store(store), "convergence", "distance").values).all()


def test_what_is_damaged_again_and_again_ends_the_run(store: Path, threads: Client) -> None:
    def ruin(progress: Progress) -> None:
        if progress.stage == "tables" and not progress.done:
            flip(store / FIELD.format(row=1))

    study = Study.from_table(small_table(norm={"orders": [-4.0]}))
    with pytest.raises(DamageError, match="the field of ico/1 is damaged"):
        run(study, store, threads, on_progress=ruin)


def test_a_damaged_record_counts_as_none(store: Path, mended: Callable[..., None]) -> None:
    for row, damage in enumerate((truncate, empty, flip, delete)):
        damage(store / RECORD.format(row=row))
    assert status(store).lost_records == LABELS[:4]
    assert "ico/2: its completion record is gone" in str(status(store))
    assert "incomplete: run the study again" in str(status(store))
    assert "done" not in str(status(store))
    assert call("status", store).returncode == 3
    found = verify(store)
    assert (tuple(found.fields), found.complete) == (LABELS[:4], 1)
    mended(*LABELS[:4])


@pytest.mark.parametrize(
    "data",
    [
        (2**32 - 1).to_bytes(4, "little") + b"\x02\x00\x00\x00{}",
        b"\x01\x00\x00\x00\xff\xff\xff\xff{}",
        b"\x01\x00\x00\x00\x02\x00\x00\x00\xff\xfe",
        b"",
    ],
    ids=["a huge count", "a huge length", "no UTF-8", "nothing"],
)
def test_texts_that_cannot_be_are_refused_before_they_take_memory(
    data: bytes, store: Path, mended: Callable[..., None]
) -> None:
    data += int(google_crc32c.value(data)).to_bytes(4, "little")
    for group, name, row in (("records", "record", 2), ("meshes", "name", 0)):
        (store / group / name / f"c/{row}").write_bytes(data)
        with pytest.raises(DamageError, match=rf"{group}/{name} is damaged"):
            variable(open_store(store), group, name).load()
    assert status(store).lost_records == ("ico/2",)
    mended("ico/2")


def test_files_larger_than_any_memory_are_named_and_made_again(store: Path, study: Study, threads: Client) -> None:
    # A stray link of an editor is no damage.
    (store / "norms" / ".#lock").symlink_to("/nonexistent")
    assert verify(store).is_sound
    (store / "norms" / ".#lock").unlink()
    sparse = [RECORD.format(row=2), "meshes/name/c/0", "fourier/mesh/c/0", "norms/norm/c/0/0", "meshes/area/zarr.json"]
    sparse.append(FIELD.format(row=2))
    for name in sparse:
        content = (store / name).read_bytes()
        os.truncate(store / name, 1 << 42)
        assert not verify(store).is_sound or status(store).lost_records, name
        (store / name).write_bytes(content)
    for name in sparse:
        os.truncate(store / name, 1 << 42)
    with pytest.raises(DamageError, match=r"results\.zarr: chunk 0 of fourier/mesh is damaged \(it has"):
        Store.open(store).labels()
    assert run(study, store, threads).computed == ("ico/2",)
    assert verify(store).is_sound


def test_an_earlier_field_with_its_record(store: Path, earlier: Path, mended: Callable[..., None]) -> None:
    bring_back = restore(FIELD.format(row=1), RECORD.format(row=1))
    bring_back(store, earlier)
    assert list(verify(store).fields) == ["ico/1"]
    bring_back(store, earlier)
    assert status(store).lost_records == ("ico/1",)
    tree = open_store(store)
    fields = StoreAccessor(tree)
    for use in (partial(matrix, tree, -3.5), partial(fields.distance, -3.0, "ico/1", "ico/2")):
        with pytest.raises(DamageError, match="the field of ico/1 is damaged"):
            use()
    assert fields.distance(-3.0, "ico/2", "ico/3")["distance"] > 0
    mended("ico/1")


def test_earlier_tables_and_root_with_newer_fields(
    store: Path, earlier: Path, finished_store: Path, mended: Callable[..., None]
) -> None:
    restore("zarr.json", "meshes", "norms", "distances", "convergence", "fourier/quality")(store, earlier)
    found = verify(store)
    assert len(found.fields) == 5
    assert "fourier/quality" in found.tables
    restore("records/record")(store, finished_store)
    mended()


@pytest.mark.parametrize("name", ["meshes/area", "fourier/fourier", "records"])
def test_metadata_of_one_node(name: str, store: Path, mended: Callable[..., None]) -> None:
    path = store / name / "zarr.json"
    content = path.read_bytes()
    other = json.dumps({**json.loads(content), "node_type": "x"}).encode()
    path.unlink()
    for damaged in (None, other, content[: len(content) // 2], bytes(len(content))):
        if damaged is not None:
            path.write_bytes(damaged)
        assert set(verify(store).tables) == {"records" if name == "records" else "zarr.json"}, damaged
    mended()


def test_metadata_where_the_last_meshes_have_no_record_yet(store: Path, mended: Callable[..., None]) -> None:
    for row in (3, 4):
        delete(store / RECORD.format(row=row))
    delete(store / "fourier/xi_x/zarr.json")
    mended(*LABELS[3:])


ROOT = "consolidated_metadata", "metadata"


@pytest.mark.parametrize(
    ("place", "value", "makes_sense"),
    [
        (("attributes", "study", "orders"), [-11.0, -3.0], True),
        (("attributes", "similarity", "scale"), 2.0, True),
        (("attributes", "study", "lattice", "M"), 18, True),
        ((*ROOT, "fourier/fourier", "shape"), [5, 18, 17, 9], True),
        (("attributes", "study", "reference"), "nobody", True),
        (("attributes", "study", "lattice"), {}, False),
        (("attributes", "similarity", "scale"), 0, False),
        ((*ROOT, "meshes/area", "fill_value"), "x", False),
        ((*ROOT, "meshes/area", "codecs"), [{"name": "bytes"}], False),
        ((*ROOT, "meshes/area", "dimension_names"), ["a", "b", "c"], False),
        ((*ROOT, "meshes/area", "data_type"), "float32", False),
        ((*ROOT, "meshes/area", "shape"), [3], False),
    ],
)
def test_metadata_at_the_root_that_were_altered(
    place: tuple[str, ...], value: object, makes_sense: bool,
    store: Path, finished_store: Path, mended: Callable[..., None],
) -> None:  # fmt: skip
    root = json.loads((store / "zarr.json").read_text())
    tables = {name: json.loads(root["attributes"][name]) for name in ("study", "similarity", "versions")}
    root["attributes"] |= tables
    node = reduce(operator.getitem, place[:-1], root)
    assert node.get(place[-1]) != value
    node[place[-1]] = value
    root["attributes"] |= {name: json.dumps(table) for name, table in tables.items()}
    (store / "zarr.json").write_text(json.dumps(root))
    if makes_sense:
        assert not verify(store).is_sound
        restore("records/record")(store, finished_store)
        mended()
    else:
        with pytest.raises(DamageError):
            open_store(store)["meshes"].to_dataset().load()
        mended()


@pytest.mark.parametrize("count", [3, 9])
@pytest.mark.parametrize("name", ["records/record", "records/page", "fourier/quality", "fourier/mesh"])
def test_numbers_of_rows_that_were_altered(name: str, count: int, store: Path, mended: Callable[..., None]) -> None:
    root = json.loads((store / "zarr.json").read_text())
    root["consolidated_metadata"]["metadata"][name]["shape"] = [count]
    (store / "zarr.json").write_text(json.dumps(root))
    for use in (Store.open, open_store, status, verify):
        with pytest.raises(DamageError, match=r"zarr\.json is damaged \(its arrays have different numbers of rows\)"):
            use(store)
    mended()


@pytest.mark.parametrize("damage", [truncate, empty, delete])
def test_a_root_that_cannot_be_read(damage: Damage, store: Path, threads: Client, mended: Callable[..., None]) -> None:
    damage(store / "zarr.json")
    for use in (Store.open, open_store, status, verify):
        with pytest.raises(DamageError, match=r"zarr\.json(, the metadata at the root,)? is (damaged|gone)"):
            use(store)
    before = contents(store)
    other = Study.from_table(small_table(transform={"eps": 1e-7}))
    with pytest.raises(StoreError, match="no field of this study is found in the store"):
        run(other, store, threads)
    assert contents(store) == before
    mended()


def test_the_record_of_a_run_that_was_altered(store: Path, study: Study, threads: Client) -> None:
    path = store / "records/zarr.json"
    written = json.loads(path.read_text())
    failed = {**written["attributes"]["run"], "state": "failed"}
    for altered in (failed, [failed], "failed"):
        path.write_text(json.dumps({**written, "attributes": {"run": altered}}))
        with pytest.raises(
            DamageError, match=r"records/zarr.json, the record of the latest run, is damaged .*run the study"
        ):
            status(store)
        assert list(verify(store).tables) == ["records"]
    RunRecord("running", "process 1", utc_now(), "25:00 o'clock").write(Store.open(store))
    with pytest.raises(DamageError, match=r"records/zarr.json, .* is damaged \(seen: .*o'clock"):
        status(store)
    assert list(verify(store).tables) == ["records"]
    run(study, store, threads)
    assert verify(store).is_sound


@pytest.mark.process
def test_the_command_says_what_is_damaged(store: Path, tmp_path: Path) -> None:
    sound = call("verify", store)
    assert (sound.returncode, sound.stdout.splitlines()[-1]) == (0, "nothing is damaged")
    flip(store / FIELD.format(row=2))
    flip(store / "norms/norm/c/0/0")
    found = call("verify", store)
    assert found.returncode == 1
    _, field, table_of_norms, last = found.stdout.splitlines()
    assert field.startswith("ico/2: ")
    assert table_of_norms.startswith("table norms/norm: ")
    assert last == "damaged: 1 surface and 1 array of tables; run the study again to repair it"
    assert call("run", write_toml(tmp_path), "--store", store, "--workers", "1").returncode == 0
    assert call("verify", store).returncode == 0
