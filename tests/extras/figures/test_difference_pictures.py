"""Pictures of where two meshes differ: what assertions and `compare` draw."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import sobolev_batch as sb
from sobolev_batch.extras.figures import views
from sobolev_batch.testing.difference import require_place, write_difference

BALL = sb.shapes.icosphere(4)
INNER, OUTER = (sb.Mesh(radius * BALL.vertices + 1000, BALL.triangles) for radius in (25.0, 37.5))
PLATE = sb.Mesh([[0, 0, 0], [4, 0, 0], [4, 6, 0], [0, 6, 0]], [[0, 1, 2], [0, 2, 3]])
RAISED = sb.Mesh(np.add(PLATE.vertices, [0, 0, 0.5]), PLATE.triangles)


def outwards() -> float:
    """The largest distance of a vertex of the inner ball from the outer one, whose closest plane decides."""
    first, second, third = BALL.corners()
    normals = np.cross(second - first, third - first)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    heights = 1.5 * (normals * first).sum(axis=1) - BALL.vertices @ normals.T
    return 25 * float(heights.min(axis=1).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("a", "b", "scaling", "most", "lengths"),
    [
        pytest.param(OUTER, INNER, True, 60_000, lambda: (12.5, outwards()), id="spheres, in radii of one"),
        pytest.param(OUTER, INNER, True, 1_000, lambda: (12.5, outwards()), id="simplified"),
        pytest.param(PLATE, RAISED, False, 60_000, lambda: (0.5, 0.5), id="a shifted plate"),
    ],
)
def test_a_picture_has_distances_in_the_unit_of_the_files(
    a: sb.Mesh,
    b: sb.Mesh,
    scaling: bool,
    most: int,
    lengths: Callable[[], tuple[float, float]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    figures: dict[str, Figure] = {}
    monkeypatch.setattr(views, "PICTURE_LIMITS", (100, most, 50_000_000))
    monkeypatch.setattr(views, "write_figures", lambda named, *_: figures.update(named) or ("drawn",))
    names = ("left.ply", "right.ply")
    text = write_difference(a, b, tmp_path / "w.png", -2.0, scaling=scaling, names=names, distances="$mm$")
    assert text.endswith("; witness: drawn")
    figure = figures["w"]
    figure.draw_without_rendering()
    drawn, page = figure.get_tightbbox(), figure.bbox_inches
    assert min(drawn.xmin, drawn.ymin) >= 0
    assert (drawn.xmax <= page.xmax, drawn.ymax <= page.ymax) == (True, True)
    panels = [axes for axes in figure.axes if axes.get_label() != "<colorbar>"]
    titles = [axes.get_title().splitlines() for axes in panels]
    assert [title[0] for title in titles] == [*names, *names]
    found = [float(re.findall(r"^points up to (\S+) \\\$mm\\\$ away$", title[1])[0]) for title in titles[2:]]
    assert found == pytest.approx(lengths(), rel=5e-3)
    largest = max(lengths())
    # Both meshes are drawn to one scale, and so are their distances.
    assert panels[0].dataLim.bounds == panels[1].dataLim.bounds
    bar = figure.axes[-1]
    assert bar.get_xlim() == pytest.approx((0, largest), rel=1e-9)
    steps = np.diff(bar.get_xticks())
    assert len(steps) > 2
    assert steps == pytest.approx(steps[0])
    assert bar.get_xlabel() == r"distance to the closest point of the other mesh, in \$mm\$"


@pytest.mark.parametrize("most", [8_000, 300])
def test_distances_between_vertices_are_shown(most: int) -> None:
    """The vertices of the coarse ball lie on the fine one, and its triangles inside."""
    coarse, fine = sb.shapes.icosphere(2), sb.shapes.icosphere(5)
    view = views.distance_view("coarse", coarse, fine, "mm", most, signed=True)
    lower, upper = (-getattr(sb.largest_deviation(coarse, fine).forward, name) for name in ("lower", "upper"))
    assert upper <= view.values.min() <= 0.95 * lower
    assert view.values.max() < 1e-3


def test_a_picture_needs_matplotlib(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sobolev_batch.extras.figures.views", None)
    with pytest.raises(sb.errors.InputError, match=r"a picture needs a library.*\[plot\]"):
        require_place(tmp_path / "new" / "w.png")
    assert not list(tmp_path.iterdir())
