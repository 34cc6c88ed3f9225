"""The transform of a mesh at many frequencies one by one: closed forms again, faster and to fewer digits.

Away from small gaps the divided difference of exp at the corners is a plain sum of their exponentials, which
neighbouring triangles share. `triangles` keeps all digits; this loses some, and is several times as fast where
triangles are not small beside the wavelength.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.backends.arrays import cosine_and_sine
from sobolev_batch.spectral.exact.triangles import doubled_areas, exact_transform, second_difference
from sobolev_batch.surfaces.shapes.mesh import Mesh

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# A gap below this (radians) goes through the stable form: the plain one would lose its square in digits.
_LEAST_GAP = 2e-3
# If the longest edge is below this many radians, most triangles would go through the stable form.
_FINE_MESH = 0.5
# Pairs of a triangle and a frequency at a time: their temporaries stay in cache.
_PAIRS = 1 << 14


def sampled_transform(mesh: Mesh, frequencies: Reals, threads: int = 1) -> Complexes:
    """Return the transform ∫ exp(-2πi ξ·x) dμ(x) of a mesh's area measure at single frequencies.

    Args:
        mesh: Mesh in units of length.
        frequencies: ξ, float64 (P, 3), in cycles per unit length.
        threads: Number of threads.

    Returns:
        complex128 (P,). The error of a triangle is at most about 1e-10 of its area. Of whole meshes at random
        frequencies it was measured to be 5e-15 of the area.
    """
    frequencies = np.asarray(frequencies, dtype=np.float64)
    lengths = np.linalg.norm(frequencies, axis=1)
    fine = 2 * np.pi * lengths * mesh.edge_length_range[1] < _FINE_MESH
    values = np.empty(len(frequencies), dtype=np.complex128)
    values[fine] = exact_transform(mesh, frequencies[fine])
    parts = np.array_split(frequencies[~fine], threads)
    with ThreadPoolExecutor(threads) as pool:
        values[~fine] = np.concatenate(list(pool.map(partial(_plain_sums, mesh), parts)))
    return values


def _plain_sums(mesh: Mesh, frequencies: Reals) -> Complexes:
    triangles = np.ascontiguousarray(mesh.triangles.T)
    corners = mesh.vertices.T[:, triangles]
    doubled = doubled_areas((corners[:, 0], corners[:, 1], corners[:, 2]))
    step = max(1, _PAIRS // len(doubled))
    groups = [frequencies[first : first + step] for first in range(0, len(frequencies), step)]
    return np.concatenate([_group_sums(mesh, triangles, doubled, group) for group in groups] or [np.empty(0, complex)])


def _group_sums(mesh: Mesh, triangles: NDArray[np.int64], doubled: Reals, frequencies: Reals) -> Complexes:
    """Return the transform (P,) at a few frequencies."""
    phases = (-2 * np.pi * frequencies) @ mesh.vertices.T
    cosines, sines = cosine_and_sine(phases)
    first, second, third = (np.take(phases, index, axis=1) for index in triangles)
    opposite = third - second, first - third, second - first
    product = opposite[0] * opposite[1] * opposite[2]
    smallest = np.minimum(np.minimum(np.abs(opposite[0]), np.abs(opposite[1])), np.abs(opposite[2]))
    close = smallest < _LEAST_GAP
    product[close] = np.inf
    factors = doubled / product
    # With gaps g_a = γ - β and so on, the divided difference is (e_a g_a + e_b g_b + e_c g_c) / (g_a g_b g_c).
    real = sum(np.take(cosines, index, axis=1) * gap for index, gap in zip(triangles, opposite, strict=True))
    imaginary = sum(np.take(sines, index, axis=1) * gap for index, gap in zip(triangles, opposite, strict=True))
    sums = np.einsum("pt,pt->p", real, factors) + 1j * np.einsum("pt,pt->p", imaginary, factors)
    rows, columns = np.nonzero(close)
    means = (first[rows, columns] + second[rows, columns] + third[rows, columns]) / 3
    differences = second_difference(opposite[2][rows, columns], -opposite[1][rows, columns])
    cosines, sines = cosine_and_sine(means)
    terms = doubled[columns] * (cosines + 1j * sines) * differences
    sums += np.bincount(rows, terms.real, len(sums)) + 1j * np.bincount(rows, terms.imag, len(sums))
    return np.asarray(sums)
