"""Exact Fourier transforms of flat triangles, evaluated without loss of digits.

They cost O(triangles) for each frequency: they do not replace the NUFFT, but rate quadrature rules and check fields.

The transform of a triangle of area A is 2A times the second divided difference of exp at the nodes -2πi ξ·p_j of its
corners p_j (Hermite-Genocchi; C. de Boor, "Divided differences", 2005, arXiv:math/0502036). The explicit quotient of
exponentials cancels if two nodes are close, the usual case on a fine mesh. Hence two branches: a power series about
the centroid if all three are close, else the difference quotient of first differences across the widest gap.

Where digits would be lost, sums and products carry their rounding errors: T. J. Dekker, "A floating-point technique for
extending the available precision" (1971), doi:10.1007/BF01397083; T. Ogita, S. M. Rump, S. Oishi, "Accurate sum and dot
product" (2005), doi:10.1137/030601818. That is valid without over- and underflow.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np

from sobolev_batch.arrays import Array, Complexes, Reals, slices
from sobolev_batch.compiled import pays
from sobolev_batch.geometry.mesh import Mesh, dot
from sobolev_batch.transform.backends import CPU, Backend, combine, compute_on, cosine_and_sine, sums_at

# A number as a rounded value and what it lacks.
Pair = tuple[Array, Array]

# Gaps below this (radians) go through the series: at most 19 terms, and a fraction of the time of the quotient.
_SERIES_GAP = 2.0
# Below this many cycles a plain dot product keeps the phase of exp to 5e-14 radians.
_PLAIN_CYCLES = 16.0
# Triangles whose area is a smaller fraction of their squared centroid radius lose digits in a plain cross product.
_FLATNESS = 2.5e-2
# Triangles at a time: their temporaries stay in a processor's cache.
_BATCH = {"cpu": 1 << 13, "gpu": 1 << 18}
# Pairs of a triangle and a frequency for each pass: with fewer, calls of NumPy and CuPy take longer than their work.
_PAIRS = {"cpu": 1 << 11, "gpu": 1 << 21}
# With fewer pairs a GPU takes longer than compiled loops on the processor.
_FEWEST_FOR_GPU = 1 << 21
# Triangles at a time in compiled loops: the exponentials at their vertices stay in a processor's cache.
_COMPILED_BATCH = 1 << 12
# Compiled loops take frequencies in vectors of this many: 7 further ones would take three times as long as 8.
_VECTOR = 8
# With fewer frequencies for each thread, threads take different triangles instead.
_FEWEST_PER_THREAD = 32
# A product of gaps below this (radians cubed) goes through the stable form: the plain one would lose as many digits.
_LEAST_PRODUCT = 2e-3
# If the longest edge is below this many radians, most triangles would go through the stable form.
_FINE_MESH = 0.5
# Most pairs of a triangle and a frequency at a time in `sampled_transform`, and most triangles: temporaries stay small.
_SAMPLED_PAIRS = {"cpu": 1 << 14, "gpu": 1 << 22}
# Processor time of a pair of a triangle and a frequency on arrays, at least.
_PAIR_SECONDS = 4e-8
# Splits a double into halves of 26 bits each.
_SPLITTER = 2.0**27 + 1


def exact_transform(mesh: Mesh, frequencies: Reals, backend: Backend = CPU, threads: int = 1) -> Complexes:
    """Return the transform ∫ exp(-2πi ξ·x) dμ(x) of a mesh's area measure, free of quadrature error.

    For ξ, float64 (P, 3), in cycles per unit length, it is complex128 (P,). The error of each triangle is about 1e-15
    of its contribution, or of its area if that is smaller; the area itself is exact to rounding even on slivers. A GPU
    and compiled loops change the last digits; threads, which these loops take, do not.
    """
    frequencies = np.asarray(frequencies, dtype=np.float64)
    columns = [np.ascontiguousarray(column) for column in mesh.vertices.T]

    def sums(backend: Backend) -> Complexes:
        if backend is CPU and pays(_PAIR_SECONDS * len(mesh.triangles) * len(frequencies)):
            return _compiled_exact_transform(mesh, frequencies, threads)
        doubled, parts = doubled_areas(mesh), []
        for batch in slices(len(mesh.triangles), _BATCH[backend.name]):
            rows = np.ascontiguousarray(mesh.triangles[batch].T)
            corners = np.stack([[column[index] for column in columns] for index in rows])
            parts.append(_sums(corners, doubled[batch], frequencies, backend))
        return np.asarray(np.sum(parts, axis=0, dtype=np.complex128))

    return compute_on(backend if len(mesh.triangles) * len(frequencies) >= _FEWEST_FOR_GPU else CPU, sums)


def _compiled_exact_transform(mesh: Mesh, frequencies: Reals, threads: int) -> Complexes:
    from sobolev_batch.compiled.divided_differences import exact_sums

    doubled = doubled_areas(mesh)
    # Sums of sums round less often.
    batches = slices(len(doubled), _COMPILED_BATCH)
    faces = [(mesh.vertices, mesh.triangles[batch], doubled[batch]) for batch in batches]
    return _by_threads(exact_sums, faces, frequencies, threads)


def _compiled_sampled_transform(mesh: Mesh, frequencies: Reals, threads: int) -> Complexes:
    from sobolev_batch.compiled.divided_differences import sampled_sums

    doubled, total = doubled_areas(mesh), np.zeros(len(frequencies), dtype=np.complex128)
    for number, batch in mesh.batches(_COMPILED_BATCH):
        faces = batch.vertices, batch.triangles, doubled[number * _COMPILED_BATCH :][: len(batch.triangles)]
        total += _by_threads(sampled_sums, [faces], frequencies, threads)
    return total


def _by_threads(
    sums: Callable[..., Complexes], faces: Sequence[tuple[Array, ...]], frequencies: Reals, threads: int
) -> Complexes:
    """Return the sums (P,) of batches of faces at frequencies (P, 3), whose digits do not depend on the threads."""
    parts = np.array_split(frequencies, threads if len(frequencies) >= _FEWEST_PER_THREAD * threads else 1)

    def over_faces(part: Reals) -> Iterator[Complexes]:
        rows = np.zeros((3, -(-len(part) // _VECTOR) * _VECTOR))
        rows[:, : len(part)] = part.T
        return each(lambda batch: sums(*batch, rows)[: len(part)], faces)

    with ThreadPoolExecutor(threads) as pool:
        each = pool.map if threads > 1 and len(parts) * len(faces) > 1 else map
        found = [over_faces(part) for part in parts]
        totals = [sum(of_part, np.zeros(len(part), np.complex128)) for of_part, part in zip(found, parts, strict=True)]
    return np.concatenate(totals)


def second_difference(ab: Array, ac: Array) -> Array:
    """Return the second divided difference of exp at imaginary nodes iα, iβ, iγ whose mean is zero, complex128 (n,).

    The gaps are β - α and γ - α in radians (n,). Form them from edge vectors: differences of phases have lost the
    digits that the phases share. If the three nodes coincide, the value is 1/2.
    """
    widest = np.maximum(np.maximum(np.abs(ab), np.abs(ac)), np.abs(ac - ab))
    most = float(widest.max()) if len(widest) else 0.0
    if most < _SERIES_GAP:
        real, imaginary = _series(ab, ac, most)
        return real + 1j * imaginary
    close = widest < _SERIES_GAP
    values = np.empty(len(ab), dtype=np.complex128, like=ab)
    real, imaginary = _series(ab[close], ac[close], _SERIES_GAP)
    values[close] = real + 1j * imaginary
    apart = ~close
    b, c = ab[apart], ac[apart]
    lowest = (b + c) / -3
    corners = np.exp(1j * lowest), np.exp(1j * (b + lowest)), np.exp(1j * (c + lowest))
    values[apart] = _quotient(corners, b, c)
    return values


def doubled_areas(mesh: Mesh) -> Reals:
    """Return twice the area of each triangle (m,), to rounding even if its corners are nearly collinear.

    On flat triangles the edge vectors and their cross product are formed in double-double arithmetic: in doubles, an
    aspect ratio of 1e6 costs six digits.
    """
    doubled = 2 * mesh.areas
    is_flat, y, z = mesh.areas < _FLATNESS * mesh.centroid_radii**2, [1, 2, 0], [2, 0, 1]
    for batch in slices(len(doubled), _BATCH["cpu"]):
        flat = batch.start + np.flatnonzero(is_flat[batch])
        a, b, c = (corner.T for corner in mesh.corners(flat))
        (p, p_low), (q, q_low) = _two_sum(b, -a), _two_sum(c, -a)
        forward, backward = _multiply((p[y], p_low[y]), (q[z], q_low[z])), _multiply((p[z], p_low[z]), (q[y], q_low[y]))
        high, low = _two_sum(forward[0], -backward[0])
        high, low = _two_sum(high, low + (forward[1] - backward[1]))
        doubled[flat] = np.sqrt(((high + low) ** 2).sum(axis=0))
    return doubled


def _sums(corners: Reals, doubled: Reals, frequencies: Reals, backend: Backend) -> Complexes:
    """Return the transform (P,) of triangles by their corners (3, 3, k), axis by axis, and twice their areas (k,)."""
    a, b, c = corners
    ab, ac = b - a, c - a
    longest = np.sqrt(max(float(np.einsum("ij,ij->j", side, side).max()) for side in (ab, ac, c - b)))
    centroids = a + (ab + ac) / 3
    farthest = float(np.abs(centroids).max()) + longest
    doubled = backend.upload(doubled)
    points, edges = (backend.upload(np.stack(rows)) for rows in ((centroids, a, b, c), (ab, ac)))
    parts = []
    # For few triangles, take several frequencies at a time.
    step = max(1, _PAIRS[backend.name] // len(doubled))
    for group in (frequencies[part] for part in slices(len(frequencies), step)):
        plain = farthest * float(np.abs(group).sum(axis=1).max()) <= _PLAIN_CYCLES
        widest = 2 * np.pi * float(np.linalg.norm(group, axis=1).max()) * longest
        if len(group) == 1:
            contributions = _contributions(doubled, points, edges, group[0], plain, widest)
        else:
            all_points, all_edges = (np.tile(rows, len(group)) for rows in (points, edges))
            repeated = np.repeat(backend.upload(group).T, len(doubled), axis=1)
            contributions = _contributions(np.tile(doubled, len(group)), all_points, all_edges, repeated, plain, widest)
        real, imaginary = (values.reshape(len(group), -1).sum(axis=1) for values in contributions)
        parts.append(backend.download(real + 1j * imaginary))
    return np.concatenate(parts) if parts else np.empty(0, dtype=np.complex128)


def _contributions(
    doubled: Array, points: Array, edges: Array, frequency: Array, plain: bool, widest: float
) -> tuple[Array, Array]:
    """Return real and imaginary parts of the transform of each triangle, at ξ (3,) for all or (3, k) for each.

    The points are centroids and the three corners, the edges those from the first corner, (3, k) each. Phases are
    plain dot products if these are good enough; all gaps are at most the widest one, in radians.
    """
    ab, ac = (dot(-2 * np.pi * frequency, edge) for edge in edges)
    if widest < _SERIES_GAP:
        return _near(doubled, _phases(points[0], frequency, plain), ab, ac, widest)
    real, imaginary = np.empty_like(doubled), np.empty_like(doubled)
    close = np.maximum(np.maximum(np.abs(ab), np.abs(ac)), np.abs(ac - ab)) < _SERIES_GAP
    apart = ~close
    near, far = (frequency if frequency.ndim == 1 else frequency[:, mask] for mask in (close, apart))
    phases = _phases(points[0][:, close], near, plain)
    real[close], imaginary[close] = _near(doubled[close], phases, ab[close], ac[close], _SERIES_GAP)
    at_corners = (cosine_and_sine(_phases(corner[:, apart], far, plain)) for corner in points[1:])
    exponentials = [cosines + 1j * sines for cosines, sines in at_corners]
    quotients = doubled[apart] * _quotient(exponentials, ab[apart], ac[apart])
    real[apart], imaginary[apart] = quotients.real, quotients.imag
    return real, imaginary


def _near(doubled: Array, phases: Array, ab: Array, ac: Array, widest: float) -> tuple[Array, Array]:
    """Return the same for triangles with small gaps, from the phases of their centroids."""
    cosines, sines = (doubled * values for values in cosine_and_sine(phases))
    real, imaginary = _series(ab, ac, widest)
    return cosines * real - sines * imaginary, cosines * imaginary + sines * real


def _phases(points: Array, frequency: Array, plain: bool) -> Array:
    """Return -2π ξ·p at points (3, k), in radians; unless ``plain``, whole cycles are subtracted before rounding."""
    if plain:
        return dot(-2 * np.pi * frequency, points)
    cycles: Pair = (np.zeros_like(points[0]), np.zeros_like(points[0]))
    for axis in range(3):
        high, low = _two_product(points[axis], frequency[axis])
        high -= np.rint(high)  # exact, and whole cycles do not change the exponential
        total, error = _two_sum(cycles[0], high)
        cycles = total, cycles[1] + (error + low)
    return -2 * np.pi * (cycles[0] + cycles[1])


def _series(ab: Array, ac: Array, widest: float) -> tuple[Array, Array]:
    """Return real and imaginary part of Σ_n i^n h_n / (n+2)!, h_n the complete homogeneous symmetric polynomials.

    As the nodes have mean zero, h_n is the sum of C(j+k, k) p^j q^k over 2j + 3k = n, p = Σ node²/2, q their product.
    """
    lowest = (ab + ac) / -3
    p = (ab * (ab - ac) + ac * ac) / 3
    q = lowest * (ab + lowest) * (ac + lowest)
    n = 2
    # |h_n| <= 2 (widest · 2/3)^n: stop where the next term is below half a rounding error of 1/2.
    while 2 * (widest * 2 / 3) ** (n + 1) / math.factorial(n + 3) > 2e-17:
        n += 1
    # Powers of q with even exponents are real, the others imaginary; Horner's scheme in p, and then in q².
    parts: list[Array] = [np.zeros_like(p), np.zeros_like(p)]
    squares = q * q
    for power, (last, *others) in reversed(list(enumerate(_coefficients(n)))):
        values = np.zeros_like(p)
        values += last
        for coefficient in others:
            values *= p
            values += coefficient
        parts[power % 2] *= squares
        parts[power % 2] += values
    return parts[0], parts[1] * q


@cache
def _coefficients(highest: int) -> list[list[float]]:
    """Return the factors of p^j q^k in a series up to n, for each k those of the highest j first."""
    return [
        [
            (-1) ** ((2 * j + 3 * k) // 2) * math.comb(j + k, k) / math.factorial(2 * j + 3 * k + 2)
            for j in reversed(range((highest - 3 * k) // 2 + 1))
        ]
        for k in range(highest // 3 + 1)
    ]


def _quotient(exponentials: Sequence[Array], ab: Array, ac: Array) -> Array:
    """Return the difference quotient of the two first differences that meet across the widest gap."""
    a, b, c = exponentials
    bc = ac - ab
    of_ab, of_ac, of_bc = _first_difference(a, b, ab), _first_difference(a, c, ac), _first_difference(b, c, bc)
    across_ab = np.abs(ab) >= np.maximum(np.abs(ac), np.abs(bc))
    across_ac = np.abs(ac) >= np.abs(bc)
    numerator = np.where(across_ab, of_bc - of_ac, np.where(across_ac, of_bc - of_ab, of_ac - of_ab))
    return numerator / (1j * np.where(across_ab, ab, np.where(across_ac, ac, bc)))


def _first_difference(a: Array, b: Array, gap: Array) -> Array:
    """Return the first divided difference (exp(iβ) - exp(iα)) / (i (β - α))."""
    wide = np.abs(gap) > 1
    denominator = np.where(wide, gap, 1.0)
    near = a * np.exp(0.5j * gap) * np.sinc(gap / (2 * np.pi))
    return np.where(wide, (b - a) / (1j * denominator), near)


def _two_sum(a: Array, b: Array) -> Pair:
    """Return the rounded sum and its rounding error: a + b = high + low exactly."""
    high = a + b
    shadow = high - a
    return high, (a - (high - shadow)) + (b - shadow)


def _two_product(a: Array, b: Array) -> Pair:
    """Return the rounded product and its rounding error: a * b = high + low exactly."""
    high = a * b
    a_high, a_low = _halves(a)
    b_high, b_low = _halves(b)
    return high, a_low * b_low - (((high - a_high * b_high) - a_low * b_high) - a_high * b_low)


def _multiply(a: Pair, b: Pair) -> Pair:
    """Return the product of two double-double numbers, to about twice double precision."""
    high, low = _two_product(a[0], b[0])
    return _two_sum(high, low + (a[0] * b[1] + a[1] * b[0]))


def _halves(a: Array) -> Pair:
    shifted = _SPLITTER * a
    high = shifted - (shifted - a)
    return high, a - high


def sampled_transform(mesh: Mesh, frequencies: Reals, threads: int = 1, backend: Backend = CPU) -> Complexes:
    """Return the transform ∫ exp(-2πi ξ·x) dμ(x) of a mesh at single frequencies (P, 3), fast and to fewer digits.

    Away from small gaps the divided difference of exp at the corners is a plain sum of their exponentials, which
    neighbouring triangles share. It is several times as fast as `exact_transform` where triangles are not small beside
    the wavelength. The error of a triangle is at most about 1e-9 of its area. That of whole meshes at random
    frequencies was measured to be at most 1e-13 of the area.
    """
    frequencies = np.asarray(frequencies, dtype=np.float64)
    gaps = 2 * np.pi * np.linalg.norm(frequencies, axis=1) * mesh.edge_length_range[1]
    values = np.empty(len(frequencies), dtype=np.complex128)
    if backend is CPU and pays(_PAIR_SECONDS * len(mesh.triangles) * len(frequencies)):
        fine = gaps < _SERIES_GAP
        for chosen, transform in ((fine, _compiled_exact_transform), (~fine, _compiled_sampled_transform)):
            if chosen.any():
                values[chosen] = transform(mesh, frequencies[chosen], threads)
        return values
    fine = gaps < _FINE_MESH
    values[fine] = exact_transform(mesh, frequencies[fine], backend, threads)
    others, doubled = frequencies[~fine], doubled_areas(mesh)

    def sums(backend: Backend) -> Complexes:
        total, size = np.zeros(len(others), dtype=np.complex128), _SAMPLED_PAIRS[backend.name]
        for number, batch in mesh.batches(size):
            corners, areas = np.ascontiguousarray(batch.triangles.T), doubled[number * size :][: len(batch.triangles)]
            a, b, c = np.moveaxis(batch.vertices.T[:, corners], 1, 0)
            arrays = np.ascontiguousarray(batch.vertices.T), corners, areas, np.stack([b - a, c - b])
            faces = tuple(map(backend.upload, arrays))
            step = max(1, size // len(batch.triangles))
            sums_of_groups = (_group_sums(faces, others[part]) for part in slices(len(others), step))
            total += np.concatenate([backend.download(found) for found in sums_of_groups])
        return total

    faster = backend if len(mesh.triangles) * len(others) >= _FEWEST_FOR_GPU else CPU
    values[~fine] = compute_on(faster, sums) if len(others) else 0
    return values


def _group_sums(faces: tuple[Array, ...], frequencies: Reals) -> Array:
    """Return sums (P,) over faces: vertices (3, n), corners (3, m), twice the areas (m,), and two edges (2, 3, m)."""
    vertices, (a, b, c), doubled, edges = faces
    directions = -2 * np.pi * frequencies
    phases = combine(directions, vertices)
    # Of one edge, of the next, and of both.
    first, second = combine(directions, edges[0]), combine(directions, edges[1])
    both = first + second
    product = first * second
    product *= both
    close = np.abs(product) < _LEAST_PRODUCT
    product[close] = np.inf
    factors = doubled / product
    # The divided difference is (e_a g_bc + e_b g_ca + e_c g_ab) / (g_ab g_bc g_ca); the gaps g add up to zero.
    parts = []
    for values in cosine_and_sine(phases):
        middle = np.take(values, b, axis=1)
        before, after = np.take(values, a, axis=1), np.take(values, c, axis=1)
        before -= middle
        before *= second
        after -= middle
        after *= first
        before += after
        before *= factors
        parts.append(before.sum(axis=1))
    sums = -(parts[0] + 1j * parts[1])
    rows, columns = np.nonzero(close)
    gaps = first[rows, columns], both[rows, columns]
    means = phases[rows, b[columns]] + (gaps[1] - 2 * gaps[0]) / 3
    cosines, sines = cosine_and_sine(means)
    terms = doubled[columns] * (cosines + 1j * sines) * second_difference(*gaps)
    real, imaginary = (sums_at(rows, values, len(sums)) for values in (terms.real, terms.imag))
    return sums + (real + 1j * imaginary)
