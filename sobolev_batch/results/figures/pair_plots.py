"""Plots of the distances of all pairs: a heat map, and a map of the meshes."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from numpy.typing import NDArray
from scipy.cluster.hierarchy import leaves_list, linkage
from scipy.spatial.distance import squareform

from sobolev_batch.errors import InputError
from sobolev_batch.results.figures.selection import Selection
from sobolev_batch.results.figures.style import EXTENDS, Reals, escaped, hide_frame, inches, set_title, shortened
from sobolev_batch.results.tables.groups import complete_meshes, families_of, reference_of
from sobolev_batch.results.tables.matrix import Matrix

# In matrices and on maps.
MOST_MESHES = 300
# Points of the font of labels beside a matrix; smaller ones are left out.
_SMALLEST_FONT, _LARGEST_FONT = 4.0, 8.0
# Width of a character, as a multiple of the size of the font.
_CHARACTER_WIDTH = 0.6
# The colours of a matrix end at a percentile if the distances beyond it would take most of the scale.
_PERCENTILES = (2.0, 98.0)


def has_pairs(tree: xr.DataTree) -> bool:
    """Return True if the store has the distances of all pairs of meshes."""
    return "distances" in tree.children and tree["distances"].sizes["mesh"] == tree["distances"].sizes["other"]


def _chosen(selection: Selection, order: float) -> tuple[Matrix, str]:
    """Return the distances of the chosen meshes, and a note on those left out."""
    tree, family_of = selection.tree, families_of(selection.tree)
    reference = reference_of(tree)
    meshes = [label for label in complete_meshes(tree) if family_of[label] in selection.families or label == reference]
    matrix = Matrix.from_tree(tree, order, MOST_MESHES, meshes)
    if matrix is None:
        raise InputError(
            'the store has distances to the reference alone; set pairs = "all" in [norm] and run the study again'
        )
    shown = len(matrix.labels)
    return matrix, f"the first {shown} of {len(meshes)} meshes" if shown < len(meshes) else ""


def draw_matrix(selection: Selection, order: float, axes: Axes) -> None:
    """Draw the distances of all pairs as a heat map, with similar meshes beside each other."""
    matrix, omission = _chosen(selection, order)
    arrangement = clustered_order(matrix.values)
    values = matrix.values[np.ix_(arrangement, arrangement)]
    set_title(axes, f"Sobolev distance of order {matrix.order:g}", omission)
    if not (values > 0).any():
        axes.text(0.5, 0.5, "no two meshes differ", ha="center")
        axes.set_axis_off()
        return
    low, high, extend = _color_range(values[values > 0])
    image = axes.imshow(np.ma.masked_less_equal(values, 0), norm=LogNorm(low, high), cmap="viridis", aspect="equal")
    bar = axes.figure.colorbar(image, ax=axes, shrink=0.8, label="distance in the study's unit", extend=extend)
    bar.ax.tick_params(which="both", labelsize="small")
    labels = [shortened(matrix.labels[i]) for i in arrangement]
    # Below the matrix, the longest label takes its part of the height.
    points = 0.9 * 72 * min(inches(axes)) / (len(labels) + _CHARACTER_WIDTH * max(map(len, labels)))
    if points >= _SMALLEST_FONT:
        font = min(points, _LARGEST_FONT)
        axes.set_xticks(range(len(labels)), labels, rotation=90, fontsize=font)
        axes.set_yticks(range(len(labels)), labels, fontsize=font)
    else:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_xlabel(f"{len(labels)} meshes, similar ones beside each other")
    hide_frame(axes)


def _color_range(positive: Reals) -> tuple[float, float, str]:
    """Return the ends of the scale of colours, and the ends that get an arrow."""
    low, high = positive.min(), positive.max()
    inner_low, inner_high = np.percentile(positive, _PERCENTILES)
    most = max(inner_high / inner_low, 2.0)
    ends = bool(inner_low / low > most), bool(high / inner_high > most)
    extend = EXTENDS[ends]
    low, high = inner_low if ends[0] else low, inner_high if ends[1] else high
    # Equal ends would leave no scale.
    return (low, high, extend) if low < high else (low / 1.1, high * 1.1, extend)


def draw_map(selection: Selection, order: float, axes: Axes) -> None:
    """Draw the meshes as points of a plane whose distances approximate the Sobolev distances."""
    (matrix, omission), reference = _chosen(selection, order), reference_of(selection.tree)
    family_of = families_of(selection.tree)
    points, share = embedded(matrix.values)
    families = [family_of[label] for label in matrix.labels]
    for name in dict.fromkeys(families):
        chosen = [i for i, label in enumerate(matrix.labels) if families[i] == name and label != reference]
        if chosen:
            places, style = points[chosen].T, selection.styles[name]
            axes.plot(*places, style.marker, color=style.color, label=shortened(name), markersize=5, alpha=0.85)
    center = matrix.labels.index(reference) if reference in matrix.labels else None
    if center is not None:
        axes.plot(*points[center], "*", color="black", markersize=12, label=escaped(reference))
    explained = "" if np.isnan(share) else f", {share:.0%} of the variance"
    set_title(axes, f"map at order {matrix.order:g}{explained}", omission)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.1)
    axes.grid(visible=True, alpha=0.3)
    axes.set_xlabel("in the unit of distances")


def clustered_order(distances: Reals) -> NDArray[np.intp]:
    """Return an order of meshes with similar ones beside each other.

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


def embedded(distances: Reals) -> tuple[Reals, float]:
    """Return meshes as points of the plane that is nearest to all, by classical scaling.

    Distances of a norm are those of points in a Euclidean space, so that double centring gives their
    inner products exactly, up to the errors of the distances. Its first two principal axes span the
    plane that shows most of their variance. Distances in it are never larger than the true ones.

    Args:
        distances: Distances (meshes, meshes), symmetric, without NaN.

    Returns:
        Coordinates (meshes, 2) in the unit of the distances, the first axis the longer one; and the fraction of the
        meshes' variance that the plane shows, NaN where all meshes are equal.

    Source: W. S. Torgerson, "Multidimensional scaling: I. Theory and method" (1952),
    doi:10.1007/BF02288916.
    """
    count = len(distances)
    if count == 0:
        return np.zeros((0, 2)), float("nan")
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
    return points, float(variances[:2].sum() / total) if total > 0 else float("nan")
