"""Distances of many pairs at once."""

from __future__ import annotations

import numpy as np
import pytest

from sobolev_batch import Lattice, Sphere, distance, fourier_transform, icosphere
from sobolev_batch.spectral.budget import Sums, add_sums, sums_of_shells
from sobolev_batch.spectral.gram import differences, gram_blocks
from sobolev_batch.spectral.shells import shell_sums
from sobolev_batch.surfaces.similarity import Surface

LATTICE = Lattice(4.0, 24)
ORDERS = (-2.0, -7.5)


def test_blocks_of_products_give_every_distance() -> None:
    surfaces: list[Surface] = [icosphere(0), icosphere(1), icosphere(3), Sphere(0.9)]
    fields = [fourier_transform(surface, LATTICE) for surface in surfaces]
    center = fourier_transform(Sphere(), LATTICE)
    parts, own = [], []
    for block in LATTICE.split(2_000):
        part = np.stack([(f - center).values[LATTICE.place(block)].ravel() for f in fields])
        parts.append(gram_blocks(part, part, LATTICE, block, ORDERS))
        shells = np.stack([shell_sums(row.reshape(block.shape), None, LATTICE, block) for row in part])
        own.append(sums_of_shells(shells, LATTICE, ORDERS))
    found, cancelled = differences(add_sums(parts), add_sums(own), add_sums(own))
    for i in range(4):
        for j in range(i):
            expected = distance(fields[i], fields[j], ORDERS)["distance"].values
            assert np.sqrt(found.squares.sum(axis=1)[:, i, j]) == pytest.approx(expected, rel=1e-10)
            shells = shell_sums((fields[i] - fields[j]).values, None, LATTICE, LATTICE.half)
            direct = sums_of_shells(shells, LATTICE, ORDERS)
            assert found.squares[:, :, i, j] == pytest.approx(direct.squares, rel=1e-9)
            assert found.outer[:, i, j] == pytest.approx(direct.outer, rel=0.3)  # from one sample in eight
    assert not cancelled[~np.eye(4, dtype=bool)].any()
    assert cancelled.diagonal().all()


def single(value: float, *shape: int) -> Sums:
    """One order, all of the square in the first residue."""
    squares = np.zeros((1, 4, *shape))
    squares[0, 0] = value
    return Sums(squares, np.zeros((2, *shape)))


def test_near_twins_are_reported() -> None:
    _, cancelled = differences(single(4.0 - 1e-7, 1, 1), single(4.0, 1), single(4.0, 1))
    assert cancelled[0, 0]
    found, cancelled = differences(single(3.9, 1, 1), single(4.0, 1), single(4.0, 1))
    assert not cancelled[0, 0]
    assert found.squares.sum() == pytest.approx(0.2)
