"""Drivers that are killed: what they had finished counts, and nothing else."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from sobolev_batch.batch.store.store import Store
from tests.support.commands import call, read_until, started, write_toml
from tests.support.stores import assert_same_results


@pytest.mark.parametrize(
    "line", ["[2/5]", *(pytest.param(line, marks=pytest.mark.all) for line in ("dashboard:", "tables reduced"))]
)
def test_the_next_run_computes_what_has_no_record(
    line: str, store_path: Path, finished_store: Path, tmp_path: Path
) -> None:
    study = write_toml(tmp_path)
    with started("run", study, "--store", store_path, "--workers", "1") as driver:
        read_until(driver, line)
        os.kill(driver.pid, signal.SIGKILL)
        driver.wait()
        # Its workers end with it: what they were writing is then written or never will be.
        assert driver.stdout is not None
        driver.stdout.read()
    complete = [record is not None for record in Store.open(store_path).records()].count(True)
    assert complete >= {"dashboard:": 0, "[2/5]": 2, "tables reduced": 5}[line]
    # The process is known to be gone, so that its claim keeps nobody out.
    again = call("run", study, "--store", store_path, "--workers", "1")
    assert again.returncode == 0, again.stderr
    assert "taken over from process" in again.stderr
    assert again.stderr.count("complete, ") == 5 - complete
    assert f"{5 - complete} computed, {complete} reused" in again.stdout
    assert_same_results(store_path, finished_store)
