"""Workers that end in the middle of a mesh."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import dask
import pytest

from tests.faults import fatal

LABELS = ("ico/0", "ico/1", "ico/2", "ico/3", "reference")


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
