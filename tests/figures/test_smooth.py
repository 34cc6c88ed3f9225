"""Table of docs/numerics.md: refinements that converge to an ellipsoid and to a torus."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sobolev_batch import Ellipsoid, Lattice, Mesh, Torus, distance, fourier_transform

PAGE = Path(__file__).parents[2] / "docs" / "numerics.md"
LATTICE = Lattice(5.0, 64)
TORUS, ELLIPSOID = Torus(1.0, 0.4), Ellipsoid((1.0, 0.7, 0.4))


def figures(shape: str) -> list[float]:
    (line,) = re.findall(rf"^\| {shape} .*\|$", PAGE.read_text(encoding="utf-8"), re.M)
    return [float(entry) for entry in line.strip("|").split("|")[1:]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "surface", "mesh"),
    [("torus", TORUS, lambda level: TORUS.mesh(12 << level, 6 << level)), ("ellipsoid", ELLIPSOID, ELLIPSOID.mesh)],
)
def test_refinements_converge_with_second_order(
    shape: str, surface: Torus | Ellipsoid, mesh: Callable[[int], Mesh]
) -> None:
    exact = fourier_transform(surface, LATTICE)
    meshes = [mesh(level) for level in range(5)]
    datasets = [distance(fourier_transform(mesh, LATTICE), exact, [-5.0, -10.0]) for mesh in meshes]
    distances = np.array([dataset["distance"].values for dataset in datasets])
    assert distances[:, 0] == pytest.approx(figures(shape)[:5], rel=5e-3)
    sizes = np.array([mesh.edge_lengths.mean() for mesh in meshes])
    for column in distances.T:
        assert column[3] / column[4] == pytest.approx(4.0, rel=0.005)
        assert np.polyfit(np.log(sizes[2:]), np.log(column[2:]), 1)[0] == pytest.approx(2.0, abs=0.02)
