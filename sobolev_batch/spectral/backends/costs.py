"""What the NUFFT of a backend costs, in time and memory, and the oversampling that is fastest."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from sobolev_batch.spectral.dtypes import ComplexDtype

Shape = tuple[int, int, int]


@dataclass(frozen=True)
class Costs:
    """What a NUFFT library takes, in nanoseconds and bytes; measured, and good for choices alone.

    Attributes:
        finest: the oversamplings of the fine grid that it can do, and the smallest eps that each was
            measured to keep: the coarser the grid, the cheaper the FFT, the dearer the spreading of a
            point, and the more a rounding error grows.
        making: time of making a point and sorting it.
        point: time of turning and spreading a point, without
        spread_cell: that of one of its (kernel width)³ grid cells.
        grid_cell: time of an FFT's grid cell.
        point_bytes: of a batch, a point: coordinates, angles, strengths, phases, sorting, and what
            making it takes.
        triangle_bytes: of the choice of rules.
        fixed_bytes: of plans and tables.
        work_grids: grids that the FFT holds besides the fine one.
        scattered: whether spreading holds a copy of the part of the grid that the surface reaches.
        most_cells: of one fine grid.
    """

    finest: Mapping[ComplexDtype, Mapping[float, float]]
    making: float
    point: float
    spread_cell: float
    grid_cell: float
    point_bytes: int
    triangle_bytes: int
    fixed_bytes: int
    work_grids: int
    scattered: bool
    most_cells: int

    def oversamplings(self, eps: float, dtype: ComplexDtype) -> tuple[float, ...]:
        """Those that keep an eps, the largest first."""
        return tuple(sigma for sigma, finest in self.finest[dtype].items() if eps >= finest)


def fastest_oversampling(points: float, samples: int, eps: float, dtype: ComplexDtype, costs: Costs) -> float:
    """The oversampling of the fine grid with which so many points are transformed fastest."""

    def time(sigma: float) -> float:
        return points * spreading_nanoseconds(sigma, eps, costs) + samples * sigma**3 * costs.grid_cell

    return min(costs.oversamplings(eps, dtype), key=time)


def spreading_nanoseconds(sigma: float, eps: float, costs: Costs) -> float:
    """Predicted time of spreading a point, in nanoseconds."""
    width = math.ceil(-math.log(eps) / (math.pi * math.sqrt(1 - 1 / sigma)))
    return costs.point + costs.spread_cell * width**3
