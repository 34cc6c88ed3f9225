"""Triangle rules: exactness, positivity, and the range of each."""

from __future__ import annotations

from math import factorial

import numpy as np
import pytest

from sobolev_batch import Mesh
from sobolev_batch.spectral.exact import exact_transform
from sobolev_batch.spectral.quadrature.meshes import (
    HIGHEST_DEGREE,
    TriangleRule,
    candidate_rules,
    gauss_rule,
    measure_largest_errors,
    measure_typical_errors,
    measured_errors,
    rule_ranges,
    symmetric_rule,
)


def monomial_error(rule: TriangleRule, degree: int) -> float:
    """Largest error over the barycentric monomials of a degree: their means are a! b! c! 2! / (a+b+c+2)!."""
    errors = []
    for a in range(degree + 1):
        for b in range(degree + 1 - a):
            c = degree - a - b
            found = rule.weights @ np.prod(rule.barycentric ** np.array([a, b, c]), axis=1)
            exact = 2 * factorial(a) * factorial(b) * factorial(c) / factorial(degree + 2)
            errors.append(abs(found - exact))
    return float(max(errors))


@pytest.mark.parametrize("degree", range(1, HIGHEST_DEGREE + 1))
def test_symmetric_rules_are_exact_positive_and_interior(degree: int) -> None:
    rule = symmetric_rule(degree)
    assert rule.weights.sum() == pytest.approx(1.0, abs=1e-15)
    assert (rule.weights > 0).all()
    assert (rule.barycentric > 0).all()
    assert monomial_error(rule, degree) < 3e-15


def test_the_papers_rule_has_64_points_of_degree_14() -> None:
    rule = gauss_rule(8)
    assert rule.size == 64
    assert rule.degree == 14
    assert monomial_error(rule, 14) < 3e-16
    assert monomial_error(rule, 16) > 1e-15


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9, 1e-12])
def test_no_triangle_within_range_exceeds_the_tolerance(tolerance: float) -> None:
    rng = np.random.default_rng(11)
    rules, ranges = rule_ranges(tolerance)
    assert (np.diff(ranges) > 0).all()
    assert (np.diff([rule.cost for rule in rules]) > 0).all()
    for rule, limit in zip(rules, ranges, strict=True):
        if limit == 0:
            continue
        for _ in range(8):
            corners = rng.normal(size=(3, 3))
            corners[2] = corners[0] + rng.uniform(0.01, 1.0) * (corners[2] - corners[0])
            mesh = Mesh(corners, [[0, 1, 2]])
            frequency = rng.normal(size=3)
            frequency *= limit / (2 * np.pi * mesh.centroid_radii[0] * np.linalg.norm(frequency))
            found = mesh.area * rule.weights @ np.exp(-2j * np.pi * (rule.barycentric @ corners @ frequency))
            exact = exact_transform(mesh, frequency[None, :])[0]
            assert abs(found - exact) <= max(tolerance, 1e-14) * mesh.area


@pytest.mark.parametrize("row", [0, 2, 9, 51])
def test_the_errors_that_the_package_carries_are_those_of_its_rules(row: int) -> None:
    rule, carried = candidate_rules()[row], measured_errors()
    assert carried["largest"][row] == pytest.approx(measure_largest_errors(rule), rel=1e-6, abs=1e-15)
    even, odd = measure_typical_errors(rule)
    assert carried["even"][row] == pytest.approx(even, rel=1e-6, abs=1e-15)
    assert carried["odd"][row] == pytest.approx(odd, rel=1e-6, abs=1e-15)
