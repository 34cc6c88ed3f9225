"""Whether a reported error covers the true one, and how much larger it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sobolev_batch import AccuracyError, distance, fourier_transform
from tests.coverage.cases import Case, Given
from tests.coverage.truth import Truth, truths

# A case is telling if its true error is so many times what is uncertain about the truth.
_TELLING = 10.0
# Bytes that the package may plan with, so that hundreds of cases take minutes.
_MEMORY = 500_000_000
# Beyond this an answer is none.
_LARGEST_RTOL = 0.5


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


def evaluate(case: Case) -> tuple[float, float] | None:
    """The distance of a case and its error, as the package reports them.

    Where what is asked for is out of reach, one and a half times what is in reach is asked for
    instead; None where that is no answer either.
    """
    setting = case.setting
    if isinstance(setting, Given):
        a, b = (
            fourier_transform(surface, setting.lattice, setting.eps, quadrature=setting.quadrature, order=[case.order])
            for surface in case.pair
        )
        found = distance(a, b, case.order)
    else:
        try:
            found = distance(*case.pair, case.order, rtol=setting.rtol, memory=_MEMORY)
        except AccuracyError as refusal:
            reachable = 1.5 * refusal.reachable
            if not reachable <= _LARGEST_RTOL:
                return None
            try:
                found = distance(*case.pair, case.order, rtol=reachable, memory=_MEMORY)
            except AccuracyError:
                return None
    return found["distance"].item(), found["error"].item()


def judge(cases: Sequence[Case]) -> list[Verdict]:
    """The verdicts on the cases of one pair; those that the package refuses have none."""
    known = truths(*cases[0].pair, [case.order for case in cases])
    answers = [(case, evaluate(case), truth) for case, truth in zip(cases, known, strict=True)]
    return [Verdict(case, *answer, truth) for case, answer, truth in answers if answer is not None]


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
