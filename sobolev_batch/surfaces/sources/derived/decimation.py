"""The source `decimate`: a mesh simplified by quadric edge collapse to given triangle counts."""

from __future__ import annotations

from dataclasses import dataclass

import fast_simplification
import numpy as np

from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.derived.nested import ReducedMember, ReducedSource
from sobolev_batch.surfaces.sources.fingerprints import installed_version
from sobolev_batch.surfaces.sources.registry import Fingerprint


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
