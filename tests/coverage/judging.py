"""Whether a reported error covers the true one, and how much larger it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sobolev_batch import distance, fourier_transform
from tests.coverage.cases import Case
from tests.coverage.truth import Truth, truths

# A case is telling if its true error is so many times what is uncertain about the truth.
_TELLING = 10.0


@dataclass(frozen=True)
class Verdict:
    """A distance, the error reported with it, and the truth.

    A true error cannot be known better than the truth: a case is covered if it may be, given the
    truth's uncertainty, and it is `telling` if its true error is ten times that. Ratios are taken
    of telling cases alone.
    """

    case: Case
    value: float
    reported: float
    truth: Truth

    @property
    def true_error(self) -> float:
        """As far as the truth is known."""
        return abs(self.value - self.truth.value)

    @property
    def covered(self) -> bool:
        """Whether the true value may lie within the reported error; NaN never covers."""
        return self.true_error <= self.reported + self.truth.uncertainty

    @property
    def telling(self) -> bool:
        """Whether the true error is known to a tenth of itself."""
        return self.true_error > _TELLING * self.truth.uncertainty

    @property
    def ratio(self) -> float:
        """The reported error over the true one."""
        return self.reported / self.true_error if self.true_error else np.inf


def evaluate(case: Case) -> tuple[float, float]:
    """The distance of a case and its error, as the package reports them."""
    given = case.setting
    a, b = (
        fourier_transform(surface, given.lattice, given.eps, quadrature=given.quadrature, orders=[case.order])
        for surface in case.pair
    )
    found = distance(a, b, case.order)
    return found["distance"].item(), found["error"].item()


def judge(cases: Sequence[Case]) -> list[Verdict]:
    """The verdicts on the cases of one pair."""
    known = truths(*cases[0].pair, [case.order for case in cases])
    return [Verdict(case, *evaluate(case), truth) for case, truth in zip(cases, known, strict=True)]


@dataclass(frozen=True)
class Tally:
    """What many verdicts come to."""

    verdicts: tuple[Verdict, ...]

    @property
    def covered(self) -> int:
        """How many are covered."""
        return sum(verdict.covered for verdict in self.verdicts)

    @property
    def ratios(self) -> list[float]:
        """Of the telling ones."""
        return [verdict.ratio for verdict in self.verdicts if verdict.telling]

    @property
    def median_ratio(self) -> float:
        """NaN where nothing is telling."""
        return float(np.median(self.ratios)) if self.ratios else float("nan")

    @property
    def worst(self) -> Verdict | None:
        """The uncovered one whose true error exceeds the reported one most."""
        return min((v for v in self.verdicts if not v.covered), key=lambda v: v.ratio, default=None)
