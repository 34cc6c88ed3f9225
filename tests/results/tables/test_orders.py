"""Tables at orders that a store lacks: the same as those of a study that asks for them."""

from __future__ import annotations

import re

import pandas as pd
import pytest

import sobolev_batch as sb
from sobolev_batch.batch.store.store import Store
from sobolev_batch.results.tables.convergence import format_table
from sobolev_batch.results.tables.matrix import format_matrix
from tests.support.studies import small_table

ORDERS = [-10.0, -3.7, -3.0, -0.6]
LATTICE = {"xi_max": 3.0, "M": 16, "octaves": 1}


@pytest.fixture(scope="module")
def stores() -> tuple[str, str]:
    """Return two stores of the same fields, with octaves and a mesh that failed: of two orders, and of all."""
    places = []
    for name, orders in (("few", ORDERS[::2]), ("all", ORDERS)):
        table = small_table(norm={"orders": orders}, lattice=LATTICE)
        table["family"].append({"name": "lost", "source": "files", "paths": ["nowhere.ply"]})
        sb.run(sb.Study.from_table(table), f"memory://orders-{name}.zarr", workers=1)
        places.append(f"memory://orders-{name}.zarr")
    return places[0], places[1]


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
def test_any_order_is_that_of_the_two_surfaces(stores: tuple[str, str]) -> None:
    row = sb.table(stores[0], -3.7).set_index("mesh").loc["ico/2"]
    scale = sb.Similarity.to_unit_ball(sb.Sphere()).scale
    assert scale == 1
    direct = sb.distance(sb.icosphere(2), sb.Sphere(), -3.7, rtol=1e-4)
    assert abs(row["distance"] - direct["distance"].item()) < row["error"] + direct["error"].item()


@pytest.mark.slow
def test_matrices_of_any_order(stores: tuple[str, str]) -> None:
    for values in ("distance", "error"):
        few, every = (sb.matrix(store, -3.7, values) for store in stores)
        pd.testing.assert_frame_equal(few, every, rtol=1e-9)
    texts = [format_matrix(sb.open_store(store), "text", [-3.7, -3.0]) for store in stores]
    assert texts[0].startswith(texts[1])
    note = "\nNot of the study, but computed now from its stored fields: order -3.7."
    assert note in texts[0]
    text = format_table(sb.open_store(stores[0]), "text", [-3.7])
    assert note in text
    assert re.search(r"frequencies up to 3 on each axis, and samples in octaves up to \d", text)


@pytest.mark.slow
def test_tables_of_any_order_read_no_field_and_no_record(
    stores: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(Store, "read_fields")
    assert set(sb.table(stores[0], -3.7)["order"]) == {-3.7}
    assert sb.matrix(stores[0], -3).attrs["order"] == -3.0
    with pytest.raises(AttributeError, match="read_fields"):
        sb.matrix(stores[0], -3.7)
    monkeypatch.delattr(Store, "examine_records")
    assert set(sb.table(stores[0], [-10, -3.7])["order"]) == {-10.0, -3.7}


@pytest.mark.slow
@pytest.mark.parametrize("order", [-0.5, 1.0, [], "all"])
def test_other_orders_are_refused(stores: tuple[str, str], order: float) -> None:
    for ask in (sb.table, sb.matrix, sb.evolution):
        with pytest.raises(sb.OrderError):
            ask(stores[0], order)
