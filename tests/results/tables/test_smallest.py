"""The smallest meshes below a bound, from a store put together by hand."""

from __future__ import annotations

import json

import pytest
import xarray as xr

from sobolev_batch import InputError, smallest_below
from sobolev_batch.results.tables.convergence import format_smallest


def of(tree: xr.DataTree, below: float | str, order: float = -10.0) -> dict[str, object]:
    frame = smallest_below(tree, below, order)
    assert len(frame) == 1
    row: dict[str, object] = frame.iloc[0].to_dict()
    return row


def test_the_fewest_triangles_win(tree: xr.DataTree) -> None:
    """Meshes of 20 and 1,280 triangles at 10 % and 2.5 %."""
    assert (of(tree, 0.2)["mesh"], of(tree, "20%")["triangles"]) == ("f_1/0", 20)
    assert (of(tree, "5 %")["mesh"], of(tree, 0.05)["relative"]) == ("f_1/1", 0.025)
    assert smallest_below(tree, 0.2).attrs == {"reference": "reference", "below": 0.2}


def test_surfaces_without_triangles_have_no_smallest_mesh(tree: xr.DataTree) -> None:
    meshes = tree["meshes"].to_dataset().assign(triangles=("mesh", [0, 0, 0, 0]))
    flat = xr.DataTree.from_dict({**tree.to_dict(), "/meshes": meshes})
    with pytest.raises(InputError, match="no surface of the store is known to have any"):
        smallest_below(flat, 0.2)


def test_none_is_near_enough(tree: xr.DataTree) -> None:
    row = of(tree, 0.01)
    assert (row["mesh"], row["nearest"], row["nearest_relative"], row["undecided"]) == ("", "f_1/1", 0.025, "")
    assert "none" in format_smallest(tree, below=0.01)
    assert "nearest: f_1/1, 2.500 % ± 0.003 %" in format_smallest(tree, "text", [-10.0], below=0.01)


def test_errors_leave_smaller_meshes_open(tree: xr.DataTree) -> None:
    # 10 % ± 0.01 %.
    assert (of(tree, 0.10005)["mesh"], of(tree, 0.10005)["undecided"]) == ("f_1/1", "f_1/0")
    assert of(tree, 0.1002)["mesh"] == "f_1/0"
    assert of(tree, 0.0998)["undecided"] == ""
    # Where even the largest mesh is open, none is below.
    assert (of(tree, 0.025)["mesh"], of(tree, 0.025)["undecided"]) == ("", "f_1/1")


def test_surfaces_without_triangles_have_no_smallest(tree: xr.DataTree) -> None:
    tree["meshes"]["triangles"] = 0 * tree["meshes"].to_dataset()["triangles"]
    with pytest.raises(InputError, match="no surface of the store is known to have any"):
        smallest_below(tree, 0.01)


def test_programs_read_it_too(tree: xr.DataTree) -> None:
    (record,) = json.loads(format_smallest(tree, "json", [-10.0], below=0.05))
    assert (record["family"], record["mesh"], record["triangles"]) == ("f_1", "f_1/1", 1280)
    (record,) = json.loads(format_smallest(tree, "json", [-10.0], below=0.001))
    assert (record["mesh"], record["triangles"], record["relative"]) == ("", None, None)


@pytest.mark.parametrize("bound", [0, -1, "x%", "", True])
def test_bounds_are_positive(tree: xr.DataTree, bound: float | str) -> None:
    with pytest.raises(InputError, match="a fraction is a positive number"):
        smallest_below(tree, bound)
