"""Lattices that follow from an accuracy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sobolev_batch import Sphere
from sobolev_batch.spectral.adaptive.lattice_selection import first_lattice, good_intervals
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.budget import Support


def test_intervals_suit_ffts() -> None:
    for least in (2, 17, 30.5, 100, 211, 416):
        intervals = good_intervals(least)
        assert intervals % 2 == 0
        assert least <= intervals <= 1.13 * least + 8
        grid = 2 * (intervals + 1)
        # The grid of the oversampled axis is at most a twentieth larger than twice its modes.
        assert any(grid <= 2**a * 3**b * 5**c <= 1.08 * grid for a in range(10) for b in range(7) for c in range(5))


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
