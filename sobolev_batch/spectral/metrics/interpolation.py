"""Values of a field between the frequencies of its lattice.

A field is the transform of a measure on a box, hence band-limited: between samples it is known from
its neighbours, the better the smaller the box is against the lattice's period. The weights of the
neighbours are those that interpolate every exponential of the box best in the mean; how well they
do so is measured, and bounds the error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sobolev_batch.errors import InputError, LatticeError
from sobolev_batch.spectral.lattice import AXES, Lattice
from sobolev_batch.spectral.metrics.inputs import field_of, quality_of, triples_of

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Neighbours along an axis. More of them would gain little where the box is small, and cost their cube.
_WIDTH = 24
# The relative error of samples that weights are fitted for: what is smaller is not worth larger weights.
_NOISE = 1e-10
# Points of the box at which weights are fitted: more than enough for the exponentials of so many neighbours.
_FITTED = 96
# Samples gathered at a time.
_GATHERED = 1 << 20


@dataclass(frozen=True, eq=False)
class _Axis:
    """Interpolation along one axis of the lattice.

    Attributes:
        lattice: whose axis.
        center: of the box along it, in units of length.
        reach: half its side.
        width: neighbours used.
    """

    lattice: Lattice
    center: float
    reach: float
    width: int

    @classmethod
    def of(cls, lattice: Lattice, lowest: float, highest: float) -> _Axis:
        """The axis of a box from a lowest to a highest coordinate."""
        return cls(lattice, (lowest + highest) / 2, (highest - lowest) / 2, min(_WIDTH, lattice.M + 1))

    def weights(self, frequencies: Reals, lowest: int) -> tuple[NDArray[np.int64], Complexes, Reals, Reals]:
        """Of frequencies (n,): their first neighbours k, the weights (n, width), worst errors and sums of moduli (n,).

        Args:
            frequencies: in cycles per unit length.
            lowest: the least k that there are samples of.
        """
        places = frequencies / self.lattice.spacing
        first = np.floor(places).astype(np.int64) - (self.width // 2 - 1)
        first = np.clip(first, lowest, self.lattice.M // 2 + 1 - self.width)
        plain, errors = self._fitted(places - first)
        # A field whose box lies elsewhere is that of a centred one, turned.
        neighbours = first[:, None] + np.arange(self.width)
        turns = np.exp(2j * np.pi * self.center * self.lattice.spacing * (neighbours - places[:, None]))
        return first, plain * turns, errors, np.abs(plain).sum(axis=1)

    def _fitted(self, places: Reals) -> tuple[Reals, Reals]:
        """Weights (n, width) for places counted from the first neighbour, and their largest error on the box."""
        nodes, masses = np.polynomial.legendre.leggauss(_FITTED)
        angles = 2 * np.pi * self.lattice.spacing * self.reach * nodes
        rows = np.outer(angles, np.arange(self.width) - self.width / 2)
        targets = np.outer(angles, places - self.width / 2)
        matrix, wanted = (np.concatenate([np.cos(phases), np.sin(phases)]) for phases in (rows, targets))
        scales = np.tile(np.sqrt(masses / 2), 2)[:, None]
        left, singular, right = np.linalg.svd(scales * matrix, full_matrices=False)
        damped = (singular / (singular**2 + _NOISE**2))[:, None] * (left.T @ (scales * wanted))
        found = right.T @ damped
        missed = (matrix @ found - wanted).reshape(2, _FITTED, -1)
        return np.asarray(found.T), np.asarray(np.hypot(missed[0], missed[1]).max(axis=0))


def interpolate(field: xr.DataArray, frequencies: ArrayLike, *, reach: float | None = None) -> xr.DataArray:
    """The values of a field at any frequencies within the cube of its lattice.

    Args:
        field: from `fourier_transform` or a store.
        frequencies: ξ, real (n, 3), in cycles per unit length, |ξ_i| <= ξ_max.
        reach: the surface lies in |x_i| <= reach, in units of length. Computed and stored fields know
            their surface's bounding box; other ones need it.

    Returns:
        complex128 (frequency,) with the coordinates xi_x, xi_y, xi_z, and `error`: a bound on what
        interpolation adds, the worst over all measures of the same area in the box. The field's own error
        comes on top, at most `amplification` times (a coordinate too). Where
        the box fills a third of the period along each axis, the bound is 2e-10 of the area, and 1e-7
        between the outermost samples, beside the faces of the cube; the icosphere T_3 was met a
        hundred times closer. At half the period these are 3e-5; beyond, samples tell ever less.

    Raises:
        LatticeError: not a single whole field; frequencies beyond the cube; a reach beyond the half period.
        InputError: frequencies that are not finite or not (n, 3); a field that does not know its box, and no reach.

    Source: D. Slepian, "Prolate spheroidal wave functions, Fourier analysis, and uncertainty V: the discrete
    case" (1978), doi:10.1002/j.1538-7305.1978.tb02104.x, for what samples tell of a band-limited function.
    """
    lattice = Lattice.of(field_of(field, None, ()))
    wanted = _frequencies(frequencies, lattice)
    axes = [_Axis.of(lattice, *bounds) for bounds in _box(field, lattice, reach)]
    # μ is real: at -ξ the field is the conjugate of that at ξ.
    mirrored = wanted[:, 2] < 0
    upper = np.where(mirrored[:, None], -wanted, wanted)
    samples = _extended(field, axes[2].width)
    lowest = [-lattice.M // 2, -lattice.M // 2, -(samples.shape[2] - lattice.M // 2 - 1)]
    found = [axis.weights(column, low) for axis, column, low in zip(axes, upper.T, lowest, strict=True)]
    values = np.empty(len(wanted), dtype=np.complex128)
    step = max(1, _GATHERED // (axes[0].width * axes[1].width * axes[2].width))
    for start in range(0, len(wanted), step):
        part = slice(start, start + step)
        x, y, z = (
            first[part, None] - low + np.arange(axis.width)
            for (first, *_), low, axis in zip(found, lowest, axes, strict=True)
        )
        near = samples[x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]]
        along = np.einsum("nijk,nk->nij", near, found[2][1][part])
        values[part] = np.einsum("nij,nj,ni->n", along, found[1][1][part], found[0][1][part])
    moduli = np.stack([sums for *_, sums in found])
    misses = np.stack([errors for _, _, errors, _ in found])
    amplification = moduli.prod(axis=0)
    # Each exponential of the measure is replaced by a product of three, each of which misses by so much.
    error = np.expm1(np.log1p(misses).sum(axis=0))
    area = abs(samples[lattice.M // 2, lattice.M // 2, -lowest[2]])
    return xr.DataArray(
        np.where(mirrored, np.conj(values), values),
        dims=("frequency",),
        coords={
            **{name: ("frequency", column) for name, column in zip(AXES, wanted.T, strict=True)},
            "error": ("frequency", area * error),
            "amplification": ("frequency", amplification),
        },
        name=field.name,
    )


def full_lattice(field: xr.DataArray) -> xr.DataArray:
    """A field on the whole lattice, ξ_z < 0 included, from its half: the conjugate at the opposite frequency.

    Args:
        field: from `fourier_transform` or a store; other dimensions, such as mesh, stay.

    Returns:
        Likewise, with 2 (len(xi_z)) - 1 samples along xi_z. Lazy where the field is a Dask array.

    Raises:
        LatticeError: not the half of a lattice.
    """
    Lattice.of(field)
    backwards = {"xi_x": slice(None, None, -1), "xi_y": slice(None, None, -1), "xi_z": slice(None, 0, -1)}
    mirrored = field.isel(backwards).conj()
    mirrored = mirrored.assign_coords({name: -mirrored[name] for name in AXES})
    # Exactly the same axes: -0.0 and 0.0 are equal, but print differently.
    mirrored = mirrored.assign_coords(xi_x=field["xi_x"], xi_y=field["xi_y"])
    joined = xr.concat([mirrored, field], dim="xi_z", join="exact", coords="minimal", compat="override")
    return joined.transpose(*field.dims).assign_attrs(field.attrs)


def _frequencies(frequencies: ArrayLike, lattice: Lattice) -> Reals:
    found = triples_of(frequencies, "frequencies")
    if not np.isfinite(found).all():
        raise InputError("frequencies must be finite")
    highest = float(np.abs(found).max(initial=0.0))
    if highest > lattice.xi_max * (1 + 1e-12):
        raise LatticeError(
            f"the field is known up to |ξ_i| = {lattice.xi_max:g}, found {highest:.6g}: it cannot be extrapolated"
        )
    return np.clip(found, -lattice.xi_max, lattice.xi_max)


def _box(field: xr.DataArray, lattice: Lattice, reach: float | None) -> list[tuple[float, float]]:
    """The lowest and highest coordinate of the surface along each axis."""
    quality = quality_of(field)
    if reach is not None:
        if not 0 < reach < lattice.half_period:
            raise LatticeError(f"the reach must lie between 0 and 1/(2h) = {lattice.half_period:.6g}, found {reach!r}")
        return [(-reach, reach)] * 3
    if quality is None:
        raise InputError("the field does not say how far its surface reaches: pass reach=...")
    lower, upper = quality.extent.box
    return list(zip(lower.tolist(), upper.tolist(), strict=True))


def _extended(field: xr.DataArray, planes: int) -> Complexes:
    """The samples of a field (M+1, M+1, M/2+1 and some more), with as many planes of ξ_z < 0 as are needed."""
    half = np.asarray(field.transpose(*AXES).values, dtype=np.complex128)
    count = min(planes, half.shape[2] - 1)
    return np.concatenate([np.conj(half[::-1, ::-1, count:0:-1]), half], axis=2)
