"""Sentences about distances."""

from __future__ import annotations

import pytest

from sobolev_batch.results.tables.text import answer

NUMBERS = {"order": -2.0, "distance": 0.03, "error": 0.0003, "relative": 0.0102, "relative_error": 0.0001}
SHARES = {"area_share": 0.561, "area_share_error": 0.012, "excess": -0.007}
UNKNOWN = dict.fromkeys(SHARES, float("nan"))


def said(area_change: float = -0.008, **changes: float) -> str:
    return answer("a.obj", "b.obj", {**NUMBERS, **SHARES, **changes}, area_change)


@pytest.mark.parametrize(
    ("changes", "area_change", "share"),
    [
        ({}, -0.008, "; 56 % of it is lost area"),
        ({"excess": 0.007}, 0.02, "; 56 % of it is gained area"),
        ({"area_share_error": 0.1}, -0.008, "; 60 % of it is lost area"),
        ({"area_share": 0.004, "area_share_error": 1e-3}, 0.0, "; less than 1 % of it is a change of area"),
        # Not resolved, not known, or no area that was really lost: the surface was moved, or has become rough.
        ({"area_share_error": 0.2}, -0.008, ""),
        (UNKNOWN, -0.008, ""),
        ({}, 0.0, ""),
        ({}, 0.01, ""),
    ],
)
def test_shares_of_area(changes: dict[str, float], area_change: float, share: str) -> None:
    assert said(area_change, **changes) == f"a.obj differs from b.obj by 1.02 % ± 0.01 % at order -2{share}."


def test_distances_that_cannot_be_told_from_zero() -> None:
    assert (
        said(distance=2e-4, relative=1e-4) == "a.obj differs from b.obj by less than 0.020 % at order -2: not resolved."
    )
    equal = "a.obj and b.obj are equal up to rounding at order -2: they differ by less than 2.1 × 10⁻¹¹ %."
    assert said(distance=1e-14, error=2e-13, relative=1e-14, relative_error=2e-13) == equal
    zero = dict.fromkeys(NUMBERS, 0.0)
    assert said(**zero, **UNKNOWN) == "a.obj and b.obj are identical: they have the same triangles."


def test_unknown_errors() -> None:
    nan = float("nan")
    assert "by 1.020 % ± ? at order -2" in said(relative_error=nan)
    assert (
        said(error=nan, relative_error=nan)
        == "a.obj differs from b.obj by an unknown amount at order -2: not resolved."
    )
