"""Limits on the size of a report, which browsers set."""

from __future__ import annotations

from dataclasses import dataclass

from sobolev_batch.results.figures.pair_plots import MOST_MESHES
from sobolev_batch.results.figures.selection import MOST_MESHES as MOST_SPECTRA


@dataclass(frozen=True)
class ReportLimits:
    """Limits on the size of a report, which browsers set.

    Attributes:
        convergence_rows: Rows of all convergence tables together; browsers become slow beyond.
        mesh_rows: Rows of the table of meshes.
        pairs: Meshes in the matrix and on the map.
        spectra: Meshes in the spectra.
        matrix_numbers: Numbers of all matrices together: 10 bytes each, on a page of up to 15 MB.
        points: Points of all convergence charts together.
        reasons: Meshes of a collection that are missing, with their reasons.
    """

    convergence_rows: int = 10_000
    mesh_rows: int = 5_000
    pairs: int = MOST_MESHES
    spectra: int = MOST_SPECTRA
    matrix_numbers: int = 400_000
    points: int = 50_000
    reasons: int = 2_000
