"""Meshes and lattices larger than a worker: that they end, in the memory there is, with the right numbers."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client
from numpy.typing import NDArray

from sobolev_batch import Lattice, Mesh, Similarity, Study, icosphere, open_store, run
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.spectral.quadrature.meshes import gauss_rule
from tests.support.studies import small_table, variable

pytestmark = pytest.mark.all

CORTEX = Study.from_toml(Path(__file__).parents[3] / "workflows" / "cortex.toml")
PER_EDGE = 32
SCALE = 0.009


def original() -> Mesh:
    (member,) = CORTEX.reference.members(CORTEX.folder)  # type: ignore[union-attr]
    mesh = member.load()
    assert isinstance(mesh, Mesh)
    return mesh


def write_subdivided(mesh: Mesh, per_edge: int, path: Path) -> int:
    """A PLY file of a mesh whose triangles are cut into per_edge² flat ones each; how many it holds."""
    i, j = np.meshgrid(np.arange(per_edge + 1), np.arange(per_edge + 1), indexing="ij")
    inside = i + j <= per_edge
    number = np.cumsum(inside).reshape(inside.shape) - 1
    barycentric = np.stack([per_edge - i[inside] - j[inside], i[inside], j[inside]], axis=1) / per_edge
    a, b = (part[:-1, :-1].ravel() for part in (i, j))
    upright, turned = a + b < per_edge, a + b < per_edge - 1
    small = np.concatenate(
        [
            np.stack([number[a, b], number[a + 1, b], number[a, b + 1]], axis=1)[upright],
            np.stack([number[a + 1, b], number[a + 1, b + 1], number[a, b + 1]], axis=1)[turned],
        ]
    )
    vertices = (barycentric @ mesh.vertices[mesh.triangles]).reshape(-1, 3)
    starts = np.arange(len(mesh.triangles), dtype=np.int32) * np.int32(len(barycentric))
    faces = np.empty(len(starts) * len(small), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"] = 3
    faces["corners"] = (small.astype(np.int32) + starts[:, None, None]).reshape(-1, 3)
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    with path.open("wb") as file:
        file.write(header.encode())
        vertices.astype("<f8").tofile(file)
        faces.tofile(file)
    return len(faces)


def direct_sum(mesh: Mesh, frequencies: NDArray[np.float64]) -> NDArray[np.complex128]:
    """The transform by 64 points a triangle, which knows neither series nor NUFFT nor pieces."""
    rule = gauss_rule(8)
    points = np.einsum("pk,tkx->tpx", rule.barycentric, mesh.vertices[mesh.triangles]).reshape(-1, 3)
    weights = np.outer(mesh.areas, rule.weights).ravel()
    return np.array([np.sum(weights * np.exp(-2j * np.pi * (points @ frequency))) for frequency in frequencies])


def assert_field(store: Path, row: str, lattice: Lattice, mesh: Mesh, eps: float, seed: int) -> None:
    """Compare a stored field with a direct sum at random frequencies."""
    rng = np.random.default_rng(seed)
    index = tuple(rng.integers(0, count, 8) for count in lattice.shape)
    frequencies = np.stack([axis[place] for axis, place in zip(lattice.axes, index, strict=True)], axis=1)
    names = ("xi_x", "xi_y", "xi_z")
    where: dict[str, Any] = {name: ("draw", place) for name, place in zip(names, index, strict=True)}
    found = variable(open_store(store), "fourier", "fourier").sel(mesh=row).isel(where).to_numpy()
    assert np.abs(found - direct_sum(mesh, frequencies)).max() < 5 * eps * mesh.area


def processes(client: Client) -> set[int]:
    return set(client.run(os.getpid).values())


@pytest.mark.timeout(900)
def test_twenty_million_triangles_on_a_worker_of_six_gigabytes(tmp_path: Path, store_path: Path) -> None:
    base = original()
    count = write_subdivided(base, PER_EDGE, tmp_path / "huge.ply")
    assert count > 20_000_000
    # Finer, it takes four times the points and as many times as long.
    lattice, eps = Lattice(4.0, 48), 1e-6
    table = small_table(
        lattice={"xi_max": lattice.xi_max, "M": lattice.M},
        norm={"orders": [-2.0]},
        transform={"eps": eps},
        scaling={"mode": "fixed", "scale": SCALE},
        family=[{"name": "cortex", "source": "files", "paths": ["huge.ply"]}],
    )
    study = Study.from_table(table, folder=tmp_path)
    with local_client(1, "6GB") as client:
        before = processes(client)
        summary = run(study, store_path, client)
        assert processes(client) == before, "a worker was ended for its memory"
    assert not summary.failed
    meshes = open_store(store_path)["meshes"].to_dataset().sel(mesh="cortex/huge")
    assert meshes["triangles"].item() == count
    scaled = Similarity(SCALE).apply(base)
    assert isinstance(scaled, Mesh)
    assert meshes["area"].item() == pytest.approx(scaled.area, rel=1e-12)
    # A flat subdivision has the transform of the original.
    assert_field(store_path, "cortex/huge", lattice, scaled, eps, seed=1)
    (tmp_path / "huge.ply").unlink()


@pytest.mark.timeout(900)
def test_a_lattice_of_512_intervals_on_a_worker_of_three_gigabytes(store_path: Path) -> None:
    lattice = Lattice(20.0, 512)
    table = small_table(
        lattice={"xi_max": lattice.xi_max, "M": lattice.M},
        norm={"orders": [-2.0]},
        compare=None,
        family=[{"name": "ico", "source": "icosphere", "levels": [4]}],
    )
    study = Study.from_table(table)
    with local_client(1, "3GB") as client:
        before = processes(client)
        summary = run(study, store_path, client)
        assert processes(client) == before, "a worker was ended for its memory"
    assert not summary.failed
    assert_field(store_path, "ico/4", lattice, icosphere(4), 1e-9, seed=2)
    assert len(list((store_path / "fourier" / "fourier" / "c" / "0").rglob("*"))) > 4
    distance = variable(open_store(store_path), "distances", "distance").sel(mesh="ico/4").item()
    assert 0 < distance < 0.1
