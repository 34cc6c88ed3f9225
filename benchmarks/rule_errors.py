"""Errors of the rules on triangles: `python -m benchmarks.rule_errors` measures those that the package carries."""

from __future__ import annotations

import numpy as np

from sobolev_batch.arrays import Complexes, Reals
from sobolev_batch.transform.exact import second_difference
from sobolev_batch.transform.rules import (
    SIZES,
    SIZES_ON_AVERAGE,
    TABULATED,
    TriangleRule,
    candidate_rules,
    tabulated,
)


def measure_largest_errors(rule: TriangleRule) -> Reals:
    """Return the largest relative error of a rule on triangles of each size (160,).

    On a plane wave the error of a rule depends only on the phases at the triangle's three corners. Measured from the
    centroid they sum to zero, and the largest is at most 2π|ξ|ρ: a hexagon; symmetry leaves one twelfth of it to
    sample.
    """
    fractions = np.linspace(0.5, 1.0, 5)
    largest = np.repeat(SIZES, len(fractions))
    second = -largest * np.tile(fractions, len(SIZES))
    errors = np.abs(_errors(rule, np.stack([largest, second, -largest - second])))
    return np.asarray(errors.reshape(len(SIZES), -1).max(axis=1))


def measure_typical_errors(rule: TriangleRule) -> tuple[Reals, Reals]:
    """Return the even and the odd part of a rule's error at each size (64,): see `typical_errors`."""
    sizes = SIZES_ON_AVERAGE
    cosines, weights = np.polynomial.legendre.leggauss(4)
    sines = np.sqrt(1 - ((1 + cosines) / 2) ** 2)
    angles = (np.arange(4) + 0.5) * np.pi / 24
    equilateral = np.cos(angles + 2 * np.pi / 3 * np.arange(3)[:, None])
    flat = np.outer([1.0, -0.5, -0.5], np.cos((np.arange(4) + 0.5) * np.pi / 8))
    even, odd = [], []
    for shape in (equilateral, flat):
        phases = (sizes[:, None, None] * sines[:, None]) * shape[:, None, None, :]
        difference = _errors(rule, phases.reshape(3, -1)).reshape(len(sizes), len(sines), -1)
        even.append(np.sqrt(weights / 2 @ np.mean(difference.real**2, axis=2).T))
        odd.append(np.sqrt(weights / 2 @ np.mean(difference.imag**2, axis=2).T))
    return np.maximum(*even), np.maximum(*odd)


def _errors(rule: TriangleRule, phases: Reals) -> Complexes:
    """Return the error (n,) of a rule on exp(i phase), relative to the area, from the phases at the corners (3, n)."""
    corners = [(np.cos(one), np.sin(one)) for one in phases]
    real, imaginary = second_difference(corners, phases[1] - phases[0], phases[2] - phases[1])
    return np.asarray(rule.weights @ np.exp(1j * (rule.barycentric @ phases)) - 2 * (real + 1j * imaginary))


if __name__ == "__main__":
    _largest = [measure_largest_errors(rule) for rule in candidate_rules()]
    _even, _odd = zip(*(measure_typical_errors(rule) for rule in candidate_rules()), strict=True)
    _rules = {name: tabulated()[name] for name in ("sizes", "nodes", "weights")}
    np.savez_compressed(TABULATED, allow_pickle=False, largest=_largest, even=_even, odd=_odd, **_rules)
