"""Structure of a distance matrix: the meshes that are similar, and a map of all of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import leaves_list, linkage
from scipy.spatial.distance import squareform

Reals = NDArray[np.float64]


def clustered_order(distances: Reals) -> NDArray[np.intp]:
    """Return an order of meshes in which similar ones stand beside each other.

    Hierarchical clustering by mean distances, its leaves in the order that makes neighbours closest
    (Z. Bar-Joseph et al. 2001, doi:10.1093/bioinformatics/17.suppl_1.S22).

    Args:
        distances: Distances (meshes, meshes), symmetric, without NaN.

    Returns:
        Indices of meshes, (meshes,).
    """
    if len(distances) < 3:
        return np.arange(len(distances))
    pairs = squareform((distances + distances.T) / 2, checks=False)
    return np.asarray(leaves_list(linkage(pairs, method="average", optimal_ordering=True)), dtype=np.intp)


@dataclass(frozen=True)
class Embedding:
    """Meshes as points of the plane.

    Attributes:
        points: Coordinates (meshes, 2) in the unit of the distances; the first axis is the longer one.
        explained: Fraction of the meshes' variance that the plane shows; NaN where all meshes are equal.
    """

    points: Reals
    explained: float

    @classmethod
    def of(cls, distances: Reals) -> Embedding:
        """Return the best plane through the meshes, by classical scaling.

        Distances of a norm are those of points in a Euclidean space, so that double centring gives their
        inner products exactly, up to the errors of the distances. Its first two principal axes span the
        plane that shows most of their variance. Distances in it are never larger than the true ones.

        Args:
            distances: Distances (meshes, meshes), symmetric, without NaN.

        Source: W. S. Torgerson, "Multidimensional scaling: I. Theory and method" (1952),
        doi:10.1007/BF02288916.
        """
        count = len(distances)
        if count == 0:
            return cls(np.zeros((0, 2)), float("nan"))
        centring = np.eye(count) - 1 / count
        products = -centring @ (distances**2 + distances.T**2) @ centring / 4
        eigenvalues, axes = np.linalg.eigh(products)
        # Rounding and the errors of the distances make some of them negative.
        variances = np.maximum(eigenvalues[::-1], 0.0)
        points = np.zeros((count, 2))
        shown = min(2, count)
        points[:, :shown] = axes[:, ::-1][:, :shown] * np.sqrt(variances[:shown])
        # Eigenvectors have no sign of their own: maps would flip between machines.
        for axis in points.T:
            axis *= np.sign(axis[np.argmax(np.abs(axis))]) or 1.0
        total = variances.sum()
        return cls(points, float(variances[:2].sum() / total) if total > 0 else float("nan"))
