"""Numbers with the digits that their errors leave them, and sentences about distances."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sobolev_batch import Mesh
from sobolev_batch.cli.comparison import answer, motion_text
from sobolev_batch.shapes import icosphere
from sobolev_batch.tables.text import bound, percent, with_error, wrapped

_NAN = float("nan")


@pytest.mark.parametrize(
    ("function", "value", "error", "shown"),
    [
        (with_error, 0.66889, 0.0213, "0.67 ± 0.03"),
        (with_error, 6.299876e-01, 1e-10, "0.6299876 ± 1 × 10⁻¹⁰"),
        (with_error, 0.001, 0.005, "0.001 ± 0.005"),
        (with_error, 2.6e-9, 9.99e-8, "(2.6 ± 99.9) × 10⁻⁹"),
        (with_error, 0.2654, 0.0994, "0.27 ± 0.11"),
        (with_error, 0.0, 0.0, "0 ± 0"),
        (with_error, 0.0, 5.97e-10, "0 ± 6 × 10⁻¹⁰"),
        (with_error, 12.0, _NAN, "12.00 ± ?"),
        (with_error, _NAN, 1.0, ""),
        (with_error, 2.0123e-5, 1.23e-8, "(2.012 ± 0.002) × 10⁻⁵"),
        (with_error, 1.84604e-5, 1.1e-12, "1.846040 × 10⁻⁵ ± 2 × 10⁻¹²"),
        (percent, 9.87, 0.12, "990 % ± 20 %"),
        (percent, 1.234e-4, 7.2e-7, "0.01234 % ± 0.00008 %"),
        (percent, 1.2341e-8, 4.4e-12, "(1.2341 ± 0.0005) × 10⁻⁶ %"),
        (percent, 0.0102, _NAN, "1.020 % ± ?"),
        (percent, 0.0, 0.0, "0 % ± 0"),
        # Bounds are rounded up.
        (lambda value, _: bound(value), 0.01011, _NAN, "1.1 %"),
        (lambda value, _: bound(value), 3.1e-13, _NAN, "3.1 × 10⁻¹¹ %"),
    ],
)
def test_errors_decide_on_digits(
    function: Callable[[float, float], str], value: float, error: float, shown: str
) -> None:
    assert function(value, error) == shown


@given(st.floats(1e-12, 1e6), st.floats(1e-12, 10.0))
def test_what_is_shown_keeps_the_promise_of_the_error(value: float, ratio: float) -> None:
    """The interval that is shown holds that of the error, unless the value has more digits than are shown."""
    error = value * ratio
    shown, shown_error = _parsed(with_error(value, error))
    rounding = abs(shown - value) if ratio > 1e-5 else 0.0
    assert shown_error >= (error + rounding) * (1 - 1e-6)
    assert math.isclose(shown, value, rel_tol=0.51, abs_tol=error / 10)


def _parsed(text: str) -> tuple[float, float]:
    plain = text.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")).replace(" × 10", "e")
    match = re.fullmatch(r"\(?([\d.e-]+) ± ([\d.e-]+)\)?(e-?\d+)?", plain)
    assert match is not None, text
    value, error, power = match.groups("")
    return float(value + power), float(error + power)


NUMBERS = {"order": -2.0, "distance": 0.03, "error": 0.0003, "relative": 0.0102, "relative_error": 0.0001}
SHARES = {"area_share": 0.561, "area_share_error": 0.012, "excess": -0.007}
UNKNOWN = dict.fromkeys(SHARES, float("nan"))


def said(area_change: float = -0.008, **changes: float) -> str:
    return answer("a.obj", "b.obj", {**NUMBERS, **SHARES, **changes}, area_change)


@pytest.mark.parametrize(
    ("changes", "area_change", "share"),
    [
        ({}, -0.008, "a uniform loss of area explains 56 %"),
        ({"excess": 0.007}, 0.02, "a uniform gain of area explains 56 %"),
        ({"area_share_error": 0.1}, -0.008, "a uniform loss of area explains 60 %"),
        (
            {"area_share": 0.004, "area_share_error": 1e-3},
            0.0,
            "a uniform change of area explains less than 1 %",
        ),
        # Not resolved, not known, or no area that was really lost: the surface was moved, or has become rough.
        ({"area_share_error": 0.2}, -0.008, ""),
        (UNKNOWN, -0.008, ""),
        ({}, 0.0, ""),
        ({}, 0.01, ""),
    ],
)
def test_shares_of_area(changes: dict[str, float], area_change: float, share: str) -> None:
    remark = f"; {share} of the squared distance" if share else ""
    assert said(area_change, **changes) == f"a.obj differs from b.obj by 1.02 % ± 0.01 % at order -2{remark}."


def test_a_number_and_its_unit_stay_on_one_line_of_a_paragraph() -> None:
    for length in range(10, 110):
        lines = wrapped(f"{'x' * length} differs by 0.5\N{NO-BREAK SPACE}% at most")
        assert sum("0.5 %" in line for line in lines) == 1


def test_distances_that_cannot_be_told_from_zero_and_unknown_errors() -> None:
    near = "a.obj differs from b.obj by less than 0.020 % at order -2: not resolved."
    assert said(distance=2e-4, relative=1e-4) == near
    equal = "a.obj and b.obj are equal up to rounding at order -2: they differ by less than 2.1 × 10⁻¹¹ %."
    assert said(distance=1e-14, error=2e-13, relative=1e-14, relative_error=2e-13) == equal
    finer = "a.obj and b.obj are equal up to the rounding of files at order -2: they differ by less than 0.00020 %."
    assert said(distance=0.0, error=2e-6, relative=0.0, relative_error=2e-6) == finer
    zero = dict.fromkeys(NUMBERS, 0.0)
    assert said(**zero, **UNKNOWN) == "a.obj and b.obj are identical: they cover the same surface."
    assert "by 1.020 % ± ? at order -2" in said(relative_error=_NAN)
    unknown = "a.obj differs from b.obj by an unknown amount at order -2: not resolved."
    assert said(error=_NAN, relative_error=_NAN) == unknown


@pytest.mark.parametrize("away", [0.0, 1e3, 1e7])
def test_a_motion_can_be_repeated_from_its_words_however_far_the_mesh_is(away: float) -> None:
    mesh, matrix = icosphere(1), np.eye(4)
    mesh = Mesh(5 * mesh.vertices + away * np.array([3.0, -4.0, 12.0]), mesh.triangles)
    matrix[:3, :3] = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    matrix[:3, 3] = [1.0 / 3, away / 7, -2.0]
    angle, *numbers = (float(one) for one in re.findall(r"-?\d[\d.e+-]*", motion_text(matrix, mesh)))
    turn = Rotation.from_rotvec(angle * np.array(numbers[:3]), degrees=True)
    repeated = mesh.vertices @ turn.as_matrix().T + numbers[3:]
    gaps = repeated - (mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3])
    assert np.abs(gaps).max() < 1e-5 * mesh.bounding_sphere[1]
