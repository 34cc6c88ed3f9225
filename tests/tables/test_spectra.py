"""Stored radial spectra: that they are those of the fields, computed once, and made again when they are lost."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from distributed import Client

from sobolev_batch import Study, open_store, run, table, verify
from sobolev_batch.errors import DamageError
from sobolev_batch.store.field_arrays import Fields
from sobolev_batch.store.layout import SPECTRA_KEYS, Store
from tests.support.studies import small_table

BALLS = [{"name": f"ball-{k}", "source": "sphere", "radius": 0.5 + 0.1 * k} for k in range(3)]
OCTAVES = {"xi_max": 3.0, "M": 16, "octaves": 1}


def balls(count: int = 3, **changes: Any) -> Study:
    return Study.from_table(small_table(family=BALLS[:count], compare=None, **changes))


@pytest.fixture
def rows_read(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return the rows whose fields are read from now on."""
    rows: list[int] = []
    read = Fields.read

    def recording(fields: Fields, chosen: list[int], *arguments: Any) -> Any:
        rows.extend(chosen)
        return read(fields, chosen, *arguments)

    monkeypatch.setattr(Fields, "read", recording)
    return rows


@pytest.mark.parametrize("lattice", [small_table()["lattice"], OCTAVES])
def test_a_weighted_sum_of_a_spectrum_is_a_squared_norm_or_distance(
    lattice: dict[str, Any], store_path: Path, threads: Client
) -> None:
    run(balls(lattice=lattice), store_path, threads)
    tree = xr.open_datatree(store_path, engine="zarr")
    spectra = tree["spectra"].to_dataset()
    for order in (-10.0, -3.0):
        weights = spectra["weight"] * (1 + spectra["radius"] ** 2) ** order
        for name, group in (("norm", "norms"), ("distance", "convergence")):
            found = (spectra[name] * weights).sum("shell") + tree[group]["beyond"].sel(order=order)
            expected = tree[group][name].sel(order=order) ** 2
            assert found.sel(mesh=expected["mesh"]).values == pytest.approx(expected.values, rel=1e-12)
    bands = open_store(store_path).sobolev.spectrum(-3.0, "ball-0/sphere", "reference")
    rows = tree["convergence"].sel(mesh="ball-0/sphere", order=-3.0)
    assert bands["squared"].sum() + rows["beyond"] == pytest.approx(float(rows["distance"]) ** 2, rel=1e-12)


@pytest.mark.slow
def test_only_new_fields_are_read_for_new_meshes(store_path: Path, threads: Client, rows_read: list[int]) -> None:
    run(balls(2), store_path, threads)
    labels = Store(store_path).labels()
    rows_read.clear()
    run(balls(3), store_path, threads)
    assert {(*labels, "ball-2/sphere")[row] for row in rows_read} == {"ball-2/sphere", "reference"}
    rows_read.clear()
    run(balls(3, norm={"orders": [-2.0, -1.0]}), store_path, threads)
    assert not rows_read
    assert_same_results_as_anew(balls(3, norm={"orders": [-2.0, -1.0]}), store_path, threads)


def assert_same_results_as_anew(study: Study, store_path: Path, threads: Client) -> None:
    run(study, store_path.with_name("anew.zarr"), threads)
    found, expected = (
        table(path, [-10.0, -1.0]).drop(columns=["seconds"]) for path in (store_path, store_path.with_name("anew.zarr"))
    )
    pd.testing.assert_frame_equal(found, expected, rtol=1e-12)


@pytest.mark.slow
def test_another_reference_makes_all_spectra_anew(store_path: Path, threads: Client) -> None:
    run(balls(), store_path, threads)
    study = balls(reference={"source": "sphere", "radius": 0.9})
    run(study, store_path, threads)
    assert_same_results_as_anew(study, store_path, threads)


@pytest.mark.slow
def test_an_interrupted_chunk_is_computed_again(
    store_path: Path, threads: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It must not pass for that of the meshes before: the study goes back to them afterwards."""
    run(balls(), store_path, threads)
    write = Store.write

    def interrupted(store: Store, name: str, *arguments: Any) -> None:
        write(store, name, *arguments)
        if name == "spectra/distance":
            raise KeyError("interrupted")

    with monkeypatch.context() as patch:
        patch.setattr(Store, "write", interrupted)
        with pytest.raises(KeyError, match="interrupted"):
            run(balls(reference={"source": "sphere", "radius": 0.9}), store_path, threads)
    run(balls(), store_path, threads)
    assert_same_results_as_anew(balls(), store_path, threads)


def lose(path: Path) -> None:
    path.unlink()


def alter(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[8] ^= 1
    path.write_bytes(content)


@pytest.mark.slow
@pytest.mark.parametrize("damage", [lose, alter])
@pytest.mark.parametrize("name", ["spectra/norm", SPECTRA_KEYS])
def test_spectra_that_are_lost_or_altered_are_told_and_made_again(
    name: str, damage: Callable[[Path], None], store_path: Path, threads: Client
) -> None:
    run(balls(), store_path, threads)
    chunk = next(path for path in (store_path / name / "c").rglob("*") if path.is_file())
    damage(chunk)
    with pytest.raises(DamageError, match="spectra"):
        table(open_store(store_path), -7.0)
    found = verify(store_path)
    assert any("spectra" in name for name in found.tables)
    assert found.withdrawn
    assert run(balls(), store_path, threads).computed == ()
    assert verify(store_path).is_sound
    assert np.isfinite(table(store_path, -7.0)["distance"]).all()
