"""Texts and tables of a report, from a store put together by hand."""

from __future__ import annotations

import xarray as xr

from sobolev_batch.results.report.content import _tables


def test_proximities_are_columns_of_a_report(near: xr.DataTree, tree: xr.DataTree) -> None:
    plain, rows = (_tables(each, ("f_1", "reference"), 100)[0][0].rows for each in (tree, near))
    assert [len(row.cells) - len(before.cells) for row, before in zip(rows, plain, strict=True)] == [2, 2, 0]
    assert [cell.text for cell in rows[0].cells[-2:]] == ["0.25", "0.1250 ± 0.0010"]
    assert [cell.key for cell in rows[1].cells[-2:]] == [None, None]


def test_a_distance_below_its_error_is_marked_and_has_no_area_fraction(tree: xr.DataTree) -> None:
    above, unresolved, _ = _tables(tree, ("f_1", "reference"), 100)[0][1].rows
    assert [(row.cells[2].mark, row.cells[-1].text) for row in (above, unresolved)] == [
        ("above rtol", "36.0 %"),
        ("below its error", ""),
    ]
