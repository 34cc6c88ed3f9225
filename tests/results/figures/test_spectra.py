"""Choice of the meshes whose spectra are read."""

from __future__ import annotations

import pytest

from sobolev_batch.results.figures.spectra import _spread_over_families, spread

MEMBERS = [("a", f"a/{i}") for i in range(10)] + [("b", "b/0")] + [("c", f"c/{i}") for i in range(3)]


@pytest.mark.parametrize("most", [3, 5, 7, 13])
def test_every_family_has_a_mesh_and_none_is_favoured(most: int) -> None:
    chosen = _spread_over_families(MEMBERS, most)
    assert len(chosen) == len(set(chosen)) == most
    counts = {name: sum(label.startswith(name) for label in chosen) for name in "abc"}
    assert counts["b"] == 1
    assert counts["c"] == min(3, (most - 1) // 2)
    assert chosen == [label for _, label in MEMBERS if label in chosen]


def test_fewer_meshes_than_families() -> None:
    assert _spread_over_families(MEMBERS, 2) == ["a/0", "c/0"]
    assert _spread_over_families(MEMBERS, 100) == [label for _, label in MEMBERS]


def test_spread_keeps_both_ends() -> None:
    assert spread(range(11), 3) == [0, 5, 10]
    assert spread([], 3) == []
