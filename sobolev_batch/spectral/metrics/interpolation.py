"""Values of a field between the frequencies of its lattice.

A field is the transform of a measure on a box, hence band-limited: neighbouring samples determine it in
between, the better the smaller the box is against the lattice's period. The weights of the neighbours
interpolate the exponentials of the box best in the mean. Their largest error on the box bounds the error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sobolev_batch.errors import InputError, LatticeError
from sobolev_batch.spectral.lattice import AXES, Lattice
from sobolev_batch.spectral.metrics.inputs import field_of, point_array, quality_of

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Neighbours along an axis. More of them would gain little where the box is small, and cost their cube.
_WIDTH = 24
# Relative error of samples that weights are fitted for; a smaller one would need larger weights.
_NOISE = 1e-10
# Points of the box at which weights are fitted: more than enough for the exponentials of so many neighbours.
_FITTED = 96
# Samples gathered at a time.
_GATHERED = 1 << 20


@dataclass(frozen=True, eq=False)
class _Neighbours:
    """Neighbours of frequencies along one axis.

    Attributes:
        indices: Array indices of the samples (n, width).
        weights: Weights of the samples (n, width).
        errors: Largest error of the weights on the box (n,).
        moduli: Sum of the moduli of the weights (n,).
    """

    indices: NDArray[np.int64]
    weights: Complexes
    errors: Reals
    moduli: Reals

    @classmethod
    def of(cls, lattice: Lattice, bounds: tuple[float, float], frequencies: Reals, lowest: int) -> _Neighbours:
        """Return the neighbours of frequencies (n,) among samples from k = ``lowest`` on, for a box with bounds."""
        width = min(_WIDTH, lattice.M + 1)
        center, reach = (bounds[0] + bounds[1]) / 2, (bounds[1] - bounds[0]) / 2
        positions = frequencies / lattice.spacing
        first = np.floor(positions).astype(np.int64) - (width // 2 - 1)
        first = np.clip(first, lowest, lattice.M // 2 + 1 - width)
        centred, errors = _fitted_weights(2 * np.pi * lattice.spacing * reach, positions - first, width)
        # A box off the origin turns the phase of the samples.
        indices = first[:, None] + np.arange(width)
        turns = np.exp(2j * np.pi * center * lattice.spacing * (indices - positions[:, None]))
        return cls(indices - lowest, centred * turns, errors, np.abs(centred).sum(axis=1))


def interpolate(field: xr.DataArray, frequencies: ArrayLike, *, reach: float | None = None) -> xr.DataArray:
    """Return the values of a field at any frequencies within the cube of its lattice.

    Args:
        field: Field from `fourier_transform` or a store.
        frequencies: Frequencies ξ, real (n, 3), in cycles per unit length, |ξ_i| <= ξ_max.
        reach: Bound on the coordinates of the surface, |x_i| <= reach, in units of length. Fields with the
            attribute `quality` know their surface's bounding box; other ones need it.

    Returns:
        complex128 (frequency,) with the coordinates xi_x, xi_y, xi_z, and `error`: a bound on the error by
        interpolation, the worst over all measures of the same area in the box. The field's own error
        comes on top, at most `amplification` times (a coordinate too). If the box fills a third of the
        period along each axis, the bound is 2e-10 of the area, and 1e-7 between the outermost samples,
        beside the faces of the cube; the icosphere T_3 was met a hundred times closer. At half the period
        these are 3e-5, and beyond that they grow further.

    Raises:
        LatticeError: The argument is not a single whole field, frequencies lie beyond the cube, or the reach
            lies beyond the half period.
        InputError: Frequencies are not finite or not (n, 3), or a field does not know its box and has no reach.

    Source: D. Slepian, "Prolate spheroidal wave functions, Fourier analysis, and uncertainty V: the discrete
    case" (1978), doi:10.1002/j.1538-7305.1978.tb02104.x, on band-limited functions and their samples.

    >>> from sobolev_batch import Lattice, Sphere, fourier_transform
    >>> values = interpolate(fourier_transform(Sphere(), Lattice(3.0, 32)), [[0.1, 0.2, 0.3]])
    >>> f"{values.item().real:.6f}"
    '3.799405'
    """
    lattice = Lattice.of(field_of(field, None, ()))
    wanted = _frequencies(frequencies, lattice)
    box = _box(field, lattice, reach)
    # μ is real: at -ξ the field is the conjugate of that at ξ.
    mirrored = wanted[:, 2] < 0
    upper = np.where(mirrored[:, None], -wanted, wanted)
    samples = _extended(field, min(_WIDTH, lattice.M + 1))
    origin = lattice.M // 2, lattice.M // 2, samples.shape[2] - lattice.M // 2 - 1
    near = [
        _Neighbours.of(lattice, bounds, column, -index)
        for bounds, column, index in zip(box, upper.T, origin, strict=True)
    ]
    values = _weighted_sums(samples, near)
    # Each exponential of the measure is replaced by a product of three, each with its error.
    error = np.expm1(np.log1p(np.stack([one.errors for one in near])).sum(axis=0))
    return xr.DataArray(
        np.where(mirrored, np.conj(values), values),
        dims=("frequency",),
        coords={
            **{name: ("frequency", column) for name, column in zip(AXES, wanted.T, strict=True)},
            "error": ("frequency", abs(samples[origin]) * error),
            "amplification": ("frequency", np.stack([one.moduli for one in near]).prod(axis=0)),
        },
        name=field.name,
    )


def _weighted_sums(samples: Complexes, near: list[_Neighbours]) -> Complexes:
    """Return the sums of samples (n,) weighted along the three axes, so many at a time."""
    values = np.empty(len(near[0].errors), dtype=np.complex128)
    step = max(1, _GATHERED // math.prod(one.weights.shape[1] for one in near))
    for start in range(0, len(values), step):
        batch = slice(start, start + step)
        x, y, z = (one.indices[batch] for one in near)
        gathered = samples[x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]]
        along = np.einsum("nijk,nk->nij", gathered, near[2].weights[batch])
        values[batch] = np.einsum("nij,nj,ni->n", along, near[1].weights[batch], near[0].weights[batch])
    return values


def _fitted_weights(phase: float, positions: Reals, width: int) -> tuple[Reals, Reals]:
    """Return weights (n, width) for positions counted from the first neighbour, and their largest error.

    Args:
        phase: Phase of the exponentials at the end of the box, per sample.
        positions: Positions of the frequencies (n,), in samples.
        width: Number of neighbours.
    """
    nodes, masses = np.polynomial.legendre.leggauss(_FITTED)
    rows = np.outer(phase * nodes, np.arange(width) - width / 2)
    targets = np.outer(phase * nodes, positions - width / 2)
    matrix, wanted = (np.concatenate([np.cos(phases), np.sin(phases)]) for phases in (rows, targets))
    scales = np.tile(np.sqrt(masses / 2), 2)[:, None]
    left, singular, right = np.linalg.svd(scales * matrix, full_matrices=False)
    damped = (singular / (singular**2 + _NOISE**2))[:, None] * (left.T @ (scales * wanted))
    weights = right.T @ damped
    errors = (matrix @ weights - wanted).reshape(2, _FITTED, -1)
    return np.asarray(weights.T), np.asarray(np.hypot(errors[0], errors[1]).max(axis=0))


def full_lattice(field: xr.DataArray) -> xr.DataArray:
    """Return a field on the whole lattice from its half: at -ξ it is the conjugate of that at ξ.

    Args:
        field: Field from `fourier_transform` or a store; other dimensions, such as mesh, stay.

    Returns:
        The field with 2 len(xi_z) - 1 samples along xi_z. Lazy if the field is a Dask array.

    Raises:
        LatticeError: The argument is not the half of a lattice.

    >>> from sobolev_batch import Lattice, Sphere, fourier_transform
    >>> full_lattice(fourier_transform(Sphere(), Lattice(1.0, 8))).shape
    (9, 9, 9)
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
    points = point_array(frequencies, "frequencies")
    if not np.isfinite(points).all():
        raise InputError("frequencies must be finite")
    highest = float(np.abs(points).max(initial=0.0))
    if highest > lattice.xi_max * (1 + 1e-12):
        raise LatticeError(
            f"the field is sampled up to |ξ_i| = {lattice.xi_max:g}, found {highest:.6g}: it cannot be extrapolated"
        )
    return np.clip(points, -lattice.xi_max, lattice.xi_max)


def _box(field: xr.DataArray, lattice: Lattice, reach: float | None) -> list[tuple[float, float]]:
    """Return the lowest and highest coordinate of the surface along each axis."""
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
    """Return the samples of a field (M+1, M+1, M/2+1+planes), with some planes of ξ_z < 0."""
    half = np.asarray(field.transpose(*AXES).values, dtype=np.complex128)
    count = min(planes, half.shape[2] - 1)
    return np.concatenate([np.conj(half[::-1, ::-1, count:0:-1]), half], axis=2)
