"""Sources that make their surfaces from the one mesh of another source."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Self

from pydantic import Field, SerializeAsAny, field_validator

from sobolev_batch.errors import MeshError, StudyError
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.sources.names import quoted
from sobolev_batch.surfaces.sources.registry import (
    MOST_ENTRIES,
    ExpectedSize,
    Member,
    Source,
    at_most,
    parse_source,
    single_member,
)

# Measured peak of simplifying and of clustering, for each triangle of the original.
_REDUCING_BYTES = 450
# No mesh that can be read has as many.
_MOST_TRIANGLES = 10**9


class NestedSource(Source):
    """A source that works on the one surface of another.

    Attributes:
        mesh: Table of the other source.
    """

    mesh: SerializeAsAny[Source]

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions that the other source needs."""
        return self.mesh.libraries

    def with_reference(self, reference: Source) -> Self:
        """Return the source with the study's reference handed to the other source."""
        return self.model_copy(update={"mesh": self.mesh.with_reference(reference)})

    @field_validator("mesh", mode="before")
    @classmethod
    def _parse_mesh(cls, table: object) -> object:
        return parse_nested(table)


def parse_nested(table: object) -> Source:
    """Return the source that a table within the table of another source names.

    Raises:
        ValueError: It is no table.
        StudyError: See `parse_source`.
    """
    if not isinstance(table, dict):
        raise ValueError('must be a table that names a source, such as { source = "files", paths = ["a.ply"] }')
    try:
        return parse_source(table)
    except StudyError as error:
        raise StudyError(f"the table {quoted(table)}: {error}") from error


class ReducedSource(NestedSource, ABC):
    """A source of coarser versions of one mesh.

    Attributes:
        mesh: Table of a source with one member, the mesh to reduce.
        triangles: Triangle counts of the coarser versions; each must be below that of the mesh.
    """

    triangles: Annotated[
        tuple[Annotated[int, Field(ge=4, le=_MOST_TRIANGLES)], ...],
        Field(min_length=1, strict=False),
        at_most(MOST_ENTRIES),
    ]

    member_type: ClassVar[type[ReducedMember]]

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member per triangle count, coarse to fine."""
        original = single_member(self.mesh, folder)
        counts = sorted(set(self.triangles))
        return tuple(self.member_type(str(count), rank, original, count) for rank, count in enumerate(counts))


@dataclass(frozen=True)
class ReducedMember(Member, ABC):
    """A mesh reduced to a number of triangles.

    Attributes:
        original: Member of the mesh to reduce.
        triangles: Number of triangles.
    """

    original: Member
    triangles: int

    def load_original(self) -> Mesh:
        """Return the mesh to reduce.

        Raises:
            MeshError: It is no mesh, or has too few triangles.
        """
        mesh = load_mesh(self.original)
        if self.triangles >= len(mesh.triangles):
            raise MeshError(
                f"{self.original.name} has {len(mesh.triangles)} triangles and cannot be reduced to "
                f"{self.triangles}: ask for fewer"
            )
        return mesh

    def expected_size(self) -> ExpectedSize:
        """Return the size of the reduced mesh and the memory that reducing the original takes."""
        return reduced_size(self.original, self.triangles)


def load_mesh(member: Member) -> Mesh:
    """Return the surface of a member that must be a mesh.

    Raises:
        MeshError: The surface is no mesh, or cannot be made.
    """
    mesh = member.load()
    if not isinstance(mesh, Mesh):
        raise MeshError(f"{member.name} is no mesh; its triangles are needed, so take a source of meshes")
    return mesh


def reduced_size(original: Member, triangles: int) -> ExpectedSize:
    """Return the expected size of a mesh that is made from a finer one."""
    size = original.expected_size()
    return ExpectedSize(triangles, max(size.projected_bytes, _REDUCING_BYTES * size.triangles), size.seconds)
