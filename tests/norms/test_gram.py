"""Distances of many pairs at once."""

from __future__ import annotations

import numpy as np
import pytest

from sobolev_batch import Lattice, distance, fourier_transform
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.norms.budget import add_sums, sums_of_shells
from sobolev_batch.norms.gram import Arrangement, differences
from sobolev_batch.shapes import Sphere, icosphere
from sobolev_batch.transform.lattice import SobolevWeights, shell_sums

LATTICE = Lattice(4.0, 24)
ORDERS = (-2.0, -7.5)
WEIGHTS = SobolevWeights(LATTICE, ORDERS)


def test_blocks_of_products_give_every_distance() -> None:
    surfaces: list[Surface] = [icosphere(0), icosphere(1), icosphere(3), Sphere(0.9)]
    fields = [fourier_transform(surface, LATTICE) for surface in surfaces]
    center = fourier_transform(Sphere(), LATTICE)
    parts, own = [], []
    for block in LATTICE.half.split(2_000):
        arrangement = Arrangement.for_block(WEIGHTS, block)
        part = np.stack([(f - center).values[block.place_in(LATTICE.half)].ravel()[arrangement.order] for f in fields])
        parts.append(arrangement.products(part, part))
        own.append(arrangement.squares(part))
    sums, cancelled = differences(add_sums(parts), add_sums(own), add_sums(own))
    for i in range(4):
        for j in range(i):
            expected = distance(fields[i], fields[j], ORDERS)["distance"].values
            assert np.sqrt(sums.totals[:, i, j]) == pytest.approx(expected, rel=1e-10)
            shells = shell_sums((fields[i] - fields[j]).values, None, LATTICE, LATTICE.half)
            direct = sums_of_shells(shells, WEIGHTS)
            assert sums.totals[:, i, j] == pytest.approx(direct.totals, rel=1e-9)
            assert sums.by_residue[:, :, i, j] == pytest.approx(direct.by_residue, rel=1e-9)
            assert sums.outer[:, i, j] == pytest.approx(direct.outer, rel=0.1)  # blocks this small are sampled in part
    assert not cancelled[~np.eye(4, dtype=bool)].any()
    assert cancelled.diagonal().all()


@pytest.mark.parametrize(("apart", "lost"), [(1e-2, False), (1e-4, True)])
def test_near_twins_have_the_outer_energies_of_their_difference_and_are_reported(apart: float, lost: bool) -> None:
    # They come from the same samples as the squares, so that what cancels leaves no noise behind.
    lattice = Lattice(4.0, 40)
    one, two = np.random.default_rng(0).standard_normal((2, lattice.half.size, 2)) @ [1, 1j]
    twin = one + apart * two
    arrangement = Arrangement.for_block(SobolevWeights(lattice, ORDERS), lattice.half)
    pair = np.stack([one[arrangement.order], twin[arrangement.order]])
    squares = arrangement.squares(pair)
    sums, cancelled = differences(arrangement.products(pair, pair), squares, squares)
    assert cancelled[0, 1] == lost
    expected = arrangement.squares((twin - one)[arrangement.order][None])
    assert sums.outer[:, 0, 1] == pytest.approx(expected.outer[:, 0], rel=1e-13 / apart**2)
