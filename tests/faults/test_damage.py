"""Stores that something else has damaged: named, never shown as data, and repaired by a run."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from distributed import Client

from sobolev_batch import DamageError, StoreError, Study, norm, open_store, run, verify
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.batch.store.store import Store
from tests.support.commands import call, write_toml
from tests.support.stores import assert_same_fields, assert_same_tables
from tests.support.studies import small_table, variable

FIELD = "fourier/fourier/c/{row}/0/0/0"


def truncate(chunk: Path) -> None:
    chunk.write_bytes(chunk.read_bytes()[:-10])


def empty(chunk: Path) -> None:
    chunk.write_bytes(b"")


def flip(chunk: Path) -> None:
    data = bytearray(chunk.read_bytes())
    data[len(data) // 3] ^= 1
    chunk.write_bytes(data)


def delete(chunk: Path) -> None:
    chunk.unlink()


def swap(chunk: Path) -> None:
    """Another mesh's field: its own checksum is right."""
    shutil.copy(chunk.parents[3] / "0/0/0/0", chunk)


def swap_octaves(chunk: Path) -> None:
    """Another mesh's values in octaves: their own checksum is right."""
    shutil.copy(chunk.parents[1] / "0/0", chunk)


DAMAGES = (truncate, empty, flip, delete, swap)
Damage = Callable[[Path], None]


@pytest.fixture
def store(finished_store: Path, store_path: Path) -> Path:
    shutil.copytree(finished_store, store_path)
    return store_path


@pytest.mark.parametrize("damage", DAMAGES)
def test_verify_names_the_mesh_and_run_repairs_it(
    damage: Damage, store: Path, study: Study, finished_store: Path, client: Client
) -> None:
    assert verify(store).is_sound
    damage(store / FIELD.format(row=2))
    found = verify(store)
    assert (list(found.fields), found.tables, found.withdrawn) == (["ico/2"], {}, True)
    assert (found.complete, found.total) == (5, 5)
    assert run(study, store, client).computed == ("ico/2",)
    assert verify(store).is_sound
    assert_same_fields(store, finished_store)
    assert_same_tables(store, finished_store)


@pytest.mark.parametrize(
    ("damage", "pairs", "row"),
    [(truncate, "all", 1), (empty, "reference", 4), (flip, "all", 4), (delete, "reference", 1), (swap, "all", 1)],
)
def test_a_reduction_names_the_mesh_and_computes_it_again(
    damage: Damage, pairs: str, row: int, store: Path, client: Client, caplog: pytest.LogCaptureFixture
) -> None:
    damage(store / FIELD.format(row=row))
    label = ("ico/1", "reference")[row == 4]
    # New orders need all fields and no transform.
    study = Study.from_table(small_table(norm={"orders": [-4.0], "pairs": pairs}))
    assert run(study, store, client).computed == (label,)
    assert f"the field of {label} is damaged" in caplog.text
    tree = open_store(store)
    assert np.isfinite(variable(tree, "convergence", "distance").values).all()
    assert verify(store).is_sound


@pytest.mark.parametrize("damage", [truncate, delete])
def test_a_run_with_nothing_to_do_sees_what_is_missing(
    damage: Damage, store: Path, study: Study, client: Client
) -> None:
    damage(store / FIELD.format(row=3))
    assert run(study, store, client).computed == ("ico/3",)


@pytest.mark.parametrize("damage", [empty, delete])
def test_a_run_with_nothing_to_do_sees_what_tables_lack(
    damage: Damage, store: Path, study: Study, finished_store: Path, client: Client
) -> None:
    damage(store / "convergence/distance/c/0/0")
    assert run(study, store, client).computed == ()
    assert_same_tables(store, finished_store)


def test_what_is_damaged_again_and_again_ends_the_run(
    store: Path, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ruin(progress: object) -> None:
        flip(store / FIELD.format(row=1))

    study = Study.from_table(small_table(norm={"orders": [-4.0]}))
    with pytest.raises(DamageError, match="the field of ico/1 is damaged"):
        run(study, store, client, on_progress=lambda p: ruin(p) if p.stage == "reduction" and not p.done else None)


@pytest.mark.parametrize(
    ("damage", "name"),
    [
        (truncate, "convergence/distance/c/0/0"),
        (empty, "meshes/status/c/0"),
        (flip, "meshes/triangles/c/0"),
        (delete, "distances/error/c/0/0/0"),
    ],
)
def test_tables_are_never_read_damaged(
    damage: Damage, name: str, store: Path, study: Study, finished_store: Path, client: Client
) -> None:
    damage(store / name)
    with pytest.raises((DamageError, ValueError)):
        load(store)
    found = verify(store)
    assert list(found.tables) == [name.partition("/c/")[0]]
    # Until they are made anew, there are none.
    assert "convergence" not in open_store(store).children
    assert run(study, store, client).computed == ()
    assert_same_tables(store, finished_store)
    assert verify(store).is_sound


@pytest.mark.parametrize("damage", [flip, delete])
def test_coordinates_are_written_again(
    damage: Damage, store: Path, study: Study, finished_store: Path, client: Client
) -> None:
    damage(store / "fourier/xi_x/c/0")
    assert list(verify(store).tables) == ["fourier/xi_x"]
    run(study, store, client)
    assert verify(store).is_sound
    assert_same_fields(store, finished_store)


@pytest.mark.parametrize("damage", [truncate, empty, flip, delete])
def test_a_damaged_record_counts_as_none(damage: Damage, store: Path, study: Study, client: Client) -> None:
    damage(store / "records/record/c/2")
    found = verify(store)
    assert list(found.fields) == ["ico/2"]
    assert found.complete == 4
    assert run(study, store, client).computed == ("ico/2",)
    assert verify(store).is_sound


@pytest.mark.parametrize("damage", [flip, delete])
def test_labels_come_from_the_table_of_meshes(
    damage: Damage, store: Path, study: Study, finished_store: Path, client: Client
) -> None:
    damage(store / "fourier/mesh/c/0")
    assert list(verify(store).tables) == ["fourier/mesh"]
    assert run(study, store, client).computed == ()
    assert verify(store).is_sound
    assert_same_fields(store, finished_store)
    # Without that table, nothing says which field is whose.
    damage(store / "fourier/mesh/c/0")
    damage(store / "meshes/mesh/c/0")
    for use in (verify, lambda place: run(study, place, client)):
        with pytest.raises(StoreError, match="fourier/mesh is damaged, and nothing else says which field is whose"):
            use(store)


def test_labels_that_an_extension_has_added(store: Path, client: Client) -> None:
    more = [{"name": "ico", "source": "icosphere", "levels": [0, 1, 2, 3, 4]}]
    study = Study.from_table(small_table(family=more))
    assert run(study, store, client).computed == ("ico/4",)
    for name in ("fourier/mesh", "fourier/quality"):
        delete(store / name / "c/1")
        assert list(verify(store).tables) == [name]
        assert run(study, store, client).computed == ()
        assert verify(store).is_sound


@pytest.mark.parametrize("damage", [truncate, empty])
def test_what_errors_hang_on_is_written_again(damage: Damage, store: Path, study: Study, client: Client) -> None:
    damage(store / "fourier/quality/c/0")
    assert list(verify(store).tables) == ["fourier/quality"]
    assert run(study, store, client).computed == ()
    assert verify(store).is_sound
    field = variable(open_store(store), "fourier", "fourier").sel(mesh="ico/2")
    assert np.isfinite(norm(field, -3.0)["error"].item())


def test_sparse_chunks_and_stray_links(store: Path) -> None:
    os.truncate(store / FIELD.format(row=2), 1 << 42)
    (store / "norms" / ".#lock").symlink_to("/nonexistent")
    assert verify(store).fields == {"ico/2": "it is not there, or of another length"}


def test_fields_that_are_replaced_are_not_described_any_more(store: Path, tmp_path: Path, client: Client) -> None:
    """A driver that is killed after a field and before the tables."""

    def stop(progress: Progress) -> None:
        if progress.stage == "fields" and progress.done == 1:
            raise KeyboardInterrupt

    study = Study.from_table(small_table(transform={"eps": 1e-7}))
    with pytest.raises(KeyboardInterrupt):
        run(study, store, client, on_progress=stop)
    tree = open_store(store)
    assert "convergence" not in tree.children
    qualities = tree["fourier"].to_dataset()["quality"].values.tolist()
    assert qualities == [""] * 5
    assert run(study, store, client).failed == {}
    assert verify(store).is_sound


@pytest.mark.parametrize("damage", [truncate, empty, delete])
def test_damaged_metadata_are_said(damage: Damage, store: Path, study: Study, threads: Client) -> None:
    damage(store / "zarr.json")
    for use in (Store.open, open_store):
        with pytest.raises(StoreError, match=r"results\.zarr: .*no store of a study is there"):
            use(store)
    if damage is delete:
        with pytest.raises(StoreError, match=r"results\.zarr: .*holds no store"):
            run(study, store, threads)


def load(store: Path) -> None:
    for node in open_store(store).subtree:
        node.to_dataset().load()


def test_a_field_of_zeros_is_one(store: Path, study: Study, client: Client) -> None:
    there = Store.open(store)
    (place,) = there.block_slices()
    record = there.read_record(1)
    assert record is not None
    zeros = np.zeros([part.stop for part in place], dtype=complex)
    checksum = there.write_field(1, place, zeros)
    there.write_record(1, replace(record, checksums=(checksum,)))
    assert verify(store).is_sound
    assert run(study, store, client).computed == ()
    assert (there.read_fields([1], place, [checksum]) == 0).all()


def test_the_command_says_what_is_damaged(store: Path, tmp_path: Path) -> None:
    sound = call("verify", store)
    assert (sound.returncode, sound.stdout.splitlines()[-1]) == (0, "nothing is damaged")
    flip(store / FIELD.format(row=2))
    flip(store / "norms/norm/c/0/0")
    found = call("verify", store)
    assert found.returncode == 1
    assert found.stdout.splitlines()[1].startswith("ico/2: ")
    assert found.stdout.splitlines()[2].startswith("table norms/norm: ")
    assert (
        found.stdout.splitlines()[3]
        == "1 surfaces and 1 arrays of tables are damaged; run the study again to repair it"
    )
    assert call("run", write_toml(tmp_path), "--store", store, "--workers", "1").returncode == 0
    assert call("verify", store).returncode == 0
