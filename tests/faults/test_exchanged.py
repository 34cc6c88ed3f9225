"""Stores with whole chunks in wrong places, old chunks, and altered metadata: `verify` names them, `run` mends them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from distributed import Client

from sobolev_batch import DamageError, Study, open_store, run, status, table, verify
from sobolev_batch.batch.store.store import Store
from sobolev_batch.results.store_accessor import StoreAccessor
from tests.faults.conftest import FIELD
from tests.support.stores import contents
from tests.support.studies import small_table, variable

RECORD = "records/record/c/{row}"
# Pairs of chunks of equal length.
PAIRS = [
    ("distances/aliasing/c/0/0/0", "distances/discretisation/c/0/0/0"),
    ("meshes/edge_length_mean/c/0", "meshes/area/c/0"),
    ("fourier/xi_x/c/0", "convergence/edge_length/c/0"),
]


@pytest.fixture(scope="module")
def earlier(sound: Path, threads: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same store before its fields were computed again, with other keys."""
    path = Path(shutil.copytree(sound, tmp_path_factory.mktemp("earlier") / "results.zarr"))
    run(Study.from_table(small_table(transform={"eps": 1e-7})), path, threads)
    return path


def exchange(store: Path, one: str, other: str) -> None:
    first, second = (store / name for name in (one, other))
    before = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(before)


def restore(store: Path, earlier: Path, *names: str) -> None:
    """Bring keys and groups back as a backup has them."""
    for name in names:
        source, target = earlier / name, store / name
        if source.is_dir():
            shutil.rmtree(target)
            shutil.copytree(source, target)
        else:
            shutil.copyfile(source, target)


def relabel(store: Path) -> None:
    """Write labels in another order. The keys in the records say which field is whose."""
    there = Store.open(store)
    there.write("fourier/mesh", ..., np.array(there.labels()[::-1], dtype=object))


def trade(store: Path) -> None:
    for name in (FIELD, RECORD):
        exchange(store, name.format(row=1), name.format(row=2))
    assert status(store).lost_records == ("ico/1", "ico/2")


@pytest.mark.parametrize(
    ("change", "labels"),
    [
        (lambda store, earlier: trade(store), ("ico/1", "ico/2")),
        *((lambda store, earlier, pair=pair: exchange(store, *pair), ()) for pair in PAIRS),
        (lambda store, earlier: exchange(store, FIELD.format(row=1), FIELD.format(row=2)), ("ico/1", "ico/2")),
        (lambda store, earlier: relabel(store), ()),
        (lambda store, earlier: restore(store, earlier, "convergence/distance/c/0/0"), ()),
        (lambda store, earlier: restore(store, earlier, "fourier/quality/c/0"), ()),
    ],
)
def test_what_is_in_another_place_or_of_an_earlier_state_is_named_and_mended(
    change: Callable[[Path, Path], None],
    labels: tuple[str, ...],
    store: Path,
    earlier: Path,
    mended: Callable[..., None],
) -> None:
    change(store, earlier)
    found = verify(store)
    assert tuple(found.fields) == labels
    assert labels or found.tables
    mended(*labels)


def test_an_earlier_field_with_its_record(store: Path, earlier: Path, mended: Callable[..., None]) -> None:
    restore(store, earlier, FIELD.format(row=1), RECORD.format(row=1))
    assert list(verify(store).fields) == ["ico/1"]
    restore(store, earlier, FIELD.format(row=1), RECORD.format(row=1))
    assert status(store).lost_records == ("ico/1",)
    tree = open_store(store)
    with pytest.raises(DamageError, match="the field of ico/1 is damaged"):
        table(tree, -3.5)
    fields = StoreAccessor(tree)
    with pytest.raises(DamageError, match="the field of ico/1 is damaged"):
        fields.distance("ico/1", "reference", -3.0)
    assert fields.norm("ico/2", -3.0)["norm"] > 0
    mended("ico/1")


def test_earlier_tables_and_root_with_newer_fields(
    store: Path, earlier: Path, finished_store: Path, mended: Callable[..., None]
) -> None:
    restore(store, earlier, "zarr.json", "meshes", "norms", "distances", "convergence", "fourier/quality")
    found = verify(store)
    assert len(found.fields) == 5
    assert "fourier/quality" in found.tables
    restore(store, finished_store, "records/record")
    mended()


@pytest.mark.parametrize("name", ["meshes/area", "fourier/fourier", "records"])
def test_metadata_of_one_node(name: str, store: Path, mended: Callable[..., None]) -> None:
    path = store / name / "zarr.json"
    content = path.read_bytes()
    other = json.dumps({**json.loads(content), "node_type": "x"}).encode()
    for damaged in (None, other, content[: len(content) // 2], bytes(len(content))):
        path.unlink(missing_ok=True)
        if damaged is not None:
            path.write_bytes(damaged)
        assert set(verify(store).tables) == {"records" if name == "records" else "zarr.json"}, damaged
    mended()


def alter(store: Path, *place: str, value: object) -> None:
    """Write another value into the metadata at the root."""
    root = node = json.loads((store / "zarr.json").read_text())
    for name in place[:-1]:
        node = node[name]
    assert node.get(place[-1]) != value
    node[place[-1]] = value
    (store / "zarr.json").write_text(json.dumps(root))


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("attributes", "study", "orders"), [-11.0, -3.0]),
        (("attributes", "similarity", "scale"), 2.0),
        (("attributes", "study", "lattice", "M"), 18),
        (("consolidated_metadata", "metadata", "fourier/fourier", "shape"), [5, 18, 17, 9]),
    ],
)
def test_metadata_at_the_root_that_were_altered(
    place: tuple[str, ...], value: object, store: Path, finished_store: Path, mended: Callable[..., None]
) -> None:
    alter(store, *place, value=value)
    assert not verify(store).is_sound
    restore(store, finished_store, "records/record")
    mended()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("fill_value", "x"),
        ("codecs", [{"name": "bytes"}]),
        ("dimension_names", ["a", "b", "c"]),
        ("data_type", "float32"),
        ("shape", [3]),
    ],
)
def test_metadata_that_make_no_sense_are_damage(name: str, value: object, store: Path) -> None:
    alter(store, "consolidated_metadata", "metadata", "meshes/area", name, value=value)
    with pytest.raises(DamageError):
        open_store(store)["meshes"].to_dataset().load()


def test_a_root_that_cannot_be_read(store: Path, study: Study, threads: Client, mended: Callable[..., None]) -> None:
    text = (store / "zarr.json").read_bytes()
    (store / "zarr.json").write_bytes(text[: len(text) // 2])
    for use in (open_store, status, verify):
        with pytest.raises(DamageError, match=r"zarr\.json is damaged"):
            use(store)
    before = contents(store)
    other = Study.from_table(small_table(transform={"eps": 1e-7}))
    with pytest.raises(DamageError, match="no field of this study is found in the store"):
        run(other, store, threads)
    assert contents(store) == before
    mended()


def test_the_record_of_a_run_that_was_altered(store: Path, study: Study, threads: Client) -> None:
    path = store / "records/zarr.json"
    path.write_text(path.read_text().replace('"state": "done"', '"state": "failed"'))
    with pytest.raises(DamageError, match="the record of the latest run is damaged"):
        status(store)
    assert list(verify(store).tables) == ["records"]
    run(study, store, threads)
    assert verify(store).is_sound


def test_the_digest_is_no_attribute_of_a_tree(store: Path) -> None:
    assert "digest" not in open_store(store).attrs
    assert variable(open_store(store), "records", "record").shape == (5,)
