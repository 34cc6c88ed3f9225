"""Spectra: the squared norm of a surface, or the squared distance of two, by bands of |ξ|."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.parameters import is_whole_number
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.metrics.datasets import (
    AREA,
    FREQUENCY,
    KERNEL,
    LENGTH,
    NUMBER,
    described,
    lattice_attributes,
    order_axis,
)
from sobolev_batch.spectral.metrics.inputs import OperandLike, field_of, pair_of, shells_of
from sobolev_batch.spectral.shells import Orders, Reals, SobolevWeights, check_orders, shell_volumes
from sobolev_batch.surfaces.shapes.surface import Similarity

# Shells this close to an edge, relative to it, lie on it.
_ON_EDGE = 1e-12


def spectrum(
    a: OperandLike,
    b: OperandLike | None,
    order: Orders,
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
          ∫ (1 + |ξ|²)^s |a^ - b^|² dξ, in units of length. Bands that cover all frequencies add up to the
          whole;
        - `share` (order, band): that over the whole; NaN where the whole is zero;
        - `total` (order): the whole, on the lattice;
        - `mean_square` (band): mean of |a^ - b^|² over the band, in unit length to the fourth; NaN
          where no lattice frequency lies in the band;
        - `energy` (band): ∫_{|ξ|=r} |a^ - b^|² dS, its mean over the radii r of the band, from
          `mean_square`, in squared units of length. For one surface it tends to twice the area.

        A single order has no dimension `order`. Attributes hold the lattice and the kernel.

    Raises:
        OrderError: An order is not below -1/2.
        LatticeError: The fields lie on different lattices, or a surface does not fit into the lattice.
        InputError: Edges do not increase from zero or above, or a surface comes without a lattice.

    >>> from sobolev_batch import Lattice, Sphere, icosphere, spectrum
    >>> bands = spectrum(icosphere(1), Sphere(), -2.0, bands=[0, 1, 2, 4], lattice=Lattice(3.0, 32))
    >>> bands["share"].round(2).values.tolist()
    [0.26, 0.41, 0.32]
    """
    orders = check_orders(order)
    first, second = (field_of(a, lattice, orders), None) if b is None else pair_of(a, b, lattice, orders)
    lattice = Lattice.from_field(first)
    edges = _edges(bands, lattice)
    count = len(edges) - 1
    sums = shells_of(first, second, lattice)
    weighted = SobolevWeights(lattice, orders).per_shell * sums
    members = _bands_of_shells(edges, lattice)
    squared = np.stack([_sums_of_bands(row, members, count) for row in weighted])
    total = weighted.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = squared / total[:, None]
        mean = _sums_of_bands(sums, members, count) / _sums_of_bands(shell_volumes(lattice), members, count)
    lower, upper = edges[:-1], edges[1:]
    surfaces = 4 * np.pi / 3 * (lower**2 + lower * upper + upper**2)
    dims, values, _ = axis = order_axis(order)
    fields = (first,) if second is None else (first, second)
    return xr.Dataset(
        {
            "squared": ((*dims, "band"), squared.reshape(*values.shape, -1), described("squared value", LENGTH)),
            "share": ((*dims, "band"), share.reshape(*values.shape, -1), described("share of the total", NUMBER)),
            "total": (dims, total.reshape(values.shape), described("squared value of all bands", LENGTH)),
            "mean_square": ("band", mean, described("mean square of the field", "unit length to the fourth")),
            "energy": ("band", mean * surfaces, described("energy on a sphere of frequencies", AREA)),
        },
        coords={"order": axis, **band_coordinates(lower, upper, similarity)},
        attrs={"kernel": KERNEL, **lattice_attributes(lattice, *fields)},
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


def _bands_of_shells(edges: Reals, lattice: Lattice) -> NDArray[np.intp]:
    """Return the band of each shell, counted from 1; 0 for shells below all bands, one more than the last above."""
    radii = lattice.spacing * np.sqrt(np.arange(lattice.shell_count))
    bands = np.searchsorted(edges, radii * (1 + _ON_EDGE), side="right")
    bands[np.abs(radii - edges[-1]) <= _ON_EDGE * edges[-1]] = len(edges) - 1
    return bands


def _sums_of_bands(values: Reals, bands: NDArray[np.intp], count: int) -> Reals:
    return np.asarray(np.bincount(bands, weights=values, minlength=count + 2)[1 : count + 1])


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
