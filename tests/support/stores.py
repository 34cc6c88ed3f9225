"""Comparison of stores, and damage to their files."""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from threading import Barrier

import numpy as np
import xarray as xr

from sobolev_batch.errors import DamageError, LockError
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import Lock, acquire
from tests.support.studies import variable

# What depends on who did it, and when.
_OF_THE_RUN = ("seconds", "worker", "finished")


def differences(ours: xr.DataTree, theirs: xr.DataTree) -> Iterator[str]:
    """Yield where an open store differs from one that is right: fields to the bit, tables to their last digits."""
    fields, right = (variable(tree, "fourier", "fourier") for tree in (ours, theirs))
    labels = right["mesh"].values.tolist()
    if fields["mesh"].values.tolist() != labels or set(ours.children) != set(theirs.children):
        yield "the meshes or the tables are not the same"
        return
    own, collected = (variable(ours, "records", name).values for name in ("record", "page"))
    for row, label in enumerate(labels):
        if not (own[row] or collected[row]):
            yield f"{label}: missing"
        # A field that is missing is NaN, which equals nothing.
        elif not np.array_equal(fields[row].values, right[row].values):
            yield f"{label}: another field"
    for name in ("fourier", "norms", "distances", "convergence", "meshes"):
        try:
            found, expected = (
                tree[name]
                .to_dataset()
                .reset_coords()
                .drop_vars(["fourier", *_OF_THE_RUN], errors="ignore")
                # Keys of tiles, which may be of any size.
                .drop_dims(["tile", "other_tile"], errors="ignore")
                .drop_attrs()
                for tree in (ours, theirs)
            )
            xr.testing.assert_allclose(found, expected, rtol=1e-12, atol=0)
        except (AssertionError, DamageError) as error:
            yield f"{name}: {error}"


def assert_same_results(one: Path | str, other: Path | str) -> None:
    """Check that two stores are complete and equal, as anybody reads them."""
    with xr.open_datatree(one, engine="zarr") as left, xr.open_datatree(other, engine="zarr") as right:
        found = list(differences(left, right))
    assert not found, found


# A program that reads a store without this package.
READER = """
import sys, warnings
warnings.simplefilter("error")
sys.modules["sobolev_batch"] = None
import xarray
tree = xarray.open_datatree(sys.argv[1], engine="zarr")
for node in tree.subtree:
    node.to_dataset().load()
assert sorted(tree.children) == ["convergence", "distances", "fourier", "meshes", "norms", "records", "spectra"]
assert tree["fourier"]["fourier"].dims == ("mesh", "xi_x", "xi_y", "xi_z")
assert str(tree["convergence"]["distance"].sel(mesh="ico/2", order=-3.0).dims) == "()"
print(float(tree["convergence"]["relative"].sel(mesh="ico/3", order=-10.0)))
"""


@contextmanager
def full_disk(most_bytes: int | None = None) -> Iterator[Callable[[int], None]]:
    """Let this process write no larger files, from now on or once the yielded function is called with a size."""
    before, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    writes_no_bytecode = sys.dont_write_bytecode

    def fill(size_bytes: int) -> None:
        # Python cuts a compiled module off at the limit and keeps it, so that every later import of it would fail.
        sys.dont_write_bytecode = writes_no_bytecode or size_bytes != before
        # Python ignores the signal, so that writing fails.
        resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, most))

    try:
        if most_bytes is not None:
            fill(most_bytes)
        yield fill
    finally:
        fill(before)


def winners(location: Location, count: int) -> int:
    """Return how many of several drivers that claim a store at once get it."""
    together = Barrier(count)

    def attempt(number: int) -> bool:
        together.wait()
        try:
            acquire(location, Lock.of_this_process())
        except LockError:
            return False
        return True

    with ThreadPoolExecutor(count) as pool:
        return sum(pool.map(attempt, range(count)))


def contents(store: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}


@contextmanager
def put_back(store: Path) -> Iterator[Path]:
    """Undo every change of a store's files at the end: quicker than a copy of the store."""
    before = contents(store)
    yield store
    for path in {path for path in store.rglob("*") if path.is_file()} - before.keys():
        path.unlink()
    for path, content in before.items():
        # A file may be sparse, and larger than the memory.
        if not path.exists() or path.stat().st_size != len(content) or path.read_bytes() != content:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)


def truncate(chunk: Path) -> None:
    chunk.write_bytes(chunk.read_bytes()[:-10])


def empty(chunk: Path) -> None:
    chunk.write_bytes(b"")


def flip(chunk: Path) -> None:
    data = bytearray(chunk.read_bytes())
    data[len(data) // 3] ^= 1
    chunk.write_bytes(data)


def delete(chunk: Path) -> None:
    chunk.unlink()
