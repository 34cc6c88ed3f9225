"""What plots show of a store: orders, families, and the spectra of their meshes."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import pandas as pd
import xarray as xr

from sobolev_batch.errors import InputError
from sobolev_batch.extras.figures.style import Style, style_of
from sobolev_batch.extras.leagues.statistics import EDGE_LENGTH
from sobolev_batch.norms.causes import spectrum
from sobolev_batch.parameters import as_names
from sobolev_batch.sources.names import fits, quoted
from sobolev_batch.tables.open import AnyStore, as_tree, complete_meshes, finished_group, reference_of
from sobolev_batch.tables.other_orders import distances_at
from sobolev_batch.tables.results import FROM_COARSE_TO_FINE
from sobolev_batch.tables.store_accessor import StoreAccessor
from sobolev_batch.tables.text import spread
from sobolev_batch.transform.lattice import Orders, check_orders

# Names of families, or globs of names; None is all of them.
Families = str | Sequence[str] | None
# A field is read for each mesh; one of 17 MB takes about a quarter of a second.
MOST_SPECTRA = 24
_MOST_SAMPLES = 1 << 28


@dataclass(frozen=True, eq=False)
class Selection:
    """The part of an open store that plots show.

    Attributes:
        x: Horizontal axis of convergence.
    """

    tree: xr.DataTree
    orders: tuple[float, ...]
    families: tuple[str, ...]
    x: str = EDGE_LENGTH

    @classmethod
    def from_store(
        cls, store: AnyStore, order: Orders | None = None, family: Families = None, x: str = EDGE_LENGTH
    ) -> Self:
        """Choose any orders, default the study's, and families by names or globs; InputError for an unknown family."""
        tree = as_tree(store)
        orders = finished_group(tree, "convergence")["order"].values.tolist() if order is None else check_orders(order)
        return cls(tree, tuple(orders), tuple(chosen_families(tree, family)), x)

    @cached_property
    def styles(self) -> Mapping[str, Style]:
        """Style of each family of the study, whichever of them are drawn."""
        return {family: style_of(i) for i, family in enumerate(dict.fromkeys(families_of(self.tree).values()))}

    @cached_property
    def compared(self) -> list[str]:
        """Labels of the computed meshes of the chosen families; none where the reference is not computed."""
        complete, family_of, reference = complete_meshes(self.tree), families_of(self.tree), reference_of(self.tree)
        others = [label for label in complete if label != reference and family_of[label] in self.families]
        return others if reference in complete else []

    @cached_property
    def spectra(self) -> xr.Dataset:
        """Squared distances of some meshes to the reference by wavelength, evenly through the chosen families.

        `share` (mesh, order, band) of each squared distance; `energy` (mesh, band), ∫_{|ξ|=r} |a^ - b^|² dS of the
        difference as a fraction of twice both areas, with its standard error `energy_error`, zero for bands of a
        lattice; `wavelength` (band), that of the middle frequency in the study's unit; and `text` (band), its range.
        The attribute `omission` is a note on the meshes that were not chosen, empty where all were. InputError where
        the store has no mesh to compare.
        """
        tree, orders, meshes = self.tree, self.orders, self.compared
        if not meshes:
            raise InputError("the store has no mesh to compare: the reference or all others are not computed")
        reference, fields = reference_of(tree), tree["fourier"].to_dataset()["fourier"]
        affordable = _MOST_SAMPLES // int(np.prod(fields.shape[1:]))
        labels = spread(meshes, max(1, min(MOST_SPECTRA, affordable)))
        if "octaves" in tree:
            found = [StoreAccessor(tree).spectrum(orders, label, reference) for label in labels]
        else:
            of_reference = fields.sel(mesh=reference).load()
            found = [spectrum(fields.sel(mesh=label), of_reference, orders) for label in labels]
            found = [bands.assign(energy_error=xr.zeros_like(bands["energy"])) for bands in found]
        along, parts = pd.Index(labels, name="mesh"), [bands[["share", "energy", "energy_error"]] for bands in found]
        spectra = xr.concat(parts, along, coords="minimal", compat="override").drop_attrs()
        areas = finished_group(tree, "meshes")["area"].reset_coords(drop=True)
        limits = 2 * (areas.sel(mesh=labels) + areas.sel(mesh=reference, drop=True))
        longest, shortest = (spectra[f"{name}_wavelength"].to_numpy() for name in ("longest", "shortest"))
        ends = zip(longest, shortest, strict=True)
        texts = [f"> {short:.3g}" if np.isinf(long) else f"{long:.3g} – {short:.3g}" for long, short in ends]
        return spectra.assign(
            energy=spectra["energy"] / limits,
            energy_error=spectra["energy_error"] / limits,
            wavelength=("band", 2 / (1 / longest + 1 / shortest)),
            text=("band", texts),
        ).assign_attrs(omission=f"{len(labels)} of {len(meshes)} meshes" if len(labels) < len(meshes) else "")

    @property
    def has_spectra(self) -> bool:
        """True if the store has a mesh to compare, of the chosen families."""
        return "similarity" in self.tree.attrs and bool(self.compared)


def families_of(tree: xr.DataTree) -> dict[str, str]:
    """Return the family of each mesh by its label, in the order of the study."""
    meshes = finished_group(tree, "meshes", load=False)
    return dict(zip(meshes["mesh"].values.tolist(), meshes["family"].values.tolist(), strict=True))


def chosen_families(tree: xr.DataTree, family: Families) -> list[str]:
    """Return the families that names or globs choose, in the study's order; InputError if one fits none of it."""
    known = list(dict.fromkeys(families_of(tree).values()))
    if family is None:
        return known
    chosen: set[str] = set()
    for pattern in as_names(family):
        # A name may have characters that mean something else in a glob.
        fitting = [pattern] if pattern in known else [name for name in known if fits(name, pattern)]
        if not fitting:
            raise InputError(f"the study has no family {quoted(pattern)}, only {', '.join(known)}")
        chosen.update(fitting)
    return [name for name in known if name in chosen]


def has_pairs(tree: xr.DataTree) -> bool:
    """Return True if an open store has the distances of all pairs of meshes."""
    return "distances" in tree.children and tree["distances"].sizes["mesh"] == tree["distances"].sizes["other"]


def pairs_of(tree: xr.DataTree, order: float, most: int, among: Collection[str] | None = None) -> xr.Dataset | None:
    """Return `distance` and `error` of one order between the computed meshes, over `mesh` and `other`, symmetric.

    They are limited to the first ones, or those of some labels, and the reference. None without those of all pairs.
    """
    if not has_pairs(tree):
        return None
    reference, complete = reference_of(tree), complete_meshes(tree)
    wanted = {*complete} if among is None else {*among}
    others = [label for label in complete if label != reference and label in wanted]
    kept = others[: max(0, most - 1)] + [reference] * (reference in complete)
    return distances_at(tree, order)[["distance", "error"]].sel(order=order, mesh=kept, other=kept).load()


def is_sequence(rows: pd.DataFrame) -> bool:
    """Return True where the meshes of a family go from coarse to fine, so that a line may join them."""
    return bool(rows["ordered_by"].isin(FROM_COARSE_TO_FINE).all())
