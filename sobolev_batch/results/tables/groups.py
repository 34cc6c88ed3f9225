"""Groups of an open store, and the orders that they have."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase

import numpy as np
import xarray as xr

from sobolev_batch.errors import InputError
from sobolev_batch.spectral.shells import Orders
from sobolev_batch.surfaces.sources.names import quoted

# Names of families, or globs of names; None is all of them.
Families = str | Sequence[str] | None


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
