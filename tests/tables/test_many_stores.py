"""Several stores open as one: the numbers of one study of all their meshes, and refusals of what does not fit."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import sobolev_batch as sb
from sobolev_batch.batch.cluster.clients import thread_client
from sobolev_batch.errors import InputError, StoreError
from tests.support.studies import small_table, variable

pytestmark = pytest.mark.slow

OCTAVES = {"xi_max": 3.0, "M": 16, "octaves": 1}


def stored(folder: Path, name: str, radii: list[float], **changes: Any) -> str:
    """Run a study of balls, and return the path of its store."""
    path = str(folder / f"{name}.zarr")
    families = [{"name": f"b{radius:g}", "source": "sphere", "radius": radius} for radius in radii]
    study = {**small_table()["study"], "name": changes.pop("study", name)}
    with thread_client(1) as client:
        sb.run(sb.Study.from_table(small_table(study=study, family=families, **changes)), path, client)
    return path


@pytest.fixture(scope="module", params=["lattice", "octaves"])
def stores(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str, str]:
    """Return two stores, and that of one study with the meshes of both."""
    changes = {"lattice": OCTAVES} if request.param == "octaves" else {}
    folder = tmp_path_factory.mktemp("many")
    radii = {"a": [0.5, 0.6], "b": [0.7, 0.8, 0.9], "all": [0.5, 0.6, 0.7, 0.8, 0.9]}
    one, other, every = (stored(folder, f"{name}-{request.param}", part, **changes) for name, part in radii.items())
    return one, other, every


def test_tables_and_distances_are_those_of_one_study_of_all(stores: tuple[str, str, str]) -> None:
    one, other, every = stores
    joined, expected = sb.open_store([one, other]), sb.open_store(every)
    labels = [label for label in variable(expected, "meshes", "mesh").values.tolist() if label != "reference"]
    assert sorted(variable(joined, "convergence", "mesh").values.tolist()) == sorted([*labels, "reference"])
    assert len(set(variable(joined, "convergence", "study").values.tolist())) == 2
    assert variable(joined, "fourier", "fourier").chunks is not None
    for order in (-10.0, -3.5, [-3.0, -2.5]):
        found, wanted = joined.sobolev.distance(order), expected.sobolev.distance(order)
        for name in ("distance", "relative", "area_part"):
            xr.testing.assert_allclose(
                found[name].sel(mesh=labels).reset_coords(drop=True),
                wanted[name].sel(mesh=labels).reset_coords(drop=True),
                rtol=1e-9,
            )
    field = variable(joined, "fourier", "fourier").sel(mesh="b0.8/sphere")
    assert np.array_equal(field.values, variable(expected, "fourier", "fourier").sel(mesh="b0.8/sphere").values)
    norm = joined.sobolev.norm(-2.5, "b0.8/sphere")["norm"].item()
    assert norm == pytest.approx(expected.sobolev.norm(-2.5, "b0.8/sphere")["norm"].item(), rel=1e-12)
    assert len(sb.table(joined)) == 2 * len(labels)


def test_meshes_of_different_stores_are_compared_by_their_fields(stores: tuple[str, str, str]) -> None:
    one, other, every = stores
    joined, expected = sb.open_store([one, other]), sb.open_store(every)
    near = [tree.sobolev.nearest("b0.6/sphere", 3, -3.0)["distance"].to_series() for tree in (joined, expected)]
    pd.testing.assert_series_equal(*near, rtol=1e-9)
    assert {"b0.5/sphere", "b0.7/sphere"} <= set(near[0].index)
    pair = [tree.sobolev.distance(-3.5, "b0.6/sphere", "b0.9/sphere") for tree in (joined, expected)]
    assert pair[0]["distance"].item() == pytest.approx(pair[1]["distance"].item(), rel=1e-9)
    bands = [tree.sobolev.spectrum(-3.5, "b0.6/sphere", "b0.9/sphere")["squared"].values for tree in (joined, expected)]
    assert bands[0] == pytest.approx(bands[1], rel=1e-9)
    with pytest.raises(InputError, match="one store at a time"):
        sb.status(joined)


def test_a_label_that_comes_twice_begins_with_its_study(stores: tuple[str, str, str]) -> None:
    one, _, every = stores
    joined = sb.open_store([one, every])
    names = {json.loads(tree.attrs["study"])["name"] for tree in map(sb.open_store, (one, every))}
    assert {label.split("/")[0] for label in variable(joined, "norms", "mesh").values.tolist()} == {*names, "reference"}
    assert {family.split("/")[0] for family in variable(joined, "meshes", "family").values.tolist()} == {
        *names,
        "reference",
    }
    twice = [f"{name}/b0.5/sphere" for name in sorted(names)]
    assert joined.sobolev.distance(-3.5, *twice)["distance"].item() == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(StoreError, match=r"another study of the same name has a mesh .b0\.5/sphere. too"):
        sb.open_store([one, one])


@pytest.mark.parametrize(
    ("name", "changes", "difference"),
    [
        ("denser", {"lattice": {"xi_max": 3.0, "M": 18}}, "lattice, reference"),
        ("sampled", {"lattice": OCTAVES}, "octaves, reference"),
        ("smaller", {"reference": {"source": "sphere", "radius": 0.95}}, "similarity, reference"),
    ],
)
def test_what_differs_is_named(name: str, changes: dict[str, Any], difference: str, tmp_path: Path) -> None:
    first = stored(tmp_path, "first", [0.5])
    second = stored(tmp_path, name, [0.6], **changes)
    with pytest.raises(
        StoreError, match=f"^{re.escape(second)}: .* as one with {re.escape(first)}: they differ in {difference}$"
    ):
        sb.open_store([first, second])
