"""The similarity transform of a study, and doubts about units and places, from extents alone."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from sobolev_batch import Mesh
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.surface import placement_doubt
from sobolev_batch.shapes import Similarity, Sphere, icosphere
from tests.support.shapes import BOX_TRIANGLES, BOX_VERTICES, box, tetrahedron


def test_the_map_is_scale_times_x_minus_origin() -> None:
    mesh = Similarity(2.0, (1.0, 2.0, 4.0)).apply(box())
    assert mesh.vertices.tolist() == (2 * (BOX_VERTICES - [1, 2, 4])).tolist()
    assert mesh.triangles.tolist() == BOX_TRIANGLES
    assert mesh.area == 4 * 28.0
    assert Similarity(2.0, (1.0, 2.0, 4.0)).apply(Sphere(3.0, (2.0, 2.0, 2.0))) == Sphere(6.0, (2.0, 0.0, -4.0))


def test_the_identity_hands_the_surface_through() -> None:
    for surface in (box(), Sphere(2.0)):
        assert Similarity().apply(surface) is surface
    assert not Similarity(1.0, (0.0, 0.0, 1e-300)).is_identity
    assert not Similarity(math.nextafter(1, 2)).is_identity


def test_bare_arrays_are_no_surface() -> None:
    arrays: Any = BOX_VERTICES, BOX_TRIANGLES
    for use in (Similarity(2.0).apply, Similarity.to_unit_ball):
        with pytest.raises(InputError, match="a surface is needed, as as_mesh makes"):
            use(arrays)


FLAT = Mesh([[2.0, 5.0, 7.0], [8.0, 5.0, 7.0], [2.0, 13.0, 7.0]], [[0, 1, 2]])
UNUSED = Mesh([*BOX_VERTICES.tolist(), [1000.0, 1000.0, 1000.0]], BOX_TRIANGLES)


@pytest.mark.parametrize(
    ("surface", "origin", "radius"),
    [
        (box(), (0.5, 1.0, 2.0), math.sqrt(1 + 4 + 16) / 2),
        (UNUSED, (0.5, 1.0, 2.0), math.sqrt(1 + 4 + 16) / 2),
        (FLAT, (5.0, 9.0, 7.0), 5.0),
        # Three corners of the tetrahedron pull its mean towards the origin, not its bounding box.
        (tetrahedron(), (0.5, 0.5, 0.5), math.sqrt(3) / 2),
        (Sphere(4.0, (1.0, -2.0, 3.0)), (1.0, -2.0, 3.0), 4.0),
    ],
    ids=["box", "unused vertex", "flat", "tetrahedron", "sphere"],
)
def test_the_unit_ball_is_that_around_the_bounding_box(surface: Any, origin: Any, radius: float) -> None:
    similarity = Similarity.to_unit_ball(surface)
    assert similarity.origin == origin
    assert similarity.scale == pytest.approx(1 / radius, rel=1e-15)
    if isinstance(surface, Sphere):
        assert similarity.apply(surface) == Sphere()
        assert Similarity.to_unit_ball(Sphere()).is_identity


BALL = icosphere(2)


def placed(scale: float = 1.0, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Mesh:
    return Mesh(scale * BALL.vertices + np.array([x, y, z]), BALL.triangles)


@pytest.mark.parametrize(
    ("mesh", "doubt"),
    [
        (placed(1000.0), "1,000 times as large as the reference: is one in millimetres and the other in metres?"),
        (placed(1 / 25.4), "25.4 times as small"),
        (placed(0.11), "9.09 times as small as the reference: are both in the same unit of length?"),
        (placed(1.0, 1.6, 0.8), "hardly overlaps"),
        (placed(1.0, 0.6, 0.0), "reaches beyond the reference by 30 % of its size"),
        (placed(0.3, 0.5, 0.0, 0.2), None),
        (placed(1.0, 0.2, 0.0), None),
    ],
)
def test_doubts(mesh: Mesh, doubt: str | None) -> None:
    # The same in any unit of length and at any place.
    for scale, by in ((1.0, 0.0), (1e-3, 5.0), (1e4, -2e5)):
        pair = [Mesh(scale * one.vertices + by, one.triangles) for one in (mesh, BALL)]
        found = placement_doubt(*(one.extent for one in pair))
        assert (found is None) == (doubt is None), found
        assert found is None or (doubt is not None and doubt in found)


def test_flat_surfaces_have_a_place_too() -> None:
    square = Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    raised = Mesh(square.vertices + np.array([0, 0, 0.5]), square.triangles)
    assert placement_doubt(square.extent, square.extent) is None
    assert "hardly overlaps" in str(placement_doubt(raised.extent, square.extent))
