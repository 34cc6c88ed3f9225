"""Records collected in pages: what is read of them, and what is left after kills and damage between the steps."""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from distributed import Client

from sobolev_batch import Study, run, status, verify
from sobolev_batch.errors import StoreError
from sobolev_batch.store import create
from sobolev_batch.store.create import prepare_store
from sobolev_batch.store.layout import Store
from sobolev_batch.store.location import FolderStore
from sobolev_batch.store.records import Record, Records
from sobolev_batch.study.plan import Plan, make_plan
from tests.support.stores import assert_same_results, delete, empty, flip, put_back, truncate
from tests.support.studies import small_table

LABELS = ("ico/0", "ico/1", "ico/2", "ico/3", "reference")
OWN, PAGES = "records/record/c", "records/page/c"


@pytest.fixture(scope="module", autouse=True)
def small_pages() -> Iterator[None]:
    """Pages of two rows: the five of the small study are two pages, and one row that stays alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(create, "ROWS_PER_PAGE", 2)
        yield


def plan_of(levels: int = 4) -> Plan:
    family = [{"name": "ico", "source": "icosphere", "levels": list(range(levels))}]
    return make_plan(Study.from_table(small_table(family=family)))


def filled(path: Path | str) -> Store:
    store = prepare_store(path, plan_of())
    for row in range(5):
        Records(store).write(row, Record(f"first {row}", "complete"))
    return store


def keys_of(store: Store) -> list[str | None]:
    """The key of each row's record, read row by row and all together."""
    alone = [Records(store).read_one(row) for row in range(len(store.labels()))]
    # From Python 3.13 on, NaN makes records unequal.
    assert list(map(repr, Records(store).read())) == list(map(repr, alone))
    return [None if record is None else record.key for record in alone]


def chunks(store: Store) -> list[str]:
    return sorted(key for folder in (OWN, PAGES) for key in store.location.sizes(folder))


FIRST = [f"first {row}" for row in range(5)]


@pytest.mark.parametrize("scheme", ["", "memory://"])
def test_full_pages_take_the_place_of_chunks(scheme: str, store_path: Path) -> None:
    store = filled(scheme + str(store_path))
    assert chunks(store) == [f"{OWN}/{row}" for row in range(5)]
    Records(store).collect(Records(store).read())
    # In object storage the last page need not be full, since each chunk is a request.
    collected = [f"{PAGES}/0", f"{PAGES}/1", f"{PAGES}/2" if scheme else f"{OWN}/4"]
    assert chunks(store) == sorted(collected)
    assert keys_of(store) == FIRST
    # New rows make the last page a full one.
    grown = prepare_store(scheme + str(store_path), plan_of(5))
    assert keys_of(grown) == [*FIRST, None]
    Records(grown).write(5, Record("first 5", "failed"))
    Records(grown).collect(Records(grown).read())
    assert chunks(grown) == [f"{PAGES}/{page}" for page in range(3)]
    assert keys_of(Store.open(store.location)) == [*FIRST, "first 5"]


def test_what_is_written_later_counts_more_than_a_page(store_path: Path) -> None:
    store = filled(store_path)
    Records(store).collect(Records(store).read())
    Records(store).write(0, Record("second", "complete"))
    Records(store).write(1, None)
    expected = ["second", None, *FIRST[2:]]
    assert keys_of(store) == expected
    # A page that lacks one stays, with what lies over it.
    Records(store).collect(Records(store).read())
    assert keys_of(store) == expected
    # Damaged, it does not give way to the page either.
    flip(store_path / OWN / "0")
    assert keys_of(store) == [None, None, *FIRST[2:]]
    for row in (0, 1):
        Records(store).write(row, Record(f"third {row}", "complete"))
    Records(store).collect(Records(store).read())
    assert chunks(store) == sorted([f"{PAGES}/0", f"{PAGES}/1", f"{OWN}/4"])
    assert keys_of(store) == ["third 0", "third 1", *FIRST[2:]]


def test_records_stay_the_same_wherever_collecting_ends(store_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    filled(store_path)
    left = itertools.count()

    def dying(method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            if not next(left):
                raise OSError("the process ends here")
            return method(*arguments, **options)

        return call

    for name in ("put", "delete"):
        monkeypatch.setattr(FolderStore, name, dying(getattr(FolderStore, name)))
    for steps in range(20):
        store, left = Store.open(store_path), itertools.count(-steps)
        with put_back(store_path):
            try:
                Records(store).collect(Records(store).read())
                break
            except StoreError:
                assert keys_of(Store.open(store_path)) == FIRST
            left = itertools.count(1)
            Records(store).collect(Records(store).read())
            assert chunks(store) == sorted([f"{PAGES}/0", f"{PAGES}/1", f"{OWN}/4"])
            assert keys_of(store) == FIRST
    # A page and two chunks, twice.
    assert steps == 6


@pytest.fixture(scope="module")
def sound(threads: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pages") / "results.zarr"
    run(Study.from_table(small_table()), path, threads)
    return path


@pytest.fixture
def store(sound: Path) -> Iterator[Path]:
    with put_back(sound):
        yield sound


def test_a_run_collects_and_a_later_one_mends_what_was_killed(study: Study, store: Path, threads: Client) -> None:
    there = Store.open(store)
    assert chunks(there) == sorted([f"{PAGES}/0", f"{PAGES}/1", f"{OWN}/4"])
    assert (status(store).complete, verify(store).complete, verify(store).is_sound) == (5, 5, True)
    record = Records(there).read_one(0)
    Records(there).write(0, record)
    assert run(study, store, threads).reused == LABELS
    assert f"{OWN}/0" not in chunks(there)
    assert Records(there).read_one(0) == record
    assert json.loads(there.read_strings("records/page")[1])["row"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("damage", [truncate, empty, flip, delete])
def test_a_damaged_page_concerns_its_rows_alone(
    damage: Callable[[Path], None], study: Study, store: Path, sound: Path, threads: Client, tmp_path: Path
) -> None:
    right = shutil.copytree(sound, tmp_path / "right.zarr")
    damage(store / PAGES / "0")
    assert status(store).lost_records == LABELS[:2]
    found = verify(store)
    assert (tuple(found.fields), found.complete, found.withdrawn) == (LABELS[:2], 3, True)
    assert run(study, store, threads).computed == LABELS[:2]
    assert verify(store).is_sound
    assert_same_results(store, right)
    assert f"{OWN}/0" not in chunks(Store.open(store))


def test_metadata_are_made_again_around_pages(study: Study, store: Path, threads: Client) -> None:
    truncate(store / "zarr.json")
    flip(store / PAGES / "1")
    assert run(study, store, threads).computed == LABELS[2:4]
    assert verify(store).is_sound
