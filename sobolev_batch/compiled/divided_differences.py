"""Transforms of triangles as compiled loops: the formulas of `sobolev_batch.transform.exact`, frequency by frequency.

The inner loop of each sum runs over some frequencies, so that a processor takes several of them at a time and loads
corners and edges once for all. Phases are counted in cycles, and whole cycles are subtracted exactly.
"""

import math
from typing import Any

import numpy as np

from sobolev_batch.arrays import Complexes, Indices, Reals
from sobolev_batch.compiled import loop, part

_TURN = 2 * math.pi
# Taylor coefficients of sin(2πx)/x and cos(2πx) in x²: up to a quarter of a cycle the rest is below 2e-17.
_SINE = tuple((-1) ** n * _TURN ** (2 * n + 1) / math.factorial(2 * n + 1) for n in range(11))
_COSINE = tuple((-1) ** n * _TURN ** (2 * n) / math.factorial(2 * n) for n in range(12))
# The series in gaps below this (radians) takes 18 terms i^n h_n / (n+2)!.
_SERIES_GAP = 1.0
_FACTORS = np.array([1 / math.factorial(n + 2) for n in range(18)])
# See `sobolev_batch.transform.exact`.
_LEAST_PRODUCT = 2e-3
# Where no gap is as wide at any frequency: the square of the product of edge and frequency.
_FINE_SQUARE = (_SERIES_GAP / _TURN) ** 2
# Frequencies at a time: the exponentials at some thousand vertices stay in a processor's cache.
_LANES = 32
# Splits a double into halves of 26 bits each.
_SPLITTER = 2.0**27 + 1
_Edges = tuple[float, float, float, float, float, float]


@part
def _cosine_and_sine(cycles: float) -> tuple[float, float]:
    halves = np.floor(2 * cycles + 0.5)
    rest = cycles - 0.5 * halves
    square = rest * rest
    sine, cosine = _SINE[10], _COSINE[11]
    for n in range(10):
        sine = sine * square + _SINE[9 - n]
    for n in range(11):
        cosine = cosine * square + _COSINE[10 - n]
    sign = 1 - 2 * (halves - 2 * np.floor(0.5 * halves))
    return sign * cosine, sign * rest * sine


@loop
def _high(a: Any) -> Any:
    """Return numbers without its lower 26 bits."""
    shifted = _SPLITTER * a
    return shifted - (shifted - a)


@part
def _rest(x: float, x_high: float, u: float, u_high: float) -> Any:
    """Return a product without whole cycles; that of the higher halves is exact."""
    exact = x_high * u_high
    return exact - np.floor(exact + 0.5) + (x_high * (u - u_high) + (x - x_high) * u)


@part
def _series(p: float, q: float) -> tuple[float, float]:
    """Return the sum of i^n h_n / (n+2)!, for h_n = (p + q) h_(n-1) - pq h_(n-2)."""
    total, product = p + q, p * q
    even, odd = 1.0, total
    real, imaginary = _FACTORS[0], _FACTORS[1] * total
    for n in range(2, 18, 2):
        even = product * even - total * odd
        odd = product * odd + total * even
        real += _FACTORS[n] * even
        imaginary += _FACTORS[n + 1] * odd
    return real, imaginary


@part
def _first_difference(a: complex, b: complex, gap: float) -> complex:
    if abs(gap) > 1:
        return (b - a) / (1j * gap)
    cosine, sine = _cosine_and_sine(gap / (2 * _TURN))
    return a * complex(cosine, sine) * (sine / (gap / 2) if gap else 1.0)


@part
def _stable(a: complex, b: complex, c: complex, ab: float, bc: float, ac: float) -> complex:
    """Return the divided difference: a series, or the quotient of the two first ones that meet at the widest gap."""
    if max(abs(ab), abs(bc), abs(ac)) < _SERIES_GAP:
        return b * complex(*_series(-ab, bc))
    of_ab, of_ac, of_bc = _first_difference(a, b, ab), _first_difference(a, c, ac), _first_difference(b, c, bc)
    if abs(ab) >= max(abs(ac), abs(bc)):
        return (of_bc - of_ac) / (1j * ab)
    if abs(ac) >= abs(bc):
        return (of_bc - of_ab) / (1j * ac)
    return (of_ac - of_ab) / (1j * bc)


@part
def _edges(vertices: Reals, triangle: Indices) -> _Edges:
    """Return the edge from the first corner to the second, and from there to the third."""
    a, b, c = vertices[triangle[0]], vertices[triangle[1]], vertices[triangle[2]]
    return b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - b[0], c[1] - b[1], c[2] - b[2]


@part
def _longest_square(edges: _Edges) -> float:
    px, py, pz, qx, qy, qz = edges
    third = (px + qx) ** 2 + (py + qy) ** 2 + (pz + qz) ** 2
    return max(px * px + py * py + pz * pz, qx * qx + qy * qy + qz * qz, third)


@part
def _gaps(edges: _Edges, u: float, v: float, w: float) -> tuple[float, float, float]:
    """Return the gaps along both edges, and along both together, in radians."""
    ab = -_TURN * (u * edges[0] + v * edges[1] + w * edges[2])
    bc = -_TURN * (u * edges[3] + v * edges[4] + w * edges[5])
    return ab, bc, ab + bc


@part
def _is_thin(ab: float, bc: float, ac: float) -> bool:
    return abs(ab * bc * ac) < _LEAST_PRODUCT * (1 + ab * ab + bc * bc)


@loop
def exact_sums(vertices: Reals, triangles: Indices, doubled: Reals, frequencies: Reals) -> Complexes:
    """Return the sums (P,) of the transforms of triangles, each to some rounding errors of its area.

    The vertices are (n, 3), the triangles (k, 3), twice their areas (k,), and the frequencies (3, P).
    """
    sums = np.empty(frequencies.shape[1], dtype=np.complex128)
    cosines, sines = np.empty((len(vertices), _LANES)), np.empty((len(vertices), _LANES))
    for first in range(0, len(sums), _LANES):
        last = min(first + _LANES, len(sums))
        u, v, w = frequencies[0, first:last], frequencies[1, first:last], frequencies[2, first:last]
        highest, u_high, v_high, w_high = np.max(u * u + v * v + w * w), _high(u), _high(v), _high(w)
        for i in range(len(vertices)):
            x, y, z = vertices[i]
            x_high, y_high, z_high = _high(x), _high(y), _high(z)
            for f in range(len(u)):
                rests = _rest(x, x_high, u[f], u_high[f]) + _rest(y, y_high, v[f], v_high[f])
                cosines[i, f], sines[i, f] = _cosine_and_sine(-(rests + _rest(z, z_high, w[f], w_high[f])))
        # Of two rows of one array LLVM would make no vectors.
        reals, imaginaries = np.zeros(len(u)), np.zeros(len(u))
        for i in range(len(triangles)):
            a, b, c = triangles[i]
            edges, area, thin = _edges(vertices, triangles[i]), doubled[i], 0
            if _longest_square(edges) * highest < _FINE_SQUARE:
                for f in range(len(u)):
                    ab, bc, _ = _gaps(edges, u[f], v[f], w[f])
                    real, imaginary = _series(-ab, bc)
                    reals[f] += area * (cosines[b, f] * real - sines[b, f] * imaginary)
                    imaginaries[f] += area * (cosines[b, f] * imaginary + sines[b, f] * real)
                continue
            for f in range(len(u)):
                ab, bc, ac = _gaps(edges, u[f], v[f], w[f])
                is_thin = _is_thin(ab, bc, ac)
                thin += is_thin
                factor = 0.0 if is_thin else area / (ab * bc * ac)
                middle, imaginary = cosines[b, f], sines[b, f]
                reals[f] -= ((cosines[a, f] - middle) * bc + (cosines[c, f] - middle) * ab) * factor
                imaginaries[f] -= ((sines[a, f] - imaginary) * bc + (sines[c, f] - imaginary) * ab) * factor
            if thin:
                for f in range(len(u)):
                    ab, bc, ac = _gaps(edges, u[f], v[f], w[f])
                    if _is_thin(ab, bc, ac):
                        at_a, at_b = complex(cosines[a, f], sines[a, f]), complex(cosines[b, f], sines[b, f])
                        value = area * _stable(at_a, at_b, complex(cosines[c, f], sines[c, f]), ab, bc, ac)
                        reals[f] += value.real
                        imaginaries[f] += value.imag
        for f in range(len(u)):
            sums[first + f] = complex(reals[f], imaginaries[f])
    return sums
