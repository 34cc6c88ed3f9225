"""The source `decimate`: a mesh simplified by quadric edge collapse to given triangle counts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import fast_simplification
import numpy as np
from pydantic import Field

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.registry import (
    MOST_ENTRIES,
    Fingerprint,
    Member,
    NestedSource,
    Size,
    at_most,
    installed_version,
    sole_member,
)

# Measured peak of simplifying and of clustering, for each triangle of the original.
_REDUCING_BYTES = 450

# No mesh that can be read has as many.
_MOST_TRIANGLES = 10**9

TriangleCounts = Annotated[
    tuple[Annotated[int, Field(ge=4, le=_MOST_TRIANGLES)], ...],
    Field(min_length=1, strict=False),
    at_most(MOST_ENTRIES),
]


class DecimateSource(NestedSource):
    """Simplifications of one mesh by quadric edge collapse.

    M. Garland, P. S. Heckbert, "Surface simplification using quadric error metrics" (1997),
    doi:10.1145/258734.258849; by the library fast-simplification.

    Attributes:
        mesh: the mesh to simplify, as a table that names a source with one member.
        triangles: the triangle counts to stop at; each must be below the mesh's own.
    """

    triangles: TriangleCounts

    def members(self, folder: Path) -> tuple[Member, ...]:
        """One member per triangle count, coarse to fine."""
        original = sole_member(self.mesh, folder)
        counts = sorted(set(self.triangles))
        return tuple(DecimatedMember(str(count), rank, original, count) for rank, count in enumerate(counts))


@dataclass(frozen=True)
class DecimatedMember(Member):
    """A mesh simplified to a number of triangles."""

    original: Member
    triangles: int

    def load(self) -> Surface:
        """Load the original and collapse edges until the count is reached."""
        mesh = whole_mesh(self.original, self.triangles)
        vertices, triangles = fast_simplification.simplify(
            np.array(mesh.vertices), np.array(mesh.triangles, dtype=np.int32), target_count=self.triangles
        )
        return Mesh(vertices, triangles)

    def fingerprint(self) -> Fingerprint:
        """The original's fingerprint, the count, and the version of the library."""
        return {
            "decimate": dict(self.original.fingerprint()),
            "triangles": self.triangles,
            "fast-simplification": installed_version("fast-simplification"),
        }

    def expected_size(self) -> Size:
        """Collapsing takes memory for the original."""
        return reduced_size(self.original, self.triangles)


def reduced_size(original: Member, triangles: int) -> Size:
    """The expected size of a mesh that is made from a finer one."""
    whole = original.expected_size()
    return Size(triangles, max(whole.making_bytes, _REDUCING_BYTES * whole.triangles))


def whole_mesh(original: Member, triangles: int) -> Mesh:
    """The mesh that a coarser one of so many triangles is to be made of.

    Raises:
        MeshError: it is no mesh, or not finer than what it is to be reduced to.
    """
    mesh = original.load()
    if not isinstance(mesh, Mesh):
        raise MeshError(f"{original.name} is not a mesh; only a mesh can be reduced to triangles")
    if triangles >= len(mesh.triangles):
        raise MeshError(
            f"{original.name} has {len(mesh.triangles)} triangles and cannot be reduced to {triangles}: ask for fewer"
        )
    return mesh
