"""Stores with whole chunks in wrong places, old chunks, and altered metadata: never read as if they were right."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from distributed import Client

import sobolev_batch as sb
from sobolev_batch import DamageError, Study, open_store, run, status, verify
from tests.support.stores import assert_same_fields, assert_same_tables
from tests.support.studies import small_table, variable

FIELD = "fourier/fourier/c/{row}/0/0/0"
RECORD = "records/record/c/{row}"
# Pairs of chunks of equal length.
PAIRS = [
    ("distances/aliasing/c/0/0/0", "distances/discretisation/c/0/0/0"),
    ("convergence/distance/c/0/0", "convergence/discretisation/c/0/0"),
    ("meshes/edge_length_mean/c/0", "meshes/area/c/0"),
    ("meshes/duplicate_triangles/c/0", "meshes/zero_area_triangles/c/0"),
    ("norms/order/c/0", "convergence/order/c/0"),
    ("fourier/xi_x/c/0", "fourier/xi_y/c/0"),
]


@pytest.fixture
def store(finished_store: Path, store_path: Path) -> Path:
    shutil.copytree(finished_store, store_path)
    return store_path


def exchange(store: Path, one: str, other: str) -> bool:
    """Let two chunks trade places, and return whether that makes a difference."""
    first, second = (store / name for name in (one, other))
    contents = first.read_bytes(), second.read_bytes()
    first.write_bytes(contents[1])
    second.write_bytes(contents[0])
    return contents[0] != contents[1]


def array_of(key: str) -> str:
    return key.partition("/c/")[0]


@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_chunks_that_trade_places_are_noticed_and_made_again(
    one: str, other: str, store: Path, study: Study, finished_store: Path, client: Client
) -> None:
    is_changed = exchange(store, one, other)
    group, name = array_of(one).split("/")
    if is_changed:
        with pytest.raises(DamageError, match=f"{group}/{name} is damaged .it is not what was written"):
            open_store(store)[group].to_dataset()[name].load()
    assert set(verify(store).tables) == ({array_of(one), array_of(other)} if is_changed else set())
    assert run(study, store, client).computed == ()
    assert verify(store).is_sound
    assert_same_tables(store, finished_store)


def test_fields_that_trade_places_are_noticed_by_those_who_read_them(store: Path) -> None:
    assert exchange(store, FIELD.format(row=1), FIELD.format(row=2))
    fields = variable(open_store(store), "fourier", "fourier")
    with pytest.raises(DamageError, match="row 1 of fourier/fourier is damaged"):
        fields.sel(mesh="ico/1").load()
    with pytest.raises(DamageError, match="row 2 of fourier/fourier is damaged"):
        fields.sel(mesh="ico/2").sobolev.norm(-3)
    assert np.isfinite(fields.sel(mesh="ico/0")).all()
    assert list(verify(store).fields) == ["ico/1", "ico/2"]


def test_fields_that_trade_places_with_their_records_are_noticed(store: Path) -> None:
    for name in (FIELD, RECORD):
        exchange(store, name.format(row=1), name.format(row=2))
    with pytest.raises(DamageError, match="row 1 of fourier/fourier is damaged"):
        variable(open_store(store), "fourier", "fourier").sel(mesh="ico/1").load()


def test_labels_and_rows_that_are_both_damaged_are_told(store: Path) -> None:
    for name in ("fourier/mesh", "meshes/row"):
        path = store / name / "c/0"
        path.write_bytes(path.read_bytes()[:-1] + b"?")
    with pytest.raises(DamageError, match="fourier/mesh is damaged, and nothing else says which field is whose"):
        verify(store)


def test_records_that_trade_places_are_none(store: Path, study: Study, client: Client) -> None:
    exchange(store, RECORD.format(row=1), RECORD.format(row=2))
    assert status(store).lost_records == ("ico/1", "ico/2")
    assert list(verify(store).fields) == ["ico/1", "ico/2"]
    assert sorted(run(study, store, client).computed) == ["ico/1", "ico/2"]
    assert status(store).lost_records == ()


@pytest.mark.parametrize("row", [0, 1])
def test_records_that_are_read_by_themselves_are_held_against_their_rows(row: int, store: Path) -> None:
    path = store / RECORD.format(row=row)
    if row:
        path.write_bytes(path.read_bytes()[:-1])
    else:
        exchange(store, RECORD.format(row=0), RECORD.format(row=2))
    # Of two rows that traded places, either may be read first.
    rows = row if row else "[02]"
    with pytest.raises(DamageError, match=f"row {rows} of records/record is damaged .it is not what was written"):
        variable(open_store(store), "records", "record").load()


@pytest.mark.parametrize("name", ["meshes/area", "fourier", "norms/norm"])
@pytest.mark.parametrize("what", ["cut short", "altered", "deleted"])
def test_metadata_of_one_node_are_held_against_those_at_the_root(name: str, what: str, store: Path) -> None:
    path = store / name / "zarr.json"
    content = json.loads(path.read_text())
    if what == "deleted":
        path.unlink()
    else:
        path.write_text(json.dumps({**content, "attributes": {"units": "m"}}) if what == "altered" else "{")
    assert set(verify(store).tables) == {name}
    assert json.loads(path.read_text())["attributes"] == content["attributes"]
    assert verify(store).is_sound


def test_a_record_that_is_gone_is_told(store: Path, study: Study, client: Client) -> None:
    (store / RECORD.format(row=2)).unlink()
    found = status(store)
    assert found.lost_records == ("ico/2",)
    assert "ico/2: its completion record is gone; run the study again" in str(found)
    assert verify(store).fields == {"ico/2": "its completion record is missing"}
    # The tables are withdrawn, so they claim nothing any more.
    assert status(store).lost_records == ()
    assert run(study, store, client).computed == ("ico/2",)


def test_a_table_of_an_earlier_state_is_noticed(store: Path, client: Client) -> None:
    old = (store / "convergence/distance/c/0/0").read_bytes()
    run(Study.from_table(small_table(transform={"eps": 1e-7})), store, client)
    assert (store / "convergence/distance/c/0/0").read_bytes() != old
    (store / "convergence/distance/c/0/0").write_bytes(old)
    with pytest.raises(DamageError, match="convergence/distance is damaged"):
        sb.table(store)


def altered(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    def alter(store: Path) -> None:
        root = json.loads((store / "zarr.json").read_text())
        change(root)
        (store / "zarr.json").write_text(json.dumps(root))

    return alter


def other_orders(root: dict[str, Any]) -> None:
    root["attributes"]["study"]["orders"][0] -= 1


def other_scale(root: dict[str, Any]) -> None:
    root["attributes"]["similarity"]["scale"] *= 2


def other_digest(root: dict[str, Any]) -> None:
    key = next(iter(root["attributes"]["digests"]))
    root["attributes"]["digests"][key] = "0" * 64


def other_shape(root: dict[str, Any]) -> None:
    root["consolidated_metadata"]["metadata"]["fourier/fourier"]["shape"][1] += 1


def truncated(store: Path) -> None:
    text = (store / "zarr.json").read_bytes()
    (store / "zarr.json").write_bytes(text[: len(text) // 2])


@pytest.mark.parametrize("damage", [*map(altered, (other_orders, other_scale, other_digest, other_shape)), truncated])
def test_metadata_at_the_root_that_were_altered_are_noticed_and_made_again(
    damage: Callable[[Path], None], store: Path, study: Study, finished_store: Path, client: Client
) -> None:
    damage(store)
    for use in (open_store, status, verify):
        with pytest.raises(DamageError, match=r"zarr\.json.* is damaged"):
            use(store)
    assert run(study, store, client).computed == ()
    assert verify(store).is_sound
    assert_same_fields(store, finished_store)
    assert_same_tables(store, finished_store)


def test_a_damaged_root_is_not_made_again_for_another_study(store: Path, client: Client) -> None:
    truncated(store)
    before = {path: path.read_bytes() for path in store.rglob("*") if path.is_file() and path.suffix == ""}
    other = Study.from_table(
        small_table(
            family=[{"name": "a", "source": "sphere", "radius": 0.5}],
            reference={"source": "ellipsoid", "axes": [1.0, 1.0, 0.5]},
        )
    )
    with pytest.raises(DamageError, match="no field of this study is found in the store"):
        run(other, store, client)
    assert all(path.read_bytes() == content for path, content in before.items())


def test_the_record_of_a_run_that_was_altered_is_noticed(store: Path) -> None:
    path = store / "records/zarr.json"
    path.write_text(path.read_text().replace('"state": "done"', '"state": "failed"'))
    with pytest.raises(DamageError, match="the record of the latest run is damaged"):
        status(store)
    assert verify(store).tables == {"records": "it is not what was written"}
    assert verify(store).is_sound


def test_digests_are_no_attributes_of_a_tree(store: Path) -> None:
    assert {"digest", "digests"}.isdisjoint(open_store(store).attrs)
    with xr.open_datatree(store, engine="zarr") as tree:
        assert {"digest", "digests"} <= set(tree.attrs)
