"""Meshes: what they refuse, what they keep and count, what they measure."""

from __future__ import annotations

import copy
import pickle
import re
import tracemalloc
from collections.abc import Callable
from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest

from sobolev_batch import Lattice, Mesh, distance, fourier_transform
from sobolev_batch.arrays import Reals
from sobolev_batch.errors import MeshError
from sobolev_batch.geometry.overlap import shared_triangles
from sobolev_batch.shapes import icosphere
from tests.support.shapes import (
    AWKWARD_VERTICES,
    BOX_AREA,
    BOX_TRIANGLES,
    TETRAHEDRON_AREA,
    TETRAHEDRON_TRIANGLES,
    TETRAHEDRON_VERTICES,
    box,
    mesh_counts,
    tetrahedron,
)

VERTICES: list[list[float]] = [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 4.0, 0.0]]
TRIANGLES = [[0, 1, 2]]


@pytest.mark.parametrize(
    ("vertices", "triangles", "message"),
    [
        ([[0, 0, 0], [3, 0, np.nan], [0, 4, 0]], TRIANGLES, "1 of 3 vertices have NaN or infinite coordinates: #1"),
        # Also where no triangle uses it.
        (np.vstack([VERTICES, [np.nan, 0.0, 0.0]]), TRIANGLES, "1 of 4 vertices"),
        (np.array(VERTICES)[:, :2], TRIANGLES, "vertices must have shape (n, 3), found (3, 2)"),
        (np.array(VERTICES) * 1j, TRIANGLES, "vertices must be real numbers, found dtype complex128"),
        (np.array(VERTICES).astype(bool), TRIANGLES, "vertices must be real numbers"),
        ([[0, 0, 0], [1, 0], [0, 1, 0]], TRIANGLES, "vertices"),
        (np.array(VERTICES) * 1e200, TRIANGLES, "overflow: largest absolute coordinate 4e+200; rescale it"),
        (VERTICES, [[0, 1, 2], [0, -1, 2]], "1 of 2 triangles have indices outside 0..2: #1 = [0, -1, 2]"),
        (VERTICES, np.array([[0, 1, 2**63]], dtype=np.uint64), "#0 = [0, 1, 9223372036854775808]"),
        (VERTICES, np.array([[0.0, 1.0, 2.0]]), "triangles must be integer indices, found dtype float64"),
        (VERTICES, np.array([[False, True, True]]), "triangles must be integer indices, found dtype bool"),
        (VERTICES, [[0, 1, 2], [0, 1]], "triangles"),
        (VERTICES, [[0, 1, 2, 0]], "triangles must have shape (m, 3), found (1, 4)"),
        (VERTICES, [], "no triangles"),
        (
            [*VERTICES, [0.0, 0.0, 0.0], [1e200, 0.0, 0.0], [0.0, 1e-200, 0.0]],
            [[0, 1, 2], [3, 4, 5]],
            "squared lengths overflow: largest absolute coordinate 1e+200; rescale it",
        ),
    ],
)
def test_bad_entries_are_named(vertices: Any, triangles: Any, message: str) -> None:
    with pytest.raises(MeshError, match=re.escape(message)):
        Mesh(vertices, triangles)


def test_long_lists_of_offenders_are_cut() -> None:
    with pytest.raises(MeshError, match=r"5 of 6 .*: #1 = .*, #2 = .*, #3 = \[7, 8, 9\], \.\.\.$") as caught:
        Mesh(VERTICES, [[0, 1, 2], *([[7, 8, 9]] * 5)])
    again = pickle.loads(pickle.dumps(caught.value))
    assert (type(again), str(again)) == (MeshError, str(caught.value))


@pytest.mark.parametrize(
    "vertices",
    [
        [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [1, 1, 1], [2, 2, 2]],
        # Collinear in exact arithmetic, not in rounded arithmetic.
        [[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [0.3, 0.3, 0.3]],
        [[0.0, 0.0, 0.0], [1 / 3, 1 / 7, 1 / 9], [5 / 3, 5 / 7, 5 / 9]],
    ],
)
def test_a_total_area_of_zero_is_refused(vertices: Any) -> None:
    with pytest.raises(MeshError, match="the total area of the 2 triangles is zero: every one is degenerate"):
        Mesh(vertices, [[0, 1, 2], [0, 0, 1]])


@pytest.mark.parametrize(
    ("scale", "origin", "what", "how"),
    [(1.0, 1e6, "is zero", r"1 about \(1e\+06, 0, 0\)"), (1e190, 0.0, "overflow", r"1e\+190 about \(0, 0, 0\)")],
)
def test_a_move_that_leaves_no_area_is_refused_with_its_size(scale: float, origin: float, what: str, how: str) -> None:
    tiny = Mesh(np.array([[0, 0, 0], [1e-12, 0, 0], [0, 1e-12, 0]]), [[0, 1, 2]])
    with pytest.raises(MeshError, match=rf"{what}.*, once a mesh of size 1.41e-12 is scaled by {how}; check the units"):
        tiny.moved(scale, (origin, 0.0, 0.0))


def test_counts_take_less_memory_than_a_worker_keeps_for_them() -> None:
    peaks = []
    # The first time, modules are imported too; and other threads may allocate something meanwhile.
    for _ in range(4):
        mesh = copy.deepcopy(icosphere(5))
        tracemalloc.start()
        assert mesh.counts["components"] == 1
        peaks.append(tracemalloc.get_traced_memory()[1] / len(mesh.triangles))
        tracemalloc.stop()
    # 20 million triangles take 3 GB besides the mesh, on a worker of 6 GB.
    assert min(peaks) < 150


@pytest.mark.parametrize(
    ("extra_vertices", "triangles", "counts"),
    [
        ([], TETRAHEDRON_TRIANGLES, mesh_counts(0, 0, 0, 0)),
        ([], TETRAHEDRON_TRIANGLES[:3], mesh_counts(0, 0, 3, 0, euler=1)),
        # A fourth vertex on the edge 0-1: a triangle of no area that is open along two new edges.
        ([[0.5, 0, 0]], [*TETRAHEDRON_TRIANGLES, [0, 1, 4]], mesh_counts(1, 0, 2, 1)),
        # The first face again, in the same and in the other orientation.
        ([], [*TETRAHEDRON_TRIANGLES, [0, 2, 1]], mesh_counts(0, 1, 0, 3, euler=3)),
        ([], [*TETRAHEDRON_TRIANGLES, [1, 2, 0], [0, 1, 2]], mesh_counts(0, 2, 0, 3, euler=4)),
        # A fin on the edge 0-1.
        ([[0, 0, -1]], [*TETRAHEDRON_TRIANGLES, [0, 1, 4]], mesh_counts(0, 0, 2, 1)),
        (
            [[5, 5, 5], [6, 5, 5], [5, 6, 5]],
            [*TETRAHEDRON_TRIANGLES, [4, 5, 6]],
            mesh_counts(0, 0, 3, 0, components=2, euler=3),
        ),
        ([[100, 100, 100]], TETRAHEDRON_TRIANGLES, mesh_counts(0, 0, 0, 0)),
        # The edges of [0, 0, 1] are 0-1 alone: none goes from a vertex to itself.
        ([], [[0, 1, 2], [0, 0, 1]], mesh_counts(1, 0, 2, 0)),
        ([], [*TETRAHEDRON_TRIANGLES, [0, 0, 1]], mesh_counts(1, 0, 0, 1, euler=3)),
        ([], [*TETRAHEDRON_TRIANGLES[:3], [0, 2, 3]], mesh_counts(0, 0, 0, 0, 3)),
    ],
    ids=[
        "closed",
        "open",
        "zero area",
        "duplicate",
        "duplicates",
        "fin",
        "apart",
        "unused",
        "repeat",
        "repeat 2",
        "flipped",
    ],
)
def test_oddities_are_kept_and_counted(extra_vertices: Any, triangles: Any, counts: dict[str, int]) -> None:
    vertices: Reals = np.array([*TETRAHEDRON_VERTICES.tolist(), *extra_vertices], dtype=np.float64)
    mesh = Mesh(vertices, triangles)
    assert mesh.triangles.tolist() == triangles
    assert np.array_equal(mesh.vertices, vertices)
    assert mesh.counts == counts


@pytest.mark.parametrize("scale", [1e-60, 1.0, 1e60])
@pytest.mark.parametrize("shift", [0.0, 1e6])
def test_the_volume_is_that_of_closed_consistent_meshes(scale: float, shift: float) -> None:
    vertices = scale * (np.asarray(box().vertices) + shift)
    assert Mesh(vertices, BOX_TRIANGLES).volume == pytest.approx(8 * scale**3, rel=1e-9)
    assert Mesh(vertices, np.flip(BOX_TRIANGLES, 1)).volume == pytest.approx(-8 * scale**3, rel=1e-9)
    assert np.isnan(Mesh(vertices, BOX_TRIANGLES[1:]).volume)
    assert np.isnan(Mesh(vertices, [BOX_TRIANGLES[0][::-1], *BOX_TRIANGLES[1:]]).volume)


@pytest.mark.parametrize(
    ("corners", "degrees", "ratio"),
    [
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], 45.0, (2 + 2 * np.sqrt(2)) / (2 * np.sqrt(3))),
        ([[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(0.75), 0]], 60.0, 1.0),
        # A needle: the longest edge over the radius of the incircle, whose diameter is nearly half of its height.
        ([[0, 0, 0], [2, 0, 0], [1, 2e-9, 0]], np.degrees(2e-9), 2 / 1e-9 / (2 * np.sqrt(3))),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0], [1, 0, 0], [-1, 2, 0]], 0.0, np.inf),
    ],
)
def test_the_shape_of_triangles(corners: list[list[float]], degrees: float, ratio: float) -> None:
    mesh = Mesh(corners, np.arange(len(corners)).reshape(-1, 3))
    assert mesh.smallest_angles.min() == pytest.approx(degrees, rel=1e-8)
    assert mesh.aspect_ratios.max() == pytest.approx(ratio, rel=1e-8)


@pytest.mark.parametrize("scale", [1e-60, 1e-6, 1.0, 1e6, 1e60])
def test_what_counts_as_zero_area_does_not_depend_on_the_unit(scale: float) -> None:
    needle = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 1e-13, 0.0]]
    flat = [[0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.5, 1.0 + 2e-16, 0.0]]
    mesh = Mesh(scale * np.array(needle + flat), [[0, 1, 2], [3, 4, 5]])
    assert mesh.counts["zero_area_triangles"] == 1
    assert mesh.areas[0] == pytest.approx(0.5e-13 * scale**2)


@pytest.mark.parametrize("far", [[50.0, 0.0, 0.0], [3e3, 1e3, -7e2]])
def test_triangles_without_area_have_no_part_in_sizes_and_numbers(far: list[float]) -> None:
    ball = icosphere(1)
    corners, count = np.concatenate([ball.vertices, [far], [np.array(far) / 3]]), len(ball.vertices)
    # A repeated vertex, and three on a line that rounding gives an area.
    mesh = Mesh(corners, [*ball.triangles, [0, 0, count], [count, count + 1, count]])
    line = Mesh(
        np.concatenate([ball.vertices, np.outer([0.1, 0.7, 1.0], far) + 0.1]),
        [*ball.triangles, [count, count + 1, count + 2]],
    )
    for one in (mesh, line):
        assert one.extent == ball.extent
        assert one.bounding_sphere == ball.bounding_sphere
        assert one.area == ball.area
        assert one.rounding == ball.rounding
        found, expected = (fourier_transform(each, Lattice(3.0, 16)) for each in (one, ball))
        np.testing.assert_allclose(found, expected, atol=1e-9 * ball.area)
        assert (distance(one, ball, rtol=1e-2)["distance"] == 0.0).item()


def test_areas_and_lengths_of_solids() -> None:
    assert box().area == BOX_AREA
    assert sorted(box().areas) == [1.0] * 4 + [2.0] * 4 + [4.0] * 4
    assert sorted(set(box().edge_lengths.ravel())) == pytest.approx([1, 2, np.sqrt(5), 4, np.sqrt(17), np.sqrt(20)])
    assert tetrahedron().area == pytest.approx(TETRAHEDRON_AREA, rel=1e-15)
    assert tetrahedron().areas == pytest.approx([0.5, 0.5, np.sqrt(3) / 2, 0.5], rel=1e-15)
    slanted = tetrahedron().edge_lengths[2]
    assert slanted == pytest.approx([np.sqrt(2)] * 3, rel=1e-15)
    assert tetrahedron().centroid_radii[2] == pytest.approx(np.sqrt(2 / 3), rel=1e-15)
    # The centroid is (1, 4/3, 0), the farthest corner (0, 4, 0).
    assert Mesh(VERTICES, TRIANGLES).centroid_radii == pytest.approx([np.hypot(1, 8 / 3)])


@pytest.mark.parametrize(
    ("dtype", "index_dtype"),
    [("<f8", ">i8"), (">f8", "<i4"), ("<f4", "u1"), (">f4", "<u8"), ("f2", "<i8"), ("i1", "<i8"), ("<u8", "<i8")],
)
def test_all_real_types_make_the_same_mesh(dtype: str, index_dtype: str) -> None:
    mesh = Mesh(np.array(VERTICES, dtype=dtype), np.array(TRIANGLES, dtype=index_dtype))
    assert (str(mesh.vertices.dtype), str(mesh.triangles.dtype)) == ("float64", "int64")
    assert mesh.digest == Mesh(VERTICES, TRIANGLES).digest


def test_arrays_are_copies_also_of_views() -> None:
    store, triangles = np.zeros((6, 3)), np.array(TRIANGLES)
    store[::2] = VERTICES
    meshes = Mesh(store[::2], triangles), Mesh(np.array(VERTICES), triangles)
    store[:], triangles[:] = np.nan, 0
    for mesh in meshes:
        assert mesh.vertices.tolist() == VERTICES
        assert mesh.triangles.tolist() == TRIANGLES


def test_meshes_are_frozen() -> None:
    mesh = tetrahedron()
    names = ("vertices", "triangles", "areas", "edge_lengths", "centroid_radii", "used_vertices")
    for array in (getattr(mesh, name) for name in names):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    for name in (*names, "anything"):
        with pytest.raises((FrozenInstanceError, AttributeError)):
            setattr(mesh, name, None)


def test_pickling_keeps_every_bit() -> None:
    mesh = Mesh(AWKWARD_VERTICES, BOX_TRIANGLES)
    for again in (pickle.loads(pickle.dumps(mesh)), copy.deepcopy(mesh), copy.copy(mesh)):
        assert again.vertices.tobytes() == mesh.vertices.tobytes()
        assert again.triangles.tobytes() == mesh.triangles.tobytes()
        assert again.digest == mesh.digest
        assert not again.vertices.flags.writeable
        assert not again.triangles.flags.writeable


@pytest.mark.parametrize(
    ("vertices", "triangles"),
    [
        (np.nextafter(TETRAHEDRON_VERTICES, 2), TETRAHEDRON_TRIANGLES),
        (TETRAHEDRON_VERTICES[[1, 0, 2, 3]], TETRAHEDRON_TRIANGLES),
        (TETRAHEDRON_VERTICES, TETRAHEDRON_TRIANGLES[::-1]),
        (TETRAHEDRON_VERTICES, [[2, 1, 0], *TETRAHEDRON_TRIANGLES[1:]]),
        (TETRAHEDRON_VERTICES, TETRAHEDRON_TRIANGLES[:3]),
        ([*TETRAHEDRON_VERTICES.tolist(), [9.0, 9.0, 9.0]], TETRAHEDRON_TRIANGLES),
    ],
    ids=["one bit", "vertices swapped", "triangles reversed", "corners rotated", "one less", "unused vertex"],
)
def test_the_digest_changes_with_every_array(vertices: Any, triangles: Any) -> None:
    assert Mesh(vertices, triangles).digest != tetrahedron().digest
    columns = Mesh(np.asfortranarray(TETRAHEDRON_VERTICES), np.asfortranarray(TETRAHEDRON_TRIANGLES))
    assert columns.digest == tetrahedron().digest


def test_triangles_are_shared_in_any_orientation_and_as_often_as_in_both() -> None:
    corners = np.stack(tetrahedron().corners(), axis=1)
    mine, others = corners[[0, 1, 1, 2]], np.concatenate([corners[[1, 0]][:, [2, 1, 0]], -corners[3:]])
    in_mine, in_others = shared_triangles(mine, others)
    assert (in_mine.tolist(), in_others.tolist()) == ([True, True, False, False], [True, True, False])


@pytest.mark.parametrize(
    ("spoiled", "told"),
    [
        (lambda v, t: (v, t[1:]), ("3 open edges", "Euler characteristic 1 (was 2)")),
        (lambda v, t: (v, [t[0][::-1], *t[1:]]), ("3 edges at which normals flip",)),
        (lambda v, t: (v, t[:, ::-1]), ("all triangles face inwards",)),
        (
            lambda v, t: (v, [*t, t[0]]),
            (
                "3 edges of more than two triangles",
                "1 duplicate triangle, counted twice",
                "Euler characteristic 3 (was 2)",
            ),
        ),
        (
            lambda v, t: (np.vstack([v, 2 * v]), np.vstack([t, t + len(v)])),
            ("components 2 (was 1)", "Euler characteristic 4 (was 2)"),
        ),
    ],
)
def test_damage_is_what_an_original_has_not(spoiled: Callable[..., Any], told: tuple[str, ...]) -> None:
    sound, fine = icosphere(1), icosphere(2)
    broken = Mesh(*spoiled(sound.vertices, sound.triangles))
    assert broken.damage_beside(fine) == told
    # It does not depend on counts, nor on seams that double vertices.
    assert broken.damage_beside(Mesh(*spoiled(fine.vertices, fine.triangles))) == ()
    assert Mesh(sound.vertices[sound.triangles].reshape(-1, 3), np.arange(240).reshape(-1, 3)).damage_beside(fine) == ()


@pytest.mark.parametrize("size", [64, 5000])
def test_batches_have_the_triangles_of_the_mesh_and_the_vertices_that_these_use(size: int) -> None:
    mesh = icosphere(5)
    batches = [batch for _, batch in mesh.batches(size)]
    assert np.array_equal(
        np.concatenate([one.vertices[one.triangles] for one in batches]), mesh.vertices[mesh.triangles]
    )
    assert all(len(np.unique(one.triangles)) == len(one.vertices) for one in batches)
