"""Potentials by the kernel beyond a frequency: compiled loops say what arrays say, and neither looks at too little."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sobolev_batch import Mesh
from sobolev_batch.arrays import Reals
from sobolev_batch.norms.tail import potentials
from sobolev_batch.norms.tail.close_points import Sheets
from sobolev_batch.norms.tail.potentials import Kernels, SignedTriangles, add_compiled, of_triangles
from sobolev_batch.norms.tail.remainder import remainder
from sobolev_batch.shapes import icosphere
from sobolev_batch.transform.backends import CPU
from sobolev_batch.transform.fourier import Execution
from tests.support.fake_device import device_of
from tests.support.rectangles import Rectangles

ORDERS = (-0.75, -1.0, -3.0)
CUTOFF = 12.0


@pytest.fixture(params=["random", "slivers", "points", "edges", "on a corner", "far away", "NaN"])
def triangles(request: pytest.FixtureRequest) -> tuple[Reals, Reals]:
    """Points (n, 3) beside triangles (m, 3, 3) that would be hard."""
    rng = np.random.default_rng(7)
    points = 0.3 * rng.normal(size=(60, 3))
    corners = points[:, None] + 10.0 ** rng.uniform(-3, 0.5, (60, 1, 1)) * rng.normal(size=(60, 3, 3))
    if request.param == "slivers":
        corners[:, 2] = corners[:, 1] + 1e-7 * rng.normal(size=(60, 3))
    elif request.param == "points":
        corners = points[:, None] + 1e-9 * rng.normal(size=(60, 3, 3))
    elif request.param == "edges":
        points = (0.3 * corners[:, 0] + 0.7 * corners[:, 1]).copy()
    elif request.param == "on a corner":
        points = corners[:, 0].copy()
    elif request.param == "far away":
        points, corners = points + 1e6, corners + 1e6
    elif request.param == "NaN":
        points[::7, 1] = np.nan
    return points, corners


@pytest.mark.slow
@pytest.mark.parametrize("fineness", [1, 2])
def test_loops_and_arrays_agree(triangles: tuple[Reals, Reals], fineness: int) -> None:
    points, corners = triangles
    kernels, rows = Kernels.of_orders(CUTOFF, ORDERS, fineness), np.arange(len(points))
    by_arrays = of_triangles(points, corners, kernels)
    assert np.nanmax(np.abs(by_arrays)) > 0
    for threads in (1, 2):
        found = np.zeros_like(by_arrays)
        faces = SignedTriangles(corners, np.ones(len(corners)))
        add_compiled(found, points, faces, (rows, rows), kernels, threads)
        assert np.allclose(found, by_arrays, rtol=0, atol=1e-11 * kernels.totals, equal_nan=True)


@pytest.mark.parametrize("device", ["fake", "gpu"])
def test_a_gpu_sees_what_the_processor_sees(
    device: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    backend = device_of(device)
    # Few of both: the batches that a device takes are small too.
    for name, value in (("_FEWEST_FOR_GPU", 1), ("_PAIRS_ON_DEVICE", 40_000), ("_BATCH_ON_DEVICE", 5_000)):
        monkeypatch.setattr(potentials, name, value)
    sphere, kernels = icosphere(4), Kernels.of_orders(CUTOFF, ORDERS)
    rng = np.random.default_rng(1)
    points, corners = sphere.vertices[:30] + 0.01 * rng.normal(size=(30, 3)), sphere.vertices[sphere.triangles]
    triangles = SignedTriangles(corners, rng.choice([-1.0, 1.0], len(corners)))
    expected, found = np.zeros((2, 30, len(ORDERS)))
    pairs = [
        potentials.add_of_triangles(sums, points, triangles, kernels, Execution(each))
        for sums, each in ((expected, CPU), (found, backend))
    ]
    assert np.allclose(found, expected, rtol=0, atol=1e-11 * kernels.totals)
    assert pairs[0] == pairs[1] > 10_000
    # Else the processor may have been compared with itself.
    assert not caplog.records


def test_the_kernel_of_an_order_does_not_depend_on_other_orders() -> None:
    rng = np.random.default_rng(3)
    points, corners = rng.normal(size=(200, 3)), rng.normal(size=(200, 3, 3))
    alone = of_triangles(points, corners, Kernels.of_orders(CUTOFF, [-1.0]))
    beside = of_triangles(points, corners, Kernels.of_orders(CUTOFF, [-1.0, -4.0]))
    assert np.allclose(alone[:, 0], beside[:, 0], rtol=0, atol=1e-4 * np.abs(alone).max())


def rectangles(*corners: tuple[tuple[float, float, float], ...]) -> Mesh:
    first = 4 * np.arange(len(corners))[:, None]
    return Mesh(
        np.array(corners).reshape(-1, 3), np.concatenate([first + np.array(cut) for cut in ([0, 1, 2], [0, 2, 3])])
    )


def level(a: float, b: float, c: float, d: float, z: float = 0.0) -> tuple[tuple[float, float, float], ...]:
    return ((a, b, z), (c, b, z), (c, d, z), (a, d, z))


def edited(width: float) -> tuple[Mesh, Mesh, Mesh, Mesh]:
    """A plate, the same cut anew with a box on it, and what each of them has alone."""
    x, y, u, v = 0.3, 0.4, 0.3 + width, 0.4 + width
    around = [level(0, 0, x, 1), level(u, 0, 1, 1), level(x, 0, u, y), level(x, v, u, 1)]
    ring = [(x, y), (u, y), (u, v), (x, v)]
    sides = [((*p, 0.0), (*q, 0.0), (*q, width), (*p, width)) for p, q in zip(ring, ring[1:] + ring[:1], strict=True)]
    box = [*sides, level(x, y, u, v, width)]
    return rectangles(level(0, 0, 1, 1)), rectangles(*around, *box), rectangles(level(x, y, u, v)), rectangles(*box)


@pytest.mark.slow
@pytest.mark.parametrize(("width", "relative"), [(0.005, np.inf), (0.01, 4.0), (0.06, 0.6)])
def test_no_edit_of_a_face_that_is_cut_anew_escapes(width: float, relative: float) -> None:
    whole, changed, gone, added = edited(width)
    truth, of_truth = remainder([gone, added], [1, -1], 60.0, [-0.75, -1.0], points=4000).at([-0.75, -1.0])
    for seed in range(10):
        value, error = remainder([whole, changed], [1, -1], 60.0, [-0.75, -1.0], seed=seed).at([-0.75, -1.0])
        assert (np.abs(value - truth) < error + of_truth).all()
        assert (error < relative * truth).all()
        # Too few points may not meet the edit, and say so.
        value, error = remainder([whole, changed], [1, -1], 60.0, [-0.75], points=64, seed=seed).at([-0.75])
        assert abs(value[0] - truth[0]) < error[0]


@pytest.mark.slow
def test_nodes_that_are_too_few_along_edges_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    rods = [Rectangles.box((-0.5, y, 0.0), (0.5, y + 1e-3, 1e-3)).mesh() for y in (0.0, 2e-3)]
    truth, of_truth = remainder(rods, [1, -1], 12.0, [-2.0], points=4000).at([-2.0])
    monkeypatch.setattr(potentials, "_PANEL", 2.4)
    monkeypatch.setattr(potentials, "_PANEL_NODES", np.polynomial.legendre.leggauss(4))
    monkeypatch.setattr(potentials, "_PANEL_WAVES", 3.0)
    value, error = remainder(rods, [1, -1], 12.0, [-2.0], points=4000).at([-2.0])
    assert abs(value - truth) < error + of_truth < truth


@pytest.mark.parametrize("cutoff", [2.0, 40.0])
def test_a_look_at_each_pair_finds_what_trees_find(cutoff: float, monkeypatch: pytest.MonkeyPatch) -> None:
    rng, kernels = np.random.default_rng(3), Kernels.of_orders(cutoff, ORDERS)
    points = rng.random((300, 3))
    corners = rng.random((400, 1, 3)) + 10.0 ** rng.uniform(-3, 0, (400, 1, 1)) * rng.normal(size=(400, 3, 3))
    triangles, found = SignedTriangles(corners, np.ones(400)), []
    monkeypatch.setattr(potentials, "_PAIRS_AT_ONCE", 5000)
    for share in (0.0, 1.0):
        monkeypatch.setattr(potentials, "_OFTEN_CLOSE", share)
        sums = np.zeros((300, len(ORDERS)))
        found.append((potentials.add_of_triangles(sums, points, triangles, kernels), sums))
    assert found[0][0] == found[1][0] > 1000
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("compiled", [False, True])
def test_second_differences_hold_for_moves_far_below_the_steps_of_the_tables(compiled: bool) -> None:
    kernels, height, count = Kernels.of_orders(CUTOFF, (-1.0, -1.5, -3.0)), 0.008, 20
    points = np.array([0.003, 0.004, 0.0]) + 1e-3 * np.random.default_rng(0).random((count, 3)) * [1, 1, 0]
    corners = np.tile(np.array([[0.0, 0.0, height], [0.011, 0.0, height], [0.0, 0.013, height]]), (count, 1, 1))

    def seen(move: float) -> Reals:
        moved, rows = corners + np.array([0.0, 0.0, move]), np.arange(count)
        if not compiled:
            return np.asarray(of_triangles(points, moved, kernels))
        found = np.zeros((count, 3))
        add_compiled(found, points, SignedTriangles(moved, np.ones(count)), (rows, rows), kernels, 1)
        return found

    # From far larger moves, which differ by their fourth powers.
    small, large = ((seen(move) + seen(-move) - 2 * seen(0.0)) / move**2 for move in (4e-6, 2e-4))
    assert small.mean(axis=0) == pytest.approx(large.mean(axis=0), rel=0.1)


@pytest.mark.parametrize(
    ("sides", "move", "cutoff", "order"),
    [((1.0, 0.7, 1e-3), (0.0, 0.0, 2.8e-5), 12.0, -2.0), ((12.2, 0.14, 0.083), (3.6e-3, 2e-4, 1.5e-3), 2.6, -3.0)],
)
def test_thin_parts_that_move_a_little_see_what_finer_nodes_see(
    sides: tuple[float, ...], move: tuple[float, ...], cutoff: float, order: float
) -> None:
    part = Rectangles.box((0.0, 0.0, 0.0), sides)
    sheets = Sheets.from_surfaces([part.mesh(), part.moved(*move).mesh()], (1, -1), cutoff)
    assert sheets.moved is not None
    draw = sheets.moved.in_proportion(np.ones(12), 300, np.random.default_rng(0))[0]

    def seen(fineness: int) -> float:
        found, kernels = np.zeros((600, 1)), Kernels.of_orders(cutoff, (order,))
        # The same tables and reach, and as many nodes.
        kernels = replace(kernels, fineness=fineness)
        for triangles in sheets.triangles():
            potentials.add_of_triangles(found, draw.points.reshape(-1, 3), triangles, kernels)
        return float(draw.weights.ravel() @ found[:, 0])

    assert seen(1) == pytest.approx(seen(4), rel=2e-3)


@pytest.mark.parametrize("compiled", [False, True])
def test_turned_slivers_have_no_height_over_themselves(compiled: bool) -> None:
    rng, kernels = np.random.default_rng(1), Kernels.of_orders(CUTOFF, (-0.6,))
    sliver, places = np.array([[0.6, 0.0, 0.0], [0.6 + 1e-8, 0.5, 0.0], [0.6, 0.5, 0.0]]), rng.dirichlet([1, 1, 1], 50)
    # In its plane without any rounding, and turned.
    seen = []
    for turn in (np.eye(3), np.linalg.qr(rng.normal(size=(3, 3)))[0]):
        corners, found = np.tile(sliver @ turn.T, (50, 1, 1)), np.zeros((50, 1))
        points, rows = places @ corners[0], np.arange(50)
        if compiled:
            add_compiled(found, points, SignedTriangles(corners, np.ones(50)), (rows, rows), kernels, 1)
        else:
            found += of_triangles(points, corners, kernels)
        seen.append(found.mean())
    assert seen[1] == pytest.approx(seen[0], rel=1e-3)
