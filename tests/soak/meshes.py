"""A study of many small meshes, each a file of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sobolev_batch import icosphere
from tests.support.mesh_files import off

STUDY = """
[study]
name = "soak"
[lattice]
xi_max = 2.0
M = 10
[norm]
orders = [-4.0, -2.0]
pairs = "reference"
[reference]
source = "sphere"
[[family]]
name = "bumpy"
source = "files"
paths = ["*.off"]
"""


def write_study(folder: Path, count: int, seed: int) -> Path:
    """Write icospheres whose vertices are moved in or out at random, and the study of them; its file."""
    random = np.random.default_rng(seed)
    sphere = icosphere(1)
    for number in range(count):
        vertices = sphere.vertices * random.uniform(0.7, 1.0, (len(sphere.vertices), 1))
        (folder / f"{number:06}.off").write_bytes(off(vertices, sphere.triangles.tolist()))
    path = folder / "study.toml"
    path.write_text(STUDY)
    return path
