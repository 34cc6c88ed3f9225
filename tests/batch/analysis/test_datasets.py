"""Variables of the tables: described, in the table that people read, and the same for all stores of a version."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
import xarray as xr

from sobolev_batch import open_store, table
from sobolev_batch.batch.analysis.reduce import TABLES_VERSION

# Beginning of the SHA-256 of the names of all variables, by version. A finished store gets a new variable, in place
# of NaN, only when its tables are made again, which a new version causes.
NAMES = {5: "614cc14cedafe6b7"}
GROUPS = ("meshes", "norms", "distances", "convergence")


@pytest.fixture(scope="module")
def tree(finished_store: Path) -> xr.DataTree:
    return open_store(finished_store)


def test_new_variables_come_with_a_new_version(tree: xr.DataTree) -> None:
    names = sorted(f"{group}/{name}" for group in GROUPS for name in tree[group].to_dataset().variables)
    digest = hashlib.sha256("\n".join(names).encode()).hexdigest()[:16]
    assert NAMES.get(TABLES_VERSION) == digest, "raise TABLES_VERSION, and add its digest to NAMES"


def test_every_number_of_the_convergence_group_is_described_and_a_column(tree: xr.DataTree) -> None:
    convergence = tree["convergence"].to_dataset()
    assert set(convergence.variables) <= set(table(tree))
    assert [name for name, variable in convergence.variables.items() if "long_name" not in variable.attrs] == []
