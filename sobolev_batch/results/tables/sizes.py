"""Sizes of meshes, against which distances fall, and the rates at which they do."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.spectral.metrics.datasets import observed_rates
from sobolev_batch.surfaces.sources.names import quoted

Reals = NDArray[np.float64]

# Of the columns of a table. The finer a mesh is, the smaller is the first, and the larger are the others.
EDGE_LENGTH = "edge_length"
_GROWING = ("triangles", "vertices", "seconds")
_FROM_COARSE_TO_FINE = ("level", "triangles")


_LABELS = {
    EDGE_LENGTH: "mean edge length in the study's unit",
    "triangles": "number of triangles",
    "vertices": "number of vertices",
    "seconds": "computing time of the mesh in seconds",
}


def label_of(x: str) -> str:
    """Return the label of an axis of sizes; one of the metadata has its name."""
    return _LABELS.get(x, x)


def sizes_of(frame: pd.DataFrame, x: str) -> Reals:
    """Return the sizes of the meshes of a table, NaN where they are not known.

    Args:
        frame: Rows of `table`.
        x: Name of the size.

    Raises:
        InputError: The table has no such column of numbers.
    """
    if x not in frame or not pd.api.types.is_numeric_dtype(frame[x]):
        numbers = [name for name in (EDGE_LENGTH, *_GROWING) if name in frame]
        given = [name for name in frame.attrs.get("metadata", ()) if pd.api.types.is_numeric_dtype(frame[name])]
        raise InputError(f"no size of meshes is named {quoted(x)}; known are {', '.join([*numbers, *given])}")
    sizes: Reals = frame[x].to_numpy(dtype=np.float64)
    # A surface in closed form has none.
    return np.where(sizes > 0, sizes, np.nan)


def is_sequence(rows: pd.DataFrame) -> bool:
    """Return True where the meshes of a family go from coarse to fine, so that a line may join them."""
    return bool(rows["ordered_by"].isin(_FROM_COARSE_TO_FINE).all())


def with_rates(frame: pd.DataFrame, x: str) -> pd.DataFrame:
    """Return rows of `table` with rates in another size, in place of those in the edge length.

    Raises:
        InputError: See `sizes_of`.
    """
    sizes = sizes_of(frame, x) if x == EDGE_LENGTH else 1 / sizes_of(frame, x)
    rates, errors = np.full(len(frame), np.nan), np.full(len(frame), np.nan)
    numbered = frame.reset_index(drop=True)
    for _, rows in numbered.groupby(["order", "family"], sort=False):
        if is_sequence(rows):
            places = rows.index.to_numpy()
            distances, bounds = rows["distance"].to_numpy(), rows["error"].to_numpy()
            rates[places], errors[places] = observed_rates(distances, bounds, sizes[places])
    return numbered.assign(rate=rates, rate_error=errors)
