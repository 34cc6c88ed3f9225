"""Comparison of reported errors with true ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sobolev_batch import AccuracyError, distance, fourier_transform
from tests.coverage.cases import Case, ChosenLattice
from tests.coverage.truth import Truth, truths

# A case is telling if its true error is at least so many times the uncertainty of the truth.
_TELLING = 10.0
# Memory for an rtol, so that hundreds of cases take minutes.
_MEMORY = 500_000_000
# A larger rtol is no answer.
_LARGEST_RTOL = 0.5


@dataclass(frozen=True)
class Verdict:
    """A distance, its reported error, and the truth.

    The true error is as uncertain as the truth. A case counts as covered if it may be covered within that
    uncertainty, and as `telling` if its true error is ten times as large. Ratios are those of telling cases.
    """

    case: Case
    value: float
    reported: float
    truth: Truth

    @property
    def true_error(self) -> float:
        """Difference of the distance from the truth."""
        return abs(self.value - self.truth.value)

    @property
    def covered(self) -> bool:
        """True if the truth may lie within the reported error; NaN never covers."""
        return self.true_error <= self.reported + self.truth.uncertainty

    @property
    def telling(self) -> bool:
        """True if the uncertainty is at most a tenth of the true error."""
        return self.true_error > _TELLING * self.truth.uncertainty

    @property
    def ratio(self) -> float:
        """Reported error over the true one."""
        return self.reported / self.true_error if self.true_error else np.inf


def evaluate(case: Case) -> tuple[float, float] | None:
    """Return the distance of a case and its error, as the package reports them.

    If the accuracy is out of reach, one and a half times the reachable one is tried. None if that fails too.
    """
    setting = case.setting
    if isinstance(setting, ChosenLattice):
        a, b = (
            fourier_transform(surface, setting.lattice, setting.eps, quadrature=setting.quadrature, order=[case.order])
            for surface in case.pair
        )
        dataset = distance(a, b, case.order)
    else:
        try:
            dataset = distance(*case.pair, case.order, rtol=setting.rtol, memory=_MEMORY)
        except AccuracyError as refusal:
            reachable = 1.5 * refusal.reachable
            if not reachable <= _LARGEST_RTOL:
                return None
            try:
                dataset = distance(*case.pair, case.order, rtol=reachable, memory=_MEMORY)
            except AccuracyError:
                return None
    return dataset["distance"].item(), dataset["error"].item()


def judge(cases: Sequence[Case]) -> list[Verdict]:
    """Return the verdicts on the cases of one pair, without those that the package refuses."""
    truths_of_pair = truths(*cases[0].pair, [case.order for case in cases])
    answers = [(case, evaluate(case), truth) for case, truth in zip(cases, truths_of_pair, strict=True)]
    return [Verdict(case, *answer, truth) for case, answer, truth in answers if answer is not None]


@dataclass(frozen=True)
class Tally:
    """Summary of many verdicts."""

    verdicts: tuple[Verdict, ...]

    @property
    def covered(self) -> int:
        """Number of covered cases."""
        return sum(verdict.covered for verdict in self.verdicts)

    @property
    def ratios(self) -> list[float]:
        """Ratios of the telling cases."""
        return [verdict.ratio for verdict in self.verdicts if verdict.telling]

    @property
    def median_ratio(self) -> float:
        """Median ratio; NaN if no case is telling."""
        return float(np.median(self.ratios)) if self.ratios else float("nan")

    @property
    def worst(self) -> Verdict | None:
        """Uncovered case whose true error exceeds the reported one most."""
        return min((v for v in self.verdicts if not v.covered), key=lambda v: v.ratio, default=None)
