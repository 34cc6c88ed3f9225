"""How often a run looks at the lock of its store."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest
from distributed import Client
from zarr.storage import LocalStore

from sobolev_batch import Study, run
from sobolev_batch.batch.cluster import watch
from sobolev_batch.store.location import FolderStore
from sobolev_batch.store.lock import LOCK_KEY

LOOK, WRITE = "look", "write"


@pytest.fixture
def requests(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Looks at the lock, and writes of any key, in their order."""
    # A beat between a look and its write would be taken for a second look.
    monkeypatch.setattr(watch, "HEARTBEAT_SECONDS", 600.0)
    found: list[str] = []

    def noted(method: Callable[..., Awaitable[Any]], kind: str) -> Callable[..., Awaitable[Any]]:
        def call(self: LocalStore, key: str, *arguments: Any, **options: Any) -> Awaitable[Any]:
            if kind == WRITE or key == LOCK_KEY:
                found.append(kind)
            return method(self, key, *arguments, **options)

        return call

    looks, writes = ("get", "content"), ("set", "set_if_not_exists", "delete", "delete_dir", "put")
    for name in (*looks, *writes):
        owner = LocalStore if hasattr(LocalStore, name) else FolderStore
        monkeypatch.setattr(owner, name, noted(getattr(owner, name), LOOK if name in looks else WRITE))
    return found


def test_a_run_looks_at_the_lock_once_for_each_write(
    study: Study, store_path: Path, requests: list[str], threads: Client
) -> None:
    for most, computed in ((40, 5), (6, 0)):
        requests.clear()
        assert len(run(study, store_path, threads).computed) == computed
        # Documents that are written together are preceded by one look.
        writes = sum(kind == WRITE for kind, _ in groupby(requests))
        # The only worker looks whether it sees the same store.
        assert 3 < requests.count(LOOK) <= writes + 1
        assert requests.count(LOOK) <= most
