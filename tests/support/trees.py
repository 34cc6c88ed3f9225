"""Open stores put together by hand: meshes are points, and distances of surfaces those of points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.spatial.distance import cdist

from sobolev_batch.norms.columns import dataset_of


def distances_of(points: npt.ArrayLike, labels: Sequence[str], factors: Mapping[float, float]) -> xr.Dataset:
    """Return the distances of all pairs times a factor for each order, with errors of a hundredth."""
    places = np.asarray(points, dtype=float).reshape(len(labels), -1)
    distance = cdist(places, places)[..., None] * np.array([*factors.values()])
    parts = np.multiply.outer(distance, [0.01, 0.0, 0.0, 0.0])
    columns = {"distance": distance, "error": distance / 100, "error_part": parts}
    coordinates = {"mesh": labels, "other": labels, "order": [*factors]}
    return dataset_of(columns, ("mesh", "other", "order"), coordinates)


def tree_of(points: npt.ArrayLike, labels: Sequence[str], factors: Mapping[float, float]) -> xr.DataTree:
    """Return a store of these meshes, against "reference"; a point of NaN is a mesh that failed."""
    distances = distances_of(points, labels, factors)
    failed = np.isnan(distances["distance"].isel(order=0).values.diagonal())
    meshes = {
        "family": ("mesh", [label.split("/")[0] for label in labels]),
        "status": ("mesh", np.where(failed, "failed", "complete").astype(object)),
    }
    return xr.DataTree.from_dict(
        {
            "/distances": distances,
            "/meshes": xr.Dataset(meshes, coords={"mesh": labels}),
            "/convergence": xr.Dataset(coords={"mesh": labels, "order": [*factors]}, attrs={"reference": "reference"}),
        }
    )
