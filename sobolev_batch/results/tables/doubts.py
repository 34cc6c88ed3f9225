"""Meshes of a store that one doubts can be compared with the reference: in another unit, or in another place."""

from __future__ import annotations

import xarray as xr

from sobolev_batch.results.tables.groups import complete_meshes, reference_of
from sobolev_batch.spectral.errors.quality import Quality
from sobolev_batch.surfaces.shapes.similarity import placement_doubt


def doubts_of(tree: xr.DataTree) -> dict[str, str]:
    """Return why one doubts that a mesh can be compared with the reference, by the label of the mesh."""
    complete, reference = complete_meshes(tree), reference_of(tree)
    if reference not in complete:
        return {}
    texts = tree["fourier"]["quality"].sel(mesh=complete).load()
    extents = {label: Quality.from_json(str(texts.sel(mesh=label).item())).extent for label in complete}
    doubts = {label: placement_doubt(extent, extents[reference]) for label, extent in extents.items()}
    return {label: doubt for label, doubt in doubts.items() if doubt is not None}
