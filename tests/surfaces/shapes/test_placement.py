"""Doubts about units and places, from extents alone."""

from __future__ import annotations

import numpy as np
import pytest

import sobolev_batch as sb
from sobolev_batch.surfaces.shapes.similarity import placement_doubt

BALL = sb.icosphere(2)


def moved(scale: float = 1.0, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> sb.Mesh:
    return sb.Mesh(scale * BALL.vertices + np.array([x, y, z]), BALL.triangles)


@pytest.mark.parametrize(
    ("mesh", "doubt"),
    [
        (moved(1000.0), "1e+03 times as large"),
        (moved(1 / 25.4), "25.4 times as small"),
        (moved(0.11), "about 10 times as small"),
        (moved(6.0), "6 times as large"),
        (moved(1.0, 1.6, 0.8), "hardly overlaps"),
        (moved(1.0, 0.0, 0.0, 5.0), "hardly overlaps"),
        (moved(1.0, 0.6, 0.0), "reaches beyond the reference by 30 % of its size"),
        (moved(2.0), "reaches beyond the reference by 50 % of its size"),
        (moved(1.3), None),
        (moved(0.4), None),
        (moved(0.3, 0.5, 0.0, 0.2), None),
        (moved(1.0, 0.2, 0.0), None),
    ],
)
def test_doubts(mesh: sb.Mesh, doubt: str | None) -> None:
    # The same in any unit of length and at any place.
    for scale, by in ((1.0, 0.0), (1e-3, 5.0), (1e4, -2e5)):
        pair = [sb.Mesh(scale * one.vertices + by, one.triangles) for one in (mesh, BALL)]
        found = placement_doubt(*(one.extent for one in pair))
        assert (found is None) == (doubt is None), found
        assert found is None or (doubt is not None and doubt in found)


def test_flat_surfaces_have_a_place_too() -> None:
    square = sb.Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    raised = sb.Mesh(square.vertices + np.array([0, 0, 0.5]), square.triangles)
    assert placement_doubt(square.extent, square.extent) is None
    assert "hardly overlaps" in str(placement_doubt(raised.extent, square.extent))
