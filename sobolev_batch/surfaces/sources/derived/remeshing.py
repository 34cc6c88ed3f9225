"""The source `remesh`: a mesh replaced by even triangles, in given numbers."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.derived.nested import ReducedMember, ReducedSource
from sobolev_batch.surfaces.sources.fingerprints import installed_version
from sobolev_batch.surfaces.sources.registry import Fingerprint

# Even cells need several input vertices for each output vertex; pyacvd advises to subdivide until there are.
_VERTICES_PER_CLUSTER = 10


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
