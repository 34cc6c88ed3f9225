"""Values of the witness function of a stored mesh against its study's reference."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.spectral.dtypes import ComplexDtype
from sobolev_batch.spectral.metrics.witness import witness
from sobolev_batch.surfaces.shapes.mesh import Mesh

Reals = NDArray[np.float64]


def witness_at(
    tree: xr.DataTree, label: str, orders: Sequence[float], points: Reals, dtype: ComplexDtype = "complex128"
) -> Reals:
    """Values (orders, n) from the stored fields at points (n, 3) in the study's unit; see `witness`."""
    fields = tree["fourier"].to_dataset()["fourier"]
    reference = tree["convergence"].attrs["reference"]
    found = witness(fields.sel(mesh=label), fields.sel(mesh=reference), list(orders), points, dtype=dtype)
    return np.asarray(found.to_numpy(), dtype=np.float64)


def witness_at_vertices(tree: xr.DataTree, label: str, mesh: Mesh, orders: Sequence[float]) -> Reals:
    """Values (orders, n) at the mesh's own vertices: the stored ones where the store has them, else from the fields.

    NaN at vertices that no triangle uses: they may lie beyond the lattice's period.

    Args:
        tree: an open store with tables.
        label: of the mesh.
        mesh: in the study's unit.
        orders: s, each.
    """
    used = mesh.used_vertices
    values = np.full((len(orders), len(mesh.vertices)), np.nan)
    missing = []
    for i, order in enumerate(orders):
        stored = _stored(tree, label, order, len(mesh.vertices))
        if stored is None or not np.isfinite(stored[used]).all():
            missing.append(i)
        else:
            values[i] = stored
    if missing:
        found = witness_at(tree, label, [orders[i] for i in missing], mesh.vertices[used])
        for i, row in zip(missing, found, strict=True):
            values[i, used] = row
    return values


def _stored(tree: xr.DataTree, label: str, order: float, count: int) -> Reals | None:
    """What the store has for one mesh and order, NaN where that is not computed; None where it has no room for it."""
    if "witness" not in tree.children:
        return None
    found = tree["witness"].to_dataset()["witness"]
    if label not in found["mesh"].values or order not in found["order"].values or found.sizes["vertex"] < count:
        return None
    return np.asarray(found.sel(mesh=label, order=order).isel(vertex=slice(count)).to_numpy(), dtype=np.float64)
