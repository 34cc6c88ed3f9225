"""The exact Fourier transform of flat triangles, evaluated without loss of digits.

It costs O(triangles) per frequency, so it does not replace the NUFFT: it is the independent
formula that quadrature rules are rated with and that computed fields are checked against.

The transform of a triangle of area A is 2A times the second divided difference of exp at the
nodes -2πi ξ·p_j of its corners p_j (Hermite-Genocchi; C. de Boor, "Divided differences", 2005,
arXiv:math/0502036). The explicit quotient of exponentials cancels where two nodes are close, the
usual case on a fine mesh, hence two branches: a power series about the centroid where all three are
close, and the difference quotient of first differences across the widest gap elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.backends.phases import cosine_and_sine
from sobolev_batch.spectral.exact import compensated
from sobolev_batch.surfaces.shapes.mesh import Corners, Mesh

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Gaps below this (radians) go through the series: it then needs at most 19 terms, which take a fraction of
# the time of the quotient.
_SERIES_REACH = 2.0
# Below this many cycles a plain dot product keeps the phase of exp to 5e-14 radians.
_PLAIN_CYCLES = 16.0
# Triangles whose area is a smaller part of a squared edge than this lose digits in a plain cross product.
_FLATNESS = 1e-2
# Triangles at a time: their temporaries stay in cache.
_CHUNK = 1 << 13
# Pairs of a triangle and a frequency that are worth a pass of their own.
_PAIRS = 1 << 11


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
    columns = [np.ascontiguousarray(column) for column in mesh.vertices.T]

    def part(start: int) -> Complexes:
        a, b, c = (
            np.stack([column[index] for column in columns])
            for index in np.ascontiguousarray(mesh.triangles[start : start + _CHUNK].T)
        )
        return _sums((a, b, c), frequencies)

    parts = [part(start) for start in range(0, len(mesh.triangles), _CHUNK)]
    return np.asarray(np.sum(parts, axis=0, dtype=np.complex128))


def second_difference(ab: Reals, ac: Reals) -> Complexes:
    """The second divided difference of exp at three imaginary nodes iα, iβ, iγ whose mean is zero.

    Args:
        ab: the gap β - α in radians, (n,). Gaps are to be formed from edge vectors: differences of
            phases have lost the digits that the phases share.
        ac: the gap γ - α, likewise.

    Returns:
        complex128 (n,); 1/2 where the three nodes coincide.
    """
    widest = np.maximum(np.maximum(np.abs(ab), np.abs(ac)), np.abs(ac - ab))
    close = widest < _SERIES_REACH
    if close.all():
        return _joined(*_series(ab, ac, float(widest.max(initial=0.0))))
    values = np.empty(len(ab), dtype=np.complex128)
    values[close] = _joined(*_series(ab[close], ac[close], _SERIES_REACH))
    apart = ~close
    b, c = ab[apart], ac[apart]
    lowest = (b + c) / -3
    corners = np.exp(1j * lowest), np.exp(1j * (b + lowest)), np.exp(1j * (c + lowest))
    values[apart] = _quotient(corners, b, c)
    return values


def doubled_areas(corners: Corners) -> Reals:
    """Twice the area of each triangle (m,), to rounding even where its corners are nearly collinear.

    Args:
        corners: (3, m) each, one row an axis.

    On flat triangles the edge vectors and their cross product are formed in double-double
    arithmetic: in plain doubles an aspect ratio of 1e6 costs six digits.
    """
    a, b, c = corners
    (ux, uy, uz), (vx, vy, vz) = b - a, c - a
    doubled = np.sqrt((uy * vz - uz * vy) ** 2 + (uz * vx - ux * vz) ** 2 + (ux * vy - uy * vx) ** 2)
    flat = np.flatnonzero(doubled < _FLATNESS * (ux * ux + uy * uy + uz * uz + vx * vx + vy * vy + vz * vz))
    doubled[flat] = _doubled_areas_of_flat((a[:, flat], b[:, flat], c[:, flat]))
    return np.asarray(doubled)


def _doubled_areas_of_flat(corners: Corners) -> Reals:
    a, b, c = corners
    p = [compensated.two_sum(b[i], -a[i]) for i in range(3)]
    q = [compensated.two_sum(c[i], -a[i]) for i in range(3)]
    normal = []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        high, low = compensated.subtract(compensated.multiply(p[i], q[j]), compensated.multiply(p[j], q[i]))
        normal.append(high + low)
    return np.asarray(np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2))


def _sums(corners: Corners, frequencies: Reals) -> Complexes:
    """The transforms (P,) of triangles together, from their corners (3, k) each."""
    a, b, c = corners
    ab, ac = b - a, c - a
    doubled = doubled_areas(corners)
    longest = np.sqrt(max(float(np.einsum("ij,ij->j", side, side).max()) for side in (ab, ac, c - b)))
    centroids = a + (ab + ac) / 3
    reach = float(np.abs(centroids).max()) + longest
    values = np.empty(len(frequencies), dtype=np.complex128)
    # Of few triangles, several frequencies at a time: calls of NumPy would take longer than their work.
    step = max(1, _PAIRS // len(doubled))
    for first in range(0, len(frequencies), step):
        group = frequencies[first : first + step]
        plain = reach * float(np.abs(group).sum(axis=1).max()) <= _PLAIN_CYCLES
        widest = 2 * np.pi * float(np.linalg.norm(group, axis=1).max()) * longest
        if len(group) == 1:
            parts = _contributions(doubled, (centroids, a, b, c), (ab, ac), group[0], plain, widest)
        else:
            points, edges = (list(np.tile(rows, len(group))) for rows in ((centroids, a, b, c), (ab, ac)))
            each = np.repeat(group.T, len(doubled), axis=1)
            parts = _contributions(np.tile(doubled, len(group)), points, edges, each, plain, widest)
        real, imaginary = (part.reshape(len(group), -1).sum(axis=1) for part in parts)
        values[first : first + step] = _joined(real, imaginary)
    return values


def _contributions(
    doubled: Reals, points: Sequence[Reals], edges: Sequence[Reals], frequency: Reals, plain: bool, widest: float
) -> tuple[Reals, Reals]:
    """Real and imaginary part of each triangle's transform, at one frequency (3,) or one of its own each (3, k).

    Args:
        doubled: areas, twice (k,).
        points: centroids and the three corners, (3, k) each.
        edges: from the first corner to the second and to the third, likewise.
        frequency: ξ.
        plain: whether phases are small enough for plain dot products.
        widest: a bound on all gaps, in radians.
    """
    ab, ac = (_dots(-2 * np.pi * frequency, edge) for edge in edges)
    if widest < _SERIES_REACH:
        return _near(doubled, _phases(points[0], frequency, plain), ab, ac, widest)
    real, imaginary = np.empty_like(doubled), np.empty_like(doubled)
    close = np.maximum(np.maximum(np.abs(ab), np.abs(ac)), np.abs(ac - ab)) < _SERIES_REACH
    apart = ~close
    near, far = (frequency if frequency.ndim == 1 else frequency[:, part] for part in (close, apart))
    phases = _phases(points[0][:, close], near, plain)
    real[close], imaginary[close] = _near(doubled[close], phases, ab[close], ac[close], _SERIES_REACH)
    exponentials = [_joined(*cosine_and_sine(_phases(corner[:, apart], far, plain))) for corner in points[1:]]
    quotients = doubled[apart] * _quotient(exponentials, ab[apart], ac[apart])
    real[apart], imaginary[apart] = quotients.real, quotients.imag
    return real, imaginary


def _near(doubled: Reals, phases: Reals, ab: Reals, ac: Reals, widest: float) -> tuple[Reals, Reals]:
    """The same for triangles whose gaps are small, from the phases of their centroids."""
    cosines, sines = (doubled * part for part in cosine_and_sine(phases))
    real, imaginary = _series(ab, ac, widest)
    return cosines * real - sines * imaginary, cosines * imaginary + sines * real


def _dots(direction: Reals, points: Reals) -> Reals:
    """Dot products of one vector (3,), or as many (3, k), with points (3, k).

    For so few numbers, threads of a BLAS only get in the way.
    """
    return np.asarray(direction[0] * points[0] + direction[1] * points[1] + direction[2] * points[2])


def _phases(points: Reals, frequency: Reals, plain: bool) -> Reals:
    """-2π ξ·p at points (3, k), in radians; where that is not plain, whole turns are taken off before rounding."""
    if plain:
        return _dots(-2 * np.pi * frequency, points)
    cycles: compensated.Pair = (np.zeros(points.shape[1]), np.zeros(points.shape[1]))
    for axis in range(3):
        high, low = compensated.two_product(points[axis], np.broadcast_to(frequency[axis], points.shape[1]))
        high -= np.rint(high)  # exact, and whole turns do not change the exponential
        total, error = compensated.two_sum(cycles[0], high)
        cycles = total, cycles[1] + (error + low)
    return np.asarray(-2 * np.pi * (cycles[0] + cycles[1]))


def _series(ab: Reals, ac: Reals, widest: float) -> tuple[Reals, Reals]:
    """Real and imaginary part of Σ_n i^n h_n / (n+2)!, h_n the complete homogeneous symmetric polynomials.

    With the nodes' mean at zero, h_n = p h_(n-2) + q h_(n-3) for p = Σ node²/2 and q their product.
    """
    lowest = (ab + ac) / -3
    p = (ab * (ab - ac) + ac * ac) / 3
    q = lowest * (ab + lowest) * (ac + lowest)
    before, previous, current = np.ones_like(ab), np.zeros_like(ab), p
    real, imaginary = 0.5 - p / 24, np.zeros_like(ab)
    factor, n = 1 / 24, 2
    # |h_n| <= 2 (widest · 2/3)^n: stop where the next term is below half a rounding error of 1/2.
    while 2 * (widest * 2 / 3) ** (n + 1) * factor / (n + 3) > 2e-17:
        n += 1
        factor /= n + 2
        before, previous, current = previous, current, p * previous + q * before
        target = imaginary if n % 2 else real
        target += (-factor if n % 4 >= 2 else factor) * current
    return real, imaginary


def _quotient(exponentials: Sequence[Complexes], ab: Reals, ac: Reals) -> Complexes:
    """The difference quotient of the two first differences that meet across the widest gap."""
    a, b, c = exponentials
    gaps = np.stack([ab, ac, ac - ab])
    of_ab, of_ac, of_bc = _first_difference(a, b, ab), _first_difference(a, c, ac), _first_difference(b, c, gaps[2])
    numerators = np.stack([of_bc - of_ac, of_bc - of_ab, of_ac - of_ab])
    pick = (np.abs(gaps).argmax(axis=0), np.arange(len(ab)))
    return np.asarray(numerators[pick] / (1j * gaps[pick]))


def _first_difference(a: Complexes, b: Complexes, gap: Reals) -> Complexes:
    """The first divided difference (exp(iβ) - exp(iα)) / (i (β - α))."""
    wide = np.abs(gap) > 1
    denominator = np.where(wide, gap, 1.0)
    near = a * np.exp(0.5j * gap) * np.sinc(gap / (2 * np.pi))
    return np.where(wide, (b - a) / (1j * denominator), near)


def _joined(real: Reals, imaginary: Reals) -> Complexes:
    return real + 1j * imaginary
