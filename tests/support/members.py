"""Shorthands for tests of sources: members, what they load, how they are connected."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sobolev_batch import Mesh
from sobolev_batch.surfaces.sources.registry import Member, parse_source

BALL: dict[str, Any] = {"source": "icosphere", "levels": [3]}


def members(table: dict[str, Any], folder: Path = Path()) -> tuple[Member, ...]:
    """The members of the source that a table names."""
    return parse_source(table).members(folder)


def loaded(member: Member) -> Mesh:
    """What a member makes, which must be a mesh."""
    surface = member.load()
    assert isinstance(surface, Mesh)
    return surface


def listed(found: tuple[Member, ...]) -> list[tuple[str, int]]:
    """Names and levels."""
    return [(member.name, member.level) for member in found]


def connectivity(mesh: Mesh) -> list[list[int]]:
    """The triangles without regard to order and orientation."""
    return sorted(sorted(triangle) for triangle in mesh.triangles.tolist())
