"""Values of the witness function of a stored mesh against its study's reference."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.batch.store.comparison_records import ComparisonRecords
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.store.witness_array import Witnesses
from sobolev_batch.results.open import source_of
from sobolev_batch.results.tables.groups import reference_of
from sobolev_batch.spectral.dtypes import ComplexDtype
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
    """Return values (orders, n) at a mesh's own vertices: stored ones where the store has them, else from the fields.

    Vertices that no triangle uses have NaN: they may lie beyond the lattice's period.

    Args:
        tree: Open store with tables.
        label: Label of the mesh.
        mesh: Mesh in the study's unit.
        orders: Orders s.
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
        computed = witness_at(tree, label, [orders[i] for i in missing], mesh.vertices[used])
        for i, row in zip(missing, computed, strict=True):
            values[i, used] = row
    return values


def _stored(tree: xr.DataTree, label: str, order: float, count: int) -> Reals | None:
    """Return the stored values of one mesh and order, NaN if not computed; None if the store has none of them."""
    if "witness" not in tree.children:
        return None
    stored = tree["witness"].to_dataset()["witness"]
    if label not in stored["mesh"].values or order not in stored["order"].values or stored.sizes["vertex"] < count:
        return None
    place = source_of(tree)
    store = None if place is None else Store.open(place)
    if store is None or not Witnesses(store).are_listed():
        # Values that somebody else has put into the tree.
        return np.asarray(stored.sel(mesh=label, order=order).isel(vertex=slice(count)).to_numpy(), dtype=np.float64)
    # Held against their record: chunks of two meshes may have traded places.
    row = store.labels().index(label)
    record = ComparisonRecords(store, "witness").read_row(row)
    if record is None or record.status != "complete":
        return None
    values: Reals = Witnesses(store).read(row, count, record.checksum)[stored["order"].values.tolist().index(order)]
    return values
