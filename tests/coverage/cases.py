"""Random pairs of surfaces, and the settings under which their distances are asked for."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sobolev_batch import Lattice, Mesh
from sobolev_batch.geometry.surface import Extent
from tests.coverage.kinds import MAKERS
from tests.coverage.parts import PARTS
from tests.coverage.solids import SOLIDS
from tests.coverage.truth import Pair

KINDS = MAKERS | PARTS | SOLIDS
ORDERS = (-0.6, -0.75, -1.0, -1.5, -2.0, -3.0, -4.0, -5.0, -10.0)
# Of these kinds, something is known above order -1 too.
_AT_EVERY_ORDER = {"near spheres", "far spheres", "distant spheres", "distant tetrahedra", "remeshed", *PARTS, *SOLIDS}
# Errors on a given lattice are documented to miss surfaces of short periods, and small ones far apart.
_WITHOUT_LATTICE = {"distant spheres", "distant tetrahedra", *PARTS, *SOLIDS}
# Of these kinds, one call asks for all orders of a pair.
_TOGETHER = {"close and thin", "large norms"}
# Orders of each pair.
_ORDERS_EACH = 3
# Least rtol for each order, by what takes seconds, and the largest.
_LEAST_RTOL = dict(zip(ORDERS, (3e-2, 3e-2, 1e-2, 3e-3, 1e-3, 1e-4, 1e-4, 1e-6, 1e-6), strict=True))
_LARGEST_RTOL = 1e-1
# Kinds that take no longer at high orders.
_LEAST_RTOL_OF = {"large norms": 1e-3}
# Above this order the least rtol grows with the triangles, in units of so many, up to a limit.
_SLOW_ORDER, _SLOW_TRIANGLES, _SLOW_RTOL = -2.0, 500, 8e-2


@dataclass(frozen=True)
class Case:
    """One distance of a pair, which its other cases share, perhaps in one call that asks for all their orders.

    `settings` are the accuracy `rtol`, for which the package chooses everything else; or settings of transforms on a
    lattice, as a user might choose them, well or badly.
    """

    kind: str
    index: int
    pair: Pair
    order: float
    settings: Mapping[str, Any]
    together: bool = False

    def __str__(self) -> str:
        return f"{self.kind}, pair {self.index}, order {self.order:g}, {self.settings}"


def cases_of(seed: int, index: int) -> list[Case]:
    """Return the cases of one random pair, at some orders; the same seed and index give the same ones."""
    rng = np.random.default_rng([seed, index])
    kind = tuple(KINDS)[index % len(KINDS)]
    made = KINDS[kind](rng)
    pair = made if isinstance(made, Pair) else Pair(*made)
    pair = pair if rng.random() < 0.5 else pair.swapped()
    choices = ORDERS if kind in _AT_EVERY_ORDER else ORDERS[2:]
    orders = np.sort(rng.choice(choices, size=_ORDERS_EACH, replace=False))[::-1].tolist()
    if kind in _TOGETHER:
        settings = _settings(rng, kind, pair, orders[0])
        return [Case(kind, index, pair, order, settings, together=True) for order in orders]
    return [Case(kind, index, pair, order, _settings(rng, kind, pair, order)) for order in orders]


def all_cases(seed: int, count: int, kinds: Collection[str] = tuple(KINDS), first: int = 0) -> Iterator[list[Case]]:
    """Yield at least ``count`` cases of some kinds, pair by pair, from the pair ``first`` on."""
    names = tuple(KINDS)
    chosen = (index for index in itertools.count(first) if names[index % len(names)] in kinds)
    for index in itertools.islice(chosen, -(-count // _ORDERS_EACH)):
        yield cases_of(seed, index)


def _settings(rng: np.random.Generator, kind: str, pair: Pair, order: float) -> dict[str, Any]:
    if kind not in _WITHOUT_LATTICE and rng.random() < 0.4:
        return _on_lattice(rng, pair)
    least = _LEAST_RTOL_OF.get(kind, _LEAST_RTOL[order])
    if order > _SLOW_ORDER:
        triangles = sum(len(surface.triangles) for surface in pair.surfaces if isinstance(surface, Mesh))
        least = min(least * (1 + triangles / _SLOW_TRIANGLES), _SLOW_RTOL)
    return {"rtol": float(np.exp(rng.uniform(*np.log([least, _LARGEST_RTOL]))))}


def _on_lattice(rng: np.random.Generator, pair: Pair) -> dict[str, Any]:
    """Return a lattice whose period leaves a third of a unit to three units around the surfaces, and its accuracy."""
    extent = Extent.union([surface.extent for surface in pair.surfaces])
    reach = float(np.abs([extent.lowest, extent.highest]).max())
    widest = float(extent.widths.max())
    xi_max = rng.uniform(2.0, 6.0)
    period = max(2.1 * reach, widest + rng.uniform(0.3, 3.0))
    lattice = Lattice(float(xi_max), 2 * int(np.ceil(xi_max * period)))
    quadrature: str | int = int(rng.integers(1, 5)) if rng.random() < 0.4 else "auto"
    return {"lattice": lattice, "eps": float(10.0 ** rng.uniform(-9, -4)), "quadrature": quadrature}
