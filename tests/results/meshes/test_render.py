"""Pictures of meshes: what they show, and from where."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread
from numpy.typing import NDArray

from sobolev_batch import icosphere, open_store
from sobolev_batch.cli import cli
from sobolev_batch.results.figures.selection import Selection
from sobolev_batch.results.figures.views import FRONT, MeshView, draw_mesh, make_views, write_witness_plots
from tests.support.spheres import LABELS, RIGHT

Spheres = tuple[str, Path]


def sphere_view(factors: tuple[float, ...] = (1.0,)) -> MeshView:
    """A sphere that is red to the right and blue to the left."""
    ball = icosphere(4)
    values = np.outer(factors, ball.vertices @ RIGHT)
    return MeshView("a", ball.vertices, ball.triangles.astype(np.int32), values, (-2.0, -4.0), len(ball.triangles))


def drawn(view: MeshView, index: int = 0, limit: float | None = None) -> NDArray[np.uint8]:
    """A picture (200, 200, 3) of a mesh."""
    figure = Figure(figsize=(2, 2), dpi=100)
    canvas = FigureCanvasAgg(figure)
    draw_mesh(figure.add_axes((0, 0, 1, 1)), view, index, limit)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]


def redness(picture: NDArray[Any]) -> NDArray[np.float64]:
    """Red less blue, from -1 to 1."""
    scale = 255.0 if picture.dtype == np.uint8 else 1.0
    found = (picture[..., 0].astype(float) - picture[..., 2].astype(float)) / scale
    return np.asarray(found)


def test_red_where_the_witness_is_positive_and_blue_where_it_is_negative() -> None:
    view = sphere_view((1.0, -1e-6))
    pictures = [drawn(view, index) for index in range(2)]
    is_drawn = np.any(pictures[0] < 250, axis=-1)
    # A disc, but for its margin and what is nearly white.
    assert is_drawn.mean() == pytest.approx(np.pi / 4 / 1.1**2, abs=0.05)
    first, second = map(redness, pictures)
    assert first[100, 170] > 0.3
    assert first[100, 30] < -0.3
    assert abs(first[100, 100]) < 0.1
    assert first[:, 101:][is_drawn[:, 101:]].min() > -0.1
    # Colours are relative to the largest modulus.
    assert second[100, 170] < -0.3
    assert second[100, 30] > 0.3


def test_colours_end_at_a_limit() -> None:
    strong, weak, common = (redness(drawn(sphere_view((f,)), 0, end)) for f, end in ((1, None), (0.2, None), (0.2, 1)))
    assert weak[100, 170] == pytest.approx(strong[100, 170], abs=0.02)
    assert 0.02 < common[100, 170] < 0.6 * strong[100, 170]
    assert np.abs(redness(drawn(sphere_view((0.0,))))).max() < 0.02


@pytest.mark.parametrize("turn", [1, -1])
def test_a_mesh_hides_what_is_behind_it_and_light_comes_from_above(turn: int) -> None:
    right = np.cross([0.0, 0.0, 1.0], FRONT)
    right /= np.linalg.norm(right)
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ np.stack([right, np.cross(FRONT, right)])
    vertices = np.concatenate([square - FRONT, square + FRONT])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)[::turn, ::turn]
    values = np.repeat([[1.0, -1.0]], 4, axis=1).reshape(1, 8)
    picture = redness(drawn(MeshView("a", vertices, triangles, np.sort(values)[:, ::-1], (-2.0,), 4)))
    assert picture[20:180, 20:180].max() < -0.2
    brightness = drawn(sphere_view((0.0,))).mean(axis=-1)
    assert brightness[40, 100] > 1.1 * brightness[160, 100]


@pytest.mark.process
@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_the_axis_that_points_upwards(up: Literal["x", "y", "z"], spheres: Spheres) -> None:
    place, folder = spheres
    tree = open_store(place)
    plain, turned = (make_views(tree, folder, [LABELS[1]], up=axis)[0][0].vertices for axis in ("z", up))
    assert (turned[:, 2] == plain[:, "xyz".index(up)]).all()
    # Turned, not mirrored.
    volumes = [np.linalg.det(vertices[[0, 100, 300]]) for vertices in (plain, turned)]
    assert volumes[1] == pytest.approx(volumes[0], rel=1e-9)


@pytest.mark.all
@pytest.mark.process
def test_plot_draws_the_meshes_that_are_asked_for(spheres: Spheres, tmp_path: Path) -> None:
    place, folder = spheres
    options = ["plot", place, "--output", str(tmp_path), "--folder", str(folder)]
    done = CliRunner().invoke(cli, [*options, "--witness", LABELS[1], "--witness", "closed/sphere"])
    assert done.exit_code == 3
    assert done.stderr == (
        "convergence: not drawn: 1 not computed, 1 without edges; families not drawn: closed\n"
        "closed/sphere: not drawn with its witness function: a surface that is no mesh has no triangles\n"
    )
    (path,) = tmp_path.glob("witness-*")
    assert path == Path(done.stdout.splitlines()[-1]) == tmp_path / "witness-0002-files-beside.png"
    # Two panels, seen from the side to which the sphere is shifted: it is red in the middle of each.
    for panel in np.array_split(redness(imread(path)[..., :3]), 2, axis=1):
        height, width = panel.shape
        middle = panel[2 * height // 5 : 3 * height // 5, 2 * width // 5 : 3 * width // 5]
        assert middle.min() > 0.2
    paths, _ = write_witness_plots(Selection.from_store(place), tmp_path, folder, LABELS[:2])
    assert [path.name for path in paths][2:] == ["witness.png"]
    elsewhere = CliRunner().invoke(cli, [*options[:-1], str(tmp_path)])
    assert elsewhere.exit_code == 0
    assert re.search(r"not drawn with its witness function: .*No such file", elsewhere.stderr)


SPHERE = icosphere(4)
TRIANGLES = SPHERE.triangles.astype(np.int32)


def turned(values: np.ndarray, vertices: np.ndarray = SPHERE.vertices, triangles: np.ndarray = TRIANGLES) -> MeshView:
    return MeshView("a", vertices, triangles, values[None], (-2.0,), len(triangles)).towards_worst()


@pytest.mark.parametrize("sign", [1, -1])
def test_the_worst_place_is_in_front_whatever_the_orientation(sign: int) -> None:
    rng = np.random.default_rng(8)
    for place in [*rng.normal(size=(10, 3)), FRONT, -FRONT, np.array([0.0, 0.0, -1.0])]:
        place = place / np.linalg.norm(place)
        values = sign * np.exp(-30 * (1 - SPHERE.vertices @ place)) + 0.1
        eye = turned(values, triangles=TRIANGLES[:, ::sign]).eye
        assert np.linalg.norm(eye) == pytest.approx(1)
        assert eye @ place > 0.35, place
        assert (eye == FRONT).all() or eye @ place > 0.85


def test_nothing_turns_what_is_the_same_all_around_and_single_vertices_do_not_take_the_colours() -> None:
    for constant in (1.0, 0.0):
        assert (turned(np.full(len(SPHERE.vertices), constant)).eye == FRONT).all()
    values = SPHERE.vertices[:, 0].copy()
    assert turned(values).color_limits == np.abs(values).max()
    values[:5] = 1e6
    assert turned(values).color_limits == pytest.approx(0.99, abs=0.02)
    assert turned(0 * values).color_limits == 1


def test_the_area_counts_and_not_the_number_of_vertices() -> None:
    # Half of the vertices lie in a ball of a hundredth of the area.
    vertices = np.vstack([SPHERE.vertices, 0.05 * SPHERE.vertices])
    triangles = np.vstack([TRIANGLES, TRIANGLES + len(SPHERE.vertices)])
    assert turned(np.repeat([1.0, 100.0], len(SPHERE.vertices)), vertices, triangles).color_limits == 1
