"""Stores that something else has damaged: named, never shown as data, and repaired by a run."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import google_crc32c
import numpy as np
import pytest
from distributed import Client

from sobolev_batch import DamageError, StoreError, Study, norm, open_store, run, status, verify
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.batch.store.store import Store
from tests.faults.conftest import FIELD
from tests.support.commands import call, write_toml
from tests.support.stores import put_back
from tests.support.studies import small_table, variable


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


def load(store: Path) -> None:
    for node in open_store(store).subtree:
        node.to_dataset().load()


def test_verify_names_the_mesh_and_run_repairs_it(store: Path, mended: Callable[..., None]) -> None:
    for damage in DAMAGES:
        with put_back(store):
            damage(store / FIELD.format(row=2))
            found = verify(store)
            assert (list(found.fields), found.tables, found.withdrawn) == (["ico/2"], {}, True), damage
            assert (found.complete, found.total) == (5, 5)
    for row, damage in zip((4, 3, 2, 1), (truncate, flip, delete, swap), strict=True):
        damage(store / FIELD.format(row=row))
    assert sorted(verify(store).fields) == ["ico/1", "ico/2", "ico/3", "reference"]
    mended("ico/1", "ico/2", "ico/3", "reference")


@pytest.mark.parametrize(
    ("damage", "pairs", "row"),
    [(truncate, "all", 1), (empty, "reference", 4), (flip, "all", 4), (delete, "reference", 1), (swap, "all", 1)],
)
def test_a_reduction_names_the_mesh_and_computes_it_again(
    damage: Damage, pairs: str, row: int, store: Path, threads: Client, caplog: pytest.LogCaptureFixture
) -> None:
    damage(store / FIELD.format(row=row))
    label = ("ico/1", "reference")[row == 4]
    # New orders need all fields and no transform.
    study = Study.from_table(small_table(norm={"orders": [-4.0], "pairs": pairs}))
    assert run(study, store, threads).computed == (label,)
    assert f"the field of {label} is damaged" in caplog.text
    assert np.isfinite(variable(open_store(store), "convergence", "distance").values).all()


def test_what_is_damaged_again_and_again_ends_the_run(store: Path, threads: Client) -> None:
    def ruin(progress: Progress) -> None:
        if progress.stage == "reduction" and not progress.done:
            flip(store / FIELD.format(row=1))

    study = Study.from_table(small_table(norm={"orders": [-4.0]}))
    with pytest.raises(DamageError, match="the field of ico/1 is damaged"):
        run(study, store, threads, on_progress=ruin)


def test_a_run_with_nothing_to_do_sees_what_is_missing(store: Path, study: Study, threads: Client) -> None:
    truncate(store / FIELD.format(row=3))
    delete(store / FIELD.format(row=1))
    assert run(study, store, threads).computed == ("ico/1", "ico/3")


SMALL: list[tuple[Damage, str]] = [
    (truncate, "convergence/distance/c/0/0"),
    (empty, "meshes/status/c/0"),
    (flip, "meshes/triangles/c/0"),
    (delete, "distances/error/c/0/0/0"),
    (flip, "fourier/xi_x/c/0"),
    (delete, "fourier/xi_y/c/0"),
    (delete, "fourier/mesh/c/0"),
    (truncate, "fourier/quality/c/0"),
]


def test_tables_and_coordinates_are_named_never_read_damaged_and_made_again(
    store: Path, mended: Callable[..., None]
) -> None:
    for damage, key in SMALL:
        with put_back(store):
            damage(store / key)
            # Of a coordinate, the fill values are left.
            if damage is not delete or not key.startswith("fourier/"):
                with pytest.raises(DamageError):
                    load(store)
            assert list(verify(store).tables) == [key.partition("/c/")[0]]
    for damage, key in SMALL:
        damage(store / key)
    assert set(verify(store).tables) == {key.partition("/c/")[0] for _, key in SMALL}
    mended()
    field = variable(open_store(store), "fourier", "fourier").sel(mesh="ico/2")
    assert np.isfinite(norm(field, -3.0)["error"].item())


def test_a_damaged_record_counts_as_none(store: Path, mended: Callable[..., None]) -> None:
    for row, damage in enumerate((truncate, empty, flip, delete)):
        damage(store / f"records/record/c/{row}")
    labels = ("ico/0", "ico/1", "ico/2", "ico/3")
    assert status(store).lost_records == labels
    assert "ico/2: its completion record is gone" in str(status(store))
    found = verify(store)
    assert (tuple(found.fields), found.complete) == (labels, 1)
    mended(*labels)


def with_checksum(data: bytes) -> bytes:
    return data + int(google_crc32c.value(data)).to_bytes(4, "little")


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
    (store / "records/record/c/2").write_bytes(with_checksum(data))
    (store / "meshes/name/c/0").write_bytes(with_checksum(data))
    for group, name in (("records", "record"), ("meshes", "name")):
        with pytest.raises(DamageError, match=rf"{group}/{name} is damaged"):
            variable(open_store(store), group, name).load()
    assert status(store).lost_records == ("ico/2",)
    assert list(verify(store).fields) == ["ico/2"]
    (store / "records/record/c/2").write_bytes(with_checksum(data))
    mended("ico/2")


def test_files_larger_than_any_memory_are_named_and_made_again(store: Path, study: Study, threads: Client) -> None:
    # A stray link of an editor is no damage.
    (store / "norms" / ".#lock").symlink_to("/nonexistent")
    assert verify(store).is_sound
    (store / "norms" / ".#lock").unlink()
    sparse = (
        "records/record/c/2",
        "meshes/name/c/0",
        "fourier/mesh/c/0",
        "norms/norm/c/0/0",
        "meshes/area/zarr.json",
        FIELD.format(row=2),
    )
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


def test_fields_that_are_replaced_are_not_described_any_more(store: Path, threads: Client) -> None:
    """A driver that is killed after a field and before the tables."""

    def stop(progress: Progress) -> None:
        if progress.stage == "fields" and progress.done == 1:
            raise KeyboardInterrupt

    study = Study.from_table(small_table(transform={"eps": 1e-7}))
    with pytest.raises(KeyboardInterrupt):
        run(study, store, threads, on_progress=stop)
    tree = open_store(store)
    assert "convergence" not in tree.children
    assert tree["fourier"].to_dataset()["quality"].values.tolist() == [""] * 5
    assert run(study, store, threads).failed == {}
    assert verify(store).is_sound


@pytest.mark.parametrize("damage", [truncate, empty, delete])
def test_damaged_metadata_are_told(damage: Damage, store: Path, study: Study, threads: Client) -> None:
    damage(store / "zarr.json")
    for use in (Store.open, open_store):
        with pytest.raises(StoreError, match=r"results\.zarr: .*it holds no store of a study"):
            use(store)
    if damage is delete:
        with pytest.raises(StoreError, match=r"results\.zarr: .*holds no store"):
            run(study, store, threads)


def test_a_field_of_zeros_is_one(store: Path, study: Study, threads: Client) -> None:
    there = Store.open(store)
    (place,) = there.places()
    record = there.read_record(1)
    assert record is not None
    zeros = np.zeros([part.stop for part in place], dtype=complex)
    checksum = there.write_field(1, place, zeros)
    there.write_record(1, replace(record, checksums=(checksum,)))
    assert verify(store).is_sound
    assert run(study, store, threads).computed == ()
    assert (there.read_fields([1], place, [checksum]) == 0).all()


@pytest.mark.process
def test_the_command_says_what_is_damaged(store: Path, tmp_path: Path) -> None:
    sound = call("verify", store)
    assert (sound.returncode, sound.stdout.splitlines()[-1]) == (0, "nothing is damaged")
    flip(store / FIELD.format(row=2))
    flip(store / "norms/norm/c/0/0")
    found = call("verify", store)
    assert found.returncode == 1
    lines = found.stdout.splitlines()
    assert lines[1].startswith("ico/2: ")
    assert lines[2].startswith("table norms/norm: ")
    assert lines[3] == "1 surfaces and 1 arrays of tables are damaged; run the study again to repair it"
    assert call("run", write_toml(tmp_path), "--store", store, "--workers", "1").returncode == 0
    assert call("verify", store).returncode == 0
