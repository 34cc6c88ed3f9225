"""A study of many small meshes, each a file of its own, and whether two stores of it hold the same."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import xarray as xr

from sobolev_batch import DamageError, icosphere, open_store
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.store import Store
from tests.support.mesh_files import off

STUDY = """
[study]
name = "soak"
[lattice]
xi_max = 2.0
M = 24
[norm]
orders = [-4.0, -2.0]
pairs = "reference"
[reference]
source = "sphere"
[[family]]
name = "bumpy"
source = "files"
paths = ["*.off"]
"""
# What depends on who did it, and when.
_OF_THE_RUN = ("seconds", "worker", "finished")


def write_study(folder: Path, count: int) -> Path:
    """Write icospheres whose vertices are moved in or out at random, and the study of them; return its file."""
    write_meshes(folder, range(count), np.random.default_rng(0), level=3)
    path = folder / "study.toml"
    path.write_text(STUDY)
    return path


def write_meshes(folder: Path, numbers: range, chance: np.random.Generator, level: int = 1) -> None:
    """Write icospheres of these numbers, whose vertices are moved in or out at random."""
    sphere = icosphere(level)
    for number in numbers:
        vertices = sphere.vertices * chance.uniform(0.7, 1.0, (len(sphere.vertices), 1))
        (folder / f"{number:06}.off").write_bytes(off(vertices, sphere.triangles.tolist()))


def differences(ours: Location, theirs: Location) -> Iterator[str]:
    """Where a store differs from one that is right: fields to the bit, tables to their last digits."""
    store, right = Store.open(ours), Store.open(theirs)
    if store.labels() != right.labels():
        yield "the meshes are not the same"
        return
    (place,) = right.places()
    for row, (label, record) in enumerate(zip(store.labels(), store.records(), strict=True)):
        if record is None or record.status != "complete":
            yield f"{label}: {record.reason if record else 'missing'}"
        # A field that is missing is NaN, which equals nothing.
        elif not np.array_equal(store.read_fields([row], place), right.read_fields([row], place)):
            yield f"{label}: another field"
    trees = open_store(ours), open_store(theirs)
    for name in ("norms", "distances", "convergence", "meshes"):
        try:
            found, expected = (tree[name].to_dataset().drop_vars(_OF_THE_RUN, errors="ignore") for tree in trees)
            xr.testing.assert_allclose(found.drop_attrs(), expected.drop_attrs(), rtol=1e-12, atol=0)
        except (AssertionError, DamageError) as error:
            yield f"{name}: {error}"
