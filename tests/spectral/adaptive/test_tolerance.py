"""Accuracies, what they allow, and the lattices that follow from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sobolev_batch import Sphere
from sobolev_batch.spectral.adaptive.tolerance import Accuracy, first_lattice
from sobolev_batch.spectral.budget import NormEstimate, Support


def test_memory_limits_the_lattice() -> None:
    sizes = [Accuracy(1e-3, memory).largest_intervals for memory in (5e8, 2e9, 2e10)]
    assert sizes == sorted(sizes)
    assert sizes[0] < 150 < sizes[1] < 300 < sizes[2]


def test_below_the_floor_errors_are_relative_to_it() -> None:
    values, errors = np.array([4.0, 0.1, 0.0]), np.array([0.5, 0.15, 0.25])
    found = NormEstimate(values, errors, *np.zeros((2, 3)))
    assert Accuracy(0.1).met(found).tolist() == [False, False, False]
    assert Accuracy(0.1, floor=2.0).met(found).tolist() == [False, True, False]


def test_first_lattices_hold_the_surfaces_with_room_for_their_images() -> None:
    support = Support(np.array(Sphere().area), Sphere().extent.widths, 1.0)
    for order in (-3.0, -6.0, -12.0):
        loose, tight = (first_lattice(support, [order], Accuracy(rtol))[0] for rtol in (1e-2, 1e-6))
        assert 1 / loose.spacing > 2.5
        assert tight.spacing < loose.spacing
        far, _ = first_lattice(replace(support, reach=40.0), [order], Accuracy(1e-2))
        assert far.half_period > 40.0
    assert first_lattice(support, [-1.0], Accuracy(1e-2))[1]  # the tail has no closed form: a pilot
    assert not first_lattice(support, [-10.0], Accuracy(1e-4))[1]
