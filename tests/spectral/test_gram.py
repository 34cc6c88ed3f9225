"""Distances of many pairs at once."""

from __future__ import annotations

import numpy as np
import pytest

from sobolev_batch import Lattice, Sphere, distance, fourier_transform, icosphere
from sobolev_batch.spectral.gram import gram_blocks, squared_distances
from sobolev_batch.surfaces.similarity import Surface

LATTICE = Lattice(4.0, 24)
ORDERS = (-2.0, -7.5)


def test_blocks_of_products_give_every_distance() -> None:
    surfaces: list[Surface] = [icosphere(0), icosphere(1), icosphere(3), Sphere(0.9)]
    fields = [fourier_transform(surface, LATTICE) for surface in surfaces]
    center = fourier_transform(Sphere(), LATTICE)
    products = np.zeros((2, 4, 4))
    for block in LATTICE.split(2_000):
        part = np.stack([(f - center).values[LATTICE.place(block)].ravel() for f in fields])
        products += gram_blocks(part, part, LATTICE, block, ORDERS)
    own = np.stack([np.diag(products[k]) for k in range(2)])
    squares, cancelled = squared_distances(products, own, own)
    for i in range(4):
        for j in range(i):
            expected = distance(fields[i], fields[j], ORDERS)["distance"].values
            assert np.sqrt(squares[:, i, j]) == pytest.approx(expected, rel=1e-10)
    assert not cancelled[~np.eye(4, dtype=bool)].any()
    assert cancelled.diagonal().all()


def test_near_twins_are_reported() -> None:
    far, near = np.array([[4.0]]), np.array([[4.0]])
    _, cancelled = squared_distances(np.array([[[4.0 - 1e-7]]]), far, near)
    assert cancelled[0, 0]
    squares, cancelled = squared_distances(np.array([[[3.9]]]), far, near)
    assert not cancelled[0, 0]
    assert squares[0, 0, 0] == pytest.approx(0.2)
