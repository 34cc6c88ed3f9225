"""Make an object by formula out of a fine sphere: python shapes.py INPUT OUTPUT SHAPE, where INPUT is the sphere."""

from __future__ import annotations

import sys

import numpy as np

import sobolev_batch as sb


def bumps(sphere: sb.Mesh) -> sb.Mesh:
    """Return a sphere whose radius goes up and down."""
    x, y, z = np.asarray(sphere.vertices).T
    radii = 1 + 0.15 * np.sin(5 * x) * np.sin(5 * y) + 0.1 * np.cos(7 * z)
    return sb.Mesh(radii[:, None] * np.asarray(sphere.vertices), sphere.triangles)


def cushion(sphere: sb.Mesh) -> sb.Mesh:
    """Return a cube with round edges and corners, the unit sphere of the 6-norm, pressed flat."""
    vertices = np.asarray(sphere.vertices)
    radii = np.linalg.norm(vertices, ord=6, axis=1, keepdims=True)
    return sb.Mesh(vertices / radii * [1.0, 0.7, 0.4], sphere.triangles)


def trefoil(sphere: sb.Mesh) -> sb.Mesh:
    """Return a tube around a trefoil knot, of a grid of about as many triangles."""
    across = 25
    around = len(sphere.triangles) // (2 * across)
    t = np.linspace(0, 2 * np.pi, around, endpoint=False)
    curve = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=1)
    tangents = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    # The knot never runs along z.
    sides = np.cross(tangents, [0.0, 0.0, 1.0])
    ups = np.cross(sides, tangents)
    sides, ups = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True) for vectors in (sides, ups))
    u = np.linspace(0, 2 * np.pi, across, endpoint=False)[:, None]
    points = curve[:, None] + 0.45 * (np.cos(u) * sides[:, None] + np.sin(u) * ups[:, None])
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    a, b = i * across + j, (i + 1) % around * across + j
    c, d = (i + 1) % around * across + (j + 1) % across, i * across + (j + 1) % across
    return sb.Mesh(points.reshape(-1, 3), np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]))


if __name__ == "__main__":
    source, output, shape = sys.argv[1:]
    sb.write_mesh({"bumps": bumps, "cushion": cushion, "trefoil": trefoil}[shape](sb.read_mesh(source)), output)
