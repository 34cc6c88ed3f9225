"""Sides from which pictures show meshes, so that the worst places are in front, and the ends of their colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]
Triangles = NDArray[np.int32]

# Degrees: around the vertical axis, from the first axis towards the second, and above the horizontal plane.
_FRONT_AZIMUTH = float(np.degrees(np.arctan2(-1.4, 1.25)))
_ELEVATION = float(np.degrees(np.arctan2(0.8, np.hypot(1.25, 1.4))))
_STEEP = 65.0
_HEIGHTS = {_ELEVATION: "", _STEEP: "from high above", -_ELEVATION: "from below", -_STEEP: "from far below"}
# Colours cover this fraction of the area, and all of it unless the largest value exceeds the others by the factor.
COVERED_AREA, _OUTLYING = 0.99, 1.25
# Places count by this power of their values: the worst ones alone decide.
_POWER = 4
# A mesh is turned only if that shows so many times as much of the worst places.
_WORTH_TURNING = 1.25
# Viewpoints that show this fraction of the most are as good as the one that shows it.
_ABOUT_MOST = 0.95
# Triangles for each cell of the grid by which hidden ones are found.
_TRIANGLES_PER_CELL, _FEWEST_CELLS, _MOST_CELLS = 8, 6, 96


@dataclass(frozen=True)
class Viewpoint:
    """A direction from which a mesh is seen, with the third axis upwards.

    Attributes:
        turn: Degrees by which the viewer has gone around the mesh, to the right.
        elevation: Degrees above the horizontal plane; negative from below.
    """

    turn: int = 0
    elevation: float = _ELEVATION

    @property
    def direction(self) -> Reals:
        """Unit vector (3,) from the mesh to the viewer."""
        azimuth, elevation = np.radians(_FRONT_AZIMUTH + self.turn), np.radians(self.elevation)
        level = np.cos(elevation)
        return np.array([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)])

    def __str__(self) -> str:
        """Return the direction in words; empty for the usual one, from the front and above."""
        around = {0: "", 180: "from behind"}.get(self.turn, f"turned by {self.turn}°")
        return ", ".join(filter(None, (around, _HEIGHTS[self.elevation])))


FRONT = Viewpoint()
_VIEWPOINTS = tuple(Viewpoint(turn, elevation) for elevation in _HEIGHTS for turn in range(0, 360, 45))


def color_limit(vertices: Reals, triangles: Triangles, values: Reals) -> float:
    """Return the end of a scale of colours that no small part of a mesh decides.

    Args:
        vertices: Points (n, 3).
        triangles: Indices of vertices, (m, 3).
        values: Numbers at the vertices, (n,).

    Returns:
        The modulus that is not exceeded on 99 % of the area, or the largest one if that is hardly larger; 1 for zeros.
    """
    moduli = np.abs(values)
    order = np.argsort(moduli)
    # A third of each triangle belongs to each of its corners.
    areas = np.bincount(triangles.ravel(), np.repeat(_areas(vertices, triangles), 3), minlength=len(vertices))
    below = np.cumsum(areas[order])
    covering = moduli[order][min(np.searchsorted(below, COVERED_AREA * below[-1]), len(order) - 1)]
    largest = moduli.max()
    return float(largest if largest <= _OUTLYING * covering or covering == 0 else covering) or 1.0


def seen_of_worst(vertices: Reals, triangles: Triangles, values: Reals, limits: Reals) -> Reals:
    """Return how much of the worst places each candidate viewpoint shows.

    Args:
        vertices: Points (n, 3).
        triangles: Indices of vertices, (m, 3).
        values: Numbers at the vertices (orders, n), of which large moduli are bad.
        limits: Moduli (orders,) beyond which all are alike.

    Returns:
        Numbers (viewpoints,), for `best_viewpoint`; those of several meshes can be added.
    """
    badness = (np.minimum(np.abs(values) / limits[:, None], 1.0) ** _POWER).sum(axis=0)[triangles].mean(axis=1)
    # Their lengths are twice the areas.
    normals, centers = _crosses(vertices, triangles), vertices[triangles].mean(axis=1)
    return np.array(
        [
            (badness * np.abs(normals @ viewpoint.direction))[_is_visible(centers, viewpoint.direction)].sum()
            for viewpoint in _VIEWPOINTS
        ]
    )


def best_viewpoint(seen: Reals) -> Viewpoint:
    """Return the first viewpoint that shows about most, or the usual one if no other shows much more."""
    best = _VIEWPOINTS[int(np.argmax(seen >= _ABOUT_MOST * seen.max()))]
    return best if seen.max() > _WORTH_TURNING * seen[0] else FRONT


def _is_visible(centers: Reals, direction: Reals) -> NDArray[np.bool_]:
    """Return which points no others hide, as far as a grid of cells can tell."""
    right = np.cross([0.0, 0.0, 1.0], direction)
    plane = np.stack([right / np.linalg.norm(right), np.cross(direction, right) / np.linalg.norm(right)], axis=1)
    places, depths = centers @ plane, centers @ direction
    count = int(np.clip(np.sqrt(len(centers) / _TRIANGLES_PER_CELL), _FEWEST_CELLS, _MOST_CELLS))
    side = max(np.ptp(places, axis=0).max() / count, np.finfo(float).tiny)
    columns, rows = ((places - places.min(axis=0)) / side).astype(np.int64).T
    cells = columns * (count + 1) + rows
    nearest = np.full((count + 1) ** 2, -np.inf)
    np.maximum.at(nearest, cells, depths)
    return np.asarray(depths >= nearest[cells] - 1.5 * side)


def _areas(vertices: Reals, triangles: Triangles) -> Reals:
    return np.asarray(np.linalg.norm(_crosses(vertices, triangles), axis=1) / 2)


def _crosses(vertices: Reals, triangles: Triangles) -> Reals:
    first, second, third = (vertices[triangles[:, k]] for k in range(3))
    return np.asarray(np.cross(second - first, third - first))
