"""Whether the triangles of a mesh are those of another one, cut into smaller ones and rounded, as files round them."""

import numpy as np

from sobolev_batch.arrays import Reals
from sobolev_batch.geometry.closest import Triangles
from sobolev_batch.geometry.mesh import Mesh

# Height of thin triangles, in tolerances: the centre is a third of it away from each edge.
_THIN = 8.0
# A direction without pattern, along which triangles are compared.
_DIRECTION = np.array([0.4862, -0.3817, 0.7863])


def refinement_of(fine: Mesh, coarse: Mesh, tolerance: float) -> tuple[float, float] | None:
    """Return how a mesh differs from a coarser one whose triangles it has, cut into smaller ones; None if it has not.

    The corners of a triangle lie within the tolerance of the other one, and those in one triangle have together its
    area, centre and moment of inertia, to what the tolerance, a length, permits along its edges. Parts that are covered
    twice while others are bare change these.

    Returns:
        Largest distance of a triangle from the one in which it lies, in units of length; and the root of the sum of
        squares, over the triangles of the coarser mesh, of the area that is bare or covered twice, in squared units.

    >>> from sobolev_batch.geometry.mesh import Mesh
    >>> square = Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    >>> cut = Mesh([*square.vertices, [0.5, 0.5, 1e-9]], [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    >>> refinement_of(cut, square, 1e-8)
    (1e-09, 0.0)
    """
    whole = coarse.vertices[coarse.triangles]
    centers, widths = whole.mean(axis=1), coarse.edge_lengths.max(axis=1)
    # Roundings along its edges change the area of a triangle by less.
    allowed = 2 * tolerance * widths
    if abs(fine.area - coarse.area) > allowed.sum():
        return None
    triangles, corners = Triangles(coarse), fine.vertices[fine.triangles]
    of = triangles.closest(corners.mean(axis=1))[1]
    squares = [triangles.squares(np.ascontiguousarray(corners[:, k].T / triangles.scale), of) for k in range(3)]
    distances = triangles.scale * np.sqrt(np.max(squares, axis=0))
    longest, areas = fine.edge_lengths.max(axis=1), np.asarray(fine.areas)
    # The centre of one about as thin as the tolerance may lie in a neighbour of the triangle in which it does.
    is_thin = 2 * areas <= _THIN * tolerance * longest
    if np.any((distances > tolerance) & ~is_thin):
        return None
    missing = _moments(whole - centers[:, None], widths, np.asarray(coarse.areas))
    for number, moments in enumerate(_moments(corners - centers[of, None], widths[of], areas)):
        missing[number] -= np.bincount(of, moments, len(whole))
    if np.any(np.abs(missing) > allowed):
        return None
    return min(float(distances.max()), tolerance), float(np.linalg.norm(missing[0]))


def _moments(corners: Reals, widths: Reals, areas: Reals) -> Reals:
    """Return the area, the first moments and a second one of triangles (m, 3, 3), in some widths (m,), as (5, m)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = np.nan_to_num(corners / widths[:, None, None])
    along = relative @ _DIRECTION
    second = (np.sum(along**2, axis=1) + np.sum(along, axis=1) ** 2) / 12
    return np.asarray(areas * np.stack([np.ones(len(areas)), *relative.mean(axis=1).T, second]))
