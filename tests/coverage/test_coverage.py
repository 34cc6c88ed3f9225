"""Sample of the coverage check, and checks of its own foundations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import quad
from scipy.special import gamma, kv

from sobolev_batch import Mesh, distance
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.norms.estimate import PARTS
from sobolev_batch.shapes import Sphere, icosphere
from tests.coverage.__main__ import described, judge, judged, show
from tests.coverage.cases import KINDS, cases_of
from tests.coverage.matern import kernel, radial_integral
from tests.coverage.truth import (
    closed_within,
    on_fine_lattice,
    summed_in_real_space,
    truths_of_rectangles,
    truths_of_spheres,
    without_common_triangles,
)
from tests.support.rectangles import Rectangles
from tests.support.shapes import CENTRED_BOX as BOX

SMALL = Mesh(0.9 * BOX.vertices, BOX.triangles)
WHOLE = (-2.0, -3.0, -5.0, -10.0)
CASE = replace(cases_of(0, 0)[0], order=-2.0, settings={"rtol": 0.05})
# Pairs of the sample, one of each kind, whose truth takes little time.
SAMPLE = range(22, 22 + len(KINDS))


@pytest.fixture(scope="module")
def sample() -> pd.DataFrame:
    """One case of one pair of each kind, at its lowest order."""
    return judged([row for index in SAMPLE for row in judge([cases_of(1, index)[-1]])])


@pytest.mark.all
def test_reported_errors_cover_the_true_ones_of_random_cases(sample: pd.DataFrame) -> None:
    measured = sample[sample["measured"]]
    assert len(measured) >= 20
    assert measured["covered"].sum() >= len(measured) - 1, list(map(described, measured[~measured["covered"]]))
    # At low orders the errors are smaller than what is known of the truth for some real meshes.
    assert measured["ratio"].count() >= 15
    assert measured["ratio"].median() < 30


@pytest.mark.all
def test_understated_errors_are_called_uncovered(sample: pd.DataFrame) -> None:
    telling = sample[sample["ratio"].notna()]
    true_error = (telling["value"] - telling["truth"]).abs()
    for understated in (0.5 * true_error, np.nan):
        assert not judged(telling.assign(reported=understated))["covered"].any()
    # Nor does the check pass if all errors are a third of what they are.
    assert not show(judged(telling.assign(reported=telling["reported"] / 3)))


def test_judgement_allows_for_what_is_uncertain_about_the_truth() -> None:
    row = {"case": CASE, "order": -2.0, "refused": np.nan, "value": 1.0, "reported": 0.02, "truth": 1.03}
    table = judged([row | {"uncertainty": uncertainty} for uncertainty in (0.02, 0.001)])
    assert table["covered"].tolist() == [True, False]
    assert table["ratio"].notna().tolist() == [False, True]


def test_cases_depend_on_the_seed_and_the_place_alone() -> None:
    first, again, other = (cases_of(seed, 2) for seed in (0, 0, 1))
    assert list(map(str, first)) == list(map(str, again))
    digests = [[_digest(surface) for surface in cases[0].pair.surfaces] for cases in (first, again, other)]
    assert digests[0] == digests[1] != digests[2]


@pytest.mark.all
@pytest.mark.parametrize(
    ("a", "b"),
    [(BOX, SMALL), (SMALL, Sphere(0.7)), (icosphere(0), Sphere(0.8, (0.1, 0.0, 0.0)))],
    ids=["boxes", "box and sphere", "icosphere and sphere"],
)
def test_three_ways_to_the_truth_agree_within_what_they_claim(a: Surface, b: Surface) -> None:
    ways = [way(a, b, WHOLE) for way in (closed_within, summed_in_real_space, on_fine_lattice)]
    for order, candidates in zip(WHOLE, zip(*ways, strict=True), strict=True):
        best = min(candidates, key=lambda truth: truth.uncertainty)
        for truth in candidates:
            assert abs(truth.value - best.value) <= 3 * truth.uncertainty + best.uncertainty, (order, candidates)
        assert best.uncertainty < 3e-5 * best.value


@pytest.mark.parametrize("power", [0.75, 1, 1.5, 2, 3, 5, 10])
def test_the_kernel_is_the_matern_function_and_its_integral_that_of_the_kernel(power: int) -> None:
    r = np.geomspace(1e-3, 3, 7)
    matern = 2 * np.pi**power / gamma(power) * r ** (power - 1.5) * kv(power - 1.5, 2 * np.pi * r)
    assert np.allclose(kernel(r, power), matern, rtol=1e-12, atol=0)
    rest = [quad(lambda t: t * kernel(np.array(t), power), low, np.inf, epsabs=0, epsrel=1e-11)[0] for low in r]
    assert np.allclose(radial_integral(r, power), rest, rtol=1e-9, atol=0)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (Sphere(), Sphere(0.9, (0.1, 0.05, 0.0))),
        (Sphere(0.5), Sphere(0.5, (1e-3, 0.0, 0.0))),
        (Sphere(0.5), Sphere(0.6)),
        (Sphere(0.2, (-3.0, 0.0, 0.0)), Sphere(0.1, (3.0, 0.0, 0.0))),
    ],
    ids=["moved", "near", "concentric", "distant"],
)
def test_two_ways_to_spheres_agree_at_every_order(a: Sphere, b: Sphere) -> None:
    orders = (-0.6, -0.75, -1.0, -1.5, -2.0, -5.0, -10.0)
    closed = distance(a, b, orders)
    pairs = zip(closed["distance"].values, closed["error"].values, truths_of_spheres(a, b, orders), strict=True)
    for value, error, truth in pairs:
        assert abs(value - truth.value) <= error + truth.uncertainty
        assert truth.uncertainty < 1e-4 * value


@pytest.mark.slow
@pytest.mark.parametrize("offset", [(0.1, 0.07, 0.03), (0.001, 0.002, 0.001)], ids=["moved", "near"])
@pytest.mark.parametrize(("orders", "accuracy"), [((-0.6,), 2e-3), ((-1.0, -1.5, -3.0), 6e-4)])
def test_real_space_agrees_with_heat_traces_within_what_both_claim(
    offset: tuple[float, ...], orders: tuple[float, ...], accuracy: float
) -> None:
    a = Rectangles.from_corners(((0, 0, 0), (1, 0.6, 0)), ((0, 0, 0), (0, 0.6, 0.4)))
    exact = truths_of_rectangles(a, a.moved(*offset), orders, turned=False)
    found = closed_within(a.mesh(), a.moved(*offset).mesh(), orders)
    for truth, other in zip(exact, found, strict=True):
        assert abs(truth.value - other.value) <= truth.uncertainty + other.uncertainty
        assert truth.uncertainty < 1e-6 * truth.value
        assert other.uncertainty < accuracy * truth.value


@pytest.mark.all
def test_sums_of_points_agree_with_heat_traces_where_the_kernel_is_infinite() -> None:
    orders = (-1.0, -1.5)
    box, other = Rectangles.box((0, 0, 0), (1, 0.6, 0.4)), Rectangles.box((0.2, 0.1, 0.7), (0.8, 0.5, 0.9))
    exact = truths_of_rectangles(box, other, orders, turned=False)
    for truth, found in zip(exact, summed_in_real_space(box.mesh(), other.mesh(), orders, 10_000), strict=True):
        assert abs(truth.value - found.value) <= truth.uncertainty + found.uncertainty < 0.02 * truth.value


def test_heat_traces_do_not_depend_on_how_a_part_is_cut() -> None:
    box = Rectangles.box((0, 0, 0), (1, 0.6, 0.4))
    edges = [np.array([0, 0.3, 1]), np.array([0, 0.6]), np.array([0, 0.1, 0.4])]
    cut = Rectangles.cells(edges, np.ones((2, 1, 2), dtype=bool))
    assert cut.mesh().area == pytest.approx(box.mesh().area, rel=1e-14)
    squares, slacks = cut.squared_distance(box, (-1.0, -3.0))
    assert np.all(np.abs(squares) <= slacks)
    assert np.all(slacks < 1e-10)


@pytest.mark.slow
def test_triangles_that_both_meshes_have_are_left_out() -> None:
    vertices = BOX.vertices.copy()
    vertices[0] += 0.1
    moved = Mesh(vertices[::-1], 7 - BOX.triangles[::-1])
    a, b = without_common_triangles(BOX, moved)
    assert len(a.triangles) == len(b.triangles) < len(BOX.triangles)
    whole, less = closed_within(BOX, moved, (-2.0,)), closed_within(a, b, (-2.0,))
    assert abs(whole[0].value - less[0].value) <= whole[0].uncertainty + less[0].uncertainty
    same, again = without_common_triangles(BOX, BOX)
    assert len(same.triangles) == len(again.triangles) == 1


def test_the_report_lists_what_is_uncovered_and_refused(capsys: pytest.CaptureFixture[str]) -> None:
    wrong = {"case": CASE, "kind": CASE.kind, "order": CASE.order, "measured": True, "refused": np.nan, "broken": False}
    wrong |= {"value": 1.0, "reported": 0.1, "truth": 2.0, "uncertainty": 0.01, "seconds": 3.5}
    wrong |= dict.fromkeys(PARTS, 0.025)
    refused = wrong | {"measured": False, "value": np.nan, "refused": 0.2, "broken": True, "seconds": 7.0}
    assert not show(judged([wrong, refused]))
    printed = capsys.readouterr().out
    assert "not covered: near spheres, pair 0, order -2" in printed
    assert "offered 0.2, and refused that too" in printed
    assert "1 refused, 1 of them unexpectedly" in printed
    assert "7.0 s" in printed
    assert show(judged([wrong | {"reported": 1.5}]))


def _digest(surface: Surface) -> str:
    return surface.digest if isinstance(surface, Mesh) else repr(surface)
