"""Texts and tables of a report, from a store put together by hand."""

from __future__ import annotations

import xarray as xr

from sobolev_batch.results.report.content import _tables


def test_proximities_are_columns_of_a_report(near: xr.DataTree, tree: xr.DataTree) -> None:
    plain, rows = (_tables(each, ("f_1", "reference"), 100)[0][0].rows for each in (tree, near))
    assert [len(row.cells) - len(before.cells) for row, before in zip(rows, plain, strict=True)] == [2, 2, 0]
    assert [cell.text for cell in rows[0].cells[-2:]] == ["0.25", "0.1250 ± 0.0010"]
    assert [cell.key for cell in rows[1].cells[-2:]] == [None, None]
