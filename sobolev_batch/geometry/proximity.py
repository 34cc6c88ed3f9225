"""Distances of two meshes from point to closest point: Hausdorff, mean, RMS, percentiles, Chamfer, F-score, normals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.closest import Triangles, signs
from sobolev_batch.geometry.deviation import Deviations, directed_deviation
from sobolev_batch.geometry.formats.conversion import MeshLike, as_mesh, each
from sobolev_batch.geometry.mesh import Mesh, Vectors, cross, cross_lengths, dot
from sobolev_batch.geometry.surface import is_finite_number
from sobolev_batch.parameters import check_flags, check_seed, is_whole_number

DEFAULT_POINTS = 10_000
MOST_POINTS = 10_000_000
# The threshold of the F-score, in radii of the bounding sphere of the reference.
DEFAULT_THRESHOLD = 0.01
_PERCENTILES = (50, 95, 99)
# The error of a percentile is what so many standard errors of its rank, those of 99 %, move it by, over this number (R.
# S. Woodruff, "Confidence intervals for medians and other position measures", 1952): no gap of distances is missed.
_RANKS = 2.57
# All random points miss a spot of the area of 4.6 of them once in a hundred draws. With so many points more at the
# farthest place, 2.57 standard errors allow for such a spot.
_UNSEEN = 3
# How well the largest deviation is known for that: to a factor of two, which takes half the time of the usual gap.
_ROUGH_GAP = 1.0
_WAYS = ("_forward", "_backward")

_SYMMETRIC = ("hausdorff", "hausdorff_upper", "mean", "rms", *(f"p{percent}" for percent in _PERCENTILES))
LENGTHS = (
    *(f"{name}{way}" for name in _SYMMETRIC for way in ("", *_WAYS)),
    *("mean_error", "rms_error", "bias", "bias_error", "chamfer", "chamfer_error", "threshold"),
)
_NORMALS = tuple(f"{name}{way}" for name in ("normal_mean", "normal_max") for way in ("", *_WAYS))
NUMBERS = (*LENGTHS, "fscore", "precision", "recall", *_NORMALS)
# What a study may show in its tables, with the numbers of `proximity` that belong to it.
METRICS = {
    "hausdorff": ("hausdorff", "hausdorff_upper"),
    "mean": ("mean", "mean_error"),
    "rms": ("rms", "rms_error"),
    "bias": ("bias", "bias_error"),
    "percentiles": tuple(f"p{percent}" for percent in _PERCENTILES),
    "chamfer": ("chamfer", "chamfer_error"),
    "fscore": ("fscore", "precision", "recall"),
    "normals": ("normal_mean", "normal_max"),
    "volume": ("volume",),
    "triangles": ("smallest_angle", "aspect_ratio"),
}
# Those of a single mesh, which every study measures.
OF_ONE_MESH = ("volume", "smallest_angle", "aspect_ratio")

# Memory of a search: for each triangle of either mesh, for each point, and of its temporary arrays. Pairs of 10,000 to
# 600,000 triangles took 19 to 450 MB, some 100 to 200 of them for the pieces of a largest deviation.
TRIANGLE_BYTES, POINT_BYTES, WORKING_BYTES = 600.0, 250.0, 2e8


def proximity(
    a: MeshLike, b: MeshLike, *, points: int = DEFAULT_POINTS, threshold: float | None = None, seed: int = 0
) -> dict[str, float]:
    """Measure the usual distances of two meshes, from points to the closest points of triangles.

    Args:
        a: First mesh, or what `as_mesh` makes one of.
        b: Second mesh, the reference, in the same unit of length, or what `as_mesh` makes one of.
        points: Number of random points on each mesh, spread evenly by area.
        threshold: Distance up to which a point counts as matched in the F-score; default 1 % of the radius of the
            bounding sphere of b.
        seed: Seed of the random points; the same seed gives the same numbers.

    Returns:
        Numbers by name. Lengths are in the unit of the meshes, and angles in degrees. Names with ``_forward`` are
        those of points of a from b, names with ``_backward`` those of points of b from a; the name alone is the larger.

        - hausdorff and hausdorff_upper: the largest distance of all points, not only of random ones, is between them;
          they are the bounds of `largest_deviation`, 1 % apart;
        - mean and rms: mean distance, and root of the mean squared distance, by area; their standard errors, since
          points are random, are mean_error and rms_error;
        - bias and bias_error: mean distance of points of a, positive outside of b and negative inside, and its
          standard error; NaN if triangles of b are not oriented consistently. An open mesh has its outside where its
          triangles face;
        - p50, p95 and p99: the distance below which 50, 95 and 99 % of the area is;
        - chamfer: the sum of both means, not squared; chamfer_error is its standard error;
        - fscore: harmonic mean of precision, the fraction of the area of a within the threshold of b, and recall, that
          of b within the threshold of a; and threshold;
        - normal_mean and normal_max: angle between the normal at a point and that of the closest triangle, from 0 to
          90: which way triangles face does not matter. The largest one is that of the random points.

    Raises:
        InputError: ``points``, ``threshold`` or ``seed`` is out of range; or see `as_mesh`.

    Sources: P. Cignoni, C. Rocchini, R. Scopigno, "Metro: measuring error on simplified surfaces" (1998),
    doi:10.1111/1467-8659.00236; N. Aspert, D. Santa-Cruz, T. Ebrahimi, "MESH: measuring errors between surfaces using
    the Hausdorff distance" (2002), doi:10.1109/ICME.2002.1035879, for the larger of both; A. Knapitsch et al., "Tanks
    and temples" (2017), doi:10.1145/3072959.3073599, for the F-score.

    >>> import sobolev_batch as sb
    >>> square = sb.Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    >>> raised = sb.Mesh(square.vertices + [0, 0, 0.25], square.triangles)
    >>> distances = sb.proximity(square, raised, points=1000)
    >>> distances["hausdorff"] <= 0.25 <= distances["hausdorff_upper"]
    True
    >>> f"{distances['hausdorff']:.6f} {distances['rms']:.6f} {distances['chamfer']:.6f}"
    '0.250000 0.250000 0.500000'
    """
    return proximity_and_deviations(a, b, points=points, threshold=threshold, seed=seed)[0]


def proximity_and_deviations(
    a: MeshLike,
    b: MeshLike,
    *,
    points: int = DEFAULT_POINTS,
    threshold: float | None = None,
    seed: int = 0,
    within: float | None = None,
) -> tuple[dict[str, float], Deviations]:
    """Measure the same, and return also the largest deviations, which know their places.

    Bounds between which the length `within` would lie are closer, so that they tell on which side it is.
    """
    if not is_whole_number(points) or not 1 < points <= MOST_POINTS:
        raise InputError(f"points must be an integer from 2 to {MOST_POINTS}, found {points!r}")
    if threshold is not None and not (is_finite_number(threshold) and threshold > 0):
        raise InputError(f"threshold must be a positive number, found {threshold!r}")
    check_seed(seed)
    meshes = each(as_mesh, {"a": a, "b": b})
    searches = Triangles(meshes[0]), Triangles(meshes[1])
    deviations = []
    for own, search in zip(meshes, searches[::-1], strict=True):
        found = directed_deviation(own, search)
        if within is not None and found.lower < within < found.upper:
            found = replace(found, upper=min(found.upper, directed_deviation(own, search, within=within).upper))
        deviations.append(found)
    largest = Deviations(*deviations)
    numbers = sampled_numbers(*searches, points, threshold, seed, deviations=largest)
    for way, found in zip(("", *_WAYS), (largest.both, *deviations), strict=True):
        numbers |= {f"hausdorff{way}": found.lower, f"hausdorff_upper{way}": found.upper}
    return {name: numbers[name] for name in NUMBERS}, largest


def sampled_numbers(
    a: Triangles,
    b: Triangles,
    points: int = DEFAULT_POINTS,
    threshold: float | None = None,
    seed: int = 0,
    *,
    signed: bool = True,
    deviations: Deviations | None = None,
) -> dict[str, float]:
    """Return the numbers of `proximity` that random points have, most of them with a standard error: NAME_error.

    The points may miss a spot, and errors allow for that by the largest deviations, which may be known. Without signs,
    which take about as long as all else, there is no bias.
    """
    limit = DEFAULT_THRESHOLD * b.mesh.bounding_sphere[1] if threshold is None else float(threshold)
    numbers: dict[str, float] = {"threshold": limit}
    percents = np.array(_PERCENTILES)
    beside = _RANKS * np.sqrt(percents * (100 - percents) / points)
    of_ways: list[dict[str, Sequence[float]]] = []
    if deviations is None:
        deviations = Deviations(*(directed_deviation(one.mesh, other, _ROUGH_GAP) for one, other in ((a, b), (b, a))))
    seeds, ways = np.random.SeedSequence(seed).spawn(2), (deviations.forward, deviations.backward)
    for search, other, farthest, own_seed in zip((a, b), (b, a), ways, seeds, strict=True):
        drawn, triangles = _drawn(search.mesh, points, np.random.default_rng(own_seed))
        unseen = np.tile(farthest.place, (_UNSEEN, 1))
        drawn, triangles = np.vstack([drawn, unseen]), np.append(triangles, search.closest(unseen)[1])
        distances, closest = other.closest(drawn)
        # Powers of two lose no digit, and keep squares of lengths within the range of doubles.
        scale = 2.0 ** np.frexp(distances.max(initial=np.finfo(float).tiny))[1]
        squares = (distances / scale) ** 2
        square, square_error = _mean(squares)
        across, facing = _normals(search.mesh, triangles), _normals(other.mesh, closest)
        angles = np.degrees(np.arctan2(cross_lengths(across, facing), np.abs(dot(across, facing))))
        ranks = [np.clip(percents + k * beside, 0, 100) for k in (-1, 0, 1)]
        low, middle, high = np.percentile(distances[:points], ranks)
        moves = np.maximum(high - middle, middle - low)
        of_way: dict[str, Sequence[float]] = {
            "mean": _mean(distances),
            "rms": (scale * np.sqrt(square), scale * (np.sqrt(square + square_error) - np.sqrt(square))),
            **{f"p{percent}": pair for percent, *pair in zip(_PERCENTILES, middle, moves / _RANKS, strict=True)},
            "normal_mean": _mean(angles),
            "normal_max": (angles[:points].max(), np.nan),
            "matched": (float(np.mean(distances[:points] <= limit)), np.nan),
        }
        of_ways.append(of_way)
        if search is a:
            sides = signs(other.mesh, drawn) if signed else None
            numbers["bias"], numbers["bias_error"] = _mean(distances * (np.nan if sides is None else sides))
    for name in of_ways[0]:
        found = [of_way[name] for of_way in of_ways]
        for way, (value, error) in zip(("", *_WAYS), (np.max(found, axis=0), *found), strict=True):
            numbers |= {f"{name}{way}": float(value), f"{name}{way}_error": float(error)}
    precision, recall = (numbers[f"matched{way}"] for way in _WAYS)
    return numbers | {
        "chamfer": numbers["mean_forward"] + numbers["mean_backward"],
        "chamfer_error": float(np.hypot(numbers["mean_forward_error"], numbers["mean_backward_error"])),
        "fscore": 2 * precision * recall / (precision + recall) if precision + recall else 0.0,
        "precision": precision,
        "recall": recall,
    }


def _mean(values: Reals) -> tuple[float, float]:
    """Return the mean of independent values before the last `_UNSEEN`, and its standard error with these."""
    count = len(values) - _UNSEEN
    return float(values[:count].mean()), float(values.std(ddof=1)) / np.sqrt(count)


def share_beyond(a: MeshLike, b: MeshLike, length: float, *, one_way: bool = False) -> tuple[float, float, int]:
    """Return the share of the area that is farther from the other mesh than a length, by random points, and its error.

    It is the larger of both directions, or that of the first mesh, and the last number is 1 where it is that of the
    second one. The standard error is that for one point more.
    """
    meshes = each(as_mesh, {"a": a, "b": b})
    rng, ways, points = np.random.default_rng(0), (meshes, meshes[::-1])[: 1 if one_way else 2], DEFAULT_POINTS
    counts = [np.count_nonzero(sampled_distances(mesh, other, rng, points) > length) for mesh, other in ways]
    count = max(counts)
    likely = (count + 1) / (points + 2)
    return count / points, float(np.sqrt(likely * (1 - likely) / points)), counts.index(count)


def sampled_distances(mesh: Mesh, other: Mesh, rng: np.random.Generator, points: int, *, signed: bool = False) -> Reals:
    """Return the distances (n,) of random points, spread evenly by area, from another mesh; see `vertex_distances`."""
    return point_distances(_drawn(mesh, points, rng)[0], other, signed=signed)


def vertex_distances(mesh: MeshLike, other: MeshLike, *, signed: bool = False) -> Reals:
    """Measure the distance of each vertex of a mesh from the closest point of another mesh.

    Args:
        mesh: Mesh whose vertices are measured, or what `as_mesh` makes one of.
        other: Mesh from which they are measured, in the same unit of length, or what `as_mesh` makes one of.
        signed: Whether distances of vertices inside of the other mesh are negative. An open mesh has its outside where
            its triangles face.

    Returns:
        Distances (n,) of float64, exact to rounding, in the unit of the meshes; NaN for a vertex that no triangle uses.

    Raises:
        InputError: Signs are requested, but the other mesh is not oriented consistently; or see `as_mesh`.

    >>> import sobolev_batch as sb
    >>> ball = sb.shapes.icosphere(3)
    >>> distances = sb.vertex_distances(sb.Mesh(2 * ball.vertices, ball.triangles), ball)
    >>> distances.shape, distances.round(12).min().item(), distances.round(12).max().item()
    ((642,), 1.0, 1.0)
    """
    check_flags(signed=signed)
    mesh, other = each(as_mesh, {"mesh": mesh, "other": other})
    distances, used = np.full(len(mesh.vertices), np.nan), mesh.used_vertices
    distances[used] = point_distances(mesh.vertices[used], other, signed=signed)
    return distances


def point_distances(points: Reals, other: Mesh, *, signed: bool = False) -> Reals:
    """Return the distances (n,) of points (n, 3) from a mesh; see `vertex_distances`."""
    sides = signs(other, points) if signed else np.ones(len(points))
    if sides is None:
        raise InputError(f"the other mesh has no outside: {', '.join(other.defects)}")
    return Triangles(other).closest(points)[0] * sides


def _drawn(mesh: Mesh, points: int, rng: np.random.Generator) -> tuple[Reals, Indices]:
    """Return random points on a mesh (n, 3), and the triangle of each."""
    chances = mesh.areas / mesh.areas.max()
    triangles = rng.choice(len(chances), points, p=chances / chances.sum())
    root, part = np.sqrt(rng.random((points, 1))), rng.random((points, 1))
    a, b, c = mesh.corners(triangles)
    return (1 - root) * a + root * (1 - part) * b + root * part * c, triangles


def _normals(mesh: Mesh, triangles: Indices) -> Vectors:
    """Return vectors (3, n) across triangles, of a length that no product overflows."""
    a, b, c = (corner.T for corner in mesh.corners(triangles))
    sides = b - a, c - a
    longest = np.abs(sides).max(axis=(0, 1))
    longest[longest == 0] = 1.0
    return cross(sides[0] / longest, sides[1] / longest)
