"""Maps and matrices of all pairs, of points whose distances are known."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.spatial.distance import cdist

import sobolev_batch as sb
from sobolev_batch.results.figures.pair_plots import map_figure, matrix_figure


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
        dict.fromkeys(("distance", "error"), (("mesh", "other", "order"), distances)),
        coords={"mesh": labels, "other": labels, "order": [-2.0]},
    )
    convergence = xr.Dataset(coords={"mesh": labels, "order": [-2.0]}, attrs={"reference": "reference"})
    return xr.DataTree.from_dict({"/meshes": meshes, "/distances": pairs, "/convergence": convergence})


@pytest.mark.slow
def test_names_on_a_map_hide_nothing() -> None:
    tree = store_of(np.random.default_rng(5).normal(size=(60, 2)))
    for size in ((6.4, 4.4), (3.3, 2.4)):
        figure = map_figure(tree, [-2.0], size=size)
        figure.draw_without_rendering()
        (axes,) = figure.axes
        boxes = [name.get_window_extent() for name in axes.texts]
        assert len(boxes) > 5
        assert not any(one.overlaps(other) for i, one in enumerate(boxes) for other in boxes[:i])
        places = axes.transData.transform(np.concatenate([line.get_xydata() for line in axes.lines]))
        assert not any(box.contains(*place) for box in boxes for place in places)
        assert all(axes.bbox.contains(*corner) for box in boxes for corner in (box.min, box.max))


def test_few_outliers_do_not_take_the_colours_of_a_matrix() -> None:
    points = np.random.default_rng(6).normal(size=(40, 3))
    points[1] = points[2] + 1e-12
    figure = matrix_figure(store_of(points), [-2.0])
    image, bar = figure.axes[0].images[0], figure.axes[1]
    assert image.get_clim()[0] > 1e-3
    assert image.colorbar is not None
    assert image.colorbar.extend == "min"
    assert bar.get_ylabel() == "distance in the study's unit"
    even = sb.plot_matrix(store_of(points[2:])).images[0]
    assert even.colorbar is not None
    assert even.colorbar.extend == "neither"
    assert even.get_clim()[1] == cdist(points[2:], points[2:]).max()
