"""Tables and pictures from a store put together by hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from sobolev_batch import InputError, StoreError, open_store
from sobolev_batch.results.figures.plots import (
    convergence_figure,
    map_figure,
    matrix_figure,
    plot_store,
    transform_figure,
)
from sobolev_batch.results.report.content import _tables
from sobolev_batch.results.tables.convergence import convergence_frame, format_table

MESHES = ["f_1/0", "f_1/1", "f_1/2", "reference"]


@pytest.fixture
def tree() -> xr.DataTree:
    """Two levels, a failed one, and the reference; distances 0.4 and 0.1 at edge lengths 0.2 and 0.1."""
    distance = np.array([[0.4, 0.8], [0.1, 0.2], [np.nan, np.nan], [0.0, 0.0]])
    rate = np.array([[np.nan, np.nan], [2.0, 2.0], [np.nan, np.nan], [np.nan, np.nan]])
    convergence = xr.Dataset(
        {
            "distance": (("mesh", "order"), distance),
            **dict.fromkeys(("error", "truncation"), (("mesh", "order"), distance / 1000)),
            **dict.fromkeys(("aliasing", "discretisation"), (("mesh", "order"), 0 * distance)),
            "relative": (("mesh", "order"), distance / 4),
            "relative_error": (("mesh", "order"), distance / 4000),
            "area_part": (("mesh", "order"), 0.6 * distance),
            "shape_part": (("mesh", "order"), 0.8 * distance),
            "rate": (("mesh", "order"), rate),
            "rate_error": (("mesh", "order"), 0.01 * rate),
            "resolved": (("mesh", "order"), np.array([[True, True], [True, False], [False, False], [False, False]])),
            "within": (("mesh", "order"), np.array([[True, False], [True, False], [False, False], [True, True]])),
            "edge_length": ("mesh", [0.2, 0.1, np.nan, np.nan]),
        },
        coords={"mesh": MESHES, "order": [-10.0, -2.5]},
        attrs={"reference": "reference"},
    )
    meshes = xr.Dataset(
        {
            "family": ("mesh", ["f_1", "f_1", "f_1", "reference"]),
            "name": ("mesh", ["0", "1", "2", "reference"]),
            "level": ("mesh", [0, 1, 2, -1]),
            "status": ("mesh", ["complete", "complete", "failed", "complete"]),
            "reason": ("mesh", ["", "", "no 50% of it | is <there>", ""]),
            "triangles": ("mesh", [20, 1280, 0, 0]),
        },
        coords={"mesh": MESHES},
    )
    axis = np.linspace(-2, 2, 5)
    values = np.arange(4 * 5 * 5 * 3).reshape(4, 5, 5, 3) + 0j
    fourier = xr.Dataset(
        {"fourier": (("mesh", "xi_x", "xi_y", "xi_z"), values)},
        coords={"mesh": MESHES, "xi_x": axis, "xi_y": axis, "xi_z": axis[2:]},
    )
    return xr.DataTree.from_dict({"/convergence": convergence, "/meshes": meshes, "/fourier": fourier})


def test_text_shows_values_rates_and_what_is_missing(tree: xr.DataTree) -> None:
    text = format_table(tree, "text", [-2.5])
    assert text.splitlines()[0] == "Sobolev distance of order -2.5 to reference"
    rows = [line.split() for line in text.splitlines() if line.startswith("f_1")]
    assert rows[0] == ["f_1/0", "20", "0.2", "8.000000e-01", "±", "8e-04!", "2.00000e-01", "36.0", "%"]
    assert rows[1] == ["f_1/1", "1,280", "0.1", "2.000000e-01", "±", "2e-04*", "5.00000e-02", "2.000", "±", "2e-02"]
    assert rows[2] == ["f_1/2", *["missing"] * 6]
    assert text.endswith("f_1/2 is failed: no 50% of it | is <there>")


def test_lines_stay_readable(tree: xr.DataTree) -> None:
    assert max(map(len, format_table(tree).splitlines())) <= 100


def test_tables_made_before_there_were_parts(tree: xr.DataTree) -> None:
    tree["convergence"] = xr.DataTree(tree["convergence"].to_dataset().drop_vars(["area_part", "shape_part"]))
    assert np.isnan(convergence_frame(tree)["area_part"]).all()
    assert "%" not in format_table(tree, "text", [-10.0]).split("f_1/2")[0]


def test_every_order_gets_a_table(tree: xr.DataTree) -> None:
    for style in ("text", "markdown", "latex"):
        text = format_table(tree, style)
        assert text.index("order -10") < text.index("order -2.5")
        assert text.count("f\\_1" if style == "latex" else "f_1") >= 6


def test_programs_get_nulls_and_blanks_for_missing_numbers(tree: xr.DataTree) -> None:
    records = json.loads(format_table(tree, "json", [-10.0]))
    assert records[2]["distance"] is None
    assert records[2]["reason"] == "no 50% of it | is <there>"
    assert records[1]["rate"] == 2.0
    lines = format_table(tree, "csv", [-10.0]).splitlines()
    assert len(lines) == 4
    assert lines[3].endswith(",,,,,False,False")


def test_latex_escapes_labels(tree: xr.DataTree) -> None:
    assert r"f\_1/0" in format_table(tree, "latex")


def test_frame_is_long_and_leaves_the_reference_out(tree: xr.DataTree) -> None:
    frame = convergence_frame(tree)
    assert len(frame) == 6
    assert set(frame["mesh"]) == set(MESHES[:3])
    assert frame.query("order == -10 and level == 1")["relative"].item() == pytest.approx(0.025)


def test_unknown_orders_and_unfinished_stores(tree: xr.DataTree) -> None:
    with pytest.raises(InputError, match=r"no order -3, only -10, -2\.5"):
        format_table(tree, "text", [-3.0])
    with pytest.raises(InputError, match="no tables yet"):
        format_table(xr.DataTree())


def test_convergence_picture_has_a_line_per_family_and_the_slope(tree: xr.DataTree) -> None:
    figure = convergence_figure(tree)
    assert [axes.get_title() for axes in figure.axes] == ["order -10", "order -2.5"]
    axes = figure.axes[0]
    labels = [text.get_text() for text in axes.get_legend().get_texts()]  # type: ignore[union-attr]
    assert labels == ["f_1", "slope 2"]
    data = axes.lines[0].get_xydata()
    assert np.allclose(data, [[0.1, 0.025], [0.2, 0.1]])
    slope = np.asarray(axes.lines[1].get_xydata())
    assert np.log(slope[1, 1] / slope[0, 1]) / np.log(2) == pytest.approx(2.0)
    assert axes.get_xscale() == axes.get_yscale() == "log"


def test_transform_picture_draws_the_positive_axis(tree: xr.DataTree) -> None:
    axes = transform_figure(tree).axes[0]
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


def test_pairs_get_a_heat_map_and_a_map(pairs: xr.DataTree, tmp_path: Path) -> None:
    figure = matrix_figure(pairs, [-10.0])
    axes = figure.axes[0]
    assert axes.get_title().startswith("Sobolev distance of order -10")
    shown = [text.get_text() for text in axes.get_yticklabels()]
    assert shown in ([r"\$^\$/0", r"\$^\$/1", "reference"], ["reference", r"\$^\$/1", r"\$^\$/0"])
    places = np.concatenate([line.get_xydata() for line in map_figure(pairs, [-10.0]).axes[0].lines])
    assert np.ptp(places[:, 0]) == pytest.approx(0.4)
    assert np.allclose(places[:, 1], 0, atol=1e-7)
    names = [path.name for path in plot_store(pairs, tmp_path)]
    assert names == ["convergence.png", "transform.png", "matrix.png", "map.png"]


def test_pictures_are_written_and_refused_places_named(tree: xr.DataTree, tmp_path: Path) -> None:
    for path in plot_store(tree, tmp_path / "new" / "folder"):
        assert path.read_bytes().startswith(b"\x89PNG")
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="pictures cannot be written there"):
        plot_store(tree, tmp_path / "file")


def test_opening_nothing(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no store of a study is there"):
        open_store(tmp_path)


@pytest.fixture
def near(tree: xr.DataTree) -> xr.DataTree:
    """The same, with Hausdorff and Chamfer distances of one mesh; the other's could not be measured."""
    nan = np.nan
    columns = {
        "hausdorff": [0.25, nan, nan, nan],
        "chamfer": [0.125, nan, nan, nan],
        "chamfer_error": [1e-3, nan, nan, nan],
    }
    reason = ["", "its file has changed", "", ""]
    variables = {name: ("mesh", values) for name, values in {**columns, "reason": reason}.items()}
    proximity = xr.Dataset(variables, coords={"mesh": MESHES})
    return xr.DataTree.from_dict({**tree.to_dict(), "/proximity": proximity})


def test_proximities_have_columns_of_their_own(tree: xr.DataTree, near: xr.DataTree) -> None:
    added = [name for name in convergence_frame(near) if name not in convergence_frame(tree)]
    assert added == ["hausdorff", "chamfer", "chamfer_error"]
    text = format_table(near).splitlines()
    assert text[2].split()[-4:] == ["≥", "Chamfer", "±", "s.e."]
    assert text[4].split()[-4:] == ["2.50e-01", "1.2500e-01", "±", "1e-03"]
    assert "Hausdorff" in "\n".join(text[8:])
    assert text[-1] == "f_1/1 has no proximity: its file has changed"
    assert "Hausdorff" not in format_table(tree)
    for style in ("markdown", "latex"):
        separator = "|" if style == "markdown" else " & "
        lines = [line for line in format_table(near, style).splitlines() if line.count(separator) > 4]
        assert {line.count(separator) for line in lines} == {lines[0].count(separator)}
        assert lines[0].count(separator) == 2 + max(
            line.count(separator) for line in format_table(tree, style).splitlines()
        )
    first, second = json.loads(format_table(near, "json"))[:2]
    assert (first["hausdorff"], first["chamfer"], second["hausdorff"]) == (0.25, 0.125, None)


def test_proximities_in_a_report(near: xr.DataTree, tree: xr.DataTree) -> None:
    plain, lines = (_tables(each, ("f_1", "reference"))[0][0].lines for each in (tree, near))
    assert [len(line.cells) - len(before.cells) for line, before in zip(lines, plain, strict=True)] == [2, 2, 0]
    assert [cell.text for cell in lines[0].cells[-2:]] == ["0.25", "0.1250 ± 0.0010"]
    assert [cell.key for cell in lines[1].cells[-2:]] == [None, None]
