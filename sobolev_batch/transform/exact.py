"""Exact Fourier transforms of flat triangles, evaluated without loss of digits.

They cost O(triangles) for each frequency: they do not replace the NUFFT, but rate quadrature rules and check fields.

The transform of a triangle of area A is 2A times the second divided difference of exp at the nodes -2πi ξ·p_j of its
corners p_j (Hermite-Genocchi; C. de Boor, "Divided differences", 2005, arXiv:math/0502036). It is a plain sum of the
exponentials at the corners, which neighbouring triangles share. Where nodes are close, that sum cancels. Then it is a
power series about one of them if all three are close, else the difference quotient of first differences across the
widest gap.

Where digits would be lost, sums and products carry their rounding errors: T. J. Dekker, "A floating-point technique for
extending the available precision" (1971), doi:10.1007/BF01397083; T. Ogita, S. M. Rump, S. Oishi, "Accurate sum and dot
product" (2005), doi:10.1137/030601818. That is valid without over- and underflow.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice, product

import numpy as np

from sobolev_batch.arrays import Array, Complexes, Reals, slices
from sobolev_batch.compiled import pays
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.transform.backends import CPU, Backend, combine, compute_on, cosine_and_sine, sums_at

# A number as a rounded value and what it lacks.
Pair = tuple[Array, Array]

# Gaps below this (radians) go through the series: at most 18 terms, and a fraction of the time of the quotient.
_SERIES_GAP = 1.0
# Where all gaps are below this, nearly all go through it.
_FINE = 0.5
# A product of gaps below this, beside one and the squares of two of them, goes through the stable form: the plain sum
# would lose as many digits.
_LEAST_PRODUCT = 2e-3
# Below this many cycles a plain dot product keeps the phase of exp to 5e-14 radians.
_PLAIN_CYCLES = 16.0
# Triangles whose area is a smaller fraction of their squared centroid radius lose digits in a plain cross product.
_FLATNESS = 2.5e-2
# Triangles at a time, and those in compiled loops: temporaries, and exponentials at vertices, stay in cache.
_BATCH, _COMPILED_BATCH = 1 << 13, 1 << 12
# Batches of compiled loops in memory for each thread.
_AT_A_TIME = 16
# Most pairs of a triangle and a frequency at a time, and most triangles: temporaries stay small.
_PAIRS = {"cpu": 1 << 14, "gpu": 1 << 22}
# With fewer pairs a GPU takes longer than compiled loops on the processor.
_FEWEST_FOR_GPU = 1 << 21
# Compiled loops take frequencies in vectors of this many: 7 further ones would take three times as long as 8.
_VECTOR = 8
# With fewer frequencies for each thread, threads take different triangles instead.
_FEWEST_PER_THREAD = 32
# Processor time of a pair of a triangle and a frequency on arrays, at least.
_PAIR_SECONDS = 4e-8
# Splits a double into halves of 26 bits each.
_SPLITTER = 2.0**27 + 1


def exact_transform(mesh: Mesh, frequencies: Reals, backend: Backend = CPU, threads: int = 1) -> Complexes:
    """Return the transform ∫ exp(-2πi ξ·x) dμ(x) of a mesh's area measure, free of quadrature error.

    For ξ, float64 (P, 3), in cycles per unit length, it is complex128 (P,). The error of each triangle is some 1e-15 of
    its area, and at most about 1e-12 of its contribution; the area itself is exact to rounding even on slivers. A GPU
    and compiled loops change the last digits; threads, which these loops take, do not.
    """
    frequencies = np.asarray(frequencies, dtype=np.float64)
    pairs, doubled = len(mesh.triangles) * len(frequencies), doubled_areas(mesh)
    if backend is CPU and pays(_PAIR_SECONDS * pairs):
        return _in_loops(mesh, doubled, frequencies, threads)

    def sums(backend: Backend) -> Complexes:
        total, size = np.zeros(len(frequencies), dtype=np.complex128), _PAIRS[backend.name]
        widest = 2 * np.pi * mesh.edge_length_range[1] * float(np.linalg.norm(frequencies, axis=1).max())
        for number, batch in mesh.batches(size):
            areas, reach = doubled[number * size :][: len(batch.triangles)], float(np.abs(batch.vertices).max())
            arrays = [batch.vertices.T.copy(), batch.triangles.T.copy(), areas]
            if widest >= _FINE:
                a, b, c = np.moveaxis(arrays[0][:, arrays[1]], 1, 0)
                arrays.append(np.stack([b - a, c - b]))
            faces, step = [*map(backend.upload, arrays)], max(1, size // len(batch.triangles))
            groups = (frequencies[part] for part in slices(len(frequencies), step))
            total += np.concatenate([backend.download(_sums(faces, group, reach, widest)) for group in groups])
        return total

    return compute_on(backend if pairs >= _FEWEST_FOR_GPU else CPU, sums) if pairs else np.zeros(0, np.complex128)


def _in_loops(mesh: Mesh, doubled: Reals, frequencies: Reals, threads: int) -> Complexes:
    """Return the same by compiled loops, whose digits do not depend on the threads."""
    from sobolev_batch.compiled.divided_differences import exact_sums

    parts = np.array_split(frequencies, threads if len(frequencies) >= _FEWEST_PER_THREAD * threads else 1)
    # Sums of sums round less often.
    batches, totals = mesh.batches(_COMPILED_BATCH), [np.zeros(len(part), dtype=np.complex128) for part in parts]

    def of_part(part: Reals, number: int, batch: Mesh) -> Complexes:
        rows = np.pad(part, ((0, -len(part) % _VECTOR), (0, 0)), mode="edge").T.copy()
        areas = doubled[number * _COMPILED_BATCH :][: len(batch.triangles)]
        return exact_sums(batch.vertices, batch.triangles, areas, rows)[: len(part)]

    with ThreadPoolExecutor(threads) as pool:
        # Few copies of triangles are in memory.
        while group := list(islice(batches, _AT_A_TIME * threads)):
            found = pool.map(lambda task: of_part(task[0], *task[1]), product(parts, group))
            for total in totals:
                for sums in islice(found, len(group)):
                    total += sums
    return np.concatenate(totals)


def _sums(faces: Sequence[Array], frequencies: Reals, reach: float, widest: float) -> Array:
    """Return sums (P,) over faces up to some coordinate, with phases at corners that are up to some radians apart.

    They are vertices (3, n), corners (3, m), twice the areas (m,) and, unless phases are close, two edges (2, 3, m).
    """
    (vertices, corners, doubled), (a, b, c) = faces[:3], faces[1]
    is_plain = reach * float(np.abs(frequencies).sum(axis=1).max()) <= _PLAIN_CYCLES
    phases, parts = _phases(vertices, frequencies, is_plain), list[Array]()
    exponentials = cosine_and_sine(phases)
    if widest < _FINE:
        at_a, at_b, at_c = (np.take(phases, corner, axis=1) for corner in corners)
        gaps = at_a - at_b, at_c - at_b
        if not is_plain:
            gaps = tuple(gap - 2 * np.pi * np.rint(gap / (2 * np.pi)) for gap in gaps)
        terms = _by_series([np.take(values, b, axis=1) for values in exponentials], *gaps, widest)
        real, imaginary = ((of_pairs * doubled).sum(axis=1) for of_pairs in terms)
        return real + 1j * imaginary
    # From the edges, since differences of phases lose what the phases share.
    first, second = (combine(-2 * np.pi * frequencies, edge) for edge in faces[3])
    product = first * second
    product *= first + second
    is_close = np.abs(product) < _LEAST_PRODUCT * (1 + first * first + second * second)
    product[is_close] = np.inf
    factors = doubled / product
    # The divided difference is (e_a g_bc + e_b g_ca + e_c g_ab) / (g_ab g_bc g_ca); the gaps g add up to zero.
    for values in exponentials:
        middle = np.take(values, b, axis=1)
        before, after = np.take(values, a, axis=1), np.take(values, c, axis=1)
        before -= middle
        before *= second
        after -= middle
        after *= first
        before += after
        before *= factors
        parts.append(before.sum(axis=1))
    rows, columns = np.nonzero(is_close)
    corners = [[values[rows, corner[columns]] for values in exponentials] for corner in (a, b, c)]
    terms = second_difference(corners, first[rows, columns], second[rows, columns])
    real, imaginary = (sums_at(rows, doubled[columns] * of_pairs, len(frequencies)) for of_pairs in terms)
    return (real - parts[0]) + 1j * (imaginary - parts[1])


def _phases(points: Array, frequencies: Reals, is_plain: bool) -> Array:
    """Return -2π ξ·p (P, n) at points (3, n), in radians; those that are not plain lack some whole cycles."""
    if is_plain:
        return combine(-2 * np.pi * frequencies, points)
    (highs, lows), (high_rates, low_rates) = _halves(points), _halves(frequencies)
    cycles = combine(low_rates, highs) + combine(frequencies, lows)
    for axis in range(3):
        exact = combine(high_rates[:, axis, None], highs[axis, None])
        exact -= np.rint(exact)  # whole cycles do not change the exponential
        cycles += exact
    return -2 * np.pi * cycles


def second_difference(corners: Sequence[Sequence[Array]], ab: Array, bc: Array) -> Pair:
    """Return the second divided difference of exp at imaginary nodes iα, iβ, iγ, whatever their gaps.

    Its real and imaginary part (n,) follow from those of the exponentials, and the gaps β - α and γ - β in radians.
    """
    widest = np.maximum(np.maximum(np.abs(ab), np.abs(bc)), np.abs(ab + bc))
    close = widest < _SERIES_GAP
    apart, (p, q), (real, imaginary) = ~close, (-ab[close], bc[close]), (np.empty_like(ab), np.empty_like(ab))
    most = float(widest[close].max()) if len(p) else 0.0
    real[close], imaginary[close] = _by_series([part[close] for part in corners[1]], p, q, most)
    quotients = _quotient([real[apart] + 1j * imaginary[apart] for real, imaginary in corners], ab[apart], bc[apart])
    real[apart], imaginary[apart] = quotients.real, quotients.imag
    return real, imaginary


def _by_series(middle: Sequence[Array], p: Array, q: Array, widest: float) -> Pair:
    """Return the same from the exponential at the middle node, and how far the others are from it: all gaps are small.

    It is Σ_n i^n h_n / (n+2)!, with h_n = (p + q) h_(n-1) - pq h_(n-2) the complete homogeneous symmetric polynomials.
    """
    total, product, n = p + q, p * q, 2
    even, odd, real, imaginary = np.ones_like(p), 1 * total, 0.5, total / 6
    # |h_n| <= (n + 1) widest^n: stop where a term is below half a rounding error of 1/2.
    while (n + 1) * widest**n / math.factorial(n + 2) > 2e-17:
        even *= product
        even -= total * odd
        real += even / math.factorial(n + 2)
        odd *= product
        odd += total * even
        imaginary += odd / math.factorial(n + 3)
        n += 2
    return middle[0] * real - middle[1] * imaginary, middle[0] * imaginary + middle[1] * real


def doubled_areas(mesh: Mesh) -> Reals:
    """Return twice the area of each triangle (m,), to rounding even if its corners are nearly collinear.

    On flat triangles the edge vectors and their cross product are formed in double-double arithmetic: in doubles, an
    aspect ratio of 1e6 costs six digits.
    """
    doubled = 2 * mesh.areas
    is_flat, y, z = mesh.areas < _FLATNESS * mesh.centroid_radii**2, [1, 2, 0], [2, 0, 1]
    for batch in slices(len(doubled), _BATCH):
        flat = batch.start + np.flatnonzero(is_flat[batch])
        a, b, c = (corner.T for corner in mesh.corners(flat))
        (p, p_low), (q, q_low) = _two_sum(b, -a), _two_sum(c, -a)
        forward, backward = _multiply((p[y], p_low[y]), (q[z], q_low[z])), _multiply((p[z], p_low[z]), (q[y], q_low[y]))
        high, low = _two_sum(forward[0], -backward[0])
        high, low = _two_sum(high, low + (forward[1] - backward[1]))
        doubled[flat] = np.sqrt(((high + low) ** 2).sum(axis=0))
    return doubled


def _quotient(exponentials: Sequence[Array], ab: Array, bc: Array) -> Array:
    """Return the difference quotient of the two first differences that meet across the widest gap."""
    a, b, c = exponentials
    ac = ab + bc
    of_ab, of_ac, of_bc = _first_difference(a, b, ab), _first_difference(a, c, ac), _first_difference(b, c, bc)
    across_ab = np.abs(ab) >= np.maximum(np.abs(ac), np.abs(bc))
    across_ac = np.abs(ac) >= np.abs(bc)
    numerator = np.where(across_ab, of_bc - of_ac, np.where(across_ac, of_bc - of_ab, of_ac - of_ab))
    return numerator / (1j * np.where(across_ab, ab, np.where(across_ac, ac, bc)))


def _first_difference(a: Array, b: Array, gap: Array) -> Array:
    """Return the first divided difference (exp(iβ) - exp(iα)) / (i (β - α))."""
    wide = np.abs(gap) > 1
    near = a * np.exp(0.5j * gap) * np.sinc(gap / (2 * np.pi))
    return np.where(wide, (b - a) / (1j * np.where(wide, gap, 1.0)), near)


def _two_sum(a: Array, b: Array) -> Pair:
    """Return the rounded sum and its rounding error: a + b = high + low exactly."""
    high = a + b
    shadow = high - a
    return high, (a - (high - shadow)) + (b - shadow)


def _multiply(a: Pair, b: Pair) -> Pair:
    """Return the product of two double-double numbers, to about twice double precision."""
    high, (a_high, a_low), (b_high, b_low) = a[0] * b[0], _halves(a[0]), _halves(b[0])
    # What the rounded product of the first numbers lacks.
    low = a_low * b_low - (((high - a_high * b_high) - a_low * b_high) - a_high * b_low)
    return _two_sum(high, low + (a[0] * b[1] + a[1] * b[0]))


def _halves(a: Array) -> Pair:
    shifted = _SPLITTER * a
    high = shifted - (shifted - a)
    return high, a - high
