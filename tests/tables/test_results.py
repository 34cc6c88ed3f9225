"""The tables of a study, and the rates that follow from them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from distributed import Client

import sobolev_batch as sb
from sobolev_batch import Study, open_store, run, verify
from sobolev_batch.norms.rates import observed_rates
from sobolev_batch.store import encoding, layout
from tests.support.stores import assert_same_results
from tests.support.studies import small_table

NAN = np.nan


def test_tables_in_many_chunks_are_those_in_one(
    monkeypatch: pytest.MonkeyPatch, store_path: Path, finished_store: Path, threads: Client
) -> None:
    monkeypatch.setattr(encoding, "LARGEST_CHUNK_BYTES", 16)
    monkeypatch.setattr(layout, "LARGEST_CHUNK_BYTES", 16)
    run(Study.from_table(small_table()), store_path, threads)
    assert len(list((store_path / "convergence/distance/c").rglob("*"))) > 5
    assert verify(store_path).is_sound
    assert_same_results(store_path, finished_store)
    assert open_store(store_path)["distances"].sizes["mesh"] == 5


def test_tables_have_coordinates_and_nothing_but_nan_of_a_mesh_that_failed(store_path: Path, threads: Client) -> None:
    table = small_table()
    table["family"].append({"name": "lost", "source": "files", "paths": ["nowhere.ply"]})
    run(Study.from_table(table), store_path, threads)
    tree = xr.open_datatree(store_path, engine="zarr").load()
    for group, number in (("norms", "norm"), ("distances", "distance"), ("convergence", "distance")):
        assert list(tree[group].data_vars)[:3] == [number, "error", "error_part"]
        xr.testing.assert_equal(tree[group]["error_part"].sum("part", skipna=False), tree[group]["error"])
    for group in ("meshes", "norms", "distances", "convergence"):
        whole = tree[group].to_dataset()
        counts = {name: whole[name] for name in ("vertices", "triangles", "points") if name in whole}
        assert {values.dtype for values in counts.values()} == {np.dtype("int64")}
        small = whole.where((whole["triangles"] >= 0) & (whole["triangles"] < 100), drop=True)
        assert small["mesh"].values.tolist() == ["ico/0", "ico/1", "reference"]
        assert small["family"].values.tolist() == ["ico", "ico", "reference"]
        failed = whole.sel(mesh="lost/nowhere").drop_vars(
            ["rank", "row", "finished", "numerics", "resolved", "within"], errors="ignore"
        )
        unknown = [name for name, values in failed.variables.items() if values.attrs.get("valid_min") == 0]
        assert {int(failed[name]) for name in unknown} == {-1}
        assert {*counts} <= {*unknown}
        failed = failed.drop_vars(unknown)
        assert failed["status"] == "failed"
        assert all(
            values.isnull().all()
            for values in (*failed.data_vars.values(), failed["edge_length" if "edge_length" in failed else "area"])
        )
    rows = sb.table(store_path, -3.0).set_index("mesh")[["vertices", "triangles", "components", "euler_characteristic"]]
    assert rows.loc["ico/1"].tolist() == [42, 80, 1, 2]
    assert rows.loc["lost/nowhere"].isna().all()
    finished = tree["meshes"].to_dataset()["finished"]
    assert finished.dtype.kind == "M"
    assert finished.isnull().sum() == 0
    references = tree["convergence"].to_dataset()["is_reference"]
    assert (references.dtype.kind, references["mesh"].values[references].tolist()) == ("b", ["reference"])
    assert "convergence" in tree.attrs["description"]
    smallest = tree["convergence"].to_dataset()["relative"].groupby("family").min()
    assert smallest["family"].values.tolist() == ["ico", "lost", "reference"]
    assert smallest.isnull().any("order").values.tolist() == [False, True, False]


def test_open_stores_are_selected_by_mesh_and_written_as_netcdf(finished_store: Path, tmp_path: Path) -> None:
    pytest.importorskip("h5netcdf", reason="h5netcdf comes with the extra 'export'")
    for tree in (xr.open_datatree(finished_store, engine="zarr"), open_store(finished_store)):
        one = tree.sel(mesh="ico/1", order=-3.0)
        assert one["convergence/triangles"].item() == 80
        tree.to_netcdf(tmp_path / "tree.nc", engine="h5netcdf")
        with xr.open_datatree(tmp_path / "tree.nc", engine="h5netcdf") as again:
            assert json.loads(again.attrs["study"])["table"]["study"]["name"] == "small"
            for group in ("convergence", "spectra", "fourier"):
                found, expected = (
                    node[group].to_dataset().drop_vars("quality", errors="ignore").load() for node in (again, tree)
                )
                assert found.equals(expected), group


@pytest.mark.parametrize(
    ("sizes", "distances", "errors", "rates"),
    [
        # They follow the sizes, not the order of the meshes.
        ([0.1, 0.4, 0.2], [0.01, 0.16, 0.04], [0, 0, 0], [2, NAN, 2]),
        # Missing meshes are bridged, and so are sizes that are nearly equal.
        ([0.4, 0.2, 0.1, NAN], [0.16, NAN, 0.01, 0.001], [0, 0, 0, 0], [NAN, NAN, 2, NAN]),
        ([0.4, 0.2, 0.19], [0.16, 0.04, 0.0361], [0, 0, 0], [NAN, 2, 2]),
        # Distances below their error, distances of zero and equal sizes carry no rate.
        ([0.4, 0.2, 0.1], [0.16, 0.04, 0.01], [0, 0, 0.011], [NAN, 2, NAN]),
        ([0.2, 0.1], [1, 0], [0, 0], [NAN, NAN]),
        ([0.1, 0.1], [1, 2], [0, 0], [NAN, NAN]),
    ],
)
def test_observed_rates(sizes: list[float], distances: list[float], errors: list[float], rates: list[float]) -> None:
    found, uncertainties = observed_rates(np.array(distances), np.array(errors), np.array(sizes))
    np.testing.assert_allclose(found, rates, rtol=1e-12)
    assert np.array_equal(np.isnan(uncertainties), np.isnan(rates))


def test_errors_of_rates_cover_what_the_distances_allow() -> None:
    sizes, distances, errors = np.array([0.2, 0.1]), np.array([0.4, 0.1]), np.array([0.02, 0.01])
    rates, uncertainties = observed_rates(distances, errors, sizes)
    extremes = [
        observed_rates(distances + a * errors * [1, 0] + b * errors * [0, 1], np.zeros(2), sizes)[0][1]
        for a in (-1, 1)
        for b in (-1, 1)
    ]
    assert rates[1] - uncertainties[1] <= min(extremes)
    assert rates[1] + uncertainties[1] >= max(extremes)
    assert uncertainties[1] < 1.2 * (max(extremes) - min(extremes)) / 2
