"""Pairs of edited solids, their truths, and how the check asks for their distances."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import Any

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner

from sobolev_batch import Mesh
from sobolev_batch.norms.estimate import PARTS
from sobolev_batch.transform.exact import exact_transform
from tests.coverage import __main__ as program
from tests.coverage.cases import KINDS, all_cases, cases_of
from tests.coverage.solids import SOLIDS, Block, Turn, boundary, cut_at_random, difference
from tests.coverage.truth import closed_within, truths_of_rectangles
from tests.support.rectangles import Rectangles

BOX = Block.of((0, 0, 0), (1.0, 0.7, 0.5))
EDITS = {
    "boss": Block.of((0.3, 0.2, 0.5), (0.4, 0.25, 0.6)),
    "pocket": Block.of((0.3, 0.2, 0.4), (0.4, 0.25, 0.5), added=False),
    "hole": Block.of((0.3, 0.2, 0.0), (0.4, 0.25, 0.5), added=False),
}


@pytest.mark.parametrize(("edit", "area"), [("boss", 0.03), ("pocket", 0.03), ("hole", 0.15 - 2 * 0.005)])
def test_an_edit_changes_the_area_by_its_own_sides_alone(edit: str, area: float) -> None:
    before, after = boundary([BOX]).mesh().area, boundary([BOX, EDITS[edit]]).mesh().area
    assert before == pytest.approx(2 * (0.7 + 0.5 + 0.35), rel=1e-14)
    assert after - before == pytest.approx(area, rel=1e-12)


@pytest.mark.parametrize("edit", EDITS)
def test_the_truth_of_a_difference_is_that_of_whole_surfaces(edit: str) -> None:
    orders = (-0.75, -1.0, -3.0)
    after = boundary([BOX, EDITS[edit]])
    whole = truths_of_rectangles(boundary([BOX]), after, orders, turned=False)
    left, right = difference(boundary([BOX], [EDITS[edit]]), after)
    assert len(left.low) + len(right.low) < 10
    for truth, other in zip(whole, truths_of_rectangles(left, right, orders, turned=False), strict=True):
        assert abs(truth.value - other.value) <= truth.uncertainty + other.uncertainty < 1e-6 * truth.value


@pytest.mark.parametrize("seed", range(4))
def test_faces_cut_at_random_and_turned_are_the_same_measure_in_the_same_planes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = Turn.random(rng)
    rectangles = boundary([turn.block(BOX), turn.block(EDITS["boss"])])
    mesh = turn.apply(cut_at_random(rng, rectangles, 3, turn))
    xi = rng.normal(size=(7, 3))
    found = exact_transform(mesh, xi @ turn.whole.T / turn.denominator)
    assert np.allclose(found, _transform(rectangles, xi), rtol=0, atol=1e-13 * mesh.area)
    # Turned back, which is exact, all faces are still in planes of constant coordinates.
    corners = (mesh.vertices @ turn.whole / turn.denominator)[mesh.triangles]
    assert np.all(np.any(corners.max(axis=1) == corners.min(axis=1), axis=1))


def test_rotations_are_rotations_and_most_are_no_symmetry_of_the_axes() -> None:
    turns = [Turn.random(np.random.default_rng(seed)) for seed in range(20)]
    for turn in turns:
        assert np.array_equal(turn.whole @ turn.whole.T, turn.denominator**2 * np.eye(3))
        assert np.linalg.det(turn.whole) > 0
    assert 8 <= sum(np.abs(turn.whole / turn.denominator).max() < 1 - 1e-9 for turn in turns) <= 18


@pytest.mark.parametrize("kind", ["edited and remeshed", "close and thin", "array", "far apart"])
def test_random_pairs_have_telling_truths(kind: str) -> None:
    for seed in (5, 7):
        pair = SOLIDS[kind](np.random.default_rng(seed))
        if pair.rectangles is not None:
            sides = [np.prod(np.sort(each.high - each.low, axis=1)[:, 1:], axis=1).sum() for each in pair.rectangles]
            areas = [surface.area for surface in pair.surfaces]
            assert areas[0] - areas[1] == pytest.approx(sides[0] - sides[1], abs=1e-9 * sum(areas))
        truths = pair.truths((-0.75, -3.0))
        assert all(truth is not None and 0 <= truth.uncertainty < 1e-4 * truth.value for truth in truths)


@pytest.mark.all
@pytest.mark.parametrize(("kind", "seed", "accuracy"), [("edited and remeshed", 0, 1e-4), ("close and thin", 3, 1e-6)])
def test_truths_agree_with_potentials_of_faces(kind: str, seed: int, accuracy: float) -> None:
    pair = SOLIDS[kind](np.random.default_rng(seed))
    for truth, other in zip(pair.truths((-2.0, -3.0)), closed_within(*pair.surfaces, (-2.0, -3.0)), strict=True):
        assert truth is not None
        assert abs(truth.value - other.value) <= truth.uncertainty + other.uncertainty < accuracy * truth.value


def test_far_apart_squares_add_up() -> None:
    pair = SOLIDS["far apart"](np.random.default_rng(0))
    assert isinstance(pair.second, Mesh)
    assert np.abs(pair.second.vertices).max() > 1e3
    assert pair.rectangles is not None
    nothing = Rectangles(np.empty((0, 3)), np.empty((0, 3)))
    alone = [truths_of_rectangles(each, nothing, (-0.75, -3.0), turned=False) for each in pair.rectangles]
    for truth, first, second in zip(pair.truths((-0.75, -3.0)), *alone, strict=True):
        assert truth is not None
        assert truth.value == pytest.approx(np.hypot(first.value, second.value), rel=1e-9)


@pytest.mark.parametrize(("kind", "calls"), [("close and thin", 1), ("edited and remeshed", 3)])
def test_close_and_thin_surfaces_are_asked_for_all_orders_at_once(
    kind: str, calls: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []

    def pretended(a: Mesh, b: Mesh, orders: Sequence[float], **settings: Any) -> xr.Dataset:
        asked.append(settings["rtol"])
        values = {"distance": ("order", -np.array(orders)), "error": ("order", np.ones(len(orders)))}
        parts = {"error_part": (("part", "order"), np.ones((len(PARTS), len(orders))))}
        return xr.Dataset(values | parts, {"order": list(orders), "part": list(PARTS)})

    monkeypatch.setattr(program, "distance", pretended)
    rows = program.judge(cases_of(0, list(KINDS).index(kind)))
    assert len(asked) == calls
    assert len({row["order"] for row in rows}) == 3
    assert all(row["value"] == -row["order"] for row in rows)


def test_a_run_in_parts_has_the_cases_of_a_whole_one() -> None:
    kinds = ("far spheres", "far apart")
    whole = list(all_cases(3, 18, kinds))
    assert [cases[0].kind for cases in whole] == [*kinds] * 3
    parts = [*all_cases(3, 9, kinds), *all_cases(3, 9, kinds, first=whole[2][0].index + 1)]
    assert [str(case) for cases in whole for case in cases] == [str(case) for cases in parts for case in cases]
    assert [cases[0].index for cases in islice(all_cases(0, 9), 3)] == [0, 1, 2]


def test_rows_are_printed_as_they_come(monkeypatch: pytest.MonkeyPatch) -> None:
    judge, judged = program.judge, []

    def judge_one(cases: Any) -> Any:
        judged.append(cases)
        if len(judged) == 2:
            raise KeyboardInterrupt
        return judge(cases)

    monkeypatch.setattr(program, "judge", judge_one)
    result = CliRunner().invoke(program.main, ["--kind", "far spheres", "--cases", "6", "--seed", "2"])
    assert result.exit_code != 0
    lines = result.output.strip().splitlines()[:3]
    assert ["off/error 0." in line for line in lines if line.startswith("far spheres, pair 1, order -")] == [True] * 3


def _transform(rectangles: Rectangles, xi: np.ndarray) -> np.ndarray:
    widths, middles = rectangles.high - rectangles.low, (rectangles.high + rectangles.low) / 2
    across = np.where(widths > 0, widths, 1.0) * np.sinc(xi[:, None] * widths)
    return np.asarray((across * np.exp(-2j * np.pi * xi[:, None] * middles)).prod(axis=2).sum(axis=1))
