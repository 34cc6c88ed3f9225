"""A small soak test, and that it would notice."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sobolev_batch import open_store
from tests.soak.corruptions import BAD, answer_to, corruptions
from tests.soak.strikes import EXCHANGED, Strike, strike_all
from tests.support.stores import differences

pytestmark = pytest.mark.all


def test_nothing_is_lost_by_strikes_and_failing_requests_and_it_would_be_noticed(tmp_path: Path) -> None:
    strikes = (
        Strike(2, "nanny", "killed"),
        Strike(3, "driver", "killed"),
        Strike(4, *EXCHANGED),
        Strike(6, "worker", "stopped"),
    )
    (outcome,) = strike_all(tmp_path, {0: strikes}, meshes=60, rate=0.05)
    assert outcome.differences == ()
    assert outcome.strikes == strikes
    assert outcome.failures.total() >= 5
    clean, other = tmp_path / "clean.zarr", tmp_path / "other.zarr"
    shutil.copytree(clean, other)
    fields = other / "fourier" / "fourier" / "c"
    shutil.copyfile(fields / "1" / "0" / "0" / "0", fields / "2" / "0" / "0" / "0")
    (fields / "3" / "0" / "0" / "0").unlink()
    (other / "records" / "record" / "c" / "4").unlink()
    shutil.copyfile(other / "norms" / "norm" / "c" / "0" / "0", other / "norms" / "error" / "c" / "0" / "0")
    found = list(differences(open_store(other), open_store(clean)))
    assert found[:3] == ["bumpy/000002: another field", "bumpy/000003: another field", "bumpy/000004: missing"]
    assert [difference.split(":")[0] for difference in found[3:]] == ["norms"]


def test_no_number_changes_without_a_word(tmp_path: Path) -> None:
    found = list(corruptions(tmp_path, 6, seed=1))
    assert len(found) == 6
    for one in found:
        assert not set(one.answers.values()) & set(BAD), one
    assert any("told" in one.answers.values() for one in found)


def test_a_changed_number_would_be_noticed() -> None:
    assert answer_to({"output": "1.0"}, {"output": "2.0"}) == "silent"
    assert answer_to({"output": "1.0"}, {"output": "1.0"}) == "same"
    assert answer_to({"output": "2.0", "remarks": "a chunk is gone"}, {"output": "1.0", "remarks": ""}) == "told"
    assert answer_to({"/a": "told: damaged", "/b": "2.0"}, {"/a": "1.0", "/b": "3.0"}) == "silent"
    assert answer_to({}, {"/a": "1.0"}) == "told"
