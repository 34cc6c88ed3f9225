"""Causes of a distance: wavelengths, and places where the surfaces differ."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from sobolev_batch.arrays import ComplexDtype, Reals
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.mesh import checked_points
from sobolev_batch.geometry.surface import Similarity
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.columns import AREA, FREQUENCY, LENGTH, NUMBER, described, lattice_attributes, order_axis
from sobolev_batch.norms.fields import OperandLike, field_of, pair_of, read_blocks, shells_of
from sobolev_batch.parameters import is_whole_number
from sobolev_batch.transform.fourier import TransformSettings, require_points_inside, thread_count
from sobolev_batch.transform.lattice import Lattice, Orders, SobolevWeights, check_orders, shell_volumes
from sobolev_batch.transform.nufft import evaluate_at
from sobolev_batch.transform.nufft_costs import NufftSpec

# Shells this close to an edge, relative to it, lie on it.
_ON_EDGE = 1e-12


def spectrum(
    a: OperandLike,
    b: OperandLike | None,
    order: Orders = DEFAULT_ORDER,
    *,
    bands: int | Sequence[float] | None = None,
    lattice: Lattice | None = None,
    similarity: Similarity | None = None,
) -> xr.Dataset:
    """Return the squared distance of two surfaces, or the squared norm of one, by bands of the frequency |ξ|.

    Args:
        a: Field from `fourier_transform` or a store, or a surface.
        b: Field on the same lattice, or a surface, to take the distance to; None for the norm of a.
        order: One order s < -1/2, or several.
        bands: Increasing edges of bands in cycles per unit length, or the number of bands of equal width.
            The default is octaves downwards from xi_max, and one band for the corners of the cube beyond
            it. A band includes its lower edge, and the last one its upper edge too.
        lattice: Lattice to transform surfaces on. A field brings its own.
        similarity: Similarity of the study, for wavelengths in the meshes' own unit of length too.

    Returns:
        Dataset over `band` with the coordinates `lower` and `upper` in cycles per unit length,
        `longest_wavelength` and `shortest_wavelength` (1/|ξ|, in units of length; with a similarity also
        `own_longest_wavelength` and `own_shortest_wavelength`), and

        - `squared` (order, band): contribution of the band to the squared distance
          ∫ (1 + |ξ|²)^s |a^ - b^|² dξ, in units of length. Bands that cover all frequencies add up to the whole;
        - `share` (order, band): that over the whole; NaN where the whole is zero;
        - `total` (order): the whole, on the lattice;
        - `mean_square` (band): mean of |a^ - b^|² over it, in unit length to the fourth; NaN without frequencies;
        - `energy` (band): ∫_{|ξ|=r} |a^ - b^|² dS, its mean over the radii r of the band, from
          `mean_square`, in squared units of length. For one surface it tends to twice the area.

        A single order has no dimension `order`. Attributes hold the lattice and the kernel.

    Raises:
        OrderError: An order is not below -1/2.
        LatticeError: The fields lie on different lattices, or a surface does not fit into the lattice.
        InputError: Edges do not increase from zero or above, or a surface comes without a lattice.

    >>> from sobolev_batch import Lattice, spectrum
    >>> from sobolev_batch.shapes import Sphere, icosphere
    >>> bands = spectrum(icosphere(1), Sphere(), -2.0, bands=[0, 1, 2, 4], lattice=Lattice(3.0, 32))
    >>> bands["share"].round(2).values.tolist()
    [0.26, 0.41, 0.32]
    """
    orders = check_orders(order)
    if not isinstance(similarity, Similarity | None):
        raise InputError(f"similarity must be a Similarity, found {similarity!r}")
    fields = [field_of(a, lattice, orders)] if b is None else [*pair_of(a, b, lattice, orders)]
    lattice = Lattice.from_field(fields[0])
    edges = _edges(bands, lattice)
    sums = shells_of(fields, lattice)
    weighted = SobolevWeights(lattice, orders).per_shell * sums
    *squares, plain, volumes = _sums_of_bands([*weighted, sums, shell_volumes(lattice)], edges, lattice)
    squared, total = np.stack(squares), weighted.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = squared / total[:, None]
        mean = plain / volumes
    lower, upper = edges[:-1], edges[1:]
    surfaces = 4 * np.pi / 3 * (lower**2 + lower * upper + upper**2)
    dims, values, _ = axis = order_axis(order)
    return xr.Dataset(
        {
            "squared": ((*dims, "band"), squared.reshape(*values.shape, -1), described("squared value", LENGTH)),
            "share": ((*dims, "band"), share.reshape(*values.shape, -1), described("share of the total", NUMBER)),
            "total": (dims, total.reshape(values.shape), described("squared value of all bands", LENGTH)),
            "mean_square": ("band", mean, described("mean square of the field", "unit length to the fourth")),
            "energy": ("band", mean * surfaces, described("energy on a sphere of frequencies", AREA)),
        },
        coords={"order": axis, **band_coordinates(lower, upper, similarity)},
        attrs=lattice_attributes(lattice, *fields),
    )


def _edges(bands: int | Sequence[float] | None, lattice: Lattice) -> Reals:
    """Return the edges of bands, in cycles per unit length, increasing."""
    if bands is None:
        # An octave that starts below the second shell would hold next to nothing.
        octaves = max(1, int(np.log2(lattice.M / 4)) + 1)
        inner = lattice.xi_max / 2.0 ** np.arange(octaves - 1, -1, -1)
        return np.array([0.0, *inner, lattice.highest_frequency])
    if is_whole_number(bands):
        if bands < 1:
            raise InputError(f"there must be at least one band, found {bands}")
        return np.linspace(0.0, lattice.highest_frequency, bands + 1)
    try:
        edges = np.asarray(bands, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"bands must be a number of them or their edges: {error}") from error
    if edges.ndim != 1 or len(edges) < 2 or not np.isfinite(edges).all() or edges[0] < 0 or (np.diff(edges) <= 0).any():
        raise InputError(f"the edges of bands must be two or more, increasing from zero or above, found {bands!r}")
    return edges


def _sums_of_bands(rows: Iterable[Reals], edges: Reals, lattice: Lattice) -> Iterator[Reals]:
    """Return the sums over each band, (bands,), of rows over the shells of a lattice."""
    # Bands are counted from 1: 0 is for shells below all bands, one more than the last for those above.
    radii = lattice.spacing * np.sqrt(np.arange(lattice.shell_count))
    bands = np.searchsorted(edges, radii * (1 + _ON_EDGE), side="right")
    bands[np.abs(radii - edges[-1]) <= _ON_EDGE * edges[-1]] = len(edges) - 1
    return (np.asarray(np.bincount(bands, row, len(edges) + 1)[1:-1]) for row in rows)


def band_coordinates(
    lower: Reals, upper: Reals, similarity: Similarity | None
) -> dict[str, tuple[str, Reals, dict[str, str]]]:
    """Return the ends of bands (bands,) and the wavelengths there, as coordinates; see `spectrum`."""
    with np.errstate(divide="ignore"):
        longest, shortest = 1 / lower, 1 / upper
    coordinates = {
        "lower": ("band", lower, described("lower edge", FREQUENCY)),
        "upper": ("band", upper, described("upper edge", FREQUENCY)),
        "longest_wavelength": ("band", longest, described("longest wavelength", LENGTH)),
        "shortest_wavelength": ("band", shortest, described("shortest wavelength", LENGTH)),
    }
    if similarity is not None:
        for name in ("longest_wavelength", "shortest_wavelength"):
            long_name = name.replace("_", " ")
            own = described(f"{long_name}, as in the files", "the meshes' own unit of length")
            coordinates[f"own_{name}"] = ("band", coordinates[name][1] / similarity.scale, own)
    return coordinates


def witness(
    a: OperandLike,
    b: OperandLike,
    order: Orders,
    points: ArrayLike,
    *,
    lattice: Lattice | None = None,
    eps: float | None = None,
    dtype: ComplexDtype = "complex128",
    threads: int | None = None,
) -> xr.DataArray:
    """Return the witness function of two surfaces at points: positive where a has area that b lacks.

    It is w(x) = ∫ (1 + |ξ|²)^s (a^ - b^)(ξ) exp(+2πi ξ·x) dξ, by the trapezoidal rule over the lattice
    as in norms: the difference of the area measures, smoothed by the norm's kernel. Its integral
    against that difference is the squared distance, ∫ w d(a - b) = ||a - b||_s².

    Args:
        a: Field from `fourier_transform` or a store, or a surface.
        b: Field on the same lattice, or a surface.
        order: One order s < -1/2, or several.
        points: Points x, real (n, 3), in the fields' unit of length, as ``mesh.vertices`` after a study's similarity.
        lattice: Lattice to transform surfaces on. A field brings its own.
        eps: Accuracy of the NUFFT, relative to the sum of the moduli of all terms. The error is a small
            multiple of it. Default 1e-9, or 1e-6 in single precision.
        dtype: "complex128" or "complex64", the dtype of the arithmetic, whatever that of the fields.
        threads: Threads of the NUFFT; default one per core.

    Returns:
        `witness` over (order, point), or (point,) for a single order, with the coordinates `order` and `x`,
        `y`, `z` of the points: float64, or float32 with complex64, in 1 / unit length. NaN everywhere if a
        field has NaN anywhere. The attribute `shortest_wavelength` is 1/xi_max, in units of length: what is shorter is
        not in the function. At orders above -3 that may be much of the distance.

    Raises:
        OrderError: An order is not below -1/2.
        LatticeError: The fields lie on different lattices, or points lie beyond the half period 1/(2h).
        InputError: Points are not finite or not (n, 3); a surface lacks a lattice; settings are out of range.

    Source: A. Gretton et al., "A kernel two-sample test" (2012), JMLR 13, section 2.3.

    >>> from sobolev_batch import Lattice, witness
    >>> from sobolev_batch.shapes import Sphere
    >>> w = witness(Sphere(), Sphere(0.9), -4.0, [[1, 0, 0], [0, 0, 0]], lattice=Lattice(3.0, 32))
    >>> (w > 0).values.tolist()
    [True, False]
    """
    orders = check_orders(order)
    settings = TransformSettings(eps, dtype)
    coordinates = np.ascontiguousarray(checked_points(points).T)
    first, second = pair_of(a, b, lattice, orders)
    lattice = Lattice.from_field(first)
    require_points_inside(coordinates, lattice)
    weights = SobolevWeights(lattice, orders)
    threads = thread_count(threads)
    values = np.zeros((len(orders), coordinates.shape[1]))
    # FINUFFT refuses to evaluate nothing.
    for block, (of_a, of_b) in read_blocks(lattice, first, second) if values.size else ():
        weighted, shells = (of_a - of_b) * lattice.trapezoid_weights(block), lattice.shells(block)
        coefficients = np.empty((len(orders), *block.shape), dtype=dtype)
        for row, weight in zip(coefficients, weights.per_shell, strict=True):
            np.multiply(weighted, weight[shells], out=row, casting="same_kind")
        spec = NufftSpec(block.shape, settings.eps, dtype, threads=threads)
        values += evaluate_at(coordinates, coefficients, lattice, block, spec)
    dims, labels, _ = axis = order_axis(order)
    values = values.astype(np.float32 if dtype == "complex64" else np.float64)
    places = {name: ("point", row, described(name, LENGTH)) for name, row in zip("xyz", coordinates, strict=True)}
    return xr.DataArray(
        values.reshape(*labels.shape, coordinates.shape[1]),
        dims=(*dims, "point"),
        coords={"order": axis, **places},
        name="witness",
        attrs={
            **described("witness function", "1 / unit length"),
            "description": "positive where the first surface has area that the second lacks",
            **lattice_attributes(lattice, first, second),
            "shortest_wavelength": 1 / lattice.xi_max,
        },
    )
