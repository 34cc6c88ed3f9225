"""Convergence tables of stores put together by hand, and tables at orders that a store lacks."""

from __future__ import annotations

import json
import re
from io import StringIO
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from distributed import Client

import sobolev_batch as sb
from sobolev_batch import smallest_below, table
from sobolev_batch.errors import InputError
from sobolev_batch.store.field_arrays import Fields
from sobolev_batch.store.records import Records
from sobolev_batch.tables.conclusion import format_objects, format_verdict
from sobolev_batch.tables.convergence import format_table
from sobolev_batch.tables.matrix import format_matrix
from sobolev_batch.tables.rendering import Column, column_table, printed_table
from sobolev_batch.tables.smallest import format_smallest
from tests.support.made_tree import root_attributes
from tests.support.studies import small_table


def test_text_shows_values_rates_what_is_missing_and_a_verdict(tree: xr.DataTree) -> None:
    text = format_table(tree, "text", [-2.5])
    assert text.splitlines()[0] == "Sobolev distance of order -2.5 to reference"
    rows = [line.split() for line in text.splitlines() if line.startswith("f_1")]
    assert " ".join(rows[0]) == "f_1/0 20 0.2 20.00 % ± 0.02 %! 36 % 0.8000 ± 0.0008"
    assert " ".join(rows[1]) == "f_1/1 1,280 0.1 5.000 % ± 0.005 %* 2.00 ± 0.02 0.2000 ± 0.0002"
    assert rows[2] == ["f_1/2", *["missing"] * 6]
    assert "\n\nf_1/2 failed: no 50% of it | is <there>\n\n" in text
    # A mesh need not be resolved to be nearer than all others.
    unresolved, sure = (format_verdict(tree, "text", [order]).splitlines() for order in (-2.5, -10.0))
    assert " ".join(unresolved[6].split()) == "nearest of all f_1/1 5.000 % ± 0.005 % 1,280"
    assert " ".join(sure[6].split()) == "nearest of all f_1/1 2.500 % ± 0.003 % 1,280"
    assert [" ".join(line.split()) for line in sure[-3:]] == [
        "missing f_1/2",
        "",
        "f_1/2 failed: no 50% of it | is <there>",
    ]
    frame = pd.read_csv(StringIO(format_verdict(tree, "csv", [-10.0])))
    assert frame.loc[0, ["verdict", "mesh", "triangles"]].tolist() == ["nearest of all", "f_1/1", 1280]


def test_lines_stay_readable(tree: xr.DataTree, near: xr.DataTree) -> None:
    for one in (tree, near):
        assert max(map(len, format_table(one).splitlines())) <= 100
    labels = [*(f"f_1/{'x' * 60}/{i}" for i in range(3)), "reference"]
    groups = {name: group for name, group in tree.to_dict().items() if "mesh" in group.coords}
    renamed = xr.DataTree.from_dict({name: group.assign_coords(mesh=labels) for name, group in groups.items()})
    text = format_table(renamed, "text", [-10.0])
    assert max(map(len, text.splitlines())) <= 100
    assert re.search(r"^f_1/x+…x+/0 +20 ", text, re.MULTILINE)
    # Other programs set tables themselves.
    assert "x" * 60 in format_table(renamed, "markdown", [-10.0]).splitlines()[4]


@pytest.mark.parametrize("columns", [80, 120])
def test_tables_fit_the_terminal(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    labels = ["koala_qem/koala_qem_4500", "mmg/koala_900", "reference"]
    numbers = [f"{label}'s {'number' * 2}" for label in "abc"]
    remark = " ".join(["errors leave open"] * 4)
    text = printed_table([[label, *numbers, remark] for label in labels], ["mesh", *"xyz", "remark"], "text", [4])
    assert max(map(len, text.splitlines())) <= columns
    # Nothing is lost, and labels are cut only where there is no room. There is where the remarks follow by themselves.
    assert text.count("errors leave open") == 3 * 4
    assert all(text.count(number) == len(labels) for number in numbers)
    assert text.count(labels[0]) == (1 if columns == 120 else 2)
    # Headers come closer, and what is empty needs no table.
    close = printed_table([["a", *"123456", ""]], ["mesh", *["triangles"] * 6, "a long remark"], "text")
    assert len(close.splitlines()) == 3
    assert ("remark" in close) == (columns == 120)
    wide = [[label, *numbers[:2], f"{numbers[2]}, too", "number " * 5] for label in labels]
    text = printed_table(wide, ["mesh", *"xyz", "last"], "text")
    assert max(map(len, text.splitlines())) <= columns
    expected = labels[:2] if columns == 120 else ["koala_qem/…_qem_4500", labels[1]]
    assert [line.split()[0] for line in text.splitlines() if "/" in line][:2] == expected
    assert all(text.count(number) == len(labels) for number in numbers)


def test_columns_that_follow_keep_what_tells_rows_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    rows = [[method, by, "1" * 12, "2" * 12] for by in ("relative", "triangles") for method in ("a", "b")]
    assert printed_table(rows, ["method", "by", "new", "old"], "text").count("triangles") == 2 * 2


def test_a_column_of_texts_that_no_row_has_is_left_out() -> None:
    columns = Column("mesh", "mesh", kind="label"), Column("remark", "remark", kind="text"), Column("n", "count")
    rows = [{"mesh": name, "remark": "", "n": None} for name in "ab"]
    # Numbers that are all unknown stay.
    assert column_table(columns, rows, "text").split("\n")[0].split() == ["mesh", "count"]
    rows[1]["remark"] = "thin"
    assert column_table(columns, rows, "text").split("\n")[0].split() == ["mesh", "remark", "count"]


def test_meshes_that_are_not_computed_are_counted_on_one_line(tree: xr.DataTree) -> None:
    status = ("mesh", ["missing", "missing", "failed", "complete"])
    tree["meshes"] = xr.DataTree(tree["meshes"].to_dataset().assign(status=status))
    lines = format_table(tree).splitlines()
    assert "2 of 3 meshes are not computed; run the whole study to add them" in lines
    assert [line for line in lines if line.startswith("f_1/") and ":" in line] == [
        "f_1/2 failed: no 50% of it | is <there>"
    ]


def test_every_order_gets_a_table_and_small_numbers_are_formulas_of_latex(tree: xr.DataTree) -> None:
    for style in ("text", "markdown", "latex"):
        text = format_table(tree, style)
        assert text.index("order -10") < text.index("order -2.5")
    for name in ("relative", "relative_error"):
        tree["convergence"][name] *= 1e-7
    assert r"(2.500 ± 0.003) $\times 10^{-7}$ \%" in format_table(tree, "latex", [-10.0])


def test_programs_get_frames_nulls_and_blanks_for_missing_numbers(tree: xr.DataTree) -> None:
    frame = table(tree)
    assert (frame.attrs, frame["mesh"].tolist()) == (
        {"reference": "reference", "unit": "file units", "unit_length": 1.0},
        ["f_1/0", "f_1/1", "f_1/2"] * 2,
    )
    assert frame.query("order == -10 and level == 1")["relative"].item() == pytest.approx(0.025)
    records = json.loads(format_table(tree, "json", [-10.0]))
    assert (records[1]["rate"], records[2]["distance"]) == (2.0, None)
    assert records[2]["reason"] == "no 50% of it | is <there>"
    lines = format_table(tree, "csv", [-10.0]).splitlines()
    assert len(lines) == 4
    assert lines[3].endswith(",,,,,False,False")


def test_proximities_have_columns_of_their_own(tree: xr.DataTree, near: xr.DataTree) -> None:
    added = [name for name in table(near) if name not in table(tree)]
    assert added == ["hausdorff", "hausdorff_upper", "chamfer", "chamfer_error"]
    text = format_table(near)
    others = text.partition("\nOther distances, the same at all orders\n")[2].splitlines()
    assert others[1].split()[-4:] == ["Hausdorff", "Chamfer", "±", "s.e."]
    assert others[3].split() == ["f_1/0", "0.2500", "to", "0.2525", "0.125", "±", "0.001"]
    assert "\nf_1/1 has no proximity: its file has changed\n" in text
    assert "Hausdorff" not in format_table(tree)
    for style in ("markdown", "latex"):
        table_of_both = format_table(near, style).partition("Other distances")[2]
        assert "0.125 ± 0.001" in table_of_both
        assert r"f\_1/1" if style == "latex" else "f_1/1" in table_of_both
    first, second = json.loads(format_table(near, "json"))[:2]
    assert (first["hausdorff"], first["chamfer"], second["hausdorff"]) == (0.25, 0.125, None)


def test_tables_tell_what_a_remesher_broke(tree: xr.DataTree) -> None:
    names = "components", "euler_characteristic", "boundary_edges", "nonmanifold_edges", "inconsistent_edges"
    sound, holed = (1, 2, 0, 0, 0, 0), (2, 3, 1200, 0, 5, 1)

    def text(second: tuple[int, ...]) -> str:
        numbers = dict(
            zip((*names, "zero_area_triangles"), zip(sound, second, [np.nan] * 6, sound, strict=False), strict=False)
        )
        made: xr.DataTree = tree.copy()
        made["meshes"] = xr.DataTree(
            tree["meshes"].to_dataset().assign({k: ("mesh", [*v]) for k, v in numbers.items()})
        )
        assert table(made, -10).set_index("mesh").loc["f_1/1", [*names]].tolist() == [*second[:5]]
        return format_table(made)

    assert "How triangles" not in text(sound)
    lines = [line.split() for line in text(holed).split("How triangles are connected")[1].splitlines()]
    assert ["f_1/1", "2", "3", "1,200", "0", "5", "1"] in lines


def test_lengths_are_in_the_unit_of_the_files(near: xr.DataTree) -> None:
    near.attrs = root_attributes(0.02, length_unit="mm")
    near["proximity"].attrs["metrics"] = ["hausdorff", "volume"]
    volumes = ("mesh", [4.0, np.nan, np.nan, np.nan])
    near["meshes"] = xr.DataTree(near["meshes"].to_dataset().assign(volume=volumes))
    first = format_table(near).partition("f_1/0")[2].split()
    assert (first[:2], table(near)["edge_length"][0]) == (["20", "10"], 0.2)
    note = " ".join(format_table(near).split())
    assert re.search(r"other lengths are in mm\. .* in units of 50 mm", note)
    assert re.search(r"f_1/0 +0\.2500 to 0\.2525 +5e\+05\n", format_table(near))


def test_notes_are_those_of_all_objects(tree: xr.DataTree, near: xr.DataTree) -> None:
    precise = tree.copy()
    precise["convergence"].attrs["rtol"] = 0.02
    for objects in ({"a": near, "b": precise}, {"b": precise, "a": near}):
        text = format_table(objects)
        assert re.findall(r"^Object (.)$", text, re.MULTILINE) == list(objects)
        assert "Hausdorff distance is between the bounds" in " ".join(text.split())
        assert "an error of at most 0.02" in " ".join(text.split())
        # Failures follow the table of their own object.
        a, b = (text.index(f"Object {name}") for name in "ab")
        assert text.index("f_1/1 has no proximity") > a
        assert (text.index("f_1/1 has no proximity") < b) == (a < b)


def smallest(tree: xr.DataTree, below: float | str) -> dict[str, Any]:
    (row,) = smallest_below(tree, below, -10.0).to_dict("records")
    return {str(name): value for name, value in row.items()}


def test_the_fewest_triangles_win_if_any_mesh_is_near_enough(tree: xr.DataTree) -> None:
    """Meshes of 20 and 1,280 triangles at 10 % and 2.5 %."""
    assert (smallest(tree, 0.2)["mesh"], smallest(tree, "20%")["triangles"]) == ("f_1/0", 20)
    assert (smallest(tree, "5 %")["mesh"], smallest(tree, 0.05)["relative"]) == ("f_1/1", 0.025)
    assert smallest_below(tree, 0.2).attrs == {"reference": "reference", "below": 0.2}
    row = smallest(tree, 0.01)
    assert (row["mesh"], row["nearest"], row["nearest_relative"], row["undecided"]) == ("", "f_1/1", 0.025, "")
    assert "f_1/1 has 2.500 % ± 0.003 %" in format_smallest(tree, "text", [-10.0], below=0.01)


def test_errors_leave_smaller_meshes_open(tree: xr.DataTree) -> None:
    # The smaller mesh has 10 % ± 0.01 %. Where even the largest mesh is open, none is below.
    for below, mesh, undecided in (
        (0.10005, "f_1/1", "f_1/0"), (0.1002, "f_1/0", ""), (0.0998, "f_1/1", ""), (0.025, "", "f_1/1"),
    ):  # fmt: skip
        found = smallest(tree, below)
        assert (found["mesh"], found["undecided"]) == (mesh, undecided), below


def test_what_has_no_table_or_no_smallest_mesh(tree: xr.DataTree) -> None:
    with pytest.raises(InputError, match="the DataTree does not say where it was opened"):
        format_table(tree, "text", [-3.0])
    with pytest.raises(InputError, match="no tables yet"):
        format_table(xr.DataTree())
    (record,) = json.loads(format_smallest(tree, "json", [-10.0], below=0.001))
    assert (record["mesh"], record["triangles"], record["relative"]) == ("", None, None)
    for bound in (0, -1, "x%", "", True):
        with pytest.raises(InputError, match="a fraction is a positive number"):
            smallest_below(tree, bound)
    tree["meshes"]["triangles"] = 0 * tree["meshes"].to_dataset()["triangles"]
    with pytest.raises(InputError, match="no surface of the store is known to have any"):
        smallest_below(tree, 0.01)


ORDERS = [-10.0, -3.7, -3.0, -0.6]


@pytest.fixture(scope="module")
def stores() -> tuple[str, str]:
    """Return two stores of the same fields, with octaves and a mesh that failed: of two orders, and of all."""
    few, every = "memory://orders-few.zarr", "memory://orders-all.zarr"
    for place, orders in ((few, ORDERS[::2]), (every, ORDERS)):
        table = small_table(norm={"orders": orders}, lattice={"xi_max": 3.0, "M": 16, "octaves": 1})
        table["family"].append({"name": "lost", "source": "files", "paths": ["nowhere.ply"]})
        sb.run(sb.Study.from_table(table), place, workers=1)
    return few, every


@pytest.mark.slow
def test_any_order_is_that_of_a_study_that_asks_for_it(stores: tuple[str, str]) -> None:
    few, every = (sb.table(store, ORDERS) for store in stores)
    pd.testing.assert_frame_equal(few.drop(columns="seconds"), every.drop(columns="seconds"), rtol=1e-12)
    assert few.attrs["computed"] == [-3.7, -0.6]
    assert "computed" not in every.attrs
    assert few[few["mesh"] == "lost/nowhere"]["distance"].isna().all()
    # Near -1/2 the fields say little, and the errors say that.
    assert not few[few["order"] == -0.6]["resolved"].all()
    assert few[(few["order"] == -3.7) & (few["status"] == "complete")]["resolved"].all()


@pytest.mark.slow
def test_matrices_of_any_order(stores: tuple[str, str]) -> None:
    for values in ("distance", "error"):
        few, every = (sb.matrix(store, -3.7, values) for store in stores)
        pd.testing.assert_frame_equal(few, every, rtol=1e-9)
    few_text, every_text = (format_matrix(sb.open_store(store), "text", [-3.7, -3.0]) for store in stores)
    assert few_text.startswith(every_text)
    text = format_table(sb.open_store(stores[0]), "text", [-3.7])
    for one in (few_text, text):
        assert "\nNot of the study, but computed now from its stored fields: order -3.7." in one
    assert re.search(r"frequencies up to 3 on each axis, and samples in octaves up to \d", text)


@pytest.mark.slow
def test_tables_of_any_order_read_no_field_and_no_record(
    stores: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(Fields, "read")
    assert set(sb.table(stores[0], -3.7)["order"]) == {-3.7}
    assert sb.matrix(stores[0], -3).attrs["order"] == -3.0
    with pytest.raises(AttributeError, match="read"):
        sb.matrix(stores[0], -3.7)
    monkeypatch.delattr(Records, "examine")
    assert set(sb.table(stores[0], [-10, -3.7])["order"]) == {-10.0, -3.7}


@pytest.mark.slow
def test_other_orders_are_refused(stores: tuple[str, str]) -> None:
    for ask, order in product((sb.table, sb.matrix), (-0.5, 1.0, [], "all")):
        with pytest.raises(sb.errors.OrderError):
            ask(stores[0], order)


@pytest.mark.slow
def test_tables_have_an_order_that_is_named_twice_once(stores: tuple[str, str]) -> None:
    for orders in ([-3.0, -3], [-3.7, -3, -3.7]):
        once = list(dict.fromkeys(orders))
        pd.testing.assert_frame_equal(sb.table(stores[0], orders), sb.table(stores[0], once))
        assert sb.open_store(stores[0]).sobolev.norm(orders).sizes["order"] == len(once)
    with pytest.raises(sb.errors.InputError, match="one order is needed, found 2"):
        sb.matrix(stores[0], [-3.0, -3.7])  # type: ignore[arg-type]
    with pytest.raises(sb.errors.OrderError, match="found None"):
        sb.open_store(stores[0]).sobolev.norm(None)


def test_a_study_of_its_reference_alone_has_nothing_to_compare(store_path: Path, threads: Client) -> None:
    family, reference = [{"name": "ico", "source": "icosphere", "levels": [1]}], {"source": "family", "family": "ico"}
    sb.run(sb.Study.from_table(small_table(reference=reference, family=family)), store_path, threads)
    assert sb.table(store_path).empty
    for text in (format_table(store_path), format_verdict(sb.open_store(store_path)), format_objects(store_path)):
        assert "there is nothing to compare" in text
    assert format_table(store_path, "csv").startswith("order,mesh,")
