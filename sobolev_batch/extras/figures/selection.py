"""What plots show of a store: orders, families, and the spectra of their meshes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import xarray as xr

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import InputError
from sobolev_batch.extras.figures.style import Style, style_of
from sobolev_batch.norms.causes import spectrum
from sobolev_batch.tables.open import (
    EDGE_LENGTH,
    AnyStore,
    Families,
    as_tree,
    chosen_families,
    complete_meshes,
    families_of,
    fields_read,
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
    def spectra(self) -> Spectra:
        """Spectra of the chosen families; InputError where the store has no mesh to compare."""
        if not self.compared:
            raise InputError("the store has no mesh to compare: the reference or all others are not computed")
        with fields_read(self.tree):
            return Spectra.from_tree(self.tree, self.orders, self.compared)

    @property
    def has_spectra(self) -> bool:
        """True if the store has a mesh to compare, of the chosen families."""
        return "similarity" in self.tree.attrs and bool(self.compared)


@dataclass(frozen=True)
class Spectra:
    """Squared distances of some meshes to the reference, by wavelength.

    Attributes:
        total: Number of meshes that these were chosen from.
        shares: Fractions (meshes, orders, bands) of the squared distance, which sum to one over the bands.
        longest: Longest wavelength (bands,) in the study's unit, decreasing; the first is infinite.
        shortest: Shortest wavelength (bands,) in the study's unit.
        energies: Energy ∫_{|ξ|=r} |a^ - b^|² dS of the difference, as a fraction of twice both areas (meshes, bands).
        energy_errors: Standard error of these, zero for bands of a lattice.
    """

    labels: tuple[str, ...]
    total: int
    orders: tuple[float, ...]
    shares: Reals
    longest: Reals
    shortest: Reals
    energies: Reals
    energy_errors: Reals

    @classmethod
    def from_tree(cls, tree: xr.DataTree, orders: Sequence[float], meshes: Sequence[str]) -> Self:
        """Return the spectra of some of the meshes of an open store, evenly through the study."""
        reference = reference_of(tree)
        fields = tree["fourier"].to_dataset()["fourier"]
        affordable = _MOST_SAMPLES // int(np.prod(fields.shape[1:]))
        labels = spread(meshes, max(1, min(MOST_SPECTRA, affordable)))
        if "octaves" in tree:
            accessor = StoreAccessor(tree)
            spectra = [accessor.spectrum(orders, label, reference) for label in labels]
        else:
            of_reference = fields.sel(mesh=reference).load()
            spectra = [spectrum(fields.sel(mesh=label), of_reference, orders) for label in labels]
        shares = np.stack([np.asarray(bands["share"].transpose("order", "band")) for bands in spectra])
        longest, shortest = (spectra[0][name].to_numpy() for name in ("longest_wavelength", "shortest_wavelength"))
        areas = finished_group(tree, "meshes")["area"]
        limits = 2 * (areas.sel(mesh=labels).to_numpy() + areas.sel(mesh=reference).item())
        energies = np.stack([bands["energy"].to_numpy() for bands in spectra]) / limits[:, None]
        errors = np.zeros_like(energies)
        if "octaves" in tree:
            errors = np.stack([bands["energy_error"].to_numpy() for bands in spectra]) / limits[:, None]
        return cls(tuple(labels), len(meshes), tuple(orders), shares, longest, shortest, energies, errors)

    @property
    def omission(self) -> str:
        """Note on the meshes that were not chosen; empty where all were."""
        return f"{len(self.labels)} of {self.total} meshes" if len(self.labels) < self.total else ""

    @property
    def wavelengths(self) -> Reals:
        """Wavelength at the middle frequency of each band, in the study's unit."""
        return np.asarray(2 / (1 / self.longest + 1 / self.shortest))

    @property
    def bands(self) -> tuple[str, ...]:
        """Each band as text, in the study's unit."""
        return tuple(
            f"> {short:.3g}" if np.isinf(long) else f"{long:.3g} – {short:.3g}"
            for long, short in zip(self.longest, self.shortest, strict=True)
        )
