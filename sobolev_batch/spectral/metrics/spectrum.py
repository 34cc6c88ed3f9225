"""Bands of |ξ|: at which wavelengths a surface has its norm, or two surfaces their distance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from sobolev_batch.errors import InputError
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.metrics.inputs import Operand, field_of, pair_of, shells_of
from sobolev_batch.spectral.shells import Orders, Reals, check_orders, shell_volumes, shell_weights
from sobolev_batch.surfaces.shapes.similarity import Similarity

# Shells this close to an edge, relative to it, lie on it.
_ON_EDGE = 1e-12


def spectrum(
    a: Operand,
    b: Operand | None,
    order: Orders,
    *,
    bands: int | Sequence[float] | None = None,
    lattice: Lattice | None = None,
    similarity: Similarity | None = None,
) -> xr.Dataset:
    """The squared distance of two surfaces, or the squared norm of one, by bands of the frequency |ξ|.

    Args:
        a: a field from `fourier_transform` or a store, or a surface.
        b: a field on the same lattice, or a surface, to which the distance is meant; None for the norm of a.
        order: one order s < -1/2, or several.
        bands: edges of bands in cycles per unit length, increasing; or into how many of equal width
            the frequencies are cut. By default octaves downwards from xi_max, and the corners of
            the cube beyond it. A band has its lower edge, and the last one its upper edge too.
        lattice: where surfaces are to be transformed; a field brings its own.
        similarity: of the study, for wavelengths in the meshes' own unit of length too.

    Returns:
        A dataset over `band` with the coordinates `lower` and `upper` in cycles per unit length,
        `longest_wavelength` and `shortest_wavelength` (1/|ξ|, in units of length; with a similarity also
        `own_longest_wavelength` and `own_shortest_wavelength`), and

        - `squared` (order, band): the part of the squared distance ∫ (1 + |ξ|²)^s |a^ - b^|² dξ in the
          band, in units of length. Bands that cover all frequencies add up to the whole;
        - `share` (order, band): that over the whole; NaN where the whole is zero;
        - `total` (order): the whole, on the lattice;
        - `mean_square` (band): the mean of |a^ - b^|² over the band, in unit length to the fourth; NaN
          where no lattice frequency lies in the band;
        - `energy` (band): ∫_{|ξ|=r} |a^ - b^|² dS, its mean over the radii r of the band, from
          `mean_square`, in squared units of length; of one surface it tends to twice the area.

        A single order has no dimension `order`.

    Raises:
        OrderError: an order that is not below -1/2.
        LatticeError: fields on different lattices, or a surface that does not fit into the lattice.
        InputError: edges that do not increase from zero or above; a mesh, and no lattice from anywhere.
    """
    orders = check_orders(order)
    first, second = (field_of(a, lattice, orders), None) if b is None else pair_of(a, b, lattice, orders)
    known = Lattice.of(first)
    edges = _edges(bands, known)
    sums = shells_of(first, second, known)
    weighted = shell_weights(known, orders) * sums
    members = _members(edges, known)
    squared = np.stack([_added(row, members, len(edges) - 1) for row in weighted])
    total = weighted.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = squared / total[:, None]
        mean = _added(sums, members, len(edges) - 1) / _added(shell_volumes(known), members, len(edges) - 1)
    lower, upper = edges[:-1], edges[1:]
    surfaces = 4 * np.pi / 3 * (lower**2 + lower * upper + upper**2)
    many = np.asarray(order, dtype=np.float64)
    axis = ("order",) * many.ndim
    return xr.Dataset(
        {
            "squared": ((*axis, "band"), squared.reshape(*many.shape, -1), {"units": "unit length"}),
            "share": ((*axis, "band"), share.reshape(*many.shape, -1)),
            "total": (axis, total.reshape(many.shape), {"units": "unit length"}),
            "mean_square": ("band", mean, {"units": "unit length to the fourth"}),
            "energy": ("band", mean * surfaces, {"units": "unit length squared"}),
        },
        coords={"order": (axis, many), **_band_coordinates(lower, upper, similarity)},
    )


def _edges(bands: int | Sequence[float] | None, lattice: Lattice) -> Reals:
    """The edges of bands, in cycles per unit length, increasing."""
    if bands is None:
        # An octave that starts below the second shell would hold next to nothing.
        octaves = max(1, int(np.log2(lattice.M / 4)) + 1)
        inner = lattice.xi_max / 2.0 ** np.arange(octaves - 1, -1, -1)
        return np.array([0.0, *inner, lattice.highest_frequency])
    if isinstance(bands, int) and not isinstance(bands, bool):
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


def _members(edges: Reals, lattice: Lattice) -> np.ndarray:
    """The band of each shell, counted from 1; 0 for shells below all bands, one more than the last above them."""
    radii = lattice.spacing * np.sqrt(np.arange(lattice.shell_count))
    places = np.searchsorted(edges, radii * (1 + _ON_EDGE), side="right")
    places[np.abs(radii - edges[-1]) <= _ON_EDGE * edges[-1]] = len(edges) - 1
    return places


def _added(values: Reals, members: np.ndarray, count: int) -> Reals:
    return np.asarray(np.bincount(members, weights=values, minlength=count + 2)[1 : count + 1])


def _band_coordinates(
    lower: Reals, upper: Reals, similarity: Similarity | None
) -> dict[str, tuple[str, Reals, dict[str, str]]]:
    with np.errstate(divide="ignore"):
        longest, shortest = 1 / lower, 1 / upper
    coordinates = {
        "lower": ("band", lower, {"units": "cycles per unit length"}),
        "upper": ("band", upper, {"units": "cycles per unit length"}),
        "longest_wavelength": ("band", longest, {"units": "unit length"}),
        "shortest_wavelength": ("band", shortest, {"units": "unit length"}),
    }
    if similarity is not None:
        own = {"units": "the meshes' own unit of length"}
        coordinates["own_longest_wavelength"] = ("band", longest / similarity.scale, own)
        coordinates["own_shortest_wavelength"] = ("band", shortest / similarity.scale, own)
    return coordinates
