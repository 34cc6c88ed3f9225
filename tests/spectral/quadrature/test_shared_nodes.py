"""Points that neighbouring triangles share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from sobolev_batch import Mesh, icosphere
from sobolev_batch.spectral.quadrature import meshes
from sobolev_batch.spectral.quadrature.meshes import FaceArrays, merged_corners, merged_midpoints
from sobolev_batch.spectral.quadrature.rules import TriangleRule, corner_rule, midpoint_rule
from tests.support.shapes import CENTRED_BOX as BOX

Reals = NDArray[np.float64]
Merge = Callable[[FaceArrays, NDArray[np.int64]], tuple[Reals, Reals]]

CASES = [(merged_corners, corner_rule()), (merged_midpoints, midpoint_rule())]
# Three triangles on one edge, one of them twice, one with a corner repeated, and a vertex of no triangle.
ODD = Mesh(
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0.5], [9, 9, 9]]),
    [[0, 1, 2], [1, 0, 3], [0, 1, 4], [4, 0, 1], [2, 2, 3]],
)


def arrays(mesh: Mesh) -> FaceArrays:
    return mesh.vertices, mesh.triangles, mesh.areas


def unmerged(mesh: Mesh, rule: TriangleRule) -> dict[tuple[float, ...], float]:
    """The weight that each place gets when every triangle is taken on its own."""
    weights: dict[tuple[float, ...], float] = {}
    for corners, area in zip(mesh.vertices[mesh.triangles], mesh.areas, strict=True):
        for place, weight in zip(rule.barycentric @ corners, rule.weights * area, strict=True):
            key = tuple(np.round(place, 12) + 0.0)
            weights[key] = weights.get(key, 0.0) + weight
    return weights


@pytest.mark.parametrize(("merge", "rule"), CASES)
@pytest.mark.parametrize("mesh", [BOX, ODD, icosphere(2)], ids=["box", "odd", "icosphere"])
@pytest.mark.parametrize("bits", [63, 12])
def test_each_place_gets_the_weights_of_all_its_triangles(
    merge: Merge, rule: TriangleRule, mesh: Mesh, bits: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(meshes, "_BITS", bits)  # few bits: vertices are numbered anew
    coordinates, weights = merge(arrays(mesh), np.arange(len(mesh.triangles)))
    expected = unmerged(mesh, rule)
    found = {tuple(np.round(place, 12) + 0.0): weight for place, weight in zip(coordinates.T, weights, strict=True)}
    positive = {place for place, weight in expected.items() if weight > 0}
    assert positive <= found.keys() <= expected.keys()
    assert all(found[place] == pytest.approx(expected[place], rel=1e-14) for place in found)


@pytest.mark.parametrize(("merge", "rule"), CASES)
def test_a_closed_mesh_costs_what_its_rule_says(merge: Merge, rule: TriangleRule) -> None:
    mesh = icosphere(4)
    _, weights = merge(arrays(mesh), np.arange(len(mesh.triangles)))
    assert len(weights) / len(mesh.triangles) == pytest.approx(rule.cost, abs=1e-3)


@pytest.mark.parametrize(("merge", "rule"), CASES)
def test_some_of_the_triangles(merge: Merge, rule: TriangleRule) -> None:
    mesh, members = icosphere(2), np.arange(7, 90, 3)
    coordinates, weights = merge(arrays(mesh), members)
    assert weights.sum() == pytest.approx(mesh.areas[members].sum(), rel=1e-14)
    alone = Mesh(mesh.vertices, mesh.triangles[members])
    mean = sum(np.array(place) * weight for place, weight in unmerged(alone, rule).items())
    assert coordinates @ weights == pytest.approx(mean, abs=1e-13)
