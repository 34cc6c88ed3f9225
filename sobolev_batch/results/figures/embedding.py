"""What a distance matrix says of its meshes: which are alike, and where each lies on a map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import leaves_list, linkage
from scipy.spatial.distance import squareform

Reals = NDArray[np.float64]


def alike_together(distances: Reals) -> NDArray[np.intp]:
    """An order of meshes in which those that are alike stand beside each other.

    Hierarchical clustering by mean distances, its leaves in the order that makes neighbours closest
    (Z. Bar-Joseph et al. 2001, doi:10.1093/bioinformatics/17.suppl_1.S22).

    Args:
        distances: (meshes, meshes), symmetric, without NaN.

    Returns:
        Indices of meshes, (meshes,).
    """
    if len(distances) < 3:
        return np.arange(len(distances))
    pairs = squareform((distances + distances.T) / 2, checks=False)
    return np.asarray(leaves_list(linkage(pairs, method="average", optimal_ordering=True)), dtype=np.intp)


@dataclass(frozen=True)
class Map:
    """Meshes as points of the plane.

    Attributes:
        places: (meshes, 2), in the unit of the distances; the first axis is the longer one.
        share: of the meshes' variance in the space of the norm, what the plane shows; NaN where there is none.
    """

    places: Reals
    share: float

    @classmethod
    def of(cls, distances: Reals) -> Map:
        """The best plane through the meshes, by classical scaling.

        Distances of a norm are those of points in a Euclidean space, so that double centring gives their
        inner products exactly, up to the errors of the distances; its first two principal axes span the
        plane that shows the largest part of their variance. Distances in it are never larger than the
        true ones.

        Args:
            distances: (meshes, meshes), symmetric, without NaN.

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
        places = np.zeros((count, 2))
        shown = min(2, count)
        places[:, :shown] = axes[:, ::-1][:, :shown] * np.sqrt(variances[:shown])
        # The sign of an eigenvector is nobody's choice: without one, pictures would flip between machines.
        for axis in places.T:
            axis *= np.sign(axis[np.argmax(np.abs(axis))]) or 1.0
        total = variances.sum()
        return cls(places, float(variances[:2].sum() / total) if total > 0 else float("nan"))
