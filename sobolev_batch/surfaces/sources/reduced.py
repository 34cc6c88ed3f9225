"""Coarser versions of one mesh: the sources `decimate`, `remesh` and `spherical-levels`."""

from __future__ import annotations

import warnings
from abc import ABC
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, ClassVar

import fast_simplification
import numpy as np
from pydantic import Field, SerializeAsAny, field_validator
from scipy.spatial import ConvexHull

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.sources.generated import Levels
from sobolev_batch.surfaces.sources.registry import (
    MOST_ENTRIES,
    MadeMember,
    Member,
    NestedSource,
    Source,
    at_most,
    load_mesh,
    parse_nested,
    single_member,
)

# Takes a mesh and a number of triangles.
_Reduction = Callable[[Mesh, int], Mesh]
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

    kind: ClassVar[str]
    library: ClassVar[str]
    # What the library does.
    reduce: ClassVar[_Reduction]

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member per triangle count, coarse to fine."""
        original = single_member(self.mesh, folder)
        return tuple(
            MadeMember(
                str(count),
                rank,
                _reduced,
                {"triangles": count},
                (type(self).reduce, count),
                originals={self.kind: original},
                libraries=(self.library,),
                triangles=count,
                triangle_bytes=_REDUCING_BYTES,
            )
            for rank, count in enumerate(sorted(set(self.triangles)))
        )


def _reduced(original: Member, reduce: _Reduction, triangles: int) -> Mesh:
    mesh = load_mesh(original)
    if triangles >= len(mesh.triangles):
        raise MeshError(
            f"{original.name} has {len(mesh.triangles)} triangles and cannot be reduced to {triangles}: choose fewer"
        )
    return reduce(mesh, triangles)


def decimated(mesh: Mesh, triangles: int) -> Mesh:
    """Return a mesh with its edges collapsed down to a number of triangles."""
    vertices, faces = fast_simplification.simplify(
        np.array(mesh.vertices), np.array(mesh.triangles, dtype=np.int32), target_count=triangles
    )
    return Mesh(vertices, faces)


def remeshed(mesh: Mesh, triangles: int) -> Mesh:
    """Return a mesh of about a number of triangles around clusters of the vertices of another one.

    Raises:
        MeshError: The library is not installed.
    """
    try:
        import pyacvd
        import pyvista
    except ImportError as error:
        raise MeshError(
            f"remeshing needs a library that is missing ({error}); install the extra: "
            "pip install 'sobolev-batch[studies]'"
        ) from error
    # A closed surface of genus g has V = F/2 + 2 - 2g: two vertices more than half the triangles.
    clusters = triangles // 2 + 2
    with warnings.catch_warnings():
        # pyacvd 0.4 still reads an attribute that pyvista has renamed.
        warnings.filterwarnings("ignore", message=".*_connectivity_array")
        clustering = pyacvd.Clustering(pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.triangles))
        while len(clustering.mesh.points) < _VERTICES_PER_CLUSTER * clusters:
            clustering.subdivide(2)
        clustering.cluster(clusters)
        result = clustering.create_mesh()
    return Mesh(np.asarray(result.points), np.asarray(result.regular_faces))


class DecimateSource(ReducedSource):
    """Simplifications of one mesh by quadric edge collapse.

    M. Garland, P. S. Heckbert, "Surface simplification using quadric error metrics" (1997),
    doi:10.1145/258734.258849; by the library fast-simplification.
    """

    kind, library = "decimate", "fast-simplification"
    reduce: ClassVar[_Reduction] = staticmethod(decimated)


class RemeshSource(ReducedSource):
    """Even remeshings of one mesh, by clustering its vertices into cells of similar area.

    A closed mesh comes out within a few triangles of the counts. S. Valette, J.-M. Chassery, "Approximated
    centroidal Voronoi diagrams for uniform polygonal mesh coarsening" (2004),
    doi:10.1111/j.1467-8659.2004.00769.x; by the library pyacvd, which the extra ``studies`` installs.
    """

    kind, library = "remesh", "pyacvd"
    reduce: ClassVar[_Reduction] = staticmethod(remeshed)

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
        return tuple(
            MadeMember(
                str(level),
                level,
                _first_vertices,
                {"spherical level": level},
                (level,),
                originals={"surface": surface, "sphere": sphere},
                triangles=20 * 4**level,
                # The hull takes memory like a reduction of the surface.
                triangle_bytes=_REDUCING_BYTES,
            )
            for level in sorted(set(self.levels))
        )


def _first_vertices(surface_member: Member, sphere_member: Member, level: int) -> Mesh:
    """Take the vertices of a level from a surface, and its triangles from the hull of its map to the sphere."""
    surface, sphere = load_mesh(surface_member), load_mesh(sphere_member)
    count = 10 * 4**level + 2
    if len(surface.vertices) != len(sphere.vertices) or count > len(surface.vertices):
        raise MeshError(
            f"level {level} needs the first {count} vertices of a surface and of its map to the sphere, "
            f"found {len(surface.vertices)} and {len(sphere.vertices)}"
        )
    hull = ConvexHull(sphere.vertices[:count] - sphere.vertices[:count].mean(axis=0))
    if len(hull.simplices) != 2 * count - 4:
        raise MeshError(
            f"the first {count} vertices of {sphere_member.name} are not in convex position: their hull has "
            f"{len(hull.simplices)} triangles, expected {2 * count - 4}"
        )
    return Mesh(surface.vertices[:count], hull.simplices.astype(np.int64))
