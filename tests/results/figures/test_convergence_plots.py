"""Plots of distances to the reference, of a store put together by hand."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
import xarray as xr

import sobolev_batch as sb
from sobolev_batch.results.figures.drawing import PLOTS
from sobolev_batch.results.figures.selection import Selection
from sobolev_batch.results.figures.style import notes_of


def test_convergence_picture_has_a_line_per_family_and_the_slope(tree: xr.DataTree) -> None:
    axes = sb.plot(tree)
    assert axes.get_title() == "order -10\nnot drawn: 1 not computed"
    assert sb.plot(tree, "convergence", -2.5).get_title().startswith("order -2.5\n")
    labels = [text.get_text() for text in axes.figure.legends[0].get_texts()]
    assert labels == ["f_1", "slope 2"]
    data = axes.lines[0].get_xydata()
    assert np.allclose(data, [[0.1, 0.025], [0.2, 0.1]])
    slope = np.asarray(axes.lines[1].get_xydata())
    assert np.log(slope[1, 1] / slope[0, 1]) / np.log(2) == pytest.approx(2.0)
    assert axes.get_xscale() == axes.get_yscale() == "log"


@pytest.mark.parametrize(
    ("x", "places", "label", "slope"),
    [
        ("triangles", [1280, 20], "number of triangles", -1),
        ("vertices", [642, 12], "number of vertices", -1),
        ("seconds", [2.0, 0.25], "computing time of the mesh in seconds", None),
    ],
)
def test_other_horizontal_axes(
    tree: xr.DataTree,
    x: Literal["triangles", "vertices", "seconds"],
    places: list[float],
    label: str,
    slope: int | None,
) -> None:
    axes = sb.plot(tree, x=x)
    assert axes.get_xlabel() == label
    family, *others = axes.lines
    assert np.asarray(family.get_xdata()).tolist() == places
    assert [line.get_label() for line in others] == ([] if slope is None else [f"slope {slope}"])
    for line in others:
        ends = np.log(np.asarray(line.get_xydata()))
        assert np.diff(ends[:, 1]) / np.diff(ends[:, 0]) == pytest.approx(slope)


def test_an_axis_that_the_store_does_not_know(tree: xr.DataTree) -> None:
    tree["meshes"] = xr.DataTree(tree["meshes"].to_dataset().drop_vars("vertices"))
    with pytest.raises(sb.InputError, match="no size of meshes is named 'vertices'; known are edge_length, triangles"):
        sb.plot(tree, x="vertices")


def changed(tree: xr.DataTree, **values: list[float]) -> xr.DataTree:
    """The same, with other numbers of the meshes at all orders."""
    dataset = tree["convergence"].to_dataset()
    columns = {name: (("mesh", "order"), np.repeat(np.array(column)[:, None], 2, 1)) for name, column in values.items()}
    return xr.DataTree.from_dict({**tree.to_dict(), "/convergence": dataset.assign(columns)})


def test_distances_below_their_errors_are_hollow_and_stretch_no_axis(tree: xr.DataTree) -> None:
    unsure = changed(tree, relative_error=[1e-3, 0.2, np.nan, 0.0], resolved=[1, 0, 0, 1])
    axes = sb.plot(unsure)
    assert [text.get_text() for text in axes.figure.legends[0].get_texts()] == ["f_1", "slope 2", "not above its error"]
    hollow = [line for line in axes.lines if line.get_markerfacecolor() == "white" and np.size(line.get_xydata())]
    assert [np.asarray(line.get_xydata()).tolist() for line in hollow] == [[[0.1, 0.025]]]
    assert axes.get_ylim()[0] > 0.025 / 10
    assert axes.get_ylim()[1] > 0.225


def test_whatever_is_not_drawn_is_counted_and_named(tree: xr.DataTree) -> None:
    figure = PLOTS["convergence"].figure(Selection.from_store(changed(tree, relative=[0.0, 0.0, np.nan, 0.0])))
    assert notes_of(figure) == ["not drawn: 1 not computed, 2 equal to the reference", "families not drawn: f_1"]
    assert [axes.get_title().split("\n")[0] for axes in figure.axes] == ["order -10", "order -2.5"]
    nameless = sb.plot(tree, x="triangles", family="f?1")
    assert "families" not in nameless.get_title()
