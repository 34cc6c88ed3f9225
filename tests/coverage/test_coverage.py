"""Sample of the coverage check, and checks of its own foundations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import gamma, kv

from sobolev_batch import Mesh, Sphere, icosphere
from sobolev_batch.surfaces.shapes.surface import Surface
from tests.coverage.cases import KINDS, ORDERS, all_cases, cases_of
from tests.coverage.judging import Tally, Verdict, judge
from tests.coverage.matern import kernel, radial_integral
from tests.coverage.truth import Truth, closed_within, on_fine_lattice, summed_in_real_space, truths
from tests.support.shapes import CENTRED_BOX as BOX

pytestmark = pytest.mark.slow

SMALL = Mesh(0.9 * BOX.vertices, BOX.triangles)


@pytest.fixture(scope="module")
def sample() -> Tally:
    """Verdicts on one pair of each kind."""
    pytest.importorskip("nilearn", reason="the cortical surface comes with the extra 'studies'")
    return Tally(tuple(verdict for cases in all_cases(1, len(KINDS) * len(ORDERS)) for verdict in judge(cases)))


def test_reported_errors_cover_the_true_ones_of_random_cases(sample: Tally) -> None:
    assert len(sample.verdicts) >= 30
    assert sample.covered >= len(sample.verdicts) - 1, sample.worst
    # At low orders the errors are smaller than what is known of the truth for some real meshes.
    assert len(sample.ratios) >= 20
    assert sample.median_ratio < 30


def test_understated_errors_are_called_uncovered(sample: Tally) -> None:
    telling = [verdict for verdict in sample.verdicts if verdict.telling]
    assert not any(replace(verdict, reported=0.5 * verdict.true_error).covered for verdict in telling)
    assert not any(replace(verdict, reported=float("nan")).covered for verdict in sample.verdicts)
    # Nor would a tenth of the errors do for the sample as a whole.
    tenth = Tally(tuple(replace(verdict, reported=verdict.reported / 10) for verdict in telling))
    assert tenth.covered < 0.5 * len(telling)
    assert tenth.worst is not None


def test_judgement_allows_for_what_is_uncertain_about_the_truth() -> None:
    verdict = Verdict(cases_of(0, 0)[0], value=1.0, reported=0.02, truth=Truth(1.03, 0.02))
    assert verdict.covered
    assert not verdict.telling
    assert not replace(verdict, truth=Truth(1.03, 0.001)).covered
    assert replace(verdict, truth=Truth(1.03, 0.001)).telling
    assert Tally((verdict,)).worst is None
    assert np.isnan(Tally((verdict,)).median_ratio)


def test_cases_depend_on_the_seed_and_the_place_alone() -> None:
    first, again, other = (cases_of(seed, 2) for seed in (0, 0, 1))
    assert [case.setting for case in first] == [case.setting for case in again]
    assert [_digest(surface) for surface in first[0].pair] == [_digest(surface) for surface in again[0].pair]
    assert [_digest(surface) for surface in first[0].pair] != [_digest(surface) for surface in other[0].pair]


@pytest.mark.parametrize(
    ("a", "b"),
    [(BOX, SMALL), (SMALL, Sphere(0.7)), (icosphere(0), Sphere(0.8, (0.1, 0.0, 0.0)))],
    ids=["boxes", "box and sphere", "icosphere and sphere"],
)
def test_three_ways_to_the_truth_agree_within_what_they_claim(a: Surface, b: Surface) -> None:
    ways = [way(a, b, ORDERS) for way in (closed_within, summed_in_real_space, on_fine_lattice)]
    for order, candidates in zip(ORDERS, zip(*ways, strict=True), strict=True):
        best = min(candidates, key=lambda truth: truth.uncertainty)
        for truth in candidates:
            assert abs(truth.value - best.value) <= 3 * truth.uncertainty + best.uncertainty, (order, candidates)
        assert best.uncertainty < 3e-5 * best.value


@pytest.mark.parametrize("power", [2, 3, 5, 10])
def test_the_kernel_is_the_matern_function_and_its_integral_that_of_the_kernel(power: int) -> None:
    r = np.geomspace(1e-3, 3, 7)
    matern = 2 * np.pi**power / gamma(power) * r ** (power - 1.5) * kv(power - 1.5, 2 * np.pi * r)
    assert np.allclose(kernel(r, power), matern, rtol=1e-12, atol=0)
    rest = [quad(lambda t: t * kernel(np.array(t), power), low, np.inf, epsabs=0, epsrel=1e-11)[0] for low in r]
    assert np.allclose(radial_integral(r, power), rest, rtol=1e-9, atol=0)


def test_real_space_agrees_with_the_closed_form_of_spheres() -> None:
    # Icospheres come nearer to spheres by a factor of 4 a level; extrapolation leads to them.
    first, second = Sphere(), Sphere(0.5, (0.2, 0.1, 0.0))
    levels = []
    for level in (0, 1, 2):
        outer = icosphere(level)
        inner = Mesh(0.5 * outer.vertices + np.array(second.center), outer.triangles)
        levels.append([truth.value for truth in summed_in_real_space(outer, inner, ORDERS, 16_000)])
    coarse, middle, fine = np.array(levels)
    near, nearer = middle + (middle - coarse) / 3, fine + (fine - middle) / 3
    exact = [truth.value for truth in truths(first, second, ORDERS)]
    assert np.allclose(nearer + (nearer - near) / 15, exact, rtol=4e-4, atol=0)


def _digest(surface: Surface) -> str:
    return surface.digest if isinstance(surface, Mesh) else repr(surface)
