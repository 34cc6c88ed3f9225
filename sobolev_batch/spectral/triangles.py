"""The exact Fourier transform of flat triangles, evaluated without loss of digits.

It costs O(triangles) per frequency, so it does not replace the NUFFT: it is the independent
formula that quadrature rules are rated with and that computed fields are checked against.

The transform of a triangle of area A is 2A times the second divided difference of exp at the
nodes -2πi ξ·p_j of its corners p_j (Hermite-Genocchi; C. de Boor, "Divided differences", 2005,
arXiv:math/0502036). The explicit quotient of exponentials cancels where two nodes are close, the
usual case on a fine mesh, hence two branches: a power series where all three are close, and the
difference quotient of first differences across the widest gap elsewhere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral import compensated
from sobolev_batch.surfaces.mesh import Corners, Mesh

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Phases below this (radians) go through the series: it then needs at most 14 terms, and above it
# the quotient loses less than one digit.
_SERIES_REACH = 0.5
# Below this many cycles a plain dot product keeps the phase of exp to 5e-14 radians.
_PLAIN_CYCLES = 16.0
_CHUNK = 1 << 16


def exact_transform(mesh: Mesh, frequencies: Reals) -> Complexes:
    """The transform ∫ exp(-2πi ξ·x) dμ(x) of a mesh's area measure, free of quadrature error.

    Args:
        mesh: the mesh, in units of length.
        frequencies: (P, 3) float64, in cycles per unit length.

    Returns:
        complex128 (P,). Each triangle contributes with a relative error of about 1e-15 of
        min(area, its decay); the area itself is exact to rounding even on slivers.
    """
    frequencies = np.asarray(frequencies, dtype=np.float64)
    values = np.zeros(len(frequencies), dtype=np.complex128)
    exponentials = [_vertex_exponentials(mesh.vertices, frequency) for frequency in frequencies]
    for first in range(0, len(mesh.triangles), _CHUNK):
        part = slice(first, first + _CHUNK)
        a, b, c = mesh.corners(part)
        doubled = doubled_areas((a, b, c))
        edges = b - a, c - a, c - b
        for row, frequency in enumerate(frequencies):
            ea, eb, ec = exponentials[row][mesh.triangles[part]].T
            ab, ac, bc = (edge @ (-2 * np.pi * frequency) for edge in edges)
            values[row] += doubled @ second_difference((ea, eb, ec), ab, ac, bc)
    return values


def second_difference(
    exponentials: tuple[Complexes, Complexes, Complexes], ab: Reals, ac: Reals, bc: Reals
) -> Complexes:
    """The second divided difference of exp at three imaginary nodes iα, iβ, iγ.

    Args:
        exponentials: exp(iα), exp(iβ), exp(iγ), each (n,).
        ab: the gap β - α in radians, (n,).
        ac: the gap γ - α, likewise.
        bc: the gap γ - β, likewise. The gaps are passed apart from the exponentials since they keep
            their relative accuracy only if they are formed from edge vectors.

    Returns:
        complex128 (n,); 1/2 where the three nodes coincide at zero.
    """
    widest = np.maximum(np.maximum(np.abs(ab), np.abs(ac)), np.abs(bc))
    close = widest < _SERIES_REACH
    if close.all():
        return exponentials[0] * _series(ab, ac, float(widest.max(initial=0.0)))
    values = np.empty(len(ab), dtype=np.complex128)
    values[close] = exponentials[0][close] * _series(ab[close], ac[close], _SERIES_REACH)
    apart = ~close
    a, b, c = (e[apart] for e in exponentials)
    values[apart] = _quotient(a, b, c, ab[apart], ac[apart], bc[apart])
    return values


def doubled_areas(corners: Corners) -> Reals:
    """Twice the area of each triangle (m,), to rounding even where its corners are nearly collinear.

    The edge vectors and their cross product are formed in double-double arithmetic: in plain
    doubles an aspect ratio of 1e6 costs six digits.
    """
    a, b, c = corners
    p = [compensated.two_sum(b[:, i], -a[:, i]) for i in range(3)]
    q = [compensated.two_sum(c[:, i], -a[:, i]) for i in range(3)]
    normal = []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        high, low = compensated.subtract(compensated.multiply(p[i], q[j]), compensated.multiply(p[j], q[i]))
        normal.append(high + low)
    return np.asarray(np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2))


def _vertex_exponentials(vertices: Reals, frequency: Reals) -> Complexes:
    """exp(-2πi ξ·p) at each vertex, with the phase reduced before it is rounded."""
    bound = float(np.abs(vertices).max(initial=0.0) * np.abs(frequency).sum())
    if bound <= _PLAIN_CYCLES:
        return np.asarray(np.exp(-2j * np.pi * (vertices @ frequency)))
    cycles: compensated.Pair = (np.zeros(len(vertices)), np.zeros(len(vertices)))
    for axis in range(3):
        high, low = compensated.two_product(vertices[:, axis], np.broadcast_to(frequency[axis], len(vertices)))
        high -= np.rint(high)  # exact, and whole turns do not change the exponential
        total, error = compensated.two_sum(cycles[0], high)
        cycles = total, cycles[1] + (error + low)
    return np.asarray(np.exp(-2j * np.pi * (cycles[0] + cycles[1])))


def _series(ab: Reals, ac: Reals, widest: float) -> Complexes:
    """Σ_n i^n h_n(0, ab, ac) / (n+2)!, with h_n the complete homogeneous symmetric polynomials."""
    total, mixed = ab + ac, ab * ac
    previous, current = np.zeros_like(ab), np.ones_like(ab)
    parts = [np.full_like(ab, 0.5), np.zeros_like(ab)]
    factor, n = 0.5, 0
    # |h_n| <= (n+1) widest^n: stop where the next term is below a tenth of a rounding error of 1/2.
    while (n + 2) * widest ** (n + 1) * factor / (n + 3) > 5e-18:
        n += 1
        factor /= n + 2
        previous, current = current, total * current - mixed * previous
        parts[n % 2] += (-factor if n % 4 >= 2 else factor) * current
    return parts[0] + 1j * parts[1]


def _quotient(a: Complexes, b: Complexes, c: Complexes, ab: Reals, ac: Reals, bc: Reals) -> Complexes:
    """The difference quotient of the two first differences that meet across the widest gap."""
    first = {"ab": _first_difference(a, b, ab), "ac": _first_difference(a, c, ac), "bc": _first_difference(b, c, bc)}
    sizes = np.abs(np.stack([ab, ac, bc]))
    widest = sizes.argmax(axis=0)
    numerators = np.stack([first["bc"] - first["ac"], first["bc"] - first["ab"], first["ac"] - first["ab"]])
    gaps = np.stack([ab, ac, bc])
    pick = (widest, np.arange(len(ab)))
    return np.asarray(numerators[pick] / (1j * gaps[pick]))


def _first_difference(a: Complexes, b: Complexes, gap: Reals) -> Complexes:
    """The first divided difference (exp(iβ) - exp(iα)) / (i (β - α))."""
    wide = np.abs(gap) > 1
    denominator = np.where(wide, gap, 1.0)
    near = a * np.exp(0.5j * gap) * np.sinc(gap / (2 * np.pi))
    return np.where(wide, (b - a) / (1j * denominator), near)
