"""Tables as files of other programs; their command is tested beside the others."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
import xarray as xr
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.extras.export import export
from tests.support.studies import balls, small_table


def test_metadata_with_blanks_are_exported_without_a_warning_or_a_lock(
    threads: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("h5netcdf", reason="h5netcdf comes with the extra 'export'")
    # A lock of a cluster that was may have its name.
    monkeypatch.setattr("dask.distributed.Lock", None)
    sb.write_mesh(sb.shapes.icosphere(1), tmp_path / "ball.ply")
    family = [{"name": "f", "source": "files", "meshes": [{"path": "ball.ply", "my effort": 7.5}]}]
    study = sb.Study.from_table(small_table(object=balls(a=1.0), family=family), folder=tmp_path)
    sb.run(study, tmp_path / "s.zarr", threads)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        export(tmp_path / "s.zarr", tmp_path / "t.nc", "netcdf")
    with xr.open_dataset(tmp_path / "t.nc", group="a/convergence", engine="h5netcdf") as rows:
        assert rows["my effort"].values[0] == 7.5
