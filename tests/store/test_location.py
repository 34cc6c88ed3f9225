"""What names the place of a store, and links in a store, which lead nowhere."""

from __future__ import annotations

import errno
import os
import pickle
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from zarr.core.buffer import default_buffer_prototype
from zarr.core.sync import sync

from sobolev_batch import Study, run
from sobolev_batch.batch.status import status
from sobolev_batch.errors import SpaceError, StoreError
from sobolev_batch.store.layout import Store
from sobolev_batch.store.location import Location, path_in
from tests.support.studies import small_table


@pytest.mark.parametrize(
    ("place", "name", "scheme"),
    [
        ("storage//a.zarr/", "storage/a.zarr", ""),
        (Path("/tmp/a.zarr"), "/tmp/a.zarr", ""),
        ("s3/a.zarr", "s3/a.zarr", ""),
        (Path("s3/a.zarr"), "s3/a.zarr", ""),
        ("~/a.zarr", str(Path.home() / "a.zarr"), ""),
        (Path("~/a.zarr"), str(Path.home() / "a.zarr"), ""),
        ("odd:name/a.zarr", "odd:name/a.zarr", ""),
        ("file:///tmp/a.zarr", "/tmp/a.zarr", ""),
        ("s3://bucket/a b/c.zarr/", "s3://bucket/a b/c.zarr", "s3"),
        ("memory://a.zarr", "memory://a.zarr", "memory"),
        ("abfs://container@account.example/a.zarr", "abfs://container@account.example/a.zarr", "abfs"),
    ],
)
def test_folders_and_urls(place: str | Path, name: str, scheme: str) -> None:
    location = Location.parse(place)
    assert (location.name, str(location), location.scheme) == (name, name, scheme)
    assert Location.parse(location) is location
    assert pickle.loads(pickle.dumps(location)) == location
    assert Store(place).path == name


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("s3://key:hidden@bucket/a.zarr", "with credentials in it"),
        ("s3://key:hid/den@bucket/a.zarr", "with credentials in it"),
        ("s3://hidden@bucket/a.zarr", "with credentials in it"),
        ("sftp://user:hidden@host/a.zarr", "with credentials in it"),
        ("s3://bucket/a.zarr?secret=hidden", "with a query in it"),
        ("simplecache::s3://bucket/hidden.zarr", "a chain of URLs cannot hold a store"),
        ("s3://bucket", "names no place in a bucket"),
        ("s3:///a.zarr", "names no place in a bucket"),
        (Path("s3://bucket/hidden.zarr"), "this begins with s3:/ and a URL with s3://; a Path cannot hold a URL"),
        ("s3:/bucket/hidden.zarr", "this begins with s3:/ and a URL with s3://"),
        ("", "must be neither empty"),
    ],
)
def test_urls_that_are_refused_and_not_repeated(place: str | Path, message: str) -> None:
    with pytest.raises(StoreError, match=message) as caught:
        Location.parse(place)
    assert "hid" not in str(caught.value)
    assert caught.value.__cause__ is None


def test_an_unknown_protocol() -> None:
    with pytest.raises(StoreError, match=r"nope://a/b\.zarr: no store can lie there .*name a folder or an s3:// URL"):
        Store.open("nope://a/b.zarr")


@pytest.mark.parametrize("place", ["new", "memory://documents/a"])
def test_documents_of_a_folder_and_of_a_url(place: str, tmp_path: Path) -> None:
    location = Location.parse(place if ":" in place else tmp_path / place)
    location.require_free()
    assert ([*location.names()], location.read("b/c")) == ([], None)
    location.write({"b/c": b"1", "d": b"2"})
    location.write({"d": b"3"})
    assert (sorted(location.names()), location.read("b/c"), location.read("d")) == (["b", "d"], b"1", b"3")
    with pytest.raises(StoreError, match="not empty and holds no store"):
        location.require_free()
    for removed in ("b", "nothing"):
        location.remove(removed)
        assert (location.read("b/c"), location.read("d")) == (None, b"3")


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (OSError("Could not connect to http://me:hidden@host/x"), "Could not connect to http://host/x"),
        (PermissionError("Access\nDenied"), r"access is denied \(Access Denied\); check the credentials"),
        (TimeoutError(), "nothing answers there within"),
        (FileNotFoundError("b"), r"there is no bucket 'bucket' \(b\)"),
        (OSError(errno.ENOSPC, "No space left"), "No space left; make room there$"),
        (OSError(errno.EDQUOT, "Quota"), "Quota; make room there$"),
        (ZeroDivisionError("of a driver"), "of a driver"),
    ],
)
def test_reasons_in_one_line(error: Exception, reason: str) -> None:
    message = rf"^s3://bucket/a: the store cannot be read: {reason}"
    with pytest.raises(StoreError, match=message) as caught, Location.parse("s3://bucket/a").access("read"):
        raise error
    assert isinstance(caught.value, SpaceError) == ("make room" in reason)
    assert "\n" not in str(caught.value)
    # Of a folder, what is no failure of the disk is a defect of ours.
    if not isinstance(error, OSError):
        with pytest.raises(ZeroDivisionError), Location.parse("folder").access("read"):
            raise error


def test_what_cannot_be_read_is_not_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(folder: str) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", folder)

    monkeypatch.setattr(os, "scandir", refused)
    with pytest.raises(StoreError, match=rf"the store cannot be read: Permission denied: {tmp_path}"):
        Location(str(tmp_path)).sizes("")


LEADS_OUT = "a link, which may lead out of the store"


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
    with pytest.raises(StoreError, match=f"{key}: {LEADS_OUT}"):
        status(copy)


@pytest.mark.parametrize("key", ["records/record/c", "convergence"])
def test_nothing_is_written_or_removed_elsewhere(key: str, copy: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "5").mkdir(parents=True)
    (elsewhere / "5" / "precious").write_text("text")
    lead_away(copy / key, elsewhere)
    location = Location.parse(copy)
    with pytest.raises(StoreError, match=LEADS_OUT):
        location.write({f"{key}/5/new": b"bytes"})
    for removed in (f"{key}/5", key):
        with pytest.raises(StoreError, match=LEADS_OUT):
            location.remove(removed)
    if key.startswith("records"):
        with pytest.raises(StoreError, match=LEADS_OUT):
            run(Study.from_table(small_table()), copy)
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
        await (anext(outcome) if method == "list_dir" else outcome)

    with pytest.raises(StoreError, match=LEADS_OUT):
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
        status(copy)


def test_the_store_itself_may_be_reached_by_a_link(copy: Path, tmp_path: Path) -> None:
    (tmp_path / "link.zarr").symlink_to(copy)
    assert status(tmp_path / "link.zarr").complete == 5
    assert Store.open(tmp_path / "link.zarr").labels() == Store.open(copy).labels()


def test_a_driver_that_cannot_connect_ends_in_a_store_error(monkeypatch: pytest.MonkeyPatch) -> None:
    # Some connect as soon as they are made.
    monkeypatch.setattr(Location, "zarr_store", Mock(side_effect=ConnectionRefusedError("refused")))
    with pytest.raises(StoreError, match=r"cannot be read: .*refused"):
        Location.parse("memory://away.zarr").read("zarr.json")
