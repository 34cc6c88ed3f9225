"""Links in a store: what they lead to beyond it is neither read nor written nor removed."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from zarr.core.buffer import default_buffer_prototype
from zarr.core.sync import sync

from sobolev_batch import StoreError, Study, run
from sobolev_batch.batch.storage.location import Location, path_in
from sobolev_batch.batch.store.store import Store
from sobolev_batch.results.status import Status
from tests.support.studies import small_table


def lead_away(path: Path, target: str | Path) -> None:
    """Put a link in the place of a file or folder."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()
    path.symlink_to(target)


@pytest.mark.parametrize("key", ["zarr.json", "records/zarr.json", "records/record/c/1", "fourier/mesh/c/0"])
def test_what_lies_elsewhere_is_not_read(copy: Path, key: str) -> None:
    # Whoever followed it would read for ever.
    lead_away(copy / key, "/dev/zero")
    with pytest.raises(StoreError, match=f"{key}: a link, which may lead out of the store"):
        Status.from_store(copy)


def test_nothing_is_written_or_removed_elsewhere(copy: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "5").mkdir(parents=True)
    (elsewhere / "5" / "precious").write_text("text")
    for key in ("records/record/c", "convergence"):
        store = Path(shutil.copytree(copy, tmp_path / f"{key.replace('/', '-')}.zarr"))
        (store / key).mkdir(exist_ok=True)
        lead_away(store / key, elsewhere)
        location = Location.parse(store)
        with pytest.raises(StoreError, match="a link, which may lead out of the store"):
            location.write({f"{key}/5/new": b"bytes"})
        with pytest.raises(StoreError, match="a link, which may lead out of the store"):
            location.remove(f"{key}/5")
        with pytest.raises(StoreError, match="a link, which may lead out of the store"):
            location.remove(key)
    with pytest.raises(StoreError, match="a link, which may lead out of the store"):
        run(Study.from_table(small_table()), tmp_path / "records-record-c.zarr")
    assert [path.name for path in elsewhere.rglob("*")] == ["5", "precious"]


@pytest.mark.parametrize(
    "method", ["get", "get_partial_values", "exists", "getsize", "delete", "delete_dir", "list_dir"]
)
def test_no_method_of_the_store_that_zarr_sees_follows_a_link(method: str, copy: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "precious").write_text("text")
    (copy / "link").symlink_to(tmp_path / "elsewhere")
    keys: Any = Location.parse(copy).zarr_store()
    prototype, key = default_buffer_prototype(), "link/precious"
    arguments = {"get": (key, prototype), "get_partial_values": (prototype, [(key, None)])}.get(method, (key,))

    async def ask() -> None:
        outcome = getattr(keys, method)(*arguments)
        if method == "list_dir":
            assert not [name async for name in outcome]
        else:
            await outcome

    with pytest.raises(StoreError, match="a link, which may lead out of the store"):
        sync(ask())
    assert (tmp_path / "elsewhere" / "precious").exists()


def test_keys_that_climb(tmp_path: Path) -> None:
    for key in ("../other", "/etc/passwd", "a/../../b"):
        with pytest.raises(StoreError, match="leads out of the store"):
            path_in(tmp_path / "store.zarr", key)
    assert path_in(tmp_path, "a/b") == tmp_path / "a" / "b"


def test_a_pipe_is_not_waited_for(copy: Path) -> None:
    (copy / "records" / "record" / "c" / "1").unlink()
    os.mkfifo(copy / "records" / "record" / "c" / "1")
    with pytest.raises(StoreError, match="neither a file nor a folder, in a store"):
        Status.from_store(copy)


def test_the_store_itself_may_be_reached_by_a_link(copy: Path, tmp_path: Path) -> None:
    (tmp_path / "link.zarr").symlink_to(copy)
    assert Status.from_store(tmp_path / "link.zarr").complete == 5
    assert Store.open(tmp_path / "link.zarr").labels() == Store.open(copy).labels()
