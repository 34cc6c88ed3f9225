"""Whether two stores of a study hold the same."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import xarray as xr

from sobolev_batch import DamageError, open_store
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.store import Store

_TABLES = ("norms", "distances", "convergence", "meshes")
# What depends on who did it, and when.
_OF_THE_RUN = ("seconds", "worker", "finished")
_TABLE_RTOL = 1e-12
_AT_ONCE = 50


def differences(ours: Location, theirs: Location) -> Iterator[str]:
    """Where a store differs from one that is right: fields to the bit, tables to their last digits."""
    store, right = Store.open(ours), Store.open(theirs)
    if store.labels() != right.labels():
        yield "the meshes are not the same"
        return
    for label, record in zip(store.labels(), store.records(), strict=True):
        if record is None:
            yield f"{label}: missing"
        elif record.status != "complete":
            yield f"{label}: {record.reason}"
    shape = open_store(theirs)["fourier"]["fourier"].shape[1:]
    place = (slice(0, shape[0]), slice(0, shape[1]), slice(0, shape[2]))
    count = len(store.labels())
    for rows in (range(first, min(first + _AT_ONCE, count)) for first in range(0, count, _AT_ONCE)):
        for row, found, expected in zip(rows, *(one.read_fields(rows, place) for one in (store, right)), strict=True):
            # A field that is not there is NaN, which equals nothing.
            if not np.array_equal(found, expected):
                yield f"{store.labels()[row]}: another field"
    trees = open_store(ours), open_store(theirs)
    for name in _TABLES:
        try:
            found, expected = (tree[name].to_dataset().drop_vars(_OF_THE_RUN, errors="ignore") for tree in trees)
            xr.testing.assert_allclose(found.drop_attrs(), expected.drop_attrs(), rtol=_TABLE_RTOL, atol=0)
        except (AssertionError, DamageError) as error:
            yield f"{name}: {error}"
