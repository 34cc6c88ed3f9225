"""Texts and tables of a report, from a store put together by hand."""

from __future__ import annotations

import xarray as xr

from sobolev_batch.results.report.cells import Body
from sobolev_batch.results.report.content import convergence_table
from sobolev_batch.results.tables.convergence import table


def bodies(tree: xr.DataTree) -> tuple[Body, ...]:
    return convergence_table(tree, table(tree), ("f_1", "reference"), 100).bodies


def test_proximities_are_columns_of_a_report(near: xr.DataTree, tree: xr.DataTree) -> None:
    plain, rows = (bodies(each)[0].rows for each in (tree, near))
    assert [len(row.cells) - len(before.cells) for row, before in zip(rows, plain, strict=True)] == [2, 2, 0]
    assert [cell.text for cell in rows[0].cells[-2:]] == ["0.25", "0.125 ± 0.001"]
    assert [cell.second for cell in rows[0].cells[-2:]] == [None, 1e-3]
    assert [cell.key for cell in rows[1].cells[-2:]] == [None, None]


def test_a_distance_below_its_error_is_marked_and_has_no_area_fraction(tree: xr.DataTree) -> None:
    above, unresolved, _ = bodies(tree)[1].rows
    assert [(row.cells[0].mark, row.cells[-1].text) for row in (above, unresolved)] == [
        ("above rtol", "36 %"),
        ("below its error", ""),
    ]


def test_the_relative_distance_stands_beside_the_mesh(tree: xr.DataTree) -> None:
    headings = convergence_table(tree, table(tree), ("f_1", "reference"), 1).headings
    assert [head.name for head in headings[:3]] == ["mesh", "relative", "triangles"]
    assert headings[1].second == "relative_error"
