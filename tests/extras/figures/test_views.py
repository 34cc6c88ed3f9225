"""Witness functions in files, read back by other programs, and in pictures of meshes."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import pyvista
import trimesh
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread
from numpy.typing import NDArray
from plyfile import PlyData

import sobolev_batch as sb
from sobolev_batch import open_store
from sobolev_batch.extras.figures import views
from sobolev_batch.extras.figures.remade import StudyMeshes, fields_of
from sobolev_batch.extras.figures.selection import Selection
from sobolev_batch.extras.figures.views import FRONT, MeshView, draw_mesh, make_views, up_axis, write_witness_plots
from sobolev_batch.shapes import icosphere
from sobolev_batch.testing.difference import witness_at_vertices
from tests.support.commands import call
from tests.support.spheres import LABELS, LONG, ORDERS, RADIUS, RIGHT, STRANGE

Spheres = tuple[str, Path]


def read_ply(path: Path) -> Any:
    # In memory: the next file may have the same name.
    return PlyData.read(path, mmap=False)


def evaluated(place: str, label: str, points: np.ndarray) -> np.ndarray:
    """By the public function, from the stored fields, at points in the meshes' own unit."""
    tree = sb.open_store(place)
    fields = tree["fourier"].to_dataset()["fourier"]
    found = json.loads(tree.attrs["similarity"])
    scaled = found["scale"] * (points - np.array(found["origin"]))
    return np.asarray(sb.witness(fields.sel(mesh=label), fields.sel(mesh="reference"), ORDERS, scaled).values)


@pytest.mark.slow
def test_ply_holds_the_mesh_of_the_file_and_its_witness(spheres: Spheres, tmp_path: Path) -> None:
    place, folder = spheres
    reference = trimesh.load(folder / "large.obj", process=False)
    for label in LABELS:
        path = sb.write_witness(place, label, tmp_path / "a.ply", folder=folder, distances=True)
        there = trimesh.load(path, process=False)
        own = sb.read_mesh(folder / f"{label.removeprefix('files/')}.obj")
        assert (there.vertices == own.vertices).all()
        assert (there.faces == own.triangles).all()
        columns = read_ply(path)["vertex"].data
        expected = evaluated(place, label, own.vertices)
        for name, values in zip(("witness_minus_4", "witness_minus_2_5"), expected, strict=True):
            assert columns[name].dtype == np.dtype("<f8")
            assert columns[name] == pytest.approx(values, rel=1e-9, abs=1e-9 * np.abs(values).max())
        nearest = trimesh.proximity.closest_point_naive(reference, own.vertices)[1]
        assert columns["distance"] == pytest.approx(nearest, rel=1e-9)
        assert columns["quality"] == pytest.approx(columns["witness_minus_4"], rel=1e-6)
        (unit,) = re.findall(rb"one unit of the study is (\S+)", path.read_bytes())
        assert float(unit) == pytest.approx(RADIUS)


@pytest.mark.slow
def test_vtp_holds_the_same(spheres: Spheres, tmp_path: Path) -> None:
    place, folder = spheres
    columns = read_ply(sb.write_witness(place, LABELS[1], tmp_path / "a.ply", folder=folder))
    there = pyvista.read(sb.write_witness(place, LABELS[1], tmp_path / "a.vtp", folder=folder))
    assert (there.points == np.stack([columns["vertex"][axis] for axis in "xyz"], axis=1)).all()
    assert (there.faces.reshape(-1, 4)[:, 1:] == np.vstack(columns["face"]["vertex_indices"])).all()
    assert (there.point_data["witness, order -4"] == columns["vertex"]["witness_minus_4"]).all()
    assert (there.point_data["witness, order -2.5"] == columns["vertex"]["witness_minus_2_5"]).all()
    assert there.active_scalars_name == "witness, order -4"
    assert there.field_data["notes"][0].endswith(r"files/beside against reference, study Kugeln gr\xf6\xdfer")


@pytest.mark.slow
def test_vertices_that_no_triangle_uses_may_lie_anywhere(spheres: Spheres) -> None:
    place, folder = spheres
    tree = sb.open_store(place)
    _, scaled = StudyMeshes.from_tree(tree, folder).make(LABELS[1])
    mesh = sb.Mesh(np.vstack([scaled.vertices, [[1e6, 0, 0], [0, 0, 0]]]), scaled.triangles)
    values = witness_at_vertices(*fields_of(tree, LABELS[1]), ORDERS, mesh)
    assert np.isnan(values[:, -2:]).all()
    assert np.isfinite(values[:, :-2]).all()


@pytest.mark.slow
def test_the_command_writes_all_meshes_into_one_folder(spheres: Spheres, tmp_path: Path) -> None:
    place, folder = spheres
    done = call("witness", place, "--output", tmp_path / "out", "--folder", folder)
    assert done.returncode == 0
    assert done.stderr == ""
    names = [Path(line).name for line in done.stdout.splitlines()]
    assert names == ["0000-files-Groe-u.ply", "0002-files-beside.ply", f"0003-files-{LONG}"[:65] + ".ply"]
    assert sorted(path.relative_to(tmp_path / "out").as_posix() for path in tmp_path.rglob("*.ply")) == names
    options = ("--order", "-2.5", "--mesh", LABELS[1], "--mesh", LABELS[1])
    chosen = call("witness", place, "--output", tmp_path, "--folder", folder, *options)
    assert chosen.stdout == f"{tmp_path}/0002-files-beside.ply\n"
    assert "witness_minus_4" not in read_ply(tmp_path / "0002-files-beside.ply")["vertex"].data.dtype.names


@pytest.mark.slow
def test_meshes_that_changed_or_failed_are_named_and_the_others_written(spheres: Spheres, tmp_path: Path) -> None:
    place, folder = spheres
    copy = shutil.copytree(folder, tmp_path / "copy")
    (copy / "beside.obj").write_text((copy / "large.obj").read_text())
    (copy / f"{STRANGE}.obj").unlink()
    done = call("witness", place, "--output", tmp_path, "--folder", copy)
    assert done.returncode == 3
    lost, changed = done.stderr.splitlines()
    assert lost.startswith(f"{LABELS[0]}: ")
    assert "No such file" in lost
    assert changed == (
        "files/beside: the study makes another mesh here than the one that was computed; its files have changed"
    )
    assert [Path(line).name[:4] for line in done.stdout.splitlines()] == ["0003"]
    options = ("--mesh", "files/bad", "--mesh", "closed/sphere")
    failed = call("witness", place, "--output", tmp_path, "--folder", folder, *options)
    assert failed.returncode == 3
    assert failed.stderr.splitlines() == [
        "files/bad: its status is 'failed'",
        "closed/sphere: a surface that is no mesh has no triangles",
    ]


@pytest.mark.slow
def test_what_cannot_be_asked_for(spheres: Spheres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place, folder = spheres
    refused: list[tuple[str, str, list[float] | None, str]] = [
        ("files/besides", "a.ply", None, "no mesh 'files/besides'; did you mean 'files/beside'"),
        ("nobody", "a.ply", None, "no mesh 'nobody'; its labels are such as 'files/"),
        ("reference", "a.ply", None, "'reference' is the reference"),
        ("files/beside", "a.stl", None, r"written as \.ply or \.vtp, found '\.stl'"),
        ("files/beside", "a.ply", [-0.5], "below -1/2, found -0.5"),
        ("files/beside", "a.ply", [], "at least one order"),
        ("files/bad", "a.ply", None, "^files/bad: its status is 'failed'"),
    ]
    for label, name, orders, message in refused:
        with pytest.raises(sb.errors.InputError, match=message):
            sb.write_witness(place, label, tmp_path / name, orders, folder)
    with pytest.raises(sb.errors.StoreError, match="cannot be written there: No such file"):
        sb.write_witness(place, "files/beside", tmp_path / "nowhere" / "a.ply", folder=folder)
    tree = sb.open_store(place).load()
    tree["convergence"].attrs["reference"] = "files/bad"
    with pytest.raises(sb.errors.InputError, match="the reference 'files/bad' is not computed"):
        sb.write_witness(tree, LABELS[1], tmp_path / "a.ply", folder=folder)
    (tmp_path / "taken").write_text("")
    done = call("witness", place, "--output", tmp_path / "taken", "--folder", folder)
    assert "no files can be written there" in done.stderr
    monkeypatch.setitem(__import__("sys").modules, "pyvista", None)
    with pytest.raises(sb.errors.InputError, match=r"PyVista needs a library.*pip install 'sobolev-batch\[vtk\]'"):
        sb.write_witness(place, "files/beside", tmp_path / "a.vtp", folder=folder)
    assert os.listdir(tmp_path) == ["taken"]


def sphere_view(factors: tuple[float, ...] = (1.0,), level: int = 4) -> MeshView:
    """A sphere that is red to the right and blue to the left."""
    ball = icosphere(level)
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
    return np.asarray((picture[..., 0].astype(float) - picture[..., 2]) / scale)


def test_red_where_the_witness_is_positive_and_blue_where_it_is_negative() -> None:
    view = sphere_view((1.0, -1e-6))
    pictures = [drawn(view, index) for index in range(2)]
    is_drawn = np.any(pictures[0] < 250, axis=-1)
    # A disc, but for its margin and what is nearly white.
    assert is_drawn.mean() == pytest.approx(np.pi / 4 / 1.1**2, abs=0.05)
    # Colours are relative to the largest modulus.
    for sign, found in zip((1, -1), map(redness, pictures), strict=True):
        assert sign * found[100, 170] > 0.3
        assert sign * found[100, 30] < -0.3
        assert abs(found[100, 100]) < 0.1
        assert (sign * found)[:, 101:][is_drawn[:, 101:]].min() > -0.1
    # They end at a limit.
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


def test_an_axis_that_cannot_point_upwards_is_named() -> None:
    with pytest.raises(sb.errors.InputError, match=r"^up must be one of x, y, z, found 'up'$"):
        make_views(xr.DataTree(), "", up="up")  # type: ignore[arg-type]


FEET = np.array([[x, 0, z] for x in (0, 1) for z in (0, 2)])
# With a head in front and a tail behind.
TABLE = np.vstack([FEET, np.add(FEET, [0, 1, 0]), [[0.5, 1.4, 2.6], [0.5, 1, -0.4]]])


@pytest.mark.parametrize(
    ("points", "up"),
    [
        pytest.param(TABLE, "y", id="on four feet"),
        pytest.param(np.roll(TABLE, 1, axis=1), "z", id="the same, turned"),
        pytest.param(icosphere(3).vertices, "z", id="round"),
        pytest.param(TABLE * [1, 0, 1], "z", id="flat"),
    ],
)
def test_the_axis_that_points_upwards_is_found_by_what_a_mesh_stands_on(points: np.ndarray, up: str) -> None:
    assert up_axis(points.astype(float)) == up


@pytest.mark.slow
@pytest.mark.parametrize("colors", ["own", "common"])
@pytest.mark.parametrize("count", [3, 4, 5])
def test_panels_fill_their_rows_and_have_scales_of_their_own_or_one(
    colors: Literal["own", "common"], count: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    balls = [sphere_view((10.0**-i, 1.0), level=1) for i in range(count)]
    made = [
        dataclasses.replace(ball, label=f"a/{i}", vertices=ball.vertices * [1, 1, 1.5]) for i, ball in enumerate(balls)
    ]
    figures: dict[str, Figure] = {}
    monkeypatch.setattr(views, "make_views", lambda *_: (made, {}))
    monkeypatch.setattr(views, "write_figures", lambda named, *_: figures.update(named) or ())
    tree = xr.DataTree.from_dict({"meshes": xr.Dataset({"mesh": [view.label for view in made]})})
    write_witness_plots(Selection(tree, (-4.0, -2.0), ("a",)), tmp_path, colors=colors)
    end = made[0].color_limits[0]
    # The second order of each mesh has the same values.
    expected = {"witness": [end * 10.0**-i for i in range(count)] if colors == "own" else [end]}
    expected |= {f"witness-{i:04}-a-{i}": [end * (10.0**-i if colors == "own" else 1), end] for i in range(count)}
    found = {}
    for name, figure in figures.items():
        figure.draw_without_rendering()
        drawn_box, page = figure.get_tightbbox(), figure.bbox_inches
        assert min(drawn_box.xmin, drawn_box.ymin) >= 0
        assert drawn_box.xmax <= page.xmax
        assert drawn_box.ymax <= page.ymax
        bars = [axes for axes in figure.axes if axes.get_label() == "<colorbar>"]
        found[name] = [bar.get_xlim()[1] for bar in bars]
        boxes = [box for axes in figure.axes if axes not in bars and (box := axes.get_subplotspec())]
        cells = [(row, k) for box in boxes for row in box.rowspan for k in box.colspan]
        rows, columns = boxes[0].get_gridspec().get_geometry()
        assert sorted(cells) == [(row, k) for row in range(rows) for k in range(columns)]
    assert found == {name: pytest.approx(ends) for name, ends in expected.items()}


@pytest.mark.all
@pytest.mark.process
def test_plot_draws_the_meshes_that_are_asked_for(spheres: Spheres, tmp_path: Path) -> None:
    place, folder = spheres
    plot = partial(call, "plot", place, "--output", tmp_path, "--folder")
    done = plot(folder, "--mesh", LABELS[1], "--mesh", "closed/sphere")
    assert done.returncode == 3
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
    elsewhere = plot(tmp_path)
    assert elsewhere.returncode == 0
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


@pytest.mark.parametrize("sign", [1, -1])
def test_the_worst_triangle_faces_the_eye_though_it_faces_the_middle_of_the_mesh(sign: int) -> None:
    # A post at the corner of a plate, whose inner sides face the middle of both.
    plate, post = trimesh.creation.box((40, 40, 1)), trimesh.creation.box((2, 2, 30))
    post.apply_translation((-18, 18, 15.5))
    both = trimesh.util.concatenate(plate, post)
    for face in range(len(plate.faces), len(both.faces)):
        values = np.zeros(len(both.vertices))
        values[both.faces[face]] = 1.0
        seen = turned(values, both.vertices, np.asarray(both.faces, np.int32)[:, ::sign])
        assert both.face_normals[face] @ seen.eye > 0, face


def test_nothing_turns_what_is_the_same_all_around_and_small_parts_do_not_take_the_colours() -> None:
    for constant in (1.0, 0.0):
        assert (turned(np.full(len(SPHERE.vertices), constant)).eye == FRONT).all()
    values = SPHERE.vertices[:, 0].copy()
    assert turned(values).color_limits == np.abs(values).max()
    values[:5] = 1e6
    assert turned(values).color_limits == pytest.approx(0.99, abs=0.02)
    assert turned(0 * values).color_limits == 1
    # The area counts, not the number of vertices: half of them lie in a ball of a hundredth of the area.
    vertices = np.vstack([SPHERE.vertices, 0.05 * SPHERE.vertices])
    triangles = np.vstack([TRIANGLES, TRIANGLES + len(SPHERE.vertices)])
    assert turned(np.repeat([1.0, 100.0], len(SPHERE.vertices)), vertices, triangles).color_limits == 1
