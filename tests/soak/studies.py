"""A study of many small meshes, each a file of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sobolev_batch.shapes import icosphere
from tests.support.mesh_files import off

STUDY = """
[study]
name = "soak"
[lattice]
xi_max = 2.0
M = 24
[norm]
orders = [-4.0, -2.0]
[reference]
source = "sphere"
[[family]]
name = "bumpy"
source = "files"
paths = ["*.off"]
"""


def write_study(folder: Path, count: int) -> Path:
    """Write icospheres whose vertices are moved in or out at random, and the study of them; return its file."""
    write_meshes(folder, range(count), np.random.default_rng(0), level=3)
    path = folder / "study.toml"
    path.write_text(STUDY)
    return path


def write_meshes(folder: Path, numbers: range, chance: np.random.Generator, level: int = 1) -> None:
    """Write icospheres of these numbers, whose vertices are moved in or out at random."""
    sphere = icosphere(level)
    for number in numbers:
        vertices = sphere.vertices * chance.uniform(0.7, 1.0, (len(sphere.vertices), 1))
        (folder / f"{number:06}.off").write_bytes(off(vertices, sphere.triangles.tolist()))
