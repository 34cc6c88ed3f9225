"""At which wavelengths meshes differ from the reference: spectra of a chosen few, from the stored fields."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.results.tables.convergence import chosen_orders, finished_group
from sobolev_batch.spectral.metrics.spectrum import spectrum
from sobolev_batch.surfaces.shapes.similarity import Similarity

Reals = NDArray[np.float64]

# A field is read for each: of 17 MB in a quarter of a second, as a rule.
_MOST_MESHES = 24
_MOST_SAMPLES = 1 << 28


@dataclass(frozen=True)
class Wavelengths:
    """Where, between long waves and short ones, the squared distances of some meshes to the reference lie.

    Attributes:
        labels: of the meshes.
        of: how many meshes these were chosen from.
        orders: s, each.
        shares: (meshes, orders, bands), of the squared distance; the bands together have all of it.
        longest: (bands,) wavelengths in the study's unit, decreasing; the first is infinite.
        shortest: (bands,) likewise.
        own: one unit of the study in the meshes' own unit of length.
    """

    labels: tuple[str, ...]
    of: int
    orders: tuple[float, ...]
    shares: Reals
    longest: Reals
    shortest: Reals
    own: float

    @classmethod
    def of_store(cls, tree: xr.DataTree, orders: Sequence[float] | None = None) -> Self | None:
        """The spectra of an open store; None where there is nothing to compare.

        Args:
            tree: an open store.
            orders: some of its orders; default all.
        """
        convergence, meshes = finished_group(tree, "convergence"), finished_group(tree, "meshes")
        reference = convergence.attrs["reference"]
        complete = meshes["mesh"].values[meshes["status"].values == "complete"].tolist()
        others = [label for label in complete if label != reference]
        if reference not in complete or not others:
            return None
        fields = tree["fourier"].to_dataset()["fourier"]
        room = _MOST_SAMPLES // int(np.prod(fields.shape[1:]))
        labels = spread(others, max(1, min(_MOST_MESHES, room)))
        known = tuple(chosen_orders(convergence, orders))
        scale = tree.attrs["similarity"]["scale"]
        center = fields.sel(mesh=reference).load()
        found = [spectrum(fields.sel(mesh=label), center, known, similarity=Similarity(scale)) for label in labels]
        shares = np.stack([np.asarray(spectra["share"].transpose("order", "band")) for spectra in found])
        longest, shortest = (found[0][name].to_numpy() for name in ("longest_wavelength", "shortest_wavelength"))
        return cls(tuple(labels), len(others), known, shares, longest, shortest, 1 / scale)

    @property
    def bands(self) -> tuple[str, ...]:
        """Each band in words, in the study's unit."""
        return tuple(
            f"> {short:.3g}" if np.isinf(long) else f"{long:.3g} – {short:.3g}"
            for long, short in zip(self.longest, self.shortest, strict=True)
        )


def spread(labels: Sequence[str], most: int) -> list[str]:
    """So many labels at most, the first and the last and evenly between."""
    return [labels[i] for i in np.unique(np.linspace(0, len(labels) - 1, min(most, len(labels))).round().astype(int))]
