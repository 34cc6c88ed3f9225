"""Clusters and small studies for the tests of the batch room."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import xarray as xr
from distributed import Client

from sobolev_batch import Lattice, Study, run
from sobolev_batch.batch.cluster.clients import local_client

SMALL_LATTICE = Lattice(3.0, 16)


@pytest.fixture(scope="session")
def client() -> Iterator[Client]:
    """Two worker processes, shared by all tests that only submit to them."""
    with local_client(2) as client:
        yield client


def small_table(**changes: Any) -> dict[str, Any]:
    """A study of four icospheres that takes a second."""
    table: dict[str, Any] = {
        "study": {"name": "small"},
        "lattice": {"xi_max": SMALL_LATTICE.xi_max, "M": SMALL_LATTICE.M},
        "norm": {"orders": [-10.0, -3.0]},
        "reference": {"source": "sphere"},
        "family": [{"name": "ico", "source": "icosphere", "levels": [0, 1, 2, 3]}],
    }
    return {**table, **changes}


def variable(tree: xr.DataTree, group: str, name: str) -> xr.DataArray:
    """A variable of one group of a store."""
    return tree[group].to_dataset()[name]


@pytest.fixture
def study() -> Study:
    return Study.from_table(small_table())


@pytest.fixture
def store_path(tmp_path: Path) -> Path:
    return tmp_path / "results.zarr"


@pytest.fixture(scope="session")
def finished_store(client: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The store of the small study after a run; not to be changed."""
    path = tmp_path_factory.mktemp("finished") / "results.zarr"
    run(Study.from_table(small_table()), path, client)
    return path
