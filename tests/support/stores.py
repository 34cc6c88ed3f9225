"""Comparison of stores."""

from __future__ import annotations

import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import xarray as xr

from tests.support.studies import variable

TABLES = (("norms", "norm"), ("norms", "error"), ("distances", "distance"), ("convergence", "distance"))


def assert_same_results(one: Path | str, other: Path | str) -> None:
    """Check that the fields of two stores are complete and equal, bit for bit, and that their tables agree."""
    with xr.open_datatree(one, engine="zarr") as left, xr.open_datatree(other, engine="zarr") as right:
        a, b = variable(left, "fourier", "fourier"), variable(right, "fourier", "fourier")
        assert a["mesh"].values.tolist() == b["mesh"].values.tolist()
        for label in a["mesh"].values.tolist():
            assert not np.isnan(a.sel(mesh=label).values).any(), label
            assert np.array_equal(a.sel(mesh=label).values, b.sel(mesh=label).values), label
        for group, name in TABLES:
            a, b = variable(left, group, name), variable(right, group, name)
            np.testing.assert_allclose(a.values, b.values, rtol=1e-12, atol=0, err_msg=f"{group}/{name}")
        for name in ("status", "digest"):
            a, b = variable(left, "meshes", name), variable(right, "meshes", name)
            assert a.values.tolist() == b.values.tolist()


def assert_same(ours: xr.DataTree, theirs: xr.DataTree) -> None:
    """Check that two stores are equal to the bit, except for workers and times."""
    assert set(ours.children) == set(theirs.children)
    for group in ("fourier", "norms", "distances", "convergence", "meshes"):
        one, other = (
            tree[group].to_dataset().drop_vars(["seconds", "worker", "finished"], errors="ignore")
            for tree in (ours, theirs)
        )
        if group == "fourier":
            # This coordinate holds the data for errors; the field itself is compared below.
            assert np.array_equal(one["quality"].values, other["quality"].values)
        xr.testing.assert_identical(one.drop_attrs(), other.drop_attrs())


# A program that reads a store without this package.
READER = """
import sys, warnings
warnings.simplefilter("error")
sys.modules["sobolev_batch"] = None
import xarray
tree = xarray.open_datatree(sys.argv[1], engine="zarr")
for node in tree.subtree:
    node.to_dataset().load()
assert sorted(tree.children) == ["convergence", "distances", "fourier", "meshes", "norms", "records"]
assert tree["fourier"]["fourier"].dims == ("mesh", "xi_x", "xi_y", "xi_z")
assert str(tree["convergence"]["distance"].sel(mesh="ico/2", order=-3.0).dims) == "()"
print(float(tree["convergence"]["relative"].sel(mesh="ico/3", order=-10.0)))
"""


@contextmanager
def full_disk(most_bytes: int | None = None) -> Iterator[Callable[[int], None]]:
    """Let this process write no larger files, from now on or once the yielded function is called with a size."""
    before, most = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(size_bytes: int) -> None:
        # Python ignores the signal, so that writing fails.
        resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, most))

    try:
        if most_bytes is not None:
            fill(most_bytes)
        yield fill
    finally:
        fill(before)


def contents(store: Path) -> dict[Path, bytes]:
    """Return the content of each file of a store."""
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
