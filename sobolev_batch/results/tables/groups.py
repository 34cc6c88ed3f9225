"""What an open store has: its groups, orders, families and sizes of meshes; and its tables at any other order."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.batch.analysis.datasets import DistancesToReference, convergence_dataset, distances_dataset
from sobolev_batch.errors import InputError
from sobolev_batch.results.open import require_unchanged
from sobolev_batch.results.store_accessor import StoreAccessor, stored_fields
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.budget import NormEstimate
from sobolev_batch.spectral.metrics.norms import Proportion
from sobolev_batch.spectral.quality import Quality
from sobolev_batch.spectral.shells import Orders, check_orders
from sobolev_batch.surfaces.shapes.surface import placement_doubt
from sobolev_batch.surfaces.sources.names import quoted

Reals = NDArray[np.float64]

# Names of families, or globs of names; None is all of them.
Families = str | Sequence[str] | None

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


def finished_group(tree: xr.DataTree, name: str, *, load: bool = True) -> xr.Dataset:
    """Return a table of an open store, in memory unless it may stay on disk.

    Raises:
        InputError: The store has no tables yet.
    """
    if name not in tree.children:
        raise InputError("the store has no tables yet: run the study to its end")
    dataset = tree[name].to_dataset()
    return dataset.load() if load else dataset


def chosen_orders(dataset: xr.Dataset, order: Orders | None) -> list[float]:
    """Return one order or several of a table as a list; all of them by default.

    Raises:
        InputError: The table lacks one of them.
    """
    stored: list[float] = dataset["order"].values.tolist()
    if order is None:
        return stored
    chosen: list[float] = np.atleast_1d(np.asarray(order, dtype=np.float64)).tolist()
    for s in chosen:
        if s not in stored:
            listed = ", ".join(f"{s:g}" for s in stored)
            raise InputError(f"the store has no order {s:g}, only {listed}; add it to the study and run it again")
    return chosen


def chosen_order(tree: xr.DataTree, order: float | None) -> float:
    """Return one of the orders of an open store; its first by default.

    Raises:
        InputError: The store has no tables yet, or lacks the order.
    """
    return chosen_orders(finished_group(tree, "convergence", load=False), order)[0]


def has_proximity(tree: xr.DataTree) -> bool:
    """Return True if the store has Hausdorff and Chamfer distances."""
    return "proximity" in tree.children


def reference_of(tree: xr.DataTree) -> str:
    """Return the label of the study's reference."""
    return str(finished_group(tree, "convergence", load=False).attrs["reference"])


def families_of(tree: xr.DataTree) -> dict[str, str]:
    """Return the family of each mesh by its label, in the order of the study."""
    meshes = finished_group(tree, "meshes", load=False)
    return dict(zip(meshes["mesh"].values.tolist(), meshes["family"].values.tolist(), strict=True))


def chosen_families(tree: xr.DataTree, family: Families) -> list[str]:
    """Return the families that names or globs choose, in the order of the study; all of them by default.

    Raises:
        InputError: A name or glob fits no family.
    """
    known = list(dict.fromkeys(families_of(tree).values()))
    if family is None:
        return known
    chosen: set[str] = set()
    for pattern in [family] if isinstance(family, str) else family:
        # A name may have characters that mean something else in a glob.
        fitting = [pattern] if pattern in known else [name for name in known if fnmatchcase(name, pattern)]
        if not fitting:
            raise InputError(f"the study has no family {quoted(pattern)}, only {', '.join(known)}")
        chosen.update(fitting)
    return [name for name in known if name in chosen]


def has_times(tree: xr.DataTree) -> bool:
    """Return True if any mesh of the store has a time."""
    return "time" in finished_group(tree, "meshes", load=False).coords


def metadata_of(tree: xr.DataTree) -> list[str]:
    """Return the names of the metadata that the study gives its meshes."""
    return list(finished_group(tree, "meshes", load=False).attrs.get("metadata", ()))


def complete_meshes(tree: xr.DataTree) -> list[str]:
    """Return the labels of all meshes that are computed, the reference among them."""
    meshes = finished_group(tree, "meshes", load=False)
    labels: list[str] = meshes["mesh"].values[meshes["status"].values == "complete"].tolist()
    return labels


def placement_doubts(tree: xr.DataTree) -> dict[str, str]:
    """Return why one doubts that a mesh can be compared with the reference, by the label of the mesh."""
    complete, reference = complete_meshes(tree), reference_of(tree)
    if reference not in complete:
        return {}
    texts = tree["fourier"]["quality"].sel(mesh=complete).load()
    extents = {label: Quality.from_json(str(texts.sel(mesh=label).item())).extent for label in complete}
    doubts = {label: placement_doubt(extent, extents[reference]) for label, extent in extents.items()}
    return {label: doubt for label, doubt in doubts.items() if doubt is not None}


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


def convergence_at(tree: xr.DataTree, order: Orders | None) -> xr.Dataset:
    """Return the convergence table of an open store at some orders, in memory.

    Args:
        tree: Open store.
        order: One order s < -1/2, or several, of the store or not; default all of the store. The attribute
            ``computed`` of the table lists those that were computed from the fields.

    Raises:
        InputError: The store has no tables yet; or other orders are requested, and the tree does not say where it was
            opened.
        OrderError: An order is not below -1/2.
        DamageError: A field is not what was stored.
    """
    stored = finished_group(tree, "convergence")
    chosen, others = _divided(stored, order)
    if not others:
        return stored.sel(order=chosen)
    fields, meshes = stored_fields(tree), finished_group(tree, "meshes")
    results = fields.results(others, meshes["row"].values.tolist(), every_pair=False)
    require_unchanged(tree)
    to_reference = DistancesToReference(
        reference_of(tree),
        NormEstimate(*results.to_reference),
        Proportion(*results.proportions),
        NormEstimate(*results.norms[..., results.places[fields.reference]]),
    )
    accuracy = Accuracy(stored.attrs["rtol"]) if "rtol" in stored.attrs else None
    sizes, families = meshes["edge_length_mean"].to_numpy(), _sequences(meshes)
    return _joined(stored, convergence_dataset(meshes.coords, others, to_reference, sizes, families, accuracy), chosen)


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
    meshes = finished_group(tree, "meshes")
    results = fields.results(others, meshes["row"].values.tolist(), every_pair=every_pair)
    require_unchanged(tree)
    estimate = NormEstimate(*results.distances)
    return _joined(stored, distances_dataset(meshes.coords, stored["other"].values, others, estimate), chosen)


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
    fields = stored_fields(tree, meshes=())
    frequencies = f"frequencies up to {fields.lattice.xi_max:g} on each axis"
    if fields.tail is not None:
        frequencies = f"{frequencies}, and samples in octaves up to {fields.tail.highest_frequency:.4g}"
    return [
        f"Not of the study, but computed now from its stored fields: order {', '.join(f'{s:g}' for s in orders)}.",
        f"They hold {frequencies}.",
        "What lies beyond is in the errors, which grow at orders nearer to -1/2.",
    ]


def _divided(stored: xr.Dataset, order: Orders | None) -> tuple[list[float], tuple[float, ...]]:
    """Return the orders that are requested, and those of them that the store lacks."""
    own: list[float] = stored["order"].values.tolist()
    chosen = own if order is None else list(check_orders(order))
    return chosen, tuple(dict.fromkeys(s for s in chosen if s not in own))


def _joined(stored: xr.Dataset, computed: xr.Dataset, chosen: list[float]) -> xr.Dataset:
    """Return the chosen orders of two tables."""
    both = xr.concat(
        [stored.load(), computed], "order", data_vars="minimal", coords="minimal", compat="override",
        join="exact", combine_attrs="override",
    )  # fmt: skip
    table = both.sel(order=chosen)
    return table.assign_attrs({**stored.attrs, "computed": computed["order"].values.tolist()})


def _sequences(meshes: xr.Dataset) -> list[list[int]]:
    """Return the places of the meshes of each family that goes from coarse to fine."""
    frame = pd.DataFrame({name: meshes[name].values for name in ("family", "ordered_by")})
    return [rows.index.tolist() for _, rows in frame.groupby("family", sort=False) if is_sequence(rows)]
