"""Stores in object storage, or wherever else a driver of fsspec reaches.

Credentials are never part of a URL. The drivers take them from the environment of each process.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fsspec import AbstractFileSystem
from fsspec.asyn import sync
from fsspec.core import url_to_fs

from sobolev_batch.batch.storage.retry import RetryingStore, put_all, remove_all
from sobolev_batch.errors import StoreError

BUCKET_SCHEMES = ("s3", "s3a", "gs", "gcs")
# Drivers repeat failing requests for minutes. That helps a run, but a question should be answered sooner.
_ANSWER_SECONDS = 20
_EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gcs", "gcs": "gcs"}
# s3fs asks for the size of every key first, to read ranges of 50 MB of larger ones at once.
_SIZED_SCHEMES = ("s3", "s3a")
_RANGE_BYTES = 50 << 20


class ObjectStorage:
    """Keys of a store below a URL."""

    # The exceptions of drivers have no common base.
    failures: tuple[type[Exception], ...] = (Exception,)

    def __init__(self, url: str, scheme: str) -> None:
        self._url, self._scheme = url, scheme

    def zarr_store(self, largest_bytes: int) -> RetryingStore:
        """Return zarr's store below the URL."""
        self._filesystem()
        return RetryingStore.at(self._url, self._options(largest_bytes), largest_bytes)

    def read(self, key: str, most_bytes: int | None) -> bytes:
        """Return the content of a key, of any size."""
        files, root = self._filesystem()
        content: bytes = files.cat_file(f"{root}/{key}", **_timeout(files))
        return content

    def write(self, documents: Mapping[str, bytes]) -> None:
        """Write keys, all at once."""
        files, root = self._filesystem()
        by_path = {f"{root}/{key}": document for key, document in documents.items()}
        if files.async_impl:
            sync(files.loop, put_all, files, by_path)
        else:
            files.pipe(by_path)

    def create(self, key: str, document: bytes) -> None:
        """Write a key by a conditional request."""
        files, root = self._filesystem()
        files.pipe_file(f"{root}/{key}", document, mode="create", **_timeout(files))

    def exists(self) -> bool:
        """Return false: object storage has no folders."""
        return False

    def delete(self, key: str) -> None:
        """Remove a key."""
        files, root = self._filesystem()
        files.rm_file(f"{root}/{key}")

    def delete_all(self, prefix: str) -> None:
        """Remove all keys below a prefix."""
        files, root = self._filesystem()
        if files.async_impl:
            sync(files.loop, remove_all, files, f"{root}/{prefix}")
        else:
            files.rm(f"{root}/{prefix}", recursive=True)

    def delete_if_empty(self) -> None:
        """Do nothing: object storage has no folders."""

    def delete_partial_files(self) -> None:
        """Do nothing: object storage shows a key once it is complete."""

    def sizes(self, prefix: str) -> dict[str, int]:
        """Return the sizes of all keys below a prefix."""
        files, root = self._filesystem()
        entries = files.find(f"{root}/{prefix}", detail=True, **_timeout(files))
        return {path.removeprefix(f"{root}/"): entry["size"] for path, entry in entries.items()}

    def names(self) -> set[str]:
        """Return the names of keys at the first level."""
        files, root = self._filesystem()
        # The name alone may stand for a folder that was emptied; only existing keys are listed.
        if not files.exists(root, **_timeout(files)):
            return set()
        return {path.rstrip("/").rpartition("/")[2] for path in files.ls(root, detail=False, **_timeout(files))}

    def require_usable(self) -> None:
        """Do nothing: only a request can tell."""

    def is_absent(self, error: OSError) -> bool:
        """Return whether the key is missing, and not its bucket."""
        return not _lacks_bucket(error)

    def explain(self, error: Exception, text: str) -> str:
        """Return the reason of a failure and its remedy."""
        if _lacks_bucket(error) or (self._scheme in BUCKET_SCHEMES and isinstance(error, FileNotFoundError)):
            return f"there is no bucket {self._url.split('/')[2]!r} ({text})"
        if isinstance(error, TimeoutError):
            return f"nothing answers there within {_ANSWER_SECONDS} s"
        if "Credentials" in type(error).__name__:
            return f"no credentials ({text}); set those of {self._scheme}:// in the environment of every process"
        if isinstance(error, PermissionError):
            return f"access is denied ({text}); check the credentials in the environment and what they allow"
        return text

    def _options(self, largest_bytes: int) -> dict[str, Any]:
        # fsspec remembers listings, but other processes write to the same store.
        options: dict[str, Any] = {"use_listings_cache": False}
        if self._scheme in _SIZED_SCHEMES and largest_bytes <= _RANGE_BYTES:
            options["max_concurrency"] = 1
        return options

    def _filesystem(self) -> tuple[AbstractFileSystem, str]:
        try:
            files, root = url_to_fs(self._url, **self._options(0))
        except ImportError as error:
            extra = _EXTRAS.get(self._scheme)
            remedy = f"pip install 'sobolev-batch[{extra}]'" if extra else "install it"
            raise StoreError(
                f"{self._url}: the driver of {self._scheme}:// is missing here ({error}): {remedy}"
            ) from error
        except ValueError as error:
            raise StoreError(f"{self._url}: no store can lie there ({error}); name a folder or an s3:// URL") from error
        return files, str(root)


def _timeout(files: AbstractFileSystem) -> dict[str, Any]:
    return {"timeout": _ANSWER_SECONDS} if files.async_impl else {}


def _lacks_bucket(error: Exception) -> bool:
    """Return whether the bucket is missing, for drivers that report a missing key in the same way."""
    response: Any = getattr(error.__cause__, "response", None)
    return isinstance(response, dict) and response.get("Error", {}).get("Code") == "NoSuchBucket"
