"""What plots show of a store: orders, families, and the spectra of their meshes."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import pandas as pd
import xarray as xr

from sobolev_batch.errors import InputError
from sobolev_batch.extras.figures.style import Style, style_of
from sobolev_batch.norms.causes import spectrum
from sobolev_batch.tables.convergence import EDGE_LENGTH
from sobolev_batch.tables.open import (
    AnyStore,
    Families,
    as_tree,
    chosen_families,
    complete_meshes,
    families_of,
    finished_group,
    reference_of,
)
from sobolev_batch.tables.store_accessor import StoreAccessor
from sobolev_batch.tables.text import spread
from sobolev_batch.transform.lattice import Orders, check_orders

# A field is read for each mesh; one of 17 MB takes about a quarter of a second.
MOST_SPECTRA = 24
_MOST_SAMPLES = 1 << 28


@dataclass(frozen=True, eq=False)
class Selection:
    """The part of an open store that plots show.

    Attributes:
        x: Horizontal axis of convergence.
        truth: Family of the true surface of meshes that move; default the reference.
    """

    tree: xr.DataTree
    orders: tuple[float, ...]
    families: tuple[str, ...]
    x: str = EDGE_LENGTH
    truth: str | None = None

    @classmethod
    def from_store(
        cls,
        store: AnyStore,
        order: Orders | None = None,
        family: Families = None,
        x: str = EDGE_LENGTH,
        truth: str | None = None,
    ) -> Self:
        """Choose any orders, default the study's, and families by names or globs; InputError for an unknown family."""
        tree = as_tree(store)
        orders = finished_group(tree, "convergence")["order"].values.tolist() if order is None else check_orders(order)
        return cls(tree, tuple(orders), tuple(chosen_families(tree, family)), x, truth)

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
        along = pd.Index(labels, name="mesh")
        spectra = xr.concat(
            [bands[["share", "energy", "energy_error"]] for bands in found], along, coords="minimal", compat="override"
        ).drop_attrs()
        areas = finished_group(tree, "meshes")["area"].reset_coords(drop=True)
        limits = 2 * (areas.sel(mesh=labels) + areas.sel(mesh=reference, drop=True))
        longest, shortest = (spectra[f"{name}_wavelength"].to_numpy() for name in ("longest", "shortest"))
        texts = [
            f"> {short:.3g}" if np.isinf(long) else f"{long:.3g} – {short:.3g}"
            for long, short in zip(longest, shortest, strict=True)
        ]
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
