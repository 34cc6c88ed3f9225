"""A store that a test may damage, and workers that end in the middle of a mesh."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import dask
import pytest
from distributed import Client

from sobolev_batch import Study, run, status, verify
from tests.faults import fatal
from tests.support.stores import assert_same_results, put_back

LABELS = ("ico/0", "ico/1", "ico/2", "ico/3", "reference")
FIELD = "fourier/fourier/c/{row}/0/0/0"


@pytest.fixture(scope="module")
def sound(finished_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(finished_store, tmp_path_factory.mktemp("damage") / "results.zarr"))


@pytest.fixture
def store(sound: Path) -> Iterator[Path]:
    """A finished store, whose files are put back after the test."""
    with put_back(sound):
        yield sound


@pytest.fixture
def strike(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., fatal.Moment]:
    """What has workers that are started afterwards end or stop at a moment, whoever starts them."""

    def begin(what: str, row: int, **options: int) -> fatal.Moment:
        moment = fatal.Moment(what, row, str(tmp_path / "struck"), **options)
        monkeypatch.setenv(fatal.VARIABLE, json.dumps(asdict(moment)))
        monkeypatch.setenv("DASK_DISTRIBUTED__WORKER__PRELOAD", repr([fatal.__file__]))
        monkeypatch.setitem(dask.config.get("distributed.worker"), "preload", [fatal.__file__])
        return moment

    return begin


@pytest.fixture
def mended(store: Path, study: Study, finished_store: Path, threads: Client) -> Callable[..., None]:
    """A check that a run computes the given meshes of the store again, and leaves nothing damaged."""

    def check(*computed: str) -> None:
        assert sorted(run(study, store, threads).computed) == sorted(computed)
        assert verify(store).is_sound
        assert status(store).lost_records == ()
        assert_same_results(store, finished_store)

    return check
