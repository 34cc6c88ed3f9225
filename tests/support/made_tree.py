"""Open stores that are put together by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr

from sobolev_batch.geometry.subdivision import icosphere
from sobolev_batch.norms.columns import dataset_of
from sobolev_batch.norms.fields import Quality
from sobolev_batch.transform.probe import Probe

MESHES = ["f_1/0", "f_1/1", "f_1/2", "reference"]
QUALITY = Quality(4 * np.pi, icosphere(0).extent, Probe()).to_json()


def root_attributes(scale: float = 1.0, **header: str) -> dict[str, str]:
    """Return the attributes of the root of a study with this section [study], whose tables are JSON."""
    study = {"name": "made", "table": {"study": {"name": "made", **header}}}
    return {"study": json.dumps(study), "similarity": json.dumps({"scale": scale, "origin": [0.0, 0.0, 0.0]})}


@pytest.fixture
def tree() -> xr.DataTree:
    """Two levels, a failed one, and the reference; distances 0.4 and 0.1 at edge lengths 0.2 and 0.1."""
    distance = np.array([[0.4, 0.8], [0.1, 0.2], [np.nan, np.nan], [0.0, 0.0]])
    rate = np.array([[np.nan, np.nan], [2.0, 2.0], [np.nan, np.nan], [np.nan, np.nan]])
    columns = {
        "distance": distance,
        "error": distance / 1000,
        "error_part": np.multiply.outer(distance, [1e-3, 0.0, 0.0, 0.0]),
        "relative": distance / 4,
        "relative_error": distance / 4000,
        "area_part": 0.6 * distance,
        "area_part_error": distance / 1000,
        "shape_part": 0.8 * distance,
        "shape_part_error": distance / 1000,
        "rate": rate,
        "rate_error": 0.01 * rate,
        "resolved": np.array([[True, True], [True, False], [False, False], [False, False]]),
        "within": np.array([[True, False], [True, False], [False, False], [True, True]]),
    }
    coordinates = {"mesh": MESHES, "order": [-10.0, -2.5], "edge_length": ("mesh", [0.2, 0.1, np.nan, np.nan])}
    convergence = dataset_of(columns, ("mesh", "order"), coordinates).assign_attrs(reference="reference")
    about = {
        "family": ["f_1", "f_1", "f_1", "reference"],
        "name": ["0", "1", "2", "reference"],
        "level": [0, 1, 2, -1],
        "ordered_by": ["level"] * 4,
        "row": [0, 1, 2, 3],
        "status": ["complete", "complete", "failed", "complete"],
        "reason": ["", "", "no 50% of it | is <there>", ""],
        "remark": [""] * 4,
        "triangles": [20, 1280, 0, 0],
        "vertices": [12, 642, 0, 0],
        "seconds": [0.25, 2.0, 0.5, 0.125],
    }
    meshes = xr.Dataset({name: ("mesh", values) for name, values in about.items()}, coords={"mesh": MESHES})
    axis = np.linspace(-2, 2, 5)
    values = np.arange(4 * 5 * 5 * 3).reshape(4, 5, 5, 3) + 0j
    fourier = xr.Dataset(
        {"fourier": (("mesh", "xi_x", "xi_y", "xi_z"), values)},
        coords={"mesh": MESHES, "xi_x": axis, "xi_y": axis, "xi_z": axis[2:], "quality": ("mesh", [QUALITY] * 4)},
    )
    tree: xr.DataTree = xr.DataTree.from_dict({"/convergence": convergence, "/meshes": meshes, "/fourier": fourier})
    tree.attrs = root_attributes()
    return tree


@pytest.fixture
def near(tree: xr.DataTree) -> xr.DataTree:
    """The same, with Hausdorff and Chamfer distances of one mesh; the other's could not be measured."""
    nan = np.nan
    columns = {
        "hausdorff": [0.25, nan, nan, nan],
        "hausdorff_upper": [0.2525, nan, nan, nan],
        "chamfer": [0.125, nan, nan, nan],
        "chamfer_error": [1e-3, nan, nan, nan],
    }
    reason = ["", "its file has changed", "", ""]
    variables = {name: ("mesh", values) for name, values in {**columns, "reason": reason}.items()}
    proximity = xr.Dataset(variables, coords={"mesh": MESHES}, attrs={"metrics": ["hausdorff", "chamfer"]})
    made: xr.DataTree = tree.assign({}).copy()
    made["proximity"] = xr.DataTree(proximity)
    return made
