"""Texts and tables of a report, from a store put together by hand."""

from __future__ import annotations

import xarray as xr

from sobolev_batch.results.report.content import convergence_table
from sobolev_batch.results.tables.convergence import table


def cells(tree: xr.DataTree, order: float) -> list[dict[str, str]]:
    """Return the texts of the rows of one order, by column."""
    made = convergence_table(tree, table(tree), ("f_1", "reference"), 100)
    (rows,) = (rows for s, _, rows in made.bodies if s == order)
    return [{**{column.name: column.text(row) for column in made.columns}, "mark": row["mark"]} for row in rows]


def test_proximities_are_columns_of_a_report(near: xr.DataTree, tree: xr.DataTree) -> None:
    first, second, _ = cells(near, -10.0)
    assert (first["hausdorff"], first["chamfer"]) == ("0.25", "0.125 ± 0.001")
    assert second["hausdorff"] == second["chamfer"] == ""
    assert "chamfer" not in cells(tree, -10.0)[0]


def test_a_distance_below_its_error_is_marked_and_has_no_area_fraction(tree: xr.DataTree) -> None:
    above, unresolved, _ = cells(tree, -2.5)
    assert (above["mark"], above["area_fraction"]) == ("above rtol", "36 %")
    assert (unresolved["mark"], unresolved["area_fraction"]) == ("below its error", "")


def test_the_relative_distance_stands_beside_the_mesh(tree: xr.DataTree) -> None:
    columns = convergence_table(tree, table(tree), ("f_1", "reference"), 1).columns
    assert [column.name for column in columns[:3]] == ["mesh", "relative", "triangles"]
    assert columns[1].error == "relative_error"
