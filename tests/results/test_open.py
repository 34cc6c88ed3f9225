"""Opening stores, and what functions for their readers take for one."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
from distributed import Client

import sobolev_batch as sb
from sobolev_batch import Study
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.store.tables import hide_tables
from tests.support.studies import small_table


def test_a_store_is_a_path_or_an_open_tree_which_finds_its_fields_from_any_folder(
    finished_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(finished_store.parent)
    tree = sb.open_store(finished_store.name)
    monkeypatch.chdir("/")
    for function in (sb.table, partial(sb.table, order=-5.0), sb.status, partial(sb.matrix, order=-10)):
        result = function(finished_store)
        assert function(tree) is not result
        assert str(function(tree)) == str(result)


def test_tables_of_two_states_are_not_mixed(copy: Path, threads: Client) -> None:
    tree = sb.open_store(copy)
    before = [str(function(tree, -5.0)) for function in (sb.table, sb.matrix)]
    # As a run does before it replaces them.
    hide_tables(Store.open(copy))
    for function in (sb.table, sb.matrix):
        with pytest.raises(sb.StoreError, match="a run has changed the store while it was read"):
            function(tree, -5.0)
    sb.run(Study.from_table(small_table()), copy, threads)
    assert [str(function(tree, -5.0)) for function in (sb.table, sb.matrix)] == before
