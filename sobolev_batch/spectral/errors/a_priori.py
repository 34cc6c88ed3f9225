"""The cheapest settings that are predicted to keep a field's error small.

The prediction is good enough to choose settings by; the probe measures the error afterwards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.lattice import FrequencyLattice
from sobolev_batch.spectral.quadrature.kinds import kind_of
from sobolev_batch.spectral.quadrature.prediction import weight_masses
from sobolev_batch.spectral.transform.settings import COARSEST_EPS, FINEST_EPS, TransformSettings
from sobolev_batch.surfaces.shapes.surface import Surface

Reals = NDArray[np.float64]

# Fraction of a field's error that is left to the NUFFT.
_NUFFT_FRACTION = 0.4
# The rms error of a field of many points at one frequency over eps · area: measured 0.003 to 0.006.
_NUFFT_ERROR = 0.005
# The same of single precision over the area, however small its eps; measured 1e-7 at most.
_SINGLE_ROUNDING = 3e-7


@dataclass(frozen=True)
class ErrorTarget:
    """Largest permitted norms of a field's own error.

    Attributes:
        orders: Orders s.
        norms: Largest ||computed - exact||_s for each of them.
    """

    orders: tuple[float, ...]
    norms: tuple[float, ...]

    def tightened(self, factor: float) -> ErrorTarget:
        """Return a target that is smaller by a factor."""
        return ErrorTarget(self.orders, tuple(norm / factor for norm in self.norms))


def permits_single(surface: Surface, lattice: FrequencyLattice, target: ErrorTarget) -> bool:
    """Tell whether single precision meets a target: its rounding is 1e-7 of the area at every frequency."""
    rounding = _SINGLE_ROUNDING * surface.area * np.sqrt(weight_masses(lattice, target.orders))
    return bool(np.all(rounding <= _NUFFT_FRACTION * np.array(target.norms)))


def choose_settings(
    surface: Surface, lattice: FrequencyLattice, target: ErrorTarget, settings: TransformSettings
) -> TransformSettings:
    """Return the cheapest settings that are predicted to meet a target, or the finest possible ones.

    Args:
        surface: Surface of the field.
        lattice: Lattice of the field.
        target: Largest permitted error.
        settings: Settings whose dtype and quadrature are kept.

    Returns:
        ``settings`` with a new eps and tolerance; as they are for a closed form, which depends on neither.
    """
    kind = kind_of(surface)
    if kind.is_closed_form:
        return settings
    tolerance = kind.loosest_tolerance(lattice, target.orders, (1 - _NUFFT_FRACTION) * np.array(target.norms))
    eps = _nufft_eps(surface.area, kind.fewest_points, lattice, target, settings)
    return replace(settings, eps=eps, tolerance=tolerance)


def _nufft_eps(
    area: float, points: float, lattice: FrequencyLattice, target: ErrorTarget, settings: TransformSettings
) -> float:
    """Return the largest eps with which the NUFFT of so many points keeps to its fraction of a target."""
    masses = weight_masses(lattice, target.orders)
    spread = _NUFFT_ERROR + 1 / math.sqrt(points)
    eps = float(np.min(_NUFFT_FRACTION * np.array(target.norms) / (area * spread * np.sqrt(masses))))
    return min(max(eps, FINEST_EPS[settings.dtype]), COARSEST_EPS)
