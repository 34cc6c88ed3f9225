"""The source `spherical-levels`: icosahedral sub-levels of a surface with a spherical map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import SerializeAsAny, field_validator
from scipy.spatial import ConvexHull

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.derived.nested import NestedSource, load_mesh, reduced_size
from sobolev_batch.surfaces.sources.generated import Levels
from sobolev_batch.surfaces.sources.registry import ExpectedSize, Fingerprint, Member, Source, single_member


class SphericalLevelsSource(NestedSource):
    """Coarse versions of a surface whose vertices follow an icosahedral refinement.

    The vertices of such a surface (FreeSurfer's fsaverage is one) come in the order of their levels:
    the first 10*4^N + 2 form level N. Its map to the sphere has the same vertices in the same order,
    and the convex hull of the first ones gives the triangles of the level.

    Attributes:
        mesh: Table of a source with one member, the surface.
        sphere: Table of a source with one member, its map to the sphere.
        levels: Levels N.
    """

    sphere: SerializeAsAny[Source]
    levels: Levels

    @field_validator("sphere", mode="before")
    @classmethod
    def _parse_sphere(cls, table: object) -> object:
        return cls._parse_mesh(table)

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member per level, coarse to fine."""
        surface, sphere = single_member(self.mesh, folder), single_member(self.sphere, folder)
        return tuple(LevelMember(str(level), level, surface, sphere) for level in sorted(set(self.levels)))


@dataclass(frozen=True)
class LevelMember(Member):
    """One icosahedral level of a surface."""

    surface: Member
    sphere: Member

    def load(self) -> Surface:
        """Take the vertices of the level from the surface, and its triangles from the hull of the sphere."""
        surface, sphere = load_mesh(self.surface), load_mesh(self.sphere)
        count = 10 * 4**self.level + 2
        if len(surface.vertices) != len(sphere.vertices) or count > len(surface.vertices):
            raise MeshError(
                f"level {self.level} needs the first {count} vertices of a surface and of its map to the sphere, "
                f"found {len(surface.vertices)} and {len(sphere.vertices)}"
            )
        hull = ConvexHull(sphere.vertices[:count] - sphere.vertices[:count].mean(axis=0))
        if len(hull.simplices) != 2 * count - 4:
            raise MeshError(
                f"the first {count} vertices of {self.sphere.name} are not in convex position: their hull has "
                f"{len(hull.simplices)} triangles, expected {2 * count - 4}"
            )
        return Mesh(surface.vertices[:count], hull.simplices.astype(np.int64))

    def fingerprint(self) -> Fingerprint:
        """Return the fingerprints of both surfaces, and the level."""
        return {
            "spherical level": self.level,
            "surface": dict(self.surface.fingerprint()),
            "sphere": dict(self.sphere.fingerprint()),
        }

    def expected_size(self) -> ExpectedSize:
        """Return the size of the level; the hull takes memory like a reduction of the surface."""
        return reduced_size(self.surface, 20 * 4**self.level)
