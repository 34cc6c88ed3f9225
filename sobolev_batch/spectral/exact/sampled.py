"""The transform of a mesh at many frequencies one by one: closed forms again, faster and to fewer digits.

Away from small gaps the divided difference of exp at the corners is a plain sum of their exponentials, which
neighbouring triangles share. `triangles` keeps all digits; this loses some, and is several times as fast where
triangles are not small beside the wavelength.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.backends.arrays import cosine_and_sine
from sobolev_batch.spectral.exact.triangles import doubled_areas, exact_transform, second_difference
from sobolev_batch.surfaces.shapes.mesh import Mesh

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# A product of gaps below this (radians cubed) goes through the stable form: the plain one would lose as many digits.
_LEAST_PRODUCT = 2e-3
# If the longest edge is below this many radians, most triangles would go through the stable form.
_FINE_MESH = 0.5
# Pairs of a triangle and a frequency at a time, and so many triangles at most: their temporaries stay in cache. Those
# of all triangles of a fine mesh, on every thread, would take gigabytes.
_PAIRS = 1 << 14


def sampled_transform(mesh: Mesh, frequencies: Reals, threads: int = 1) -> Complexes:
    """Return the transform ∫ exp(-2πi ξ·x) dμ(x) of a mesh's area measure at single frequencies.

    Args:
        mesh: Mesh in units of length.
        frequencies: ξ, float64 (P, 3), in cycles per unit length.
        threads: Number of threads.

    Returns:
        complex128 (P,). The error of a triangle is at most about 1e-9 of its area. Of whole meshes at random
        frequencies it was measured to be at most 1e-13 of the area.
    """
    frequencies = np.asarray(frequencies, dtype=np.float64)
    lengths = np.linalg.norm(frequencies, axis=1)
    fine = 2 * np.pi * lengths * mesh.edge_length_range[1] < _FINE_MESH
    values = np.empty(len(frequencies), dtype=np.complex128)
    values[fine] = exact_transform(mesh, frequencies[fine])
    parts = np.array_split(frequencies[~fine], threads)
    others = np.zeros(np.count_nonzero(~fine), dtype=np.complex128)
    if others.size:
        with ThreadPoolExecutor(threads) as pool:
            for _, batch in mesh.batches(_PAIRS):
                others += np.concatenate(list(pool.map(partial(_plain_sums, _Triangles.from_mesh(batch)), parts)))
    values[~fine] = others
    return values


@dataclass(frozen=True, eq=False)
class _Triangles:
    """Triangles of a batch in arrays of one row per axis or corner.

    Attributes:
        vertices: Coordinates, float64 (3, n).
        corners: Indices of the first, second and third corners, (3, m).
        doubled: Twice the areas (m,).
        before: Edges from the first corners to the second ones, float64 (3, m).
        after: Edges from the second corners to the third ones, float64 (3, m).
    """

    vertices: Reals
    corners: NDArray[np.int64]
    doubled: Reals
    before: Reals
    after: Reals

    @classmethod
    def from_mesh(cls, mesh: Mesh) -> _Triangles:
        corners = np.ascontiguousarray(mesh.triangles.T)
        a, b, c = np.moveaxis(mesh.vertices.T[:, corners], 1, 0)
        return cls(np.ascontiguousarray(mesh.vertices.T), corners, doubled_areas((a, b, c)), b - a, c - b)


def _plain_sums(triangles: _Triangles, frequencies: Reals) -> Complexes:
    step = max(1, _PAIRS // len(triangles.doubled))
    groups = [frequencies[first : first + step] for first in range(0, len(frequencies), step)]
    return np.concatenate([_group_sums(triangles, group) for group in groups] or [np.empty(0, complex)])


def _group_sums(triangles: _Triangles, frequencies: Reals) -> Complexes:
    """Return the transform (P,) at a few frequencies."""
    directions = -2 * np.pi * frequencies
    phases = directions @ triangles.vertices
    # Of one edge, of the next, and of both.
    first, second = directions @ triangles.before, directions @ triangles.after
    both = first + second
    product = first * second
    product *= both
    close = np.abs(product) < _LEAST_PRODUCT
    product[close] = np.inf
    factors = triangles.doubled / product
    # The divided difference is (e_a g_bc + e_b g_ca + e_c g_ab) / (g_ab g_bc g_ca); the gaps g add up to zero.
    a, b, c = triangles.corners
    parts = []
    for values in cosine_and_sine(phases):
        middle = np.take(values, b, axis=1)
        before, after = np.take(values, a, axis=1), np.take(values, c, axis=1)
        before -= middle
        before *= second
        after -= middle
        after *= first
        before += after
        parts.append(np.einsum("pt,pt->p", before, factors))
    sums = -(parts[0] + 1j * parts[1])
    rows, columns = np.nonzero(close)
    gaps = first[rows, columns], both[rows, columns]
    means = phases[rows, b[columns]] + (gaps[1] - 2 * gaps[0]) / 3
    cosines, sines = cosine_and_sine(means)
    terms = triangles.doubled[columns] * (cosines + 1j * sines) * second_difference(*gaps)
    sums += np.bincount(rows, terms.real, len(sums)) + 1j * np.bincount(rows, terms.imag, len(sums))
    return np.asarray(sums)
