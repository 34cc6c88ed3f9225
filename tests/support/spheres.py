"""A study of spheres in a unit and at a place of their own, with names that are no paths."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sobolev_batch import Mesh, Study, run, write_mesh
from sobolev_batch.shapes import icosphere

RADIUS, CENTER = 40.0, np.array([10.0, -3.0, 5.0])
# To the right of who looks at a picture of the witness.
RIGHT = np.array([1.4, 1.25, 0.0]) / np.linalg.norm([1.4, 1.25])
ORDERS = (-4.0, -2.5)
LONG = "x" * 100
STRANGE = "Größe $ % ü"
LABELS = (f"files/{STRANGE}", "files/beside", f"files/{LONG}")


def sphere(scale: float, shift: float = 0.0) -> Mesh:
    ball = icosphere(3)
    return Mesh(RADIUS * scale * ball.vertices + CENTER + RADIUS * shift * RIGHT, ball.triangles)


def make_study(folder: Path, place: str) -> None:
    """A sphere as the reference; a small one within it, one beside it, a larger one, and a file without a mesh."""
    write_mesh(sphere(1.0), folder / "large.obj")
    write_mesh(sphere(0.5), folder / f"{STRANGE}.obj")
    write_mesh(sphere(1.0, shift=0.3), folder / "beside.obj")
    write_mesh(sphere(1.1), folder / f"{LONG}.obj")
    (folder / "bad.obj").write_text("v 0 0 nan\n")
    names = (f"{STRANGE}.obj", "beside.obj", f"{LONG}.obj", "bad.obj")
    table = {
        "study": {"name": "Kugeln größer"},
        "lattice": {"xi_max": 3.0, "M": 24},
        "norm": {"orders": list(ORDERS)},
        "reference": {"source": "files", "paths": ["large.obj"]},
        "family": [
            {"name": "files", "source": "files", "paths": list(names)},
            {"name": "closed", "source": "sphere", "radius": RADIUS, "center": CENTER.tolist()},
        ],
    }
    run(Study.from_table(table, folder=folder), place)
