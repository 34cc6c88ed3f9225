"""Convergence tables of a store put together by hand."""

from __future__ import annotations

import json
import re

import pytest
import xarray as xr

from sobolev_batch import InputError, table
from sobolev_batch.results.tables.convergence import format_table


def test_text_shows_values_rates_and_what_is_missing(tree: xr.DataTree) -> None:
    text = format_table(tree, "text", [-2.5])
    assert text.splitlines()[0] == "Sobolev distance of order -2.5 to reference"
    rows = [line.split() for line in text.splitlines() if line.startswith("f_1")]
    assert " ".join(rows[0]) == "f_1/0 20 0.2 20.00 % ± 0.02 %! 0.8000 ± 0.0008 36 %"
    assert " ".join(rows[1]) == "f_1/1 1,280 0.1 5.000 % ± 0.005 %* 0.2000 ± 0.0002 2.00 ± 0.02"
    assert rows[2] == ["f_1/2", *["missing"] * 6]
    assert text.endswith("f_1/2 is failed: no 50% of it | is <there>")


def test_the_nearest_mesh_is_named(tree: xr.DataTree) -> None:
    assert "\n\nNearest: f_1/1, which differs by 2.500 % ± 0.003 %.\n\n" in format_table(tree, "text", [-10.0])
    # A mesh whose distance is not larger than its error may be nearer.
    unsure = "\n\nNearest: f_1/0, which differs by 20.00 % ± 0.02 %; its errors leave open whether f_1/1 is nearer."
    assert unsure in format_table(tree, "text", [-2.5])


def test_lines_stay_readable(tree: xr.DataTree, near: xr.DataTree) -> None:
    for one in (tree, near):
        assert max(map(len, format_table(one).splitlines())) <= 100
    long = (
        tree["convergence"].to_dataset().assign_coords(mesh=[f"f_1/{'x' * 60}/{i}" for i in range(3)] + ["reference"])
    )
    meshes = tree["meshes"].to_dataset().assign_coords(mesh=long["mesh"])
    fourier = tree["fourier"].to_dataset().assign_coords(mesh=long["mesh"])
    renamed = xr.DataTree.from_dict({"/convergence": long, "/meshes": meshes, "/fourier": fourier})
    text = format_table(renamed, "text", [-10.0])
    assert max(map(len, text.split("Nearest")[0].splitlines())) <= 100
    assert re.search(r"^f_1/x+…x+/0 +20 ", text, re.MULTILINE)
    # Other programs set tables themselves.
    assert "x" * 60 in format_table(renamed, "markdown", [-10.0]).splitlines()[4]


def test_small_numbers_are_formulas_of_latex(tree: xr.DataTree) -> None:
    tree["convergence"]["relative"] *= 1e-7
    tree["convergence"]["relative_error"] *= 1e-7
    assert r"(2.500 ± 0.003) $\times 10^{-7}$ \%" in format_table(tree, "latex", [-10.0])


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
    with pytest.raises(InputError, match="the DataTree does not say where it was opened"):
        format_table(tree, "text", [-3.0])
    with pytest.raises(InputError, match="no tables yet"):
        format_table(xr.DataTree())


def test_proximities_have_columns_of_their_own(tree: xr.DataTree, near: xr.DataTree) -> None:
    added = [name for name in table(near) if name not in table(tree)]
    assert added == ["hausdorff", "chamfer", "chamfer_error"]
    text = format_table(near).splitlines()
    first = text.index("Other distances, the same at all orders")
    assert text[first + 2].split()[-4:] == ["≥", "Chamfer", "±", "s.e."]
    assert text[first + 4].split() == ["f_1/0", "0.25", "0.125", "±", "0.001"]
    assert sum("Hausdorff ≥" in line for line in text) == 1
    assert text[-1] == "f_1/1 has no proximity: its file has changed"
    assert "Hausdorff" not in format_table(tree)
    for style in ("markdown", "latex"):
        table_of_both = format_table(near, style).partition("Other distances")[2]
        assert "0.125 ± 0.001" in table_of_both
        assert r"f\_1/1" if style == "latex" else "f_1/1" in table_of_both
    first, second = json.loads(format_table(near, "json"))[:2]
    assert (first["hausdorff"], first["chamfer"], second["hausdorff"]) == (0.25, 0.125, None)
