"""Pictures of meshes, drawn by VTK: what they show, and what is said where nothing can be drawn."""

from __future__ import annotations

import shutil
import sys
from ctypes.util import find_library
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.image import imread
from numpy.typing import NDArray

from sobolev_batch import InputError, icosphere, open_store
from sobolev_batch.cli import cli
from sobolev_batch.results.figures import views as rendering
from sobolev_batch.results.figures.selection import Selection
from sobolev_batch.results.figures.views import FRONT, MeshView, make_views, render, write_witness_plots
from tests.support.repository import obstacle
from tests.support.spheres import LABELS, RIGHT

Spheres = tuple[str, Path]
drawing = pytest.mark.skipif(obstacle() is not None, reason=str(obstacle()))


def sphere_view(factors: tuple[float, ...] = (1.0,)) -> MeshView:
    """A sphere that is red to the right and blue to the left."""
    ball = icosphere(3)
    along = ball.vertices @ RIGHT
    values = np.outer(factors, along)
    return MeshView("a", ball.vertices, ball.triangles.astype(np.int32), values, (-2.0, -4.0), len(ball.triangles))


def redness(picture: NDArray[Any]) -> NDArray[np.float64]:
    """Red less blue, from -1 to 1."""
    scale = 255.0 if picture.dtype == np.uint8 else 1.0
    found = (picture[..., 0].astype(float) - picture[..., 2].astype(float)) / scale
    return np.asarray(found)


@drawing
@pytest.mark.process
def test_red_where_the_witness_is_positive_and_blue_where_it_is_negative() -> None:
    (pictures,) = render([sphere_view((1.0, -1e-6))], 6, side=200)
    assert pictures.shape == (2, 200, 200, 3)
    drawn = (pictures[0] < 250).any(axis=-1)
    # A disc, but for its margin and what is nearly white.
    assert drawn.mean() == pytest.approx(np.pi / 4 * 0.96**2, abs=0.05)
    first, second = map(redness, pictures)
    assert first[100, 170] > 0.3
    assert first[100, 30] < -0.3
    assert abs(first[100, 100]) < 0.1
    assert first[:, 101:][drawn[:, 101:]].min() > -0.1
    # Colours are relative to the largest modulus.
    assert second[100, 170] < -0.3
    assert second[100, 30] > 0.3


@drawing
@pytest.mark.process
def test_one_scale_of_colours_for_all() -> None:
    strong, weak = sphere_view((1.0,)), sphere_view((0.2,))
    own, common = (render([strong, weak], 1, side=200, common=common) for common in (False, True))
    assert redness(own[1][0])[100, 170] == pytest.approx(redness(own[0][0])[100, 170], abs=0.02)
    assert redness(common[0][0])[100, 170] == pytest.approx(redness(own[0][0])[100, 170], abs=0.02)
    assert 0.02 < redness(common[1][0])[100, 170] < 0.6 * redness(common[0][0])[100, 170]


@drawing
@pytest.mark.process
def test_meshes_seen_from_their_edge_and_no_witness() -> None:
    up, towards = np.array([0.0, 0.0, 1.0]), np.array([1.25, -1.4, 0.0])
    corners = np.array([0 * up, up, towards])
    edge = MeshView("edge", corners, np.array([[0, 1, 2]], np.int32), np.ones((1, 3)), (-2.0,), 1)
    zero = MeshView("zero", sphere_view().vertices, sphere_view().triangles, np.zeros((1, 642)), (-2.0,), 1280)
    seen, white = render([edge, zero], 1, side=100)
    assert seen.shape[2] < seen.shape[1] == 100
    assert np.abs(redness(white[0])).max() < 0.02
    assert (white < 250).mean() > 0.5


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
@drawing
@pytest.mark.process
def test_plot_draws_the_meshes_that_are_asked_for(spheres: Spheres, tmp_path: Path) -> None:
    place, folder = spheres
    options = ["plot", place, "--output", str(tmp_path), "--folder", str(folder)]
    done = CliRunner().invoke(cli, [*options, "--witness", LABELS[1], "--witness", "closed/sphere"])
    assert done.exit_code == 3
    assert done.stderr == (
        "convergence: not drawn: 1 not computed, 1 without edges; families not drawn: closed\n"
        "not drawn with their witness functions: closed/sphere: a surface that is no mesh has no triangles\n"
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


@pytest.mark.all
@pytest.mark.process
def test_plot_does_without_what_cannot_be_drawn(
    spheres: Spheres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, folder = spheres
    elsewhere = CliRunner().invoke(cli, ["plot", place, "--output", str(tmp_path), "--folder", str(tmp_path)])
    assert elsewhere.exit_code == 0
    (reason,) = (line for line in elsewhere.stderr.splitlines() if line.startswith("not drawn with"))
    assert "No such file" in reason
    assert not list(tmp_path.glob("witness-*"))
    monkeypatch.setattr(rendering, "find_spec", lambda _: None)
    paths, absent = write_witness_plots(Selection.from_store(place), tmp_path, folder, LABELS[:2])
    assert paths == ()
    assert list(absent) == list(LABELS[:2])
    for reason in absent.values():
        assert "pip install 'sobolev-batch[vtk]'" in reason


@pytest.mark.process
@pytest.mark.parametrize(
    ("program", "reason"),
    [
        ("import os; os.abort()", r"VTK crashed \(Aborted\); .* apt-get install libegl1"),
        ("raise ValueError('no such thing')", r"VTK failed \(ValueError: no such thing\)"),
        ("raise SystemExit(7)", r"VTK failed \(exit status 7\)"),
        ("import time; time.sleep(60)", r"VTK took more than 0.5 s"),
    ],
    ids=["crash", "error", "status", "hang"],
)
def test_whatever_happens_to_the_process_that_draws_is_said(
    program: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "program.py").write_text(program)
    monkeypatch.setattr(rendering, "find_spec", lambda _: True)
    timeout = 0.5 if "sleep" in program else 60.0
    with pytest.raises(InputError, match=f"meshes cannot be drawn here: {reason}"):
        render([sphere_view()], 1, program=tmp_path / "program.py", timeout_seconds=timeout)


@drawing
@pytest.mark.process
@pytest.mark.skipif(sys.platform != "linux" or find_library("OSMesa") is not None, reason="VTK finds OSMesa here")
def test_a_machine_without_opengl(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VTK_DEFAULT_OPENGL_WINDOW", "vtkOSOpenGLRenderWindow")
    with pytest.raises(InputError, match=r"cannot be drawn here: VTK (crashed|failed) .*libgl1-mesa-dri libx11-6"):
        render([sphere_view()], 1)


@drawing
@pytest.mark.process
def test_neither_a_display_that_is_gone_nor_what_lies_around_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DISPLAY", "203.0.113.1:0")
    program = shutil.copy(rendering._PROGRAM, tmp_path)
    (tmp_path / "pyvista.py").write_text("raise ImportError('not the library')")
    monkeypatch.chdir(tmp_path)
    render([sphere_view()], 1, side=50, program=Path(program))
    assert capfd.readouterr() == ("", "")


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


def test_nothing_turns_what_is_the_same_all_around() -> None:
    assert (turned(np.ones(len(SPHERE.vertices))).eye == FRONT).all()
    assert (turned(np.zeros(len(SPHERE.vertices))).eye == FRONT).all()


def test_single_vertices_do_not_take_the_colours() -> None:
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
