"""Plots of a store put together by hand, their legends and their files."""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.spatial.distance import cdist

import sobolev_batch as sb
from sobolev_batch.extras.figures.drawing import PLOTS, clustered_order, draw_spectrum, write_plots
from sobolev_batch.extras.figures.selection import Selection, chosen_families, pairs_of
from sobolev_batch.extras.figures.style import Plot, drawing, notes_of, parse_size, set_log_scale, style_of
from tests.support.commands import finished
from tests.support.made_tree import root_attributes
from tests.support.stores import full_disk
from tests.support.trees import distances_of, tree_of


@pytest.fixture
def tree(tree: xr.DataTree) -> xr.DataTree:
    """The same without fields that spectra could be made of."""
    del tree.attrs["similarity"]
    return tree


@pytest.fixture
def pairs(tree: xr.DataTree) -> xr.DataTree:
    """The same with the distances of all pairs, and names that matplotlib would take for a formula, or for hidden."""
    labels, families = ["$^$/0", "$^$/1", "_f/2", "reference"], ["$^$", "$^$", "_f", "reference"]
    tree["distances"] = xr.DataTree(distances_of([0.4, 0.1, np.nan, 0.0], labels, {-10.0: 1.0, -2.5: 2.0}))
    for group in ("convergence", "meshes", "fourier"):
        named = tree[group].to_dataset().assign_coords(mesh=labels)
        tree[group] = xr.DataTree(named.assign(family=("mesh", families)) if group == "meshes" else named)
    return tree


@pytest.mark.slow
def test_pairs_get_a_heat_map(pairs: xr.DataTree, tmp_path: Path) -> None:
    axes = sb.plot.matrix(pairs, -10.0)
    assert axes.get_title().startswith("Sobolev distance of order -10")
    shown = [text.get_text() for text in axes.get_yticklabels()]
    assert shown in ([r"\$^\$/0", r"\$^\$/1", "reference"], ["reference", r"\$^\$/1", r"\$^\$/0"])
    paths, _ = write_plots(Selection.from_store(pairs), tmp_path)
    assert [path.name for path in paths] == ["convergence.png", "matrix.png"]
    alone = sb.plot.matrix(pairs, -10.0, family="_*")
    assert [text.get_text() for text in alone.texts] == ["no two meshes differ"]


@pytest.mark.parametrize(("most", "kept"), [(10, ["f/0", "f/2", "f/3"]), (3, ["f/0", "f/2"])])
def test_pairs_leave_out_failed_meshes_and_keep_the_reference(most: int, kept: list[str]) -> None:
    places, labels = [1.0, np.nan, 3.0, 4.0, 0.0], ["f/0", "f/1", "f/2", "f/3", "reference"]
    found = pairs_of(tree_of(places, labels, {-4.0: 1.0}), -4.0, most)
    assert found is not None
    assert found["mesh"].values.tolist() == [*kept, "reference"]
    assert found["distance"].values[:, -1].tolist() == [*([1.0, 3.0, 4.0][: len(kept)]), 0.0]


def test_families_are_found_however_their_accents_are_encoded() -> None:
    composed, decomposed = "caf\u00e9", "cafe\u0301"
    tree = tree_of([1.0, 0.0], [f"{decomposed}/0", "reference"], {-4.0: 1.0})
    assert chosen_families(tree, composed) == [decomposed]


@pytest.mark.process
def test_plots_take_the_axes_of_a_caller_and_leave_pyplot_alone(tree: xr.DataTree) -> None:
    axes = Figure().subplots()
    assert sb.plot.convergence(tree, ax=axes) is axes
    assert isinstance(sb.plot.convergence(tree), Axes)
    code = "import sobolev_batch as sb, sys; sb.plot; assert 'matplotlib.pyplot' not in sys.modules"
    done = finished(sys.executable, "-c", code)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("plot", "arguments", "message"),
    [
        (sb.plot.convergence, {"order": -0.4}, "below -1/2, found -0.4"),
        (sb.plot.convergence, {"family": "g*"}, "the study has no family 'g\\*', only f_1, reference"),
        (sb.plot.convergence, {"x": "weight"}, "no size of meshes is named 'weight'; known are edge_length, triangles"),
        (sb.plot.convergence, {"x": 3}, "no size of meshes is named 3; known"),
        (sb.plot.matrix, {}, "distances to the reference alone; set pairs"),
    ],
)
def test_what_cannot_be_plotted(
    tree: xr.DataTree, plot: Callable[..., Axes], arguments: dict[str, Any], message: str
) -> None:
    nearest = tree["convergence"].to_dataset()[["distance"]].expand_dims(other=["reference"])
    with pytest.raises(sb.errors.InputError, match=message):
        plot(xr.DataTree.from_dict({**tree.to_dict(), "/distances": nearest}), **arguments)


def test_relative_distances_are_in_per_cent(tree: xr.DataTree) -> None:
    axes = sb.plot.convergence(tree, order=-10.0)
    assert isinstance(axes.figure, Figure)
    axes.figure.draw_without_rendering()
    labels = [text.get_text() for text in axes.get_yticklabels(which="both") if text.get_text()]
    assert {"3 %", "10 %"} < {*labels}
    assert all(label.endswith(" %") for label in labels)


def lines(_subject: object, count: int, axes: Axes) -> None:
    set_log_scale(axes, "xy")
    for i in range(count):
        axes.plot([0.3, 2], [i + 1, i + 2], label=f"family number {i}")


@pytest.mark.slow
@pytest.mark.parametrize("size", [(6.4, 3.6), (3.3, 2.4)])
@pytest.mark.parametrize("count", [1, 8, 40])
def test_a_legend_hides_no_data_and_counts_what_it_leaves_out(count: int, size: tuple[float, float]) -> None:
    with drawing(size):
        figure = Plot(lines, lambda _: (), 3.6).figure(None, [1, count], size)
        figure.draw_without_rendering()
    (legend,) = figure.legends
    names = [text.get_text() for text in legend.get_texts()]
    left_out = [f"and {count - len(names) + 1} more"] if len(names) < count or "more" in names[-1] else []
    assert names == [*(f"family number {i}" for i in range(len(names) - len(left_out))), *left_out]
    assert len(names) >= min(count, 10)
    box = legend.get_window_extent()
    assert all(figure.bbox.contains(*corner) for corner in (box.min, box.max))
    for axes in figure.axes:
        assert axes.bbox.height > 0.4 * figure.bbox.height / 2.2
        assert not box.overlaps(axes.get_tightbbox())  # type: ignore[arg-type]


@pytest.mark.parametrize(("size", "step", "has_shares"), [((6.4, 4.0), 1, True), ((3.3, 2.4), 3, False)])
def test_labels_of_wavelengths_do_not_overlap(size: tuple[float, float], step: int, has_shares: bool) -> None:
    bands = [f"{2.0**-i:.3g} – {2.0**-i / 2:.3g}" for i in range(12)]
    spectra = xr.Dataset(
        {"share": (("mesh", "order", "band"), np.full((8, 1, 12), 1 / 12)), "text": ("band", bands)},
        coords={"mesh": [f"a long name of a family/{i}" for i in range(8)], "order": [-2.0]},
        attrs={"omission": ""},
    )
    selection = SimpleNamespace(tree=xr.DataTree(), spectra=spectra)
    with drawing(size):
        figure = Plot(draw_spectrum, lambda _: (), 3.6).figure(selection, [-2.0], size)
        figure.draw_without_rendering()
    axes = figure.axes[0]
    labels = [label.get_text() for label in axes.get_xticklabels()]
    assert labels == bands[::step]
    assert len(axes.texts) == (96 if has_shares else 0)
    places = axes.transData.transform(np.column_stack([axes.get_xticks(), axes.get_xticks()]))[:, 0]
    apart = np.diff(places).min() * np.sin(np.radians(40)) * 72 / figure.dpi
    assert apart > axes.get_xticklabels()[0].get_fontsize()
    box, page = figure.get_tightbbox(), figure.bbox_inches
    assert min(box.xmin, box.ymin) >= 0
    assert (box.xmax <= page.xmax, box.ymax <= page.ymax) == (True, True)


def test_forty_families_have_styles_of_their_own() -> None:
    assert len({tuple(style_of(i).values()) for i in range(49)}) == 49


@pytest.mark.all
def test_vector_formats_keep_text_and_no_dates(tree: xr.DataTree, tmp_path: Path) -> None:
    settings = dict(mpl.rcParams)
    selection = Selection.from_store(tree)
    written = [write_plots(selection, tmp_path / folder, ("pdf", "svg", "png"))[0] for folder in ("a", "b")]
    assert [path.name for path in written[0]][:3] == ["convergence.pdf", "convergence.svg", "convergence.png"]
    for one, other in zip(*written, strict=True):
        assert one.read_bytes() == other.read_bytes(), one
    pdf, svg, _ = (path.read_bytes() for path in written[0][:3])
    # A TrueType font in full, which journals ask for, and no outlines in its place.
    for file, part, is_there in (
        (pdf, b"/FontFile2", True), (pdf, b"/Type3", False), (pdf, b"CreationDate", False),
        (svg, b"<text", True), (svg, b"relative Sobolev distance", True), (svg, b"<dc:date>", False),
    ):  # fmt: skip
        assert (part in file) == is_there, part
    assert dict(mpl.rcParams) == settings


@pytest.mark.slow
def test_the_size_is_that_of_a_panel_and_refused_places_are_named(tree: xr.DataTree, tmp_path: Path) -> None:
    (path, *_), _ = write_plots(Selection.from_store(tree), tmp_path / "new" / "folder", size=parse_size("3x2in"))
    # The header of a PNG: two panels of 300 dots per inch.
    assert struct.unpack(">II", path.read_bytes()[16:24]) == (900, 1200)
    with pytest.raises(sb.errors.StoreError, match="pictures cannot be written there"):
        write_plots(Selection.from_store(tree), path)
    before = path.read_bytes()
    with full_disk(1000), pytest.raises(sb.errors.StoreError, match="the picture cannot be written there"):
        write_plots(Selection.from_store(tree), path.parent)
    assert path.read_bytes() == before
    for text in ("8.4x6cm", "84x60mm", "84 × 60 mm"):
        assert parse_size(text) == pytest.approx((8.4 / 2.54, 6 / 2.54))
    for text in ("6", "6x", "6x4m", "axb", "1.2.3x4", "100x100", "0x4", "5x5mm"):
        with pytest.raises(sb.errors.InputError, match=r"size|inches"):
            parse_size(text)


def slope_of(line: Line2D) -> float:
    ends = np.log(np.asarray(line.get_xydata()))
    return float((np.diff(ends[:, 1]) / np.diff(ends[:, 0])).item())


def test_convergence_picture_has_a_line_per_family_and_the_slope(tree: xr.DataTree) -> None:
    axes = sb.plot.convergence(tree)
    assert axes.get_title() == "order -10\nnot drawn: 1 not computed"
    assert sb.plot.convergence(tree, -2.5).get_title().startswith("order -2.5\n")
    assert [text.get_text() for text in axes.figure.legends[0].get_texts()] == ["f_1", "slope 2"]
    family, slope = axes.lines
    assert np.allclose(family.get_xydata(), [[0.1, 0.025], [0.2, 0.1]])
    assert slope_of(slope) == pytest.approx(2.0)
    assert axes.get_xscale() == axes.get_yscale() == "log"


@pytest.mark.parametrize(
    ("x", "places", "label", "slopes"),
    [
        ("triangles", [1280, 20], "number of triangles", [-1]),
        ("vertices", [642, 12], "number of vertices", [-1]),
        ("seconds", [2.0, 0.25], "computing time of the mesh in seconds", []),
    ],
)
def test_other_horizontal_axes(tree: xr.DataTree, x: str, places: list[float], label: str, slopes: list[int]) -> None:
    axes = sb.plot.convergence(tree, x=x)
    family, *others = axes.lines
    assert (axes.get_xlabel(), np.asarray(family.get_xdata()).tolist()) == (label, places)
    assert [line.get_label() for line in others] == [f"slope {slope}" for slope in slopes]
    for line, slope in zip(others, slopes, strict=True):
        assert slope_of(line) == pytest.approx(slope)


def changed(tree: xr.DataTree, **values: list[float]) -> xr.DataTree:
    """The same, with other numbers of the meshes at all orders."""
    dataset = tree["convergence"].to_dataset()
    columns = {name: (("mesh", "order"), np.repeat(np.array(column)[:, None], 2, 1)) for name, column in values.items()}
    return xr.DataTree.from_dict({**tree.to_dict(), "/convergence": dataset.assign(columns)})


def test_distances_below_their_errors_are_hollow_and_stretch_no_axis(tree: xr.DataTree) -> None:
    unsure = changed(tree, relative_error=[1e-3, 0.2, np.nan, 0.0], resolved=[1, 0, 0, 1])
    axes = sb.plot.convergence(unsure)
    assert [text.get_text() for text in axes.figure.legends[0].get_texts()] == ["f_1", "slope 2", "not above its error"]
    hollow = [line for line in axes.lines if line.get_markerfacecolor() == "white" and np.size(line.get_xydata())]
    assert [np.asarray(line.get_xydata()).tolist() for line in hollow] == [[[0.1, 0.025]]]
    assert axes.get_ylim()[0] > 0.025 / 10
    assert axes.get_ylim()[1] > 0.225


def test_whatever_is_not_drawn_is_counted_and_named(tree: xr.DataTree) -> None:
    figure = PLOTS["convergence"].figure(Selection.from_store(changed(tree, relative=[0.0, 0.0, np.nan, 0.0])))
    assert notes_of(figure) == ["not drawn: 1 not computed, 2 equal to the reference", "families not drawn: f_1"]
    assert [axes.get_title().split("\n")[0] for axes in figure.axes] == ["order -10", "order -2.5"]
    nameless = sb.plot.convergence(tree, x="triangles", family="f?1")
    assert "families" not in nameless.get_title()


def test_few_outliers_do_not_take_the_colours_of_a_matrix() -> None:
    points = np.random.default_rng(6).normal(size=(40, 3))
    points[1] = points[2] + 1e-12
    for chosen, extend in ((points, "min"), (points[2:], "neither")):
        labels = ["reference", *(f"f{i % 10}/mesh {i}" for i in range(1, len(chosen)))]
        axes = sb.plot.matrix(tree_of(chosen, labels, {-2.0: 1.0}))
        (image,), (_, bar) = axes.images, axes.figure.axes
        low, high = image.get_clim()
        assert (low > 1e-3, high) == (True, cdist(chosen, chosen).max())
        assert image.colorbar is not None
        assert (image.colorbar.extend, bar.get_ylabel()) == (extend, "distance, computed in\nfile units")


def test_axes_name_the_unit_of_the_files(tree: xr.DataTree) -> None:
    tree.attrs = root_attributes(0.02, length_unit="$mm$")
    axes, edges = sb.plot.convergence(tree, -10.0), sb.table(tree, -10.0)["edge_length"].dropna()
    assert axes.get_xlabel() == r"mean edge length in \$mm\$"
    assert np.sort(axes.lines[0].get_xdata()) == pytest.approx(50 * np.sort(edges))
    tree.attrs = root_attributes(0.02)
    assert sb.plot.convergence(tree).get_xlabel() == "mean edge length in file units"
    assert sb.plot.convergence(tree, x="triangles").get_xlabel() == "number of triangles"


def test_groups_stand_together() -> None:
    places = np.array([0.0, 10.0, 0.2, 10.1, 0.1, 9.9])[:, None]
    sorted_places = places[clustered_order(cdist(places, places)), 0]
    assert (np.diff(sorted_places) > 0).all() or (np.diff(sorted_places) < 0).all()
    for count in (0, 1, 2):
        assert clustered_order(np.ones((count, count)) - np.eye(count)).tolist() == list(range(count))
