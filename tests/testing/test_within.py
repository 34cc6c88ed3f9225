"""Whether the largest deviation of two meshes is within a length, in any unit, for tests and as an exit status."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import sobolev_batch as sb
from sobolev_batch.cli.program import cli
from sobolev_batch.geometry import deviation
from sobolev_batch.parameters import length_in
from sobolev_batch.testing.within import DeviationVerdict, deviation_text
from tests.geometry.test_deviation import plate


def test_a_hole_that_was_closed_fails_and_names_its_place() -> None:
    full, hole = plate(hole=False), plate(hole=True)
    found = sb.testing.assert_within(full, hole, 3.1)
    assert 0 < found.both.lower < 3 < found.both.upper <= 3.1
    with pytest.raises(
        AssertionError,
        match=r"^not within 2: largest deviation .*2\.[89].*, at \(.*\) of a; 0.* % ± .* % of the area of a is farther",
    ):
        sb.testing.assert_within(full, hole, 2)
    # A length that is reached is not exceeded.
    box = sb.shapes.icosphere(1)
    sb.testing.assert_within(box, sb.Mesh(box.vertices, box.triangles[::-1]), 1e-9)


def test_what_a_scan_has_not_seen_counts_unless_only_its_own_points_do() -> None:
    part = sb.shapes.icosphere(2)
    scan = sb.Mesh(part.vertices, part.triangles[:200])
    found = sb.testing.assert_within(scan, part, 1e-6, one_way=True)
    assert found.forward.upper <= 1e-6 < found.backward.lower
    for pair, one_way in (((scan, part), False), ((part, scan), True)):
        # Points of the part are farther away, whichever is passed first.
        own = "ab"[pair[1] is part]
        said = rf"^not within .*, at \(.*\) of {own}; 3\d\S* % ± .* of the area of {own} is farther away$"
        with pytest.raises(AssertionError, match=said):
            sb.testing.assert_within(*pair, 1e-6, one_way=one_way)


def test_another_unit_or_place_is_doubted() -> None:
    ball = sb.shapes.icosphere(2)
    for change, doubt in (
        (ball.vertices / 25.4, "it is 25.4 times as small .*: is one in millimetres and the other in inches"),
        (ball.vertices + 9.0, "its bounding box hardly overlaps .*: are both in the same place"),
    ):
        with pytest.raises(AssertionError, match=rf"is farther away; {doubt}\?$"):
            sb.testing.assert_within((change, ball.triangles), ball, 0.1)


@pytest.mark.parametrize(
    ("length", "unit", "passes"),
    [
        ("3.2 mm", "mm", True),
        ("0.29cm", "mm", False),
        ("0.32 cm", "mm", True),
        ("1in", "cm", False),
        ("9 in", "cm", True),
    ],
)
def test_units_are_converted(length: str, unit: str, passes: bool) -> None:
    meshes = plate(hole=False), plate(hole=True)
    if passes:
        sb.testing.assert_within(*meshes, length, unit=unit)
    else:
        with pytest.raises(AssertionError, match=rf"^not within \S+ {unit}: .* {unit}, at "):
            sb.testing.assert_within(*meshes, length, unit=unit)


def test_lengths_in_units() -> None:
    assert length_in("1e-3 m", "um") == pytest.approx(1000)
    assert length_in(".5", "in") == length_in(np.float64(0.5), "mm") == 0.5
    assert length_in("2voxels", "voxels") == 2


@pytest.mark.parametrize(
    ("length", "unit", "message"),
    [
        ("0.1 mm", None, "name it, as unit='mm'"),
        ("0.1 mm", "voxels", "cannot be converted into 'voxels'"),
        ("3 furlong", "mm", "known are um, mm, cm, m, in"),
        ("1 %", "mm", "has the unit '%'"),
        *(
            (wrong, "mm", "a positive number")
            for wrong in ("0", "-1 mm", "mm", "", "nan", "1e999", 0, -0.1, True, None)
        ),
    ],
)
def test_other_lengths_are_refused(length: str, unit: str | None, message: str) -> None:
    with pytest.raises(sb.errors.InputError, match=message):
        sb.testing.assert_within(plate(hole=False), plate(hole=True), length, unit=unit)


def test_an_open_question_fails_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    meshes = plate(hole=False), plate(hole=True)
    length = 1.001 * sb.largest_deviation(*meshes, gap=1e-4).both.lower
    monkeypatch.setattr(deviation, "_MOST_PIECES", 0)
    with pytest.raises(AssertionError, match=r"^undecided whether within \S+: largest deviation \S+ to \S+, at "):
        sb.testing.assert_within(*meshes, length)
    files = [str(tmp_path / name) for name in ("a.ply", "b.ply")]
    for mesh, file in zip(meshes, files, strict=True):
        sb.write_mesh(mesh, file)
    done = CliRunner().invoke(cli, ["compare", *files, "--within", repr(length)])
    assert (done.exit_code, done.stdout.startswith("a.ply: undecided")) == (4, True)


def test_rounding_alone_is_no_deviation() -> None:
    ball = sb.shapes.icosphere(3)
    other = sb.Mesh(ball.vertices, ball.triangles[::-1])
    assert sb.largest_deviation(ball, other).both.lower > 0
    with pytest.raises(
        AssertionError, match=r"^undecided whether within 1e-300: largest deviation 0, at \S+ \S+ \S+ of [ab]$"
    ):
        sb.testing.assert_within(ball, other, 1e-300)


@pytest.mark.parametrize("unit", [None, "mm"])
def test_bounds_are_rounded_outwards_and_places_of_rounding_are_zero(unit: str | None) -> None:
    found = deviation.Deviation(0.33312, 0.33519, (60.0, -1e-17, 10.25))
    assert deviation_text(found, unit) == f"0.3331 to 0.3352{' mm' if unit else ''}, at (60, 0, 10.25)"


@pytest.mark.parametrize(
    ("length", "lower", "upper", "limit", "shown"),
    [
        (1e-4, 1.00001e-4, 1.00001e-4, "0.0001", "0.000100001"),
        (1e-4, 1.000015e-4, 1.002e-4, "0.0001", "1.000015 × 10⁻⁴ to 1.002000 × 10⁻⁴"),
        (1.2345678e-4, 1.2345699e-4, 1.0, "0.00012345678", "≥ 1.2345699 × 10⁻⁴"),
        (2.0, 2.9, 2.9, "2", "2.9"),
    ],
)
def test_a_deviation_does_not_read_as_the_length_that_it_is_above(
    length: float, lower: float, upper: float, limit: str, shown: str
) -> None:
    way = deviation.Deviation(lower, upper, (0.0, 0.0, 0.0))
    verdict = DeviationVerdict(length, None, deviation.Deviations(way, way), (0.1, 0.01))
    assert str(verdict).startswith(f"not within {limit}: largest deviation {shown}, at ")


@pytest.mark.parametrize(("upper", "shown"), [(39.42, "≥ 3.997"), (4.0201, "3.997 to 4.021")])
def test_an_upper_bound_that_a_no_left_far_away_is_not_told(upper: float, shown: str) -> None:
    way = deviation.Deviation(3.9976, upper, (60.0, 0.0, 0.0))
    verdict = DeviationVerdict(2.0, "mm", deviation.Deviations(way, way), (0.1, 0.01))
    assert str(verdict).startswith(f"not within 2 mm: largest deviation {shown} mm, at (60, 0, 0) of a; 10 % ± 1 % ")
