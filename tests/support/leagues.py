"""Rows of tables that leagues are made from, put together by hand."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd


def method_rows(distances: Mapping[str, Mapping[int, float]], error: float = 0.0, order: float = -2.0) -> pd.DataFrame:
    """Return rows of a table from relative distances by method and triangles."""
    rows = [
        {
            "order": order,
            "mesh": f"{method}/{triangles}",
            "family": method,
            "triangles": triangles,
            "edge_length": triangles**-0.5,
            "relative": value,
            "relative_error": error * value,
        }
        for method, by_size in distances.items()
        for triangles, value in by_size.items()
    ]
    return pd.DataFrame(rows)
