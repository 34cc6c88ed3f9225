"""Plots of a store put together by hand."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import sobolev_batch as sb
from sobolev_batch.results.figures.plots import write_plots


def test_transform_picture_draws_the_positive_axis(tree: xr.DataTree) -> None:
    axes = sb.plot_transform(tree)
    labels = [text.get_text() for text in axes.get_legend().get_texts()]  # type: ignore[union-attr]
    assert labels == ["f_1/0", "f_1/1", "reference"]
    data = np.asarray(axes.lines[1].get_xydata())
    assert np.array_equal(data[:, 0], [0.0, 1.0, 2.0])
    # Row 1, xi_y = xi_z = 0: strides of 75, 15, 3 and 1.
    assert np.array_equal(data[:, 1], 75 + 15 * np.array([2, 3, 4]) + 6)


@pytest.fixture
def pairs(tree: xr.DataTree) -> xr.DataTree:
    """The same with the distances of all pairs, and names that matplotlib would take for a formula, or for hidden."""
    labels, families = ["$^$/0", "$^$/1", "_f/2", "reference"], ["$^$", "$^$", "_f", "reference"]
    places = np.array([0.4, 0.1, np.nan, 0.0])
    distance = np.abs(places[:, None] - places)[..., None] * np.array([1.0, 2.0])
    tree["distances"] = xr.DataTree(
        xr.Dataset(
            dict.fromkeys(("distance", "error"), (("mesh", "other", "order"), distance)),
            coords={"mesh": labels, "other": labels, "order": [-10.0, -2.5]},
        )
    )
    for group in ("convergence", "meshes", "fourier"):
        named = tree[group].to_dataset().assign_coords(mesh=labels)
        tree[group] = xr.DataTree(named.assign(family=("mesh", families)) if group == "meshes" else named)
    return tree


@pytest.mark.slow
def test_pairs_get_a_heat_map_and_a_map(pairs: xr.DataTree, tmp_path: Path) -> None:
    axes = sb.plot_matrix(pairs, -10.0)
    assert axes.get_title().startswith("Sobolev distance of order -10")
    shown = [text.get_text() for text in axes.get_yticklabels()]
    assert shown in ([r"\$^\$/0", r"\$^\$/1", "reference"], ["reference", r"\$^\$/1", r"\$^\$/0"])
    places = np.concatenate([line.get_xydata() for line in sb.plot_map(pairs, -10.0).lines])
    assert np.ptp(places[:, 0]) == pytest.approx(0.4)
    assert np.allclose(places[:, 1], 0, atol=1e-7)
    names = [path.name for path in write_plots(pairs, tmp_path).paths]
    assert names == ["convergence.png", "transform.png", "matrix.png", "map.png"]
    alone = sb.plot_matrix(pairs, -10.0, family="_*")
    assert [text.get_text() for text in alone.texts] == ["no two meshes differ"]


@pytest.mark.slow
def test_pictures_are_written_and_refused_places_named(tree: xr.DataTree, tmp_path: Path) -> None:
    for path in write_plots(tree, tmp_path / "new" / "folder").paths:
        assert path.read_bytes().startswith(b"\x89PNG")
    (tmp_path / "file").write_text("")
    with pytest.raises(sb.StoreError, match="pictures cannot be written there"):
        write_plots(tree, tmp_path / "file")


@pytest.mark.process
def test_plots_take_the_axes_of_a_caller_and_leave_pyplot_alone(tree: xr.DataTree) -> None:
    first, second = Figure().subplots(1, 2)
    assert sb.plot_convergence(tree, ax=first) is first
    assert sb.plot_transform(tree, "f_1", ax=second) is second
    assert isinstance(sb.plot_convergence(tree), Axes)
    code = "import sobolev_batch as sb, sys; sb.plot_map; assert 'matplotlib.pyplot' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr


def test_what_cannot_be_plotted(tree: xr.DataTree) -> None:
    with pytest.raises(sb.InputError, match="no order -3, only -10"):
        sb.plot_convergence(tree, -3)
    with pytest.raises(sb.InputError, match="no mesh of the family is computed, only of: f_1"):
        sb.plot_transform(tree, "reference")
    for plot in (sb.plot_convergence, sb.plot_transform, sb.plot_matrix, sb.plot_map):
        with pytest.raises(sb.InputError, match="the study has no family 'g\\*', only f_1, reference"):
            plot(tree, family="g*")
    nearest = tree["convergence"].to_dataset()[["distance"]].expand_dims(other=["reference"])
    alone = xr.DataTree.from_dict({**tree.to_dict(), "/distances": nearest})
    for plot in (sb.plot_matrix, sb.plot_map):
        with pytest.raises(sb.InputError, match="distances to the reference alone; set pairs"):
            plot(alone)
