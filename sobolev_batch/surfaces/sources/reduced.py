"""Coarser versions of one mesh: the sources `decimate`, `remesh` and `spherical-levels`."""

from __future__ import annotations

import warnings
from abc import ABC
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import fast_simplification
import numpy as np
from pydantic import Field, SerializeAsAny, field_validator
from scipy.spatial import ConvexHull

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.generated import Levels
from sobolev_batch.surfaces.sources.registry import (
    MOST_ENTRIES,
    ExpectedSize,
    Fingerprint,
    Member,
    NestedSource,
    Source,
    at_most,
    installed_version,
    load_mesh,
    parse_nested,
    single_member,
)

# Measured peak of simplifying and of clustering, for each triangle of the original.
_REDUCING_BYTES = 450
# No mesh that can be read has as many.
_MOST_TRIANGLES = 10**9
# Even cells need several input vertices for each output vertex; pyacvd advises to subdivide until there are.
_VERTICES_PER_CLUSTER = 10


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
        return _reduced_size(self.original, self.triangles)


@dataclass(frozen=True)
class DecimatedMember(ReducedMember):
    """A mesh simplified to a number of triangles."""

    def load(self) -> Surface:
        """Load the original and collapse edges down to the count."""
        return decimated(self.load_original(), self.triangles)

    def fingerprint(self) -> Fingerprint:
        """Return the original's fingerprint, the count, and the version of the library."""
        return {
            "decimate": dict(self.original.fingerprint()),
            "triangles": self.triangles,
            "fast-simplification": installed_version("fast-simplification"),
        }


class DecimateSource(ReducedSource):
    """Simplifications of one mesh by quadric edge collapse.

    M. Garland, P. S. Heckbert, "Surface simplification using quadric error metrics" (1997),
    doi:10.1145/258734.258849; by the library fast-simplification.
    """

    member_type = DecimatedMember


def decimated(mesh: Mesh, triangles: int) -> Mesh:
    """Return a mesh with its edges collapsed down to a number of triangles."""
    vertices, faces = fast_simplification.simplify(
        np.array(mesh.vertices), np.array(mesh.triangles, dtype=np.int32), target_count=triangles
    )
    return Mesh(vertices, faces)


@dataclass(frozen=True)
class RemeshedMember(ReducedMember):
    """A mesh remeshed to about a number of triangles."""

    def load(self) -> Surface:
        """Load the original, cluster it, and triangulate the clusters."""
        try:
            import pyacvd
            import pyvista
        except ImportError as error:
            raise MeshError(
                f"remeshing needs a library that is missing ({error}); install the extra: "
                "pip install 'sobolev-batch[studies]'"
            ) from error
        mesh = self.load_original()
        # A closed surface of genus g has V = F/2 + 2 - 2g: two vertices more than half the triangles.
        clusters = self.triangles // 2 + 2
        with warnings.catch_warnings():
            # pyacvd 0.4 still reads an attribute that pyvista has renamed.
            warnings.filterwarnings("ignore", message=".*_connectivity_array")
            clustering = pyacvd.Clustering(pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.triangles))
            while len(clustering.mesh.points) < _VERTICES_PER_CLUSTER * clusters:
                clustering.subdivide(2)
            clustering.cluster(clusters)
            remeshed = clustering.create_mesh()
        return Mesh(np.asarray(remeshed.points), np.asarray(remeshed.regular_faces))

    def fingerprint(self) -> Fingerprint:
        """Return the original's fingerprint, the count, and the version of the library."""
        return {
            "remesh": dict(self.original.fingerprint()),
            "triangles": self.triangles,
            "pyacvd": installed_version("pyacvd"),
        }


class RemeshSource(ReducedSource):
    """Even remeshings of one mesh, by clustering its vertices into cells of similar area.

    A closed mesh comes out within a few triangles of the counts. S. Valette, J.-M. Chassery, "Approximated
    centroidal Voronoi diagrams for uniform polygonal mesh coarsening" (2004),
    doi:10.1111/j.1467-8659.2004.00769.x; by the library pyacvd, which the extra ``studies`` installs.
    """

    member_type = RemeshedMember

    @property
    def libraries(self) -> tuple[str, ...]:
        """The clustering library, and the distributions that the other source needs."""
        return "pyacvd", *super().libraries


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
        return parse_nested(table)

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
        return _reduced_size(self.surface, 20 * 4**self.level)


def _reduced_size(original: Member, triangles: int) -> ExpectedSize:
    """Return the expected size of a mesh that is made from a finer one."""
    size = original.expected_size()
    return ExpectedSize(triangles, max(size.projected_bytes, _REDUCING_BYTES * size.triangles), size.seconds)
