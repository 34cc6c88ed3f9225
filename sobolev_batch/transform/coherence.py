"""Errors of a mesh's triangles that add up at some frequency: all of them in arrays, whose pieces repeat."""

import math
from functools import lru_cache

import numpy as np

from sobolev_batch.arrays import Complexes, Indices, Reals, slices
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.transform.backends import CPU, Backend, combine, compute_on
from sobolev_batch.transform.faces import FaceArrays
from sobolev_batch.transform.lattice import Lattice
from sobolev_batch.transform.nufft import WeightedPoints, transform_points
from sobolev_batch.transform.nufft_costs import NufftSpec

# Triangles at a time: their temporaries stay in cache.
_BATCH = 1 << 13
# Number of ranges of |ξ| up to the highest one, the first that counts, and triangles that stand for all.
RANGES, _FIRST, _SAMPLE = 32, 10, 1 << 11
# The phase (radians) of a triangle's farthest corner at the highest frequency, once all are equally large.
_PHASE = 1.5
# Wavelengths along the box that is looked at; of a peak between the frequencies at least 0.83 is seen along each axis.
_MOST_WAVELENGTHS, _PADDING, _EPS = 50.0, 1.5, 1e-3
# The mean square over all directions for an equilateral triangle, whose errors are at most x²/4.
_MEAN_SQUARE = 8 / 15
# The largest of many sums of random terms, over their mean square, exceeds the logarithm of their number by this much.
_EXCESS = 4.0
# Numbers without pattern, which tell points apart.
_MIXERS = np.array([43758.5453, 12989.8, 7823.3])
# How often each of the ten different third moments counts: xxx, yyy, zzz, six such as xxy, and half of six times 2 xyz.
_MULTIPLES = np.array([1.0, 1.0, 1.0, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0, 1.5])


def unpaired(faces: FaceArrays) -> float:
    """Return the fraction of odd errors that adds up: 0 where each triangle has an opposite one, 1 where all are alike.

    The leading odd error is that of third moments about the centroid: of products of the three corners.
    """
    total, amount = np.zeros(len(_MULTIPLES)), 0.0
    for batch in faces.batches(_BATCH):
        moments, norms = _third_moments(batch)
        total += moments
        amount += norms
    return math.sqrt(float(_MULTIPLES @ total**2)) / amount if amount else 0.0


def _third_moments(faces: FaceArrays) -> tuple[Reals, float]:
    """Return the sums of third moments, times areas (10,), and the sum of their norms, in one unit of moments."""
    a = faces.at(0)
    u, v = faces.at(1) - a, faces.at(2) - a
    x = u + v
    b, c = 3 * u - x, 3 * v - x
    # Axes follow each other in a ring.
    squares, mixed = b * c, b * np.roll(c, -1, axis=0) + np.roll(b, -1, axis=0) * c
    after, before = (x * np.roll(mixed, turn, axis=0) for turn in (0, 1))
    after += np.roll(x, -1, axis=0) * squares
    before += np.roll(x, 1, axis=0) * squares
    x_y_z = x * np.roll(mixed, -1, axis=0)
    moments = np.concatenate([3 * x * squares, after, before, (x_y_z[0] + x_y_z[1] + x_y_z[2])[None]])
    norms = np.sqrt(combine(_MULTIPLES, moments * moments))
    sums = np.concatenate([moments, norms[None]])
    sums *= faces.areas
    found = faces.backend.download(sums.sum(axis=1))
    return found[:-1], float(found[-1])


def coherence(mesh: Mesh, highest: float, faces: FaceArrays | None = None, backend: Backend = CPU) -> Reals:
    """Return the squares of the largest sums of errors in 32 equal ranges of |ξ| up to the highest one (32,).

    They are relative to the sum of triangles that are all in phase, and zero where none exceeds the sums of random
    terms. A sample of the triangles stands for all; of meshes that are large beside the shortest wavelength, a sample
    of the box that holds most area. Frequencies fill the cube of a lattice.
    """
    triangles, areas, noise = _sample(mesh, highest, faces or FaceArrays.of_mesh(mesh))
    corners = np.stack([mesh.vertices[triangles[:, corner]].T for corner in range(3)])
    centers = corners.mean(axis=0)
    corners -= centers
    sizes = np.sqrt((corners * corners).sum(axis=1).max(axis=0))
    # Rules adapt to sizes, so errors do not depend on them: of equally large triangles, each weighs by its area. The
    # errors are those of the corners against the centroid, and vanish where ξ is normal to the triangle, as all do.
    length = _PHASE / (2 * np.pi * highest)
    corners *= length / np.maximum(sizes, np.finfo(np.float64).tiny)
    centers -= (centers.min(axis=1, keepdims=True) + centers.max(axis=1, keepdims=True)) / 2
    limit = highest / math.sqrt(3)
    count = math.ceil(2 * _PADDING * (float(np.abs(centers).max()) + length) * limit)
    # In units in which the spacing is one.
    points = np.concatenate([centers, *(centers + corners)], axis=1) * (limit / count)
    weights, lattice = np.concatenate([-areas, np.tile(areas / 3, 3)]), Lattice(count, 2 * count)

    def transform(backend: Backend) -> Complexes:
        uploaded = WeightedPoints(backend.upload(points), backend.upload(weights))
        spec = NufftSpec(lattice.shape, _EPS, "complex64")
        return np.asarray(backend.download(transform_points([uploaded], lattice, lattice.half, spec, backend)[0]))

    values = compute_on(backend, transform)
    places, numbers, radii = _ranges(count)
    squares = np.square(np.abs(values.ravel()[places]) / (np.square(_PHASE * radii) / 4 * areas.sum())) / _MEAN_SQUARE
    largest = np.zeros(RANGES)
    np.maximum.at(largest, numbers, squares)
    return np.where(largest > noise * (math.log(len(places)) + _EXCESS), np.minimum(largest, 1), 0)


def _sample(mesh: Mesh, highest: float, faces: FaceArrays) -> tuple[Indices, Reals, float]:
    """Return some triangles (k, 3), the areas that they stand for (k,), and the mean square of random sums of these.

    Triangles are drawn in proportion to their areas, by numbers that depend on their corners alone.
    """
    triangles, areas = mesh.triangles, mesh.areas
    low, high = mesh.extent.box
    if (high - low).max() * highest > _MOST_WAVELENGTHS:
        boxes = _boxes(mesh, low, _MOST_WAVELENGTHS / highest)
        here = np.flatnonzero(boxes == np.bincount(boxes, areas).argmax())
        triangles, areas, faces = triangles[here], areas[here], faces.part(here)
    if len(areas) <= _SAMPLE:
        return triangles, areas, 0.0
    levels = combine(highest * _MIXERS, faces.columns)
    np.sin(levels, out=levels)
    levels *= _MIXERS[0]
    numbers, first, each = [], 0, float(areas.sum()) / _SAMPLE
    for batch in faces.batches(_BATCH):
        a, b, c = batch.corners
        sums = levels[a] + levels[b] + levels[c]
        numbers.append(first + faces.backend.download(np.flatnonzero((sums - np.floor(sums)) * each < batch.areas)))
        first += len(batch)
    drawn = np.concatenate(numbers)
    sampled = np.maximum(areas[drawn], each)
    return triangles[drawn], sampled, np.count_nonzero(sampled == each) * (each / float(sampled.sum())) ** 2


def _boxes(mesh: Mesh, low: Reals, side: float) -> Indices:
    """Return the number of the box that holds the centroid of each triangle (m,)."""
    numbers = np.empty(len(mesh.triangles), dtype=np.int64)
    for part in slices(len(numbers), _BATCH):
        centers = mesh.vertices[mesh.triangles[part]].mean(axis=1)
        numbers[part] = ((centers - low) / side).astype(np.int64) @ [1, 1 << 20, 1 << 40]
    return np.unique(numbers, return_inverse=True)[1]


@lru_cache(maxsize=4)
def _ranges(count: int) -> tuple[Indices, Indices, Reals]:
    """Return the flat indices of those modes that count, in which range each is, and its |ξ| over the highest one."""
    axis = np.arange(-count, count + 1)
    squares = axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis[count:] ** 2
    radii = np.sqrt(squares.ravel() / 3) / count
    places = np.flatnonzero(radii * RANGES > _FIRST)
    return places, np.ceil(radii[places] * RANGES - 1e-9).astype(np.int64) - 1, radii[places]
