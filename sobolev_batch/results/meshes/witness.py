"""Values of the witness function of a stored mesh against its study's reference."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.results.tables.groups import reference_of
from sobolev_batch.spectral.backends.arrays import ComplexDtype
from sobolev_batch.spectral.metrics.witness import witness
from sobolev_batch.surfaces.shapes.mesh import Mesh

Reals = NDArray[np.float64]


def witness_at(
    tree: xr.DataTree, label: str, orders: Sequence[float], points: Reals, dtype: ComplexDtype = "complex128"
) -> Reals:
    """Return values (orders, n) from the stored fields at points (n, 3) in the study's unit; see `witness`."""
    fields = tree["fourier"].to_dataset()["fourier"]
    pair = fields.sel(mesh=label), fields.sel(mesh=reference_of(tree))
    return np.asarray(witness(*pair, list(orders), points, dtype=dtype).to_numpy(), dtype=np.float64)


def witness_at_vertices(tree: xr.DataTree, label: str, mesh: Mesh, orders: Sequence[float]) -> Reals:
    """Return values (orders, n) at a mesh's own vertices.

    Vertices that no triangle uses have NaN: they may lie beyond the lattice's period.

    Args:
        tree: Open store with tables.
        label: Label of the mesh.
        mesh: Mesh in the study's unit.
        orders: Orders s.
    """
    used = mesh.used_vertices
    values = np.full((len(orders), len(mesh.vertices)), np.nan)
    values[:, used] = witness_at(tree, label, orders, mesh.vertices[used])
    return values
