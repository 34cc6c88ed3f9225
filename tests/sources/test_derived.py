"""Meshes of one mesh: coarser ones, and those of a flow, against its integrated velocity."""

from __future__ import annotations

import re
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import sobolev_batch as sb
from sobolev_batch import Mesh
from sobolev_batch.errors import MeshError, StudyError
from sobolev_batch.shapes import icosphere
from sobolev_batch.sources.derived import carried
from sobolev_batch.sources.registry import parse_source
from tests.support.members import BALL, connectivity, listed, loaded, members
from tests.support.mesh_files import off
from tests.support.shapes import BOX_TRIANGLES, BOX_VERTICES, CLOSED

FLOW: dict[str, Any] = {"source": "flow", "mesh": {"source": "icosphere", "levels": [2]}, "times": [0.0]}
KINDS = ["decimate", "remesh"]


def positions(time: float, **settings: Any) -> np.ndarray:
    (member,) = members({**FLOW, **settings, "times": [time]})
    return np.asarray(loaded(member).vertices)


def velocity(time: float, angles: np.ndarray, strength: float, period: float) -> np.ndarray:
    """The fourth case of Nair and Lauritzen, as rates of longitude and latitude."""
    longitudes, latitudes = angles.reshape(2, -1)
    turned = longitudes - 2 * np.pi * time / period
    share = np.cos(np.pi * time / period)
    east = strength * np.sin(turned) ** 2 * np.sin(2 * latitudes) * share + 2 * np.pi * np.cos(latitudes) / period
    north = strength * np.sin(2 * turned) * np.cos(latitudes) * share
    return np.concatenate([east / np.cos(latitudes), north])


@pytest.mark.parametrize(("time", "strength", "period"), [(0.7, 2.0, 5.0), (2.5, 2.0, 5.0), (3.1, 0.5, 4.0)])
def test_vertices_follow_the_velocity(time: float, strength: float, period: float) -> None:
    x, y, z = np.asarray(sb.shapes.icosphere(2).vertices).T
    # Longitudes mean nothing at the poles, which no vertex meets on its way.
    start = np.concatenate([np.arctan2(y, x), np.arcsin(z)])
    path = solve_ivp(velocity, (0, time), start, "DOP853", rtol=1e-11, atol=1e-11, args=(strength, period))
    longitudes, latitudes = path.y[:, -1].reshape(2, -1)
    expected = np.stack(
        [np.cos(latitudes) * np.cos(longitudes), np.cos(latitudes) * np.sin(longitudes), np.sin(latitudes)], axis=1
    )
    # One that passes near a pole is hard for the oracle.
    np.testing.assert_allclose(positions(time, strength=strength, period=period), expected, rtol=0, atol=1e-6)


def test_vertices_stay_on_their_sphere_and_come_back() -> None:
    found = members({**FLOW, "times": [1.5, 0, 0.25]})
    assert [(member.name, member.time) for member in found] == [("0.0", 0.0), ("0.25", 0.25), ("1.5", 1.5)]
    mesh = Mesh([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1, 0]], [[0, 1, 2]])
    np.testing.assert_array_equal(carried(mesh, 1.0, 5.0, 2.0).vertices[0], 0.0)
    egg = {"source": "ellipsoid", "axes": [3.0, 2.0, 1.0], "levels": [2]}
    start, half, end = (positions(time, mesh=egg) for time in (0.0, 2.5, 5.0))
    np.testing.assert_allclose(np.linalg.norm(half, axis=1), np.linalg.norm(start, axis=1), rtol=1e-14)
    assert np.abs(half - start).max() > 0.5
    np.testing.assert_allclose(end, start, rtol=0, atol=1e-14)


LEVELS: dict[str, Any] = {"source": "spherical-levels", "mesh": BALL, "sphere": BALL, "levels": [1]}
COARSER = {"source": "icosphere", "levels": [2]}


def test_decimated_meshes_have_the_counts_asked_for() -> None:
    found = members({"source": "decimate", "mesh": BALL, "triangles": [320, 20, 80, 20]})
    assert listed(found) == [("20", 0), ("80", 1), ("320", 2)]
    made = [loaded(member) for member in found]
    assert [len(mesh.triangles) for mesh in made] == [20, 80, 320]
    for mesh in made:
        assert mesh.counts == CLOSED
    # Each is nearer to the original than the last; the coarsest is about an icosahedron.
    errors = [abs(mesh.area / icosphere(3).area - 1) for mesh in made]
    assert 0.25 > errors[0] > errors[1] > errors[2] > 0
    assert errors[2] < 0.01
    # In double precision: where one edge is collapsed, all vertices but one are those of the original.
    mesh = loaded(members({"source": "decimate", "mesh": BALL, "triangles": [1278]})[0])
    gaps = np.linalg.norm(mesh.vertices[:, None] - icosphere(3).vertices[None], axis=2).min(axis=1)
    assert np.count_nonzero(gaps > 1e-12) <= 1


def test_decimation_at_a_radius_does_not_depend_on_the_unit(tmp_path: Path) -> None:
    found = []
    for unit in (1.0, 2.0**-10):
        vertices = unit * (icosphere(3).vertices * [1.0, 0.8, 0.6] + [5.0, 0.0, 0.0])
        sb.write_mesh(Mesh(vertices, icosphere(3).triangles), tmp_path / f"{unit}.ply")
        files = {"source": "files", "paths": [str(tmp_path / f"{unit}.ply")]}
        (member,) = members({"source": "decimate", "mesh": files, "triangles": [200], "radius": 100})
        found.append(loaded(member).vertices / unit)
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-12)
    # Without it, fingerprints are as they were.
    (without,), (at_radius,) = (
        members({"source": "decimate", "mesh": BALL, "triangles": [80], **more}) for more in ({}, {"radius": 100})
    )
    assert at_radius.fingerprint() == {**without.fingerprint(), "radius": 100.0}


def test_decimation_keeps_open_borders_if_asked_to(tmp_path: Path) -> None:
    ball = icosphere(3)
    is_low = ball.vertices[ball.triangles][:, :, 2].max(axis=1) < 0.3
    sb.write_mesh(Mesh(ball.vertices, ball.triangles[is_low]), tmp_path / "bowl.ply")
    table = {
        "source": "decimate",
        "mesh": {"source": "files", "paths": [str(tmp_path / "bowl.ply")]},
        "triangles": [99],
    }
    (moved,), (kept,) = members(table), members({**table, "keep_boundary": True})
    shared = {tuple(vertex) for vertex in ball.vertices[np.unique(ball.triangles[~is_low])].tolist()}
    border = shared & {tuple(vertex) for vertex in ball.vertices[np.unique(ball.triangles[is_low])].tolist()}
    assert len(border) > 20
    assert border <= {tuple(vertex) for vertex in loaded(kept).vertices.tolist()}
    assert not border <= {tuple(vertex) for vertex in loaded(moved).vertices.tolist()}
    assert kept.fingerprint() == {**moved.fingerprint(), "keep_boundary": True}


def test_remeshed_surfaces_are_even_and_have_about_the_counts_asked_for() -> None:
    found = members({"source": "remesh", "mesh": BALL, "triangles": [320, 80, 80]})
    assert listed(found) == [("80", 0), ("320", 1)]
    for member, count in zip(found, (80, 320), strict=True):
        mesh = loaded(member)
        assert abs(len(mesh.triangles) - count) <= 4
        assert (mesh.counts["boundary_edges"], mesh.counts["nonmanifold_edges"]) == (0, 0)
        assert mesh.areas.std() < 0.5 * mesh.areas.mean()
        assert mesh.area == pytest.approx(icosphere(3).area, rel=0.1)
        assert np.linalg.norm(mesh.vertices, axis=1) == pytest.approx(np.ones(len(mesh.vertices)), abs=0.06)


@pytest.mark.parametrize("kind", KINDS)
def test_a_reduction_needs_one_mesh_of_more_triangles(kind: str) -> None:
    for mesh, error, message in (
        ({"source": "icosphere", "levels": [1]}, MeshError, "the mesh has 80 triangles and cannot be reduced to 80"),
        ({"source": "sphere"}, MeshError, "sphere is no mesh; its triangles are needed"),
        ({"source": "icosphere", "levels": [2, 3]}, StudyError, "the source makes 2: 2, 3"),
    ):
        with pytest.raises(error, match=message):
            members({"source": kind, "mesh": mesh, "triangles": [80]})[0].load()


def test_the_fingerprint_of_a_reduction_is_that_of_the_original_the_count_and_the_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = off(BOX_VERTICES, BOX_TRIANGLES)
    for name, changed in (("box", content), ("same", content), ("box2", content.replace(b"4.0", b"8.0"))):
        (tmp_path / f"{name}.off").write_bytes(changed)

    def of(name: str, *counts: int) -> dict[str, Any]:
        table = {"source": "decimate", "mesh": {"source": "files", "paths": [f"{name}.off"]}, "triangles": list(counts)}
        return dict(members(table, tmp_path)[-1].fingerprint())

    before = of("box", 8)
    assert before == of("same", 8) == of("box", 4, 8)
    assert before not in (of("box2", 8), of("box", 6))
    monkeypatch.setattr("sobolev_batch.sources.registry.installed_version", lambda name: "99")
    assert before != of("box", 8)


def test_remeshing_without_its_library_shows_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(distribution: str) -> str:
        raise PackageNotFoundError(distribution)

    (member,) = members({"source": "remesh", "mesh": BALL, "triangles": [80]})
    monkeypatch.setitem(sys.modules, "pyacvd", None)
    monkeypatch.setattr("sobolev_batch.sources.registry.version", version)
    for use in (member.load, member.fingerprint):
        with pytest.raises(MeshError, match=re.escape("pip install 'sobolev-batch[studies]'")):
            use()


def test_the_levels_of_an_icosphere_are_the_coarser_icospheres() -> None:
    found = members({**LEVELS, "levels": [3, 1, 0, 2, 1]})
    assert listed(found) == [("0", 0), ("1", 1), ("2", 2), ("3", 3)]
    for member in found:
        mesh, expected = loaded(member), icosphere(member.level)
        assert connectivity(mesh) == connectivity(expected)
        assert mesh.area == pytest.approx(expected.area, rel=1e-14)


def test_levels_take_vertices_from_the_surface_and_triangles_from_the_sphere(tmp_path: Path) -> None:
    ball = icosphere(2)
    # A potato: it is not convex, so that its own hull would leave vertices out.
    radii = 1 + 0.5 * np.sin(5 * ball.vertices[:, :1])
    (tmp_path / "potato.off").write_bytes(off(radii * ball.vertices, ball.triangles.tolist()))
    # The map need not be centred at the origin, nor its radius be one.
    (tmp_path / "sphere.off").write_bytes(off(100 * ball.vertices + 300, ball.triangles.tolist()))
    potato, sphere = ({"source": "files", "paths": [f"{name}.off"]} for name in ("potato", "sphere"))
    table = {**LEVELS, "mesh": potato, "sphere": sphere, "levels": [1, 2]}
    coarse, fine = (loaded(member) for member in members(table, tmp_path))
    assert np.array_equal(coarse.vertices, (radii * ball.vertices)[:42])
    assert connectivity(coarse) == connectivity(icosphere(1))
    assert connectivity(fine) == connectivity(ball)
    assert fine.area == pytest.approx(Mesh(radii * ball.vertices, ball.triangles).area, rel=1e-14)


def test_levels_need_enough_vertices_and_a_convex_map(tmp_path: Path) -> None:
    dented = icosphere(1).vertices.copy()
    dented[5] *= 0.5
    (tmp_path / "dented.off").write_bytes(off(dented, icosphere(1).triangles.tolist()))
    for changes, message in (
        ({"levels": [4]}, "level 4 needs the first 2562 vertices .*, found 642 and 642"),
        ({"sphere": COARSER}, "level 1 needs the first 42 vertices .*, found 642 and 162"),
        (
            {"mesh": {**BALL, "levels": [1]}, "sphere": {"source": "files", "paths": ["dented.off"]}},
            "the first 42 vertices of the map to the sphere are not in convex position",
        ),
    ):
        with pytest.raises(MeshError, match=message):
            members({**LEVELS, **changes}, tmp_path)[0].load()


@pytest.mark.extras
@pytest.mark.parametrize("key", ["mesh", "sphere"])
def test_both_sources_of_levels_are_meshes_and_hear_of_the_reference_and_their_libraries(key: str) -> None:
    with pytest.raises(MeshError, match="sphere is no mesh"):
        members({**LEVELS, key: {"source": "sphere"}})[0].load()
    remeshed = {"source": "remesh", "mesh": BALL, "triangles": [320]}
    assert parse_source({**LEVELS, key: remeshed}).libraries == ("pyacvd",)
    fitted = {"source": "fit", "mesh": BALL, "steps": 1}
    with_target = parse_source({**LEVELS, key: {**fitted, "target": {"source": "sphere"}}})
    assert parse_source({**LEVELS, key: fitted}).with_reference(parse_source({"source": "sphere"})) == with_target
