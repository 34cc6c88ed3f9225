"""Two surfaces, and the way to their true distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sobolev_batch import Sphere
from sobolev_batch.surfaces.shapes.surface import Surface
from tests.coverage.truth import Truth, truths_in_space, truths_of_rectangles, truths_of_spheres
from tests.support.rectangles import Rectangles


@dataclass(frozen=True, eq=False)
class Pair:
    """Two surfaces.

    Attributes:
        first: One of them.
        second: The other one.
        rectangles: What they were made of if they are axis-parallel rectangles, perhaps turned and moved together.
        turned: True if they were.
        equal: True if they are one surface in different triangles.
    """

    first: Surface
    second: Surface
    rectangles: tuple[Rectangles, Rectangles] | None = None
    turned: bool = False
    equal: bool = False

    @property
    def surfaces(self) -> tuple[Surface, Surface]:
        """Both surfaces."""
        return self.first, self.second

    def swapped(self) -> Pair:
        """Return the pair in the other order."""
        return replace(self, first=self.second, second=self.first)

    def truths(self, orders: Sequence[float]) -> list[Truth | None]:
        """Return the true distance for each order; None where nothing is known of it."""
        if self.equal:
            return [Truth(0.0, 0.0)] * len(orders)
        if self.rectangles is not None:
            return [*truths_of_rectangles(*self.rectangles, orders, turned=self.turned)]
        if isinstance(self.first, Sphere) and isinstance(self.second, Sphere):
            return [*truths_of_spheres(self.first, self.second, orders)]
        return truths_in_space(self.first, self.second, orders)
