"""Maps and matrices of all pairs, of points whose distances are known."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.spatial.distance import cdist

import sobolev_batch as sb
from sobolev_batch.results.figures.drawing import clustered_order, embedded

DISTANCES = ("distance", "error", "truncation", "aliasing", "discretisation", "statistical")


def store_of(points: np.ndarray) -> xr.DataTree:
    """A store whose meshes are points, in ten families; the first is the reference."""
    labels = ["reference", *(f"f{i % 10}/mesh {i}" for i in range(1, len(points)))]
    meshes = xr.Dataset(
        {
            "family": ("mesh", [label.split("/")[0] for label in labels]),
            "status": ("mesh", ["complete"] * len(labels)),
        },
        coords={"mesh": labels},
    )
    distances = cdist(points, points)[..., None]
    pairs = xr.Dataset(
        dict.fromkeys(DISTANCES, (("mesh", "other", "order"), distances)),
        coords={"mesh": labels, "other": labels, "order": [-2.0]},
    )
    convergence = xr.Dataset(coords={"mesh": labels, "order": [-2.0]}, attrs={"reference": "reference"})
    return xr.DataTree.from_dict({"/meshes": meshes, "/distances": pairs, "/convergence": convergence})


def test_few_outliers_do_not_take_the_colours_of_a_matrix() -> None:
    points = np.random.default_rng(6).normal(size=(40, 3))
    points[1] = points[2] + 1e-12
    figure = sb.plot(store_of(points), "matrix").figure
    image, bar = figure.axes[0].images[0], figure.axes[1]
    assert image.get_clim()[0] > 1e-3
    assert image.colorbar is not None
    assert image.colorbar.extend == "min"
    assert bar.get_ylabel() == "distance in the study's unit"
    even = sb.plot(store_of(points[2:]), "matrix").images[0]
    assert even.colorbar is not None
    assert even.colorbar.extend == "neither"
    assert even.get_clim()[1] == cdist(points[2:], points[2:]).max()


def test_groups_stand_together() -> None:
    places = np.array([0.0, 10.0, 0.2, 10.1, 0.1, 9.9])[:, None]
    order = clustered_order(cdist(places, places))
    sorted_places = places[order, 0]
    assert (np.diff(sorted_places) > 0).all() or (np.diff(sorted_places) < 0).all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_meshes(count: int) -> None:
    places = np.arange(count, dtype=float)[:, None]
    distances = cdist(places, places) if count else np.zeros((0, 0))
    assert clustered_order(distances).tolist() == list(range(count))
    assert embedded(distances)[0].shape == (count, 2)


def test_a_plane_is_found_again() -> None:
    rng = np.random.default_rng(3)
    points = np.zeros((20, 5))
    points[:, :2] = rng.normal(size=(20, 2)) * [3, 1]
    turn = np.linalg.qr(rng.normal(size=(5, 5)))[0]
    distances = cdist(points @ turn, points @ turn)
    points, explained = embedded(distances)
    assert np.allclose(cdist(points, points), distances, atol=1e-12)
    assert explained == pytest.approx(1.0)
    assert points[:, 0].var() >= points[:, 1].var()


def test_a_map_never_exaggerates() -> None:
    points = np.random.default_rng(4).normal(size=(15, 6))
    distances = cdist(points, points)
    points, explained = embedded(distances)
    assert (cdist(points, points) <= distances + 1e-12).all()
    assert 0.3 < explained < 1


def test_equal_meshes_have_no_variance() -> None:
    assert np.isnan(embedded(np.zeros((4, 4)))[1])
