"""No point of a piece is farther from triangles that cover it than is said, and what does not cover it is no cover."""

from __future__ import annotations

import numpy as np
import pytest

import sobolev_batch as sb
from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.geometry.closest import Triangles
from sobolev_batch.geometry.cover import cover_distances

CELLS = 8
# A piece that lies above many triangles of a grid.
PIECE = np.array([[0.21, 0.23, 0.05], [0.83, 0.31, 0.05], [0.42, 0.79, 0.05]])


def grid() -> tuple[Reals, Indices]:
    """Vertices and triangles of a unit square of cells."""
    x, y = np.divmod(np.arange((CELLS + 1) ** 2), CELLS + 1)
    first = np.flatnonzero((x < CELLS) & (y < CELLS))[:, None]
    corners = [first + np.array(ends) for ends in ([0, CELLS + 1, 1], [1, CELLS + 1, CELLS + 2])]
    return np.stack([x, y, 0 * x], axis=1) / CELLS, np.concatenate(corners)


def covers(pieces: Reals, mesh: sb.Mesh, most: float) -> Reals:
    """Cover distances of pieces (n, 3 corners, 3), from the triangles closest to their centers."""
    triangles = Triangles(mesh)
    starts = triangles.closest(pieces.mean(axis=1))[1]
    corners = pieces.transpose(1, 2, 0) / triangles.scale
    return np.asarray(triangles.scale * cover_distances(corners, triangles, starts, most / triangles.scale))


def test_many_triangles_cover_a_piece_together() -> None:
    (distance,) = covers(PIECE[None], sb.Mesh(*grid()), 0.06)
    # A quarter of the length is given to what lies beside the piece.
    assert distance == pytest.approx(np.hypot(0.05, 0.06 / 4))
    assert covers(PIECE[None], sb.Mesh(*grid()), 0.051) == [np.inf]


@pytest.mark.parametrize("defect", ["a hole", "a border", "two layers", "a step"])
def test_what_covers_a_piece_in_part_is_no_cover(defect: str) -> None:
    (vertices, triangles), piece = grid(), PIECE
    count = len(vertices)
    if defect == "a hole":
        inside = (np.abs(vertices[triangles].mean(axis=1) - [0.48, 0.45, 0]) < 0.08).all(axis=1)
        triangles = np.delete(triangles, np.flatnonzero(inside)[0], axis=0)
    elif defect == "a step":
        vertices[vertices[:, 0] > 0.5, 2] = -0.1
    else:
        piece = PIECE + np.array([0.3, 0, 0])
    if defect == "two layers":
        # They are one surface, folded at a border beyond which the piece reaches.
        rim = np.arange(count - CELLS - 1, count - 1)
        strips = np.stack([[rim, rim + count, rim + 1], [rim + 1, rim + count, rim + count + 1]]).transpose(0, 2, 1)
        triangles = np.concatenate([triangles, triangles[:, ::-1] + count, *strips])
        vertices = np.concatenate([vertices, vertices - [0, 0, 0.001]])
    assert covers(piece[None], sb.Mesh(vertices, triangles), 0.06) == [np.inf]


@pytest.mark.parametrize("seed", range(30))
def test_no_point_is_farther_than_its_cover(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices, triangles = grid()
    # Waves, folds, holes, borders, triangles turned over, and sides of three triangles.
    vertices += rng.normal(scale=[*[rng.choice([0, 0.02, 0.08])] * 2, 0.02], size=vertices.shape)
    triangles = triangles[rng.random(len(triangles)) >= rng.choice([0, 0.02])]
    is_turned = rng.random(len(triangles)) < rng.choice([0, 0.02])
    triangles[is_turned] = triangles[is_turned, ::-1]
    more = rng.permuted(np.tile(np.arange(len(vertices)), (rng.choice([0, 6]), 1)), axis=1)[:, :3]
    mesh = sb.Mesh(vertices, np.concatenate([triangles, more]))
    pieces = rng.random((400, 1, 3)) * [1, 1, 0] + rng.normal(scale=[0.2, 0.2, 0.02], size=(400, 3, 3))
    # Corners at vertices, and sides along sides.
    pieces[:100] = vertices[rng.integers(0, len(vertices), (100, 3))]
    found = covers(pieces, mesh, 0.1)
    pieces, found = pieces[np.isfinite(found)], found[np.isfinite(found)]
    assert len(found) > 10
    assert found.max() <= 0.1
    shares = np.array([(i, j, 12 - i - j) for i in range(13) for j in range(13 - i)]) / 12
    points = np.einsum("sk,nkd->nsd", shares, pieces)
    distances = Triangles(mesh).closest(points.reshape(-1, 3))[0].reshape(len(found), -1)
    assert (distances.max(axis=1) <= found + 1e-14).all()
