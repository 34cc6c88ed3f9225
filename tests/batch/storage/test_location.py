"""What names the place of a store, and what does not."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from sobolev_batch import StoreError
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.store import Store


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
        ("", "the path of the store is empty"),
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


def test_documents_of_a_folder_and_of_a_url(tmp_path: Path) -> None:
    for location in (Location.parse(tmp_path / "new"), Location.parse("memory://documents/a")):
        location.require_free()
        assert location.names() == set()
        assert location.read("b/c") is None
        location.write({"b/c": b"1", "d": b"2"})
        location.write({"d": b"3"})
        assert (location.read("b/c"), location.read("d")) == (b"1", b"3")
        assert location.names() == {"b", "d"}
        with pytest.raises(StoreError, match="not empty and holds no store"):
            location.require_free()
        location.remove("b")
        location.remove("nothing")
        assert location.read("b/c") is None
        assert location.read("d") == b"3"


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (OSError("Could not connect to http://me:hidden@host/x"), "Could not connect to http://host/x"),
        (PermissionError("Access\nDenied"), r"access is denied \(Access Denied\); check the credentials"),
        (TimeoutError(), "nothing answers there within"),
        (FileNotFoundError("b"), r"there is no bucket 'bucket' \(b\)"),
        (ZeroDivisionError("of a driver"), "of a driver"),
    ],
)
def test_reasons_in_one_line(error: Exception, reason: str) -> None:
    message = rf"^s3://bucket/a: the store cannot be read: {reason}"
    with pytest.raises(StoreError, match=message) as caught, Location.parse("s3://bucket/a").access("read"):
        raise error
    assert "\n" not in str(caught.value)
    # Of a folder, what is no failure of the disk is a defect of ours.
    if not isinstance(error, OSError):
        with pytest.raises(ZeroDivisionError), Location.parse("folder").access("read"):
            raise error
