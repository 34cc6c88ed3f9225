"""Convergence tables of a store put together by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr

from sobolev_batch import InputError, table
from sobolev_batch.results.tables.convergence import format_table


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
    assert np.isnan(table(tree)["area_part"]).all()
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
    frame = table(tree)
    assert len(frame) == 6
    assert frame.attrs == {"reference": "reference"}
    assert set(frame["mesh"]) == {"f_1/0", "f_1/1", "f_1/2"}
    assert frame.query("order == -10 and level == 1")["relative"].item() == pytest.approx(0.025)


def test_unknown_orders_and_unfinished_stores(tree: xr.DataTree) -> None:
    with pytest.raises(InputError, match=r"no order -3, only -10, -2\.5"):
        format_table(tree, "text", [-3.0])
    with pytest.raises(InputError, match="no tables yet"):
        format_table(xr.DataTree())


def test_proximities_have_columns_of_their_own(tree: xr.DataTree, near: xr.DataTree) -> None:
    added = [name for name in table(near) if name not in table(tree)]
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
