"""Random pairs of surfaces, and the settings under which their distances are asked for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sobolev_batch import Lattice, Mesh
from sobolev_batch.surfaces.shapes.surface import Extent
from tests.coverage.kinds import KINDS, Kind
from tests.coverage.pairs import Pair

# Orders of each pair.
_ORDERS_EACH = 3
# Least rtol for each order, by what takes seconds, and the largest.
_LEAST_RTOL = {
    -0.6: 3e-2,
    -0.75: 3e-2,
    -1.0: 1e-2,
    -1.5: 3e-3,
    -2.0: 1e-3,
    -3.0: 1e-4,
    -4.0: 1e-4,
    -5.0: 1e-6,
    -10.0: 1e-6,
}
_LARGEST_RTOL = 1e-1
# Above this order the least rtol grows with the triangles, in units of so many, up to a limit.
_SLOW_ORDER, _SLOW_TRIANGLES, _SLOW_RTOL = -2.0, 500, 8e-2


@dataclass(frozen=True)
class ChosenLattice:
    """A lattice and settings as a user might choose them, well or badly."""

    lattice: Lattice
    eps: float
    quadrature: str | int


@dataclass(frozen=True)
class ChosenAccuracy:
    """An accuracy relative to the distance; the package chooses everything else."""

    rtol: float


Setting = ChosenLattice | ChosenAccuracy


@dataclass(frozen=True)
class Case:
    """One distance.

    Attributes:
        kind: Kind of the pair.
        index: Index of the pair, which its cases share.
        pair: Two surfaces, most of them within about the unit ball.
        order: Order s.
        setting: Lattice or accuracy of the distance.
    """

    kind: str
    index: int
    pair: Pair
    order: float
    setting: Setting


def cases_of(seed: int, index: int) -> list[Case]:
    """Return the cases of one random pair, at some orders; the same seed and index give the same ones."""
    rng = np.random.default_rng([seed, index])
    name = tuple(KINDS)[index % len(KINDS)]
    kind = KINDS[name]
    pair = kind.make(rng)
    pair = pair if rng.random() < 0.5 else pair.swapped()
    orders = np.sort(rng.choice(kind.orders, size=_ORDERS_EACH, replace=False))[::-1].tolist()
    return [Case(name, index, pair, order, _setting(rng, kind, pair, order)) for order in orders]


def all_cases(seed: int, count: int) -> Iterator[list[Case]]:
    """Yield at least ``count`` cases, pair by pair."""
    for index in range(-(-count // _ORDERS_EACH)):
        yield cases_of(seed, index)


def _setting(rng: np.random.Generator, kind: Kind, pair: Pair, order: float) -> Setting:
    """Return a random setting."""
    if kind.on_lattices and rng.random() < 0.4:
        return _chosen_lattice(rng, pair)
    least = _LEAST_RTOL[order]
    if order > _SLOW_ORDER:
        triangles = sum(len(surface.triangles) for surface in pair.surfaces if isinstance(surface, Mesh))
        least = min(least * (1 + triangles / _SLOW_TRIANGLES), _SLOW_RTOL)
    return ChosenAccuracy(float(np.exp(rng.uniform(*np.log([least, _LARGEST_RTOL])))))


def _chosen_lattice(rng: np.random.Generator, pair: Pair) -> ChosenLattice:
    """Return a lattice whose period leaves a third of a unit to three units around the surfaces."""
    extent = Extent.union([surface.extent for surface in pair.surfaces])
    reach = float(np.abs([extent.lowest, extent.highest]).max())
    widest = float(extent.widths.max())
    xi_max = rng.uniform(2.0, 6.0)
    period = max(2.1 * reach, widest + rng.uniform(0.3, 3.0))
    lattice = Lattice(float(xi_max), 2 * int(np.ceil(xi_max * period)))
    quadrature: str | int = int(rng.integers(1, 5)) if rng.random() < 0.4 else "auto"
    return ChosenLattice(lattice, float(10.0 ** rng.uniform(-9, -4)), quadrature)
