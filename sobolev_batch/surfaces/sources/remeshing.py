"""The source `remesh`: a mesh replaced by one of even triangles with given triangle counts."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.decimation import TriangleCounts, reduced_size, whole_mesh
from sobolev_batch.surfaces.sources.registry import (
    Fingerprint,
    Member,
    NestedSource,
    Size,
    installed_version,
    sole_member,
)

# Clustering needs several input vertices for each output vertex to make even cells; pyacvd's own
# advice is to subdivide until there are.
_VERTICES_PER_CLUSTER = 10


class RemeshSource(NestedSource):
    """Even remeshings of one mesh by clustering its vertices into cells of like area.

    S. Valette, J.-M. Chassery, "Approximated centroidal Voronoi diagrams for uniform polygonal mesh
    coarsening" (2004), doi:10.1111/j.1467-8659.2004.00769.x; by the library pyacvd, which the extra
    ``studies`` installs.

    Attributes:
        mesh: the mesh to replace, as a table that names a source with one member.
        triangles: the approximate triangle counts; a closed mesh comes out within a few of them.
    """

    triangles: TriangleCounts

    @property
    def libraries(self) -> tuple[str, ...]:
        """What clusters, and what the other source needs."""
        return "pyacvd", *super().libraries

    def members(self, folder: Path) -> tuple[Member, ...]:
        """One member per triangle count, coarse to fine."""
        original = sole_member(self.mesh, folder)
        counts = sorted(set(self.triangles))
        return tuple(RemeshedMember(str(count), rank, original, count) for rank, count in enumerate(counts))


@dataclass(frozen=True)
class RemeshedMember(Member):
    """A mesh remeshed to about a number of triangles."""

    original: Member
    triangles: int

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
        mesh = whole_mesh(self.original, self.triangles)
        # A closed surface of genus g has V = F/2 + 2 - 2g: two vertices more than half the triangles.
        clusters = self.triangles // 2 + 2
        with warnings.catch_warnings():
            # pyacvd 0.4 still reads an attribute that pyvista has renamed.
            warnings.filterwarnings("ignore", message=".*_connectivity_array")
            clustering = pyacvd.Clustering(pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.triangles))
            while len(clustering.mesh.points) < _VERTICES_PER_CLUSTER * clusters:
                clustering.subdivide(2)
            clustering.cluster(clusters)
            made = clustering.create_mesh()
        return Mesh(np.asarray(made.points), np.asarray(made.regular_faces))

    def fingerprint(self) -> Fingerprint:
        """The original's fingerprint, the count, and the version of the library."""
        return {
            "remesh": dict(self.original.fingerprint()),
            "triangles": self.triangles,
            "pyacvd": installed_version("pyacvd"),
        }

    def expected_size(self) -> Size:
        """Clustering takes memory for the original."""
        return reduced_size(self.original, self.triangles)
