"""Distances over time, of meshes that a flow carries and of files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.extras.leagues.evolution import format_evolution
from tests.support.browser import browser
from tests.support.mesh_files import off
from tests.support.studies import small_table, variable

SHAPE: dict[str, Any] = {"source": "ellipsoid", "axes": [1.0, 0.8, 0.6]}
LATTICE = sb.Lattice(3.0, 40)


def carried(level: int, times: list[float]) -> dict[str, Any]:
    return {"source": "flow", "mesh": {**SHAPE, "levels": [level]}, "times": times}


@pytest.fixture(scope="module")
def store(client: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Meshes that a flow carries away from the reference."""
    folder = tmp_path_factory.mktemp("moving")
    family = [
        {"name": "coarse", **carried(1, [0.0, 0.4, 0.8])},
        {"name": "late", **carried(2, [0.4, 0.8, 1.2])},
        {"name": "true", **carried(4, [0.0, 0.4, 0.8])},
        {"name": "still", **SHAPE, "levels": [1]},
    ]
    lattice, norm = {"xi_max": LATTICE.xi_max, "M": LATTICE.M}, {"orders": [-2.0, -4.0]}
    study = small_table(lattice=lattice, scaling={"mode": "none"}, norm=norm, reference=SHAPE, family=family)
    sb.run(sb.Study.from_table(study), folder / "moving.zarr", client)
    return folder / "moving.zarr"


def test_distances_are_those_to_the_reference(store: Path) -> None:
    found = sb.evolution(store, -2.0)
    assert found["family"].values.tolist() == ["coarse", "late", "true"]
    assert found["time"].values.tolist() == [0.0, 0.4, 0.8, 1.2]
    table = sb.table(store, -2.0).set_index("mesh")
    for label, family, time in (("coarse/0.4", "coarse", 0.4), ("late/1.2", "late", 1.2)):
        there = found.sel(family=family, time=time, order=-2.0)
        assert there["distance"].item() == table["distance"][label]
        assert there["error"].item() == table["error"][label]
    for group in ("meshes", "norms", "convergence", "distances"):
        times = variable(sb.open_store(store), group, "time").sel(mesh=["coarse/0.8", "true/0.0", "still/1"])
        assert np.array_equal(times.values, [0.8, 0.0, np.nan], equal_nan=True)
    # A family begins at its own first time.
    late = found["growth"].sel(family="late", order=-2.0).values
    assert np.array_equal(late[:2], [np.nan, 1.0], equal_nan=True)


def test_a_new_mesh_pays_once_the_distance_has_certainly_grown(store: Path) -> None:
    growth = sb.evolution(store, -4.0)["growth"].sel(family="coarse", order=-4.0).values
    assert 1 < growth[1] < growth[2]
    for factor, moment in ((0.9 * growth[1], 0.4), (0.9 * growth[2], 0.8), (1.1 * growth[2], np.nan)):
        times = sb.evolution(store, -4.0, factor=factor)["remesh_time"]
        assert np.array_equal(times.sel(family="coarse").values, [moment], equal_nan=True)


def test_text_and_data(store: Path) -> None:
    tree = sb.open_store(store)
    text = format_evolution(tree, "text", [-4.0], factor=1.01).splitlines()
    assert text[0] == "Sobolev distance of order -4 to reference over time, in % of its norm"
    assert text[4].split()[4:6] == ["1.00", "×"]
    assert "coarse: a new mesh first pays at time 0.4" in text
    still = format_evolution(tree, "text", [-4.0], factor=1e6)
    assert "coarse: the distance has at no time certainly grown to 1e+06 times the first" in still
    assert max(map(len, text)) <= 100
    frame = pd.read_csv(io.StringIO(format_evolution(tree, "csv")))
    assert list(frame) == ["order", "family", "time", "distance", "error", "relative", "relative_error", "growth"]
    assert len(frame) == 2 * 9


def test_errors_decide_when_growth_is_certain(store: Path) -> None:
    tree, coarse = sb.open_store(store).load(), {"family": "coarse", "order": -4.0}
    growth = sb.evolution(tree, -4.0)["growth"].sel({**coarse, "time": 0.8}).item()
    factor, convergence = 1 + (growth - 1) / 2, tree["convergence"].to_dataset()
    sure = sb.evolution(tree, -4.0, factor=factor)["remesh_time"].sel(coarse).item()
    assert np.isfinite(sure)
    first = convergence["distance"].sel(mesh="coarse/0.0", order=-4.0).item()
    for label in ("coarse/0.0", f"coarse/{sure}"):
        # Either error alone may explain the growth.
        errors = convergence["error"].copy()
        errors.loc[{"mesh": label, "order": -4.0}] = (growth - 1) * first
        tree["convergence"] = xr.DataTree(convergence.assign(error=errors))
        assert not sb.evolution(tree, -4.0, factor=factor)["remesh_time"].sel(coarse).item() <= sure, label


def test_a_first_distance_below_its_error_has_no_growth(store: Path) -> None:
    tree = sb.open_store(store).load()
    # The others are many times as large.
    for name, value in (("distance", 1e-9), ("error", 2e-9)):
        tree["convergence"][name].loc[{"mesh": "coarse/0.0", "order": -4.0}] = value
    found = sb.evolution(tree, -4.0).sel(family="coarse", order=-4.0)
    assert found["growth"].isnull().all()
    assert np.isnan(found["remesh_time"])
    text = format_evolution(tree, "text", [-4.0])
    assert "coarse: its first distance is not larger than its error, so nothing is known of its growth" in text
    assert "nan" not in text


def test_the_plot_has_a_line_for_each_family(store: Path) -> None:
    axes = sb.plot.over_time(store, -4.0)
    (legend,) = axes.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["coarse", "late", "true", "a new mesh pays"]
    assert axes.get_title() == "order -4"
    late = sb.plot.over_time(store, -4.0, family="l*")
    assert late.lines[0].get_label() == "late"
    with pytest.raises(sb.errors.InputError, match="none of the chosen families moves, only coarse, late, true"):
        sb.plot.over_time(store, -4.0, family="still")


def test_new_times_of_files_need_no_new_field(client: Client, tmp_path: Path) -> None:
    for number in (2, 10, 1):
        ball = sb.shapes.icosphere(1)
        (tmp_path / f"frame_{number}.off").write_bytes(off(ball.vertices * (1 + number / 50), ball.triangles.tolist()))

    def study(**times: Any) -> sb.Study:
        family = [{"name": "frames", "source": "files", "paths": ["*.off"], **times}]
        table = small_table(lattice={"xi_max": 2.0, "M": 24}, norm={"orders": [-4.0]}, family=family)
        return sb.Study.from_table(table, folder=tmp_path)

    store = tmp_path / "frames.zarr"
    sb.run(study(), store, client)
    with pytest.raises(sb.errors.InputError, match="no mesh of the store has a time"):
        sb.evolution(store)
    assert sb.run(study(times="names"), store, client).computed == ()
    found, table = sb.evolution(store, -4.0), sb.table(store).set_index("mesh")["distance"]
    assert found["time"].values.tolist() == [1.0, 2.0, 10.0]
    assert found["distance"].values.ravel().tolist() == [table[f"frames/frame_{number}"] for number in (1, 2, 10)]


def test_a_report_draws_them(store: Path, tmp_path: Path) -> None:
    page = sb.report(store, tmp_path / "moving.html")
    found = sb.evolution(store)
    with browser(tmp_path / "profile") as reader:
        reader.open(page)
        data = reader.tell("document.getElementById('chart-evolution').data.map(({ name, x, y }) => [name, x, y])")
        late = found.sel(family="late", order=-2.0).dropna("time", subset=["distance"])["distance"].values
        assert [name for name, *_ in data] == ["coarse", "late", "true"]
        assert data[1][1:] == [[0.4, 0.8, 1.2], pytest.approx(late, rel=1e-3)]
        assert reader.complaints() == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"factor": 1.0}, "the factor must be larger than 1, found 1.0"),
        ({"order": -0.4}, "only for orders below -1/2, found -0.4"),
    ],
)
def test_wrong_questions(store: Path, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(sb.errors.InputError, match=message):
        sb.evolution(store, **arguments)
