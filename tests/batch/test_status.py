"""Opening stores, and the progress of their runs in one line: a count, a rate, and the time left."""

from __future__ import annotations

import os
import pty
import time
from contextlib import redirect_stdout
from functools import partial
from itertools import zip_longest
from pathlib import Path

import pytest
from click.testing import CliRunner
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.batch.status import Status
from sobolev_batch.cli import cli
from sobolev_batch.cli.output import replace_line
from sobolev_batch.store.latest_run import RunRecord
from sobolev_batch.store.layout import Store, hide_tables
from sobolev_batch.store.records import Record, Records
from tests.support.studies import small_table

# One instant for all moments of a test: records have whole seconds, and two readings of the clock may differ by one.
HOUR_AGO = int(time.time()) - 3600


def moment(seconds: float) -> str:
    """Return a time of this many seconds after an hour ago, as records have it."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(HOUR_AGO + seconds))


@pytest.fixture
def store() -> Store:
    """Return a store with the five rows of a study that has been run."""
    sb.run(sb.Study.from_table(small_table()), "memory://status.zarr", workers=1)
    return Store.open("memory://status.zarr")


def running(store: Store, *finished: float, begun: float = 0.0, state: str = "running") -> Status:
    """Return the status of a run in which surfaces were finished at these seconds, the first of them in vain."""
    for row, end in zip_longest(range(len(Records(store).read())), finished):
        record = Record(key="k", status="complete" if row else "failed", finished=moment(end or 0.0))
        Records(store).write(row, None if end is None else record)
    now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    RunRecord(state, "process 1", moment(begun), now, "fields, 3 of 5").write(store)  # type: ignore[arg-type]
    return sb.status(store.path)


@pytest.mark.slow
def test_the_time_left_follows_from_the_last_ones_and_what_cannot_be_told_is_not(store: Store) -> None:
    status = running(store, 0, 10, 40, 70)
    assert [status.rate, status.seconds_left] == pytest.approx([1 / 30, 30], rel=0.05)
    assert status.progress == "4 of 5 done, 1 failed, 2 a minute, about 30 s left at this rate"
    for status in (running(store, 0, 10), running(store, 0, 0, 0), running(store, 0, 10, 40, begun=20)):
        assert status.progress.endswith(" of 5 done, 1 failed, time left not known yet")
    assert running(store, 0, 10, 20, 30, 40).progress == "5 of 5 done, 1 failed, tables follow"
    assert running(store, state="submitted").progress == "0 of 5 done, 0 failed, no worker has taken it up yet"


@pytest.mark.slow
def test_a_file_has_a_line_for_each_change(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = sb.status(store.path)
    one, two = running(store), running(store, 0)
    looks = [one, one, two, ended]
    monkeypatch.setattr("sobolev_batch.batch.status.status", lambda place: looks.pop(0))
    monkeypatch.setattr("sobolev_batch.cli.store_commands._FOLLOW_SECONDS", 0)
    done = CliRunner().invoke(cli, ["status", store.path, "--follow"])
    assert done.exit_code == 0
    assert not looks
    assert done.stdout.splitlines() == [one.progress, two.progress, *str(ended).splitlines()]


def test_a_terminal_has_one_line_that_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "30")
    main, worker = pty.openpty()
    with os.fdopen(worker, "w") as terminal, redirect_stdout(terminal):
        shown = ""
        for text in (f"2 of 5 done, {'x' * 40}", "1 of 5 done", ""):
            shown = replace_line(text, shown)
        terminal.flush()
        # A terminal hands on what it has, which may be less than all.
        written = ""
        while written.count("\r\x1b[K") < 3:
            written += os.read(main, 4096).decode()
        assert written.split("\r\x1b[K") == ["", f"2 of 5 done, {'x' * 16}", "1 of 5 done", ""]
    os.close(main)


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
        with pytest.raises(sb.errors.StoreError, match="a run has changed the store while it was read"):
            function(tree, -5.0)
    sb.run(sb.Study.from_table(small_table()), copy, threads)
    assert [str(function(tree, -5.0)) for function in (sb.table, sb.matrix)] == before
