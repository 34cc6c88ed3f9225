"""Shorthands for tests of sources."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sobolev_batch import Mesh
from sobolev_batch.sources.registry import Member, parse_source

BALL: dict[str, Any] = {"source": "icosphere", "levels": [3]}

# A table of each source; box.off must lie in the folder of the study.
KINDS: dict[str, dict[str, Any]] = {
    "icosphere": {"source": "icosphere", "levels": [1, 0]},
    "sphere": {"source": "sphere", "radius": 2.0, "center": [1, 2, 3]},
    "ellipsoid": {"source": "ellipsoid", "axes": [3, 2, 1], "center": [1, 2, 3]},
    "ellipsoid with levels": {"source": "ellipsoid", "axes": [3, 2, 1], "levels": [1, 0]},
    "torus": {"source": "torus", "R": 2, "r": 0.5, "center": [1, 2, 3]},
    "torus with levels": {"source": "torus", "R": 2, "r": 0.5, "levels": [1, 0]},
    "files": {"source": "files", "paths": ["box.off"]},
    "decimate": {"source": "decimate", "mesh": BALL, "triangles": [80]},
    "remesh": {"source": "remesh", "mesh": BALL, "triangles": [80]},
    "fit": {
        "source": "fit",
        "mesh": {"source": "icosphere", "levels": [1, 0]},
        "target": {"source": "sphere", "radius": 1.1},
        "steps": 3,
    },
    "refine": {
        "source": "refine",
        "mesh": {"source": "icosphere", "levels": [0]},
        "target": {"source": "sphere", "radius": 1.1},
        "steps": 3,
        "triangles": [40, 24],
    },
    "flow": {"source": "flow", "mesh": BALL, "times": [2.0, 0.5], "period": 4.0, "strength": 1.0},
    "spherical-levels": {"source": "spherical-levels", "mesh": BALL, "sphere": BALL, "levels": [2, 1]},
}

if find_spec("sobolev_batch.extras") is None:
    del KINDS["fit"], KINDS["refine"]


class SilentError(Exception):
    """An error that has no text."""

    def __str__(self) -> str:
        raise RuntimeError("no text")


def members(table: dict[str, Any], folder: Path = Path()) -> tuple[Member, ...]:
    return parse_source(table).members(folder)


def loaded(member: Member) -> Mesh:
    """Return the surface of a member, which must be a mesh."""
    surface = member.load()
    assert isinstance(surface, Mesh)
    return surface


def listed(members: tuple[Member, ...]) -> list[tuple[str, int]]:
    return [(member.name, member.level) for member in members]


def connectivity(mesh: Mesh) -> list[list[int]]:
    """Return the triangles without regard to order and orientation."""
    return sorted(sorted(triangle) for triangle in mesh.triangles.tolist())
