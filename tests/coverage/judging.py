"""Comparison of reported errors with true ones."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sobolev_batch import AccuracyError, distance, fourier_transform
from tests.coverage.cases import Case, ChosenAccuracy, ChosenLattice
from tests.coverage.truth import Truth

# A case is telling if its true error is at least so many times the uncertainty of the truth.
_TELLING = 10.0
# Memory for an rtol, so that hundreds of cases take minutes.
_MEMORY = 500_000_000
# A larger rtol is no answer.
_LARGEST_RTOL = 0.5
# Accuracies that should be within reach: at orders up to this one, from this rtol on.
_EXPECTED_ORDER, _EXPECTED_RTOL = -1.0, 1e-2

PARTS = ("truncation", "aliasing", "discretisation", "statistical")


@dataclass(frozen=True)
class Verdict:
    """A distance, its reported error, and the truth.

    The true error is as uncertain as the truth. A case counts as covered if it may be covered within that
    uncertainty, and as `telling` if its true error is ten times as large. Ratios are those of telling cases.

    Attributes:
        case: What was asked for.
        value: Reported distance.
        reported: Reported error.
        truth: True distance.
        parts: Parts of the reported error, in the order of `PARTS`.
        seconds: Processor time.
    """

    case: Case
    value: float
    reported: float
    truth: Truth
    parts: tuple[float, ...] = ()
    seconds: float = 0.0

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


@dataclass(frozen=True)
class Refusal:
    """An accuracy that the package calls out of reach.

    Attributes:
        case: What was asked for.
        reachable: The rtol that it offers instead.
        answered: True if it kept that promise, or what it offers is none.
        seconds: Processor time of the refusal.
    """

    case: Case
    reachable: float
    answered: bool
    seconds: float

    @property
    def unexpected(self) -> bool:
        """True if the accuracy should have been within reach."""
        setting = self.case.setting
        loose = isinstance(setting, ChosenAccuracy) and setting.rtol >= _EXPECTED_RTOL
        return loose and self.case.order <= _EXPECTED_ORDER


@dataclass(frozen=True)
class Findings:
    """Verdicts and refusals of some cases; a case that is refused and then answered otherwise has both."""

    verdicts: tuple[Verdict, ...]
    refusals: tuple[Refusal, ...]


def judge(cases: Sequence[Case]) -> Findings:
    """Return what is found of the cases of one pair, without those of whose truth nothing is known."""
    verdicts, refusals = [], []
    truths = cases[0].pair.truths([case.order for case in cases])
    for case, truth in zip(cases, truths, strict=True):
        if truth is None:
            continue
        start = time.process_time()
        found: xr.Dataset | None
        try:
            found = _measured(case)
        except AccuracyError as refusal:
            seconds = time.process_time() - start
            start = time.process_time()
            found = _measured_to(case, 1.5 * refusal.reachable)
            answered = found is not None or 1.5 * refusal.reachable > _LARGEST_RTOL
            refusals.append(Refusal(case, refusal.reachable, answered, seconds))
        if found is not None:
            value, reported, *parts = (found[name].item() for name in ("distance", "error", *PARTS))
            verdicts.append(Verdict(case, value, reported, truth, tuple(parts), time.process_time() - start))
    return Findings(tuple(verdicts), tuple(refusals))


def _measured(case: Case) -> xr.Dataset:
    """Return the distance of a case with its error, as the package reports them."""
    setting, surfaces = case.setting, case.pair.surfaces
    if isinstance(setting, ChosenAccuracy):
        return distance(*surfaces, case.order, rtol=setting.rtol, memory=_MEMORY)
    return _on_lattice(case, setting)


def _on_lattice(case: Case, chosen: ChosenLattice) -> xr.Dataset:
    a, b = (
        fourier_transform(surface, chosen.lattice, chosen.eps, quadrature=chosen.quadrature, order=[case.order])
        for surface in case.pair.surfaces
    )
    return distance(a, b, case.order)


def _measured_to(case: Case, rtol: float) -> xr.Dataset | None:
    """Return the distance to an accuracy that is called reachable; None if it is no answer, or refused too."""
    if not rtol <= _LARGEST_RTOL:
        return None
    try:
        return distance(*case.pair.surfaces, case.order, rtol=rtol, memory=_MEMORY)
    except AccuracyError:
        return None


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
