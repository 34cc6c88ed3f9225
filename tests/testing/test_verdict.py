"""Verdicts see what is missing from a surface, not how it is cut; an assertion passes on proof alone and says where."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from plyfile import PlyData

import sobolev_batch as sb
from sobolev_batch.testing.difference import write_difference

# Areas alone bound what lies beyond a lattice at this order, so that verdicts are proofs and take little time.
same_surface = partial(sb.testing.same_surface, order=-4.0)
assert_same_surface = partial(sb.testing.assert_same_surface, order=-4.0)

# Triangles of 1.6 % of the area in all.
PATCH = 80


@pytest.fixture(scope="module")
def mesh() -> sb.Mesh:
    return sb.shapes.Ellipsoid((1.0, 0.8, 0.6)).mesh(4)


def permuted(mesh: sb.Mesh) -> sb.Mesh:
    rng = np.random.default_rng(0)
    order = rng.permutation(len(mesh.vertices))
    return sb.Mesh(mesh.vertices[order], rng.permutation(np.argsort(order)[mesh.triangles]))


def unmerged(mesh: sb.Mesh) -> sb.Mesh:
    return sb.Mesh(mesh.vertices[mesh.triangles].reshape(-1, 3), np.arange(3 * len(mesh.triangles)).reshape(-1, 3))


def split(mesh: sb.Mesh) -> sb.Mesh:
    return sb.Mesh(*trimesh.remesh.subdivide(mesh.vertices, mesh.triangles))


CUTS: list[Callable[[sb.Mesh], sb.Mesh]] = [
    *(permuted, unmerged, split, lambda mesh: permuted(split(mesh))),
    lambda mesh: sb.Mesh(mesh.vertices, mesh.triangles[:, ::-1]),
]


@pytest.mark.parametrize("cut", CUTS)
def test_the_same_surface_in_other_triangles(cut: Callable[[sb.Mesh], sb.Mesh], mesh: sb.Mesh) -> None:
    verdict = same_surface(cut(mesh), mesh)
    assert (bool(verdict), verdict.outcome) == (True, "same")
    assert verdict.distance + verdict.error <= verdict.tolerance
    assert verdict.area_change == pytest.approx(0.0, abs=1e-12)


CHANGES: dict[str, Callable[[sb.Mesh], sb.Mesh]] = {
    "a patch is missing": lambda mesh: sb.Mesh(mesh.vertices, mesh.triangles[PATCH:]),
    "a patch is there twice": lambda mesh: sb.Mesh(mesh.vertices, [*mesh.triangles, *mesh.triangles[:PATCH]]),
    "it is larger": lambda mesh: sb.Mesh(1.01 * mesh.vertices, mesh.triangles),
    "it is elsewhere": lambda mesh: sb.Mesh(mesh.vertices + np.array([0.01, 0.0, 0.0]), mesh.triangles),
    "it is far away": lambda mesh: sb.Mesh(mesh.vertices + np.array([1e5, 0.0, 0.0]), mesh.triangles),
    "it is in another unit": lambda mesh: sb.Mesh(mesh.vertices / 25.4, mesh.triangles),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CHANGES)
def test_another_surface(name: str, mesh: sb.Mesh) -> None:
    verdict = same_surface(CHANGES[name](mesh), mesh)
    assert (bool(verdict), verdict.outcome) == (False, "different")
    assert verdict.distance - verdict.error > verdict.tolerance
    hints = {"unit": "25.4 times as small as the reference: is one in millimetres and the other in inches?"}
    hints["away"] = "are both in the same place?"
    assert str(verdict).endswith(hints.get(name.split()[-1], " %"))


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_neither_the_unit_nor_the_place_of_both_matters(scale: float, mesh: sb.Mesh) -> None:
    place = scale * np.array([1e3, -2e3, 0.0])
    own, other = (sb.Mesh(scale * one.vertices + place, one.triangles) for one in (mesh, split(mesh)))
    assert same_surface(other, own)
    assert same_surface((other.vertices, other.triangles[PATCH:]), own).outcome == "different"
    # One triangle of 20,480, which is 5e-5 of the area.
    assert same_surface((other.vertices, other.triangles[1:]), own, tolerance=1e-4).outcome == "different"


@pytest.mark.slow
def test_flat_and_open_meshes_of_several_parts() -> None:
    square = sb.Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    assert same_surface(split(split(square)), square)
    assert same_surface((split(square).vertices, split(square).triangles[1:]), square).outcome == "different"
    both = np.concatenate([square.vertices, square.vertices + np.array([3, 0, 0])])
    beside = sb.Mesh(both, [[0, 1, 2], [0, 2, 3], [4, 5, 6]])
    assert same_surface(permuted(split(beside)), beside)
    assert same_surface(square, beside).outcome == "different"


@pytest.mark.slow
def test_files_and_closed_forms(tmp_path: Path) -> None:
    sb.write_mesh(sb.shapes.icosphere(4), tmp_path / "sphere.ply")
    verdict = same_surface(tmp_path / "sphere.ply", sb.shapes.Sphere(), tolerance=0.01)
    assert verdict
    assert verdict.area_change == pytest.approx(sb.shapes.icosphere(4).area / (4 * np.pi) - 1)
    assert same_surface(sb.shapes.Sphere(), sb.shapes.Sphere(), order=-2)
    assert not same_surface(sb.shapes.Torus(1.0, 0.3), sb.shapes.Torus(1.0, 0.31))


def test_between_same_and_different_it_is_undecided(tmp_path: Path) -> None:
    # With the norm's own unit of length the numbers are those of `distance`.
    truth = float(
        sb.distance(sb.shapes.Sphere(0.9), sb.shapes.Sphere(), -4.0)["distance"]
        / sb.norm(sb.shapes.Sphere(), -4.0)["norm"]
    )
    verdict = same_surface(sb.shapes.Sphere(0.9), sb.shapes.Sphere(), tolerance=truth, scaling=False)
    assert (bool(verdict), verdict.outcome) == (False, "undecided")
    assert abs(verdict.distance - truth) <= verdict.error
    assert re.match(r"undecided: relative distance \d+\.\d+ % ", str(verdict))
    with pytest.raises(AssertionError, match=r"^undecided: .*; take another; no witness: neither surface is a mesh$"):
        assert_same_surface(
            sb.shapes.Sphere(0.9), sb.shapes.Sphere(), tolerance=truth, scaling=False, witness=tmp_path / "none"
        )


@pytest.mark.slow
@pytest.mark.parametrize(("move", "tolerance"), [(5e-4, 1e-5), (1e-4, 1e-7), (1e-6, 1e-12)])
def test_the_bounds_hold_the_truth(move: float, tolerance: float) -> None:
    own = sb.shapes.icosphere(2)
    moved = sb.Mesh(own.vertices + np.array([move, 0, 0]), own.triangles)
    truth = float(sb.distance(moved, own, -4.0, rtol=1e-3)["distance"] / sb.norm(own, -4.0, rtol=1e-3)["norm"])
    verdict = same_surface(moved, own, tolerance=tolerance, scaling=False)
    assert verdict.lower <= truth <= verdict.upper


def test_bounds_far_apart_are_told_as_such() -> None:
    verdict = sb.testing.Verdict("different", 281.4, 2.34e12, 1e-3, -4.0, 3.0, "lattice")
    assert "relative distance from 28000 to 2.4 × 10¹⁴ % at order -4" in str(verdict)
    verdict = sb.testing.Verdict("same", 0.0, 9.52e-4, 1e-3, -4.0, 0.0, "lattice")
    assert "relative distance at most 0.096 % at order -4" in str(verdict)
    assert "; area +100 %" in str(sb.testing.Verdict("different", 1.0, 1.0, 1e-3, -4.0, 1.0, "lattice"))


@pytest.mark.parametrize(
    ("arguments", "settings", "message"),
    [
        ((3, sb.shapes.Sphere()), {}, "expected a Mesh.* found int"),
        ((sb.shapes.Sphere(), (1, 2, 3)), {}, "expected a Mesh, the path of a mesh file"),
        (
            (sb.shapes.Sphere(), sb.shapes.Sphere()),
            {"tolerance": 0},
            "tolerance must be a number between 0 and 1, found 0",
        ),
        ((sb.shapes.Sphere(), sb.shapes.Sphere()), {"order": [-2, -3]}, "one order is needed, found 2"),
        (("nowhere.ply", sb.shapes.Sphere()), {}, "nowhere.ply: "),
        ((sb.shapes.Sphere(), sb.shapes.Sphere()), {"memory": "9000TB"}, "memory of .* is more than there is"),
        # A seed is refused also where the verdict follows from a lattice, without random frequencies.
        ((sb.shapes.Sphere(), sb.shapes.Sphere()), {"seed": 1.5}, "seed must be a whole number from 0 on, found 1.5"),
    ],
)
def test_refusals(arguments: tuple[Any, Any], settings: dict[str, Any], message: str) -> None:
    with pytest.raises(sb.errors.InputError, match=message):
        same_surface(*arguments, **settings)


@pytest.mark.slow
def test_the_files_show_the_place_of_a_lost_patch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = sb.Mesh(1000 + 20 * sb.shapes.icosphere(4).vertices, sb.shapes.icosphere(4).triangles)
    heights = whole.vertices[whole.triangles].mean(axis=1)[:, 2]
    torn = sb.Mesh(whole.vertices, whole.triangles[heights < 1019.5])
    with pytest.raises(AssertionError) as failure:
        assert_same_surface(torn, whole, witness=tmp_path / "new" / "part")
    message = str(failure.value)
    assert "\n" not in message
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(AssertionError) as elsewhere:
        assert_same_surface(torn, whole)
    (unnamed,) = tmp_path.glob("sobolev-batch-*")
    assert str(elsewhere.value) == message.replace(str(tmp_path / "new" / "part"), str(unnamed / "difference"))
    files = [tmp_path / "new" / f"part-{label}.ply" for label in "ab"]
    assert message.endswith(f"witness: {files[0]} {files[1]}")
    match = re.search(r"a has less area near \((.*?)\)", message)
    assert match is not None
    assert np.array(match[1].split(","), dtype=float) == pytest.approx([1000, 1000, 1020], abs=2)
    for file, mesh in zip(files, (torn, whole), strict=True):
        data = PlyData.read(file)
        assert len(data["face"]) == len(mesh.triangles)
        vertices = data["vertex"].data
        lowest = np.nanargmin(vertices["witness_minus_4"])
        assert vertices["z"][lowest] > 1018
        assert vertices["witness_minus_4"][lowest] < 0
        assert "comparison part" in " ".join(data.comments)


@pytest.mark.slow
def test_a_place_that_cannot_be_written_leaves_the_failure_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for witness in (tmp_path / "file" / "part", "", ".", "a\0b", 3):
        with pytest.raises(AssertionError, match=r"^different surfaces: .*; no witness: "):
            assert_same_surface(sb.shapes.icosphere(1), sb.shapes.icosphere(3), witness=witness)  # type: ignore[arg-type]


def test_equal_surfaces_and_surfaces_in_closed_form_have_no_files(tmp_path: Path) -> None:
    sphere = sb.shapes.icosphere(2)
    assert assert_same_surface(sphere, sphere, witness=tmp_path / "same").outcome == "same"
    with pytest.raises(AssertionError, match=r"; no witness: neither surface is a mesh$"):
        assert_same_surface(sb.shapes.Sphere(0.9), sb.shapes.Sphere(), witness=tmp_path / "part")
    assert not list(tmp_path.iterdir())
    difference = write_difference(sphere, sphere, tmp_path / "w", -4.0)
    assert difference == f"they differ nowhere; witness: {tmp_path / 'w-a.ply'} {tmp_path / 'w-b.ply'}"
