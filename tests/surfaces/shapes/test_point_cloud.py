from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from sobolev_batch import MeshError, PointCloud, Similarity
from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.point_cloud import without_common_points

POINTS = np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0]])


@pytest.mark.parametrize(
    ("points", "weights", "message"),
    [
        (POINTS, None, r"needs the area of each point.*PointCloud.uniform\(points, area\)"),
        (np.zeros((0, 3)), [], "has no points"),
        ([[0, 0, np.nan]], [1], "1 of 1 points have NaN or infinite coordinates: #0 = "),
        (POINTS[:, :2], [1, 1, 1], r"points must have shape \(n, 3\), found \(3, 2\)"),
        (POINTS, [1, 2], r"weights must have shape \(3,\), one for each point, found \(2,\)"),
        (POINTS, [1, 0, -2], "2 of 3 weights are not positive and finite: #1 = 0.0, #2 = -2.0; leave points without"),
        (POINTS, [1, np.inf, 1], "1 of 3 weights are not positive and finite"),
        (POINTS, ["a", "b", "c"], "weights must be real numbers"),
        (POINTS * 1e160, [1, 1, 1], "coordinates so large"),
    ],
)
def test_what_is_no_cloud_is_refused_by_name(points: Any, weights: Any, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        PointCloud(points, weights)


@pytest.mark.parametrize("area", [0, -1.0, np.inf, None, "large"])
def test_a_total_area_is_a_positive_number(area: Any) -> None:
    with pytest.raises(MeshError, match="the total area of a point cloud must be positive and finite"):
        PointCloud.uniform(POINTS, area)


def test_a_cloud_is_a_surface_that_moves_with_its_areas() -> None:
    cloud = PointCloud.uniform(POINTS, 6.0)
    moved = Similarity(0.5, (1.0, 0.0, 0.0)).apply(cloud)
    assert moved.points.tolist() == [[-0.5, 0, 0], [1, 0, 0], [-0.5, 2, 0]]
    assert (cloud.area, moved.area) == (6.0, 1.5)
    assert moved.bounds[1].tolist() == [1, 2, 0]
    assert cloud.extent.reach == 4.0
    assert cloud.bounding_sphere == ((1.5, 2.0, 0.0), 2.5)


def test_arrays_are_copied_and_frozen_and_survive_pickling() -> None:
    points = POINTS.copy()
    cloud = PointCloud(points, [1, 2, 3])
    points[:] = 0
    assert cloud.points.tolist() == POINTS.tolist()
    assert not cloud.weights.flags.writeable
    assert pickle.loads(pickle.dumps(cloud)).digest == cloud.digest != PointCloud(POINTS, [1, 2, 4]).digest


def test_a_single_point_gives_no_scale() -> None:
    with pytest.raises(InputError, match="a single point has no size"):
        Similarity.to_unit_ball(PointCloud(POINTS[:1], [1.0]))


def test_common_points_cancel_by_their_weights() -> None:
    first = PointCloud(np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0], [2, 0, 0]]), [1, 1, 2, 5])
    second = PointCloud(np.array([[-0.0, 0, 0], [1, 0, 0], [3, 0, 0]]), [1, 5, 4])
    own, other = without_common_points(first, second)
    assert own is not None
    assert other is not None
    assert (own.points[:, 0].tolist(), own.weights.tolist()) == ([2.0], [5.0])
    assert (other.points[:, 0].tolist(), other.weights.tolist()) == ([1.0, 3.0], [2.0, 4.0])
    assert without_common_points(first, first) == (None, None)
    apart = PointCloud(POINTS + 9.0, [1, 2, 3])
    assert without_common_points(first, apart) == (first, apart)
