"""The rooms of the package know of each other in one direction only."""

from __future__ import annotations

import pytest

import sobolev_batch
from tests.support.repository import PACKAGE, imported

ROOMS = ("surfaces", "spectral", "batch", "results")


@pytest.mark.parametrize("room", ROOMS)
def test_dependencies_point_one_way(room: str) -> None:
    later = ROOMS[ROOMS.index(room) + 1 :]
    paths = list((PACKAGE / room).glob("*.py"))
    assert len(paths) > 2
    for path in paths:
        for name in imported(path):
            assert not name.startswith(tuple(f"sobolev_batch.{other}" for other in (*later, "cli"))), path


@pytest.mark.parametrize("room", ["surfaces", "spectral"])
def test_numbers_know_neither_dask_nor_zarr(room: str) -> None:
    for path in (PACKAGE / room).glob("*.py"):
        tops = {name.split(".")[0] for name in imported(path)}
        assert not tops & {"dask", "distributed", "zarr"}, path


def test_every_public_name_is_documented() -> None:
    for name in sobolev_batch.__all__:
        assert (getattr(sobolev_batch, name).__doc__ or "").strip(), name
