"""Subdivision: the same surface without gaps; icospheres."""

from __future__ import annotations

import math

import numpy as np
import pytest

import sobolev_batch as sb
from sobolev_batch.geometry.subdivision import Edges
from tests.support.shapes import CLOSED


def open_mesh() -> sb.Mesh:
    """Return a bumpy sheet with a boundary, an edge of three triangles and vertices that are not used."""
    ball = sb.shapes.icosphere(2)
    upper = np.asarray(ball.triangles)[np.asarray(ball.vertices)[ball.triangles][..., 2].mean(axis=1) > 0]
    vertices = np.asarray(ball.vertices) * (1 + 0.2 * np.sin(7 * np.asarray(ball.vertices)[:, :1]))
    fin = [[upper[0, 0], upper[0, 1], len(vertices)]]
    return sb.Mesh(np.concatenate([vertices, [[0.0, 0.0, 2.0]]]), np.concatenate([upper, fin]))


def normals(mesh: sb.Mesh) -> np.ndarray:
    a, b, c = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)].transpose(1, 0, 2)
    return np.asarray(np.cross(b - a, c - a))


@pytest.mark.parametrize("share", [0.0, 0.05, 0.3, 0.7, 1.0])
@pytest.mark.parametrize("mesh", [sb.shapes.icosphere(2), open_mesh()], ids=["closed", "open"])
def test_a_split_mesh_is_the_same_surface(mesh: sb.Mesh, share: float) -> None:
    edges = Edges.from_mesh(mesh)
    marks = np.random.default_rng(7).random(len(edges.ends)) < share
    split = edges.split(marks)
    # Each triangle has one more for each of its marked edges.
    assert len(split.triangles) == len(mesh.triangles) + np.count_nonzero(marks[edges.sides])
    assert len(split.vertices) == len(mesh.vertices) + np.count_nonzero(marks)
    np.testing.assert_allclose(normals(split).sum(axis=0), normals(mesh).sum(axis=0), atol=1e-13)
    assert split.area == pytest.approx(mesh.area, rel=1e-13)
    # The measure is the same, so no triangle is covered twice and none is left open.
    fields = [sb.fourier_transform(one, sb.Lattice(2.0, 24), eps=1e-12).values for one in (split, mesh)]
    assert np.abs(fields[0] - fields[1]).max() < 1e-10 * mesh.area
    # Without vertices inside of edges, the boundary only has its marked edges halved.
    boundary, finer = edges.on_boundary, Edges.from_mesh(split).on_boundary
    assert np.count_nonzero(finer) == np.count_nonzero(boundary) + np.count_nonzero(boundary & marks)


@pytest.mark.parametrize("level", range(6))
def test_the_surface_is_closed_and_on_the_sphere(level: int) -> None:
    mesh = sb.shapes.icosphere(level)
    assert (len(mesh.vertices), len(mesh.triangles)) == (10 * 4**level + 2, 20 * 4**level)
    assert set(mesh.triangles.ravel()) == set(range(len(mesh.vertices)))
    assert mesh.counts == CLOSED
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 4 * np.finfo(float).eps
    # Symmetric about the origin.
    assert np.abs(mesh.vertices.mean(axis=0)).max() < 1e-15
    a, b, c = mesh.corners()
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
    assert (np.sign(volumes) == np.sign(volumes[0])).all()
    assert abs(volumes.sum()) < 4 / 3 * math.pi
    assert mesh.digest == sb.shapes.icosphere(level).digest
