"""Tables of a store at any order: the stored ones, and others computed from the fields."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr

from sobolev_batch.batch.analysis.datasets import DistancesToReference, convergence_dataset, distances_dataset
from sobolev_batch.results.open import require_unchanged
from sobolev_batch.results.store_accessor import StoreAccessor, stored_fields
from sobolev_batch.results.tables.groups import finished_group, metadata_of, reference_of
from sobolev_batch.results.tables.sizes import is_sequence
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.errors.budget import NormEstimate
from sobolev_batch.spectral.metrics.norms import Proportion
from sobolev_batch.spectral.shells import Orders, check_orders
from sobolev_batch.surfaces.sources.registry import Metadata


@dataclass(frozen=True)
class _StoredMember:
    time: float | None
    metadata: Metadata


@dataclass(frozen=True)
class _StoredRow:
    """A row of the table of meshes."""

    label: str
    member: _StoredMember


def convergence_at(tree: xr.DataTree, order: Orders | None) -> xr.Dataset:
    """Return the convergence table of an open store at some orders, in memory.

    Args:
        tree: Open store.
        order: One order s < -1/2, or several, of the store or not; default all of the store. The attribute
            ``computed`` of the table lists those that were computed from the fields.

    Raises:
        InputError: The store has no tables yet; or other orders are asked for, and the tree does not say where it was
            opened.
        OrderError: An order is not below -1/2.
        DamageError: A field is not what was stored.
    """
    stored = finished_group(tree, "convergence")
    chosen, others = _divided(stored, order)
    if not others:
        return stored.sel(order=chosen)
    fields, meshes, rows = stored_fields(tree), finished_group(tree, "meshes"), _rows(tree)
    results, numbers = fields.results(others, every_pair=False), meshes["row"].values.tolist()
    require_unchanged(tree)
    to_reference = DistancesToReference(
        reference_of(tree),
        NormEstimate(*results.to_reference[..., numbers]),
        Proportion(*results.proportions[..., numbers]),
        NormEstimate(*results.norms[..., fields.reference]),
    )
    accuracy = Accuracy(stored.attrs["rtol"]) if "rtol" in stored.attrs else None
    sizes, families = meshes["edge_length_mean"].to_numpy(), _sequences(meshes)
    return _joined(stored, convergence_dataset(rows, others, to_reference, sizes, families, accuracy), chosen)


def distances_at(tree: xr.DataTree, order: Orders | None) -> xr.Dataset:
    """Return the distances of an open store's meshes at some orders, lazily if the store has them all.

    Args:
        tree: Open store.
        order: See `convergence_at`.

    Raises:
        InputError, OrderError, DamageError: See `convergence_at`.
    """
    stored = finished_group(tree, "distances", load=False)
    chosen, others = _divided(stored, order)
    if not others:
        return stored.sel(order=chosen)
    fields, every_pair = stored_fields(tree), stored.sizes["other"] == stored.sizes["mesh"]
    rows, numbers = _rows(tree), finished_group(tree, "meshes")["row"].values.tolist()
    distances = fields.results(others, every_pair=every_pair).distances[..., numbers, :]
    require_unchanged(tree)
    to_rows = rows if every_pair else [row for row in rows if row.label == reference_of(tree)]
    estimate = NormEstimate(*distances[..., numbers if every_pair else [0]])
    return _joined(stored, distances_dataset(rows, to_rows, others, estimate), chosen)


def reference_norm_at(tree: xr.DataTree, order: float) -> xr.Dataset:
    """Return the norm of an open store's reference at one order, with its error.

    Raises:
        InputError, OrderError, DamageError: See `convergence_at`.
    """
    stored, reference = finished_group(tree, "norms"), reference_of(tree)
    if order in stored["order"].values:
        return stored.sel(mesh=reference, order=order)
    return StoreAccessor(tree).norm(reference, order)


def order_note(tree: xr.DataTree, orders: Sequence[float]) -> list[str]:
    """Return what orders that were computed from the fields rest on, as lines of a note of a table."""
    fields = stored_fields(tree)
    frequencies = f"frequencies up to {fields.lattice.xi_max:g} on each axis"
    if fields.tail is not None:
        frequencies = f"{frequencies}, and samples in octaves up to {fields.tail.highest_frequency:.4g}"
    return [
        f"Not of the study, but computed now from its stored fields: order {', '.join(f'{s:g}' for s in orders)}.",
        f"They hold {frequencies}.",
        "What lies beyond is in the errors, which grow at orders nearer to -1/2.",
    ]


def _divided(stored: xr.Dataset, order: Orders | None) -> tuple[list[float], tuple[float, ...]]:
    """Return the orders that are asked for, and those of them that the store lacks."""
    own: list[float] = stored["order"].values.tolist()
    chosen = own if order is None else list(check_orders(order))
    return chosen, tuple(dict.fromkeys(s for s in chosen if s not in own))


def _joined(stored: xr.Dataset, computed: xr.Dataset, chosen: list[float]) -> xr.Dataset:
    """Return the chosen orders of two tables."""
    names = list(computed.data_vars)
    both = xr.concat(
        [stored[names].load(), computed], "order", data_vars="minimal", coords="minimal", compat="override",
        join="exact", combine_attrs="override",
    )  # fmt: skip
    table = both.sel(order=chosen)
    return table.assign_attrs({**stored.attrs, "computed": computed["order"].values.tolist()})


def _rows(tree: xr.DataTree) -> list[_StoredRow]:
    meshes, names = finished_group(tree, "meshes"), metadata_of(tree)
    labels: list[str] = meshes["mesh"].values.tolist()
    times = meshes["time"].values.tolist() if "time" in meshes.coords else [np.nan] * len(labels)
    columns = [meshes[name].values.tolist() for name in names]
    metadata = [tuple(zip(names, values, strict=True)) for values in zip(*columns, strict=True)] or [()] * len(labels)
    return [
        _StoredRow(label, _StoredMember(None if np.isnan(time) else time, known))
        for label, time, known in zip(labels, times, metadata, strict=True)
    ]


def _sequences(meshes: xr.Dataset) -> list[list[int]]:
    """Return the places of the meshes of each family that goes from coarse to fine."""
    frame = pd.DataFrame({name: meshes[name].values for name in ("family", "ordered_by")})
    return [rows.index.tolist() for _, rows in frame.groupby("family", sort=False) if is_sequence(rows)]
