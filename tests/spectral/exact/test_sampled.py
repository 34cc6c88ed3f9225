"""The faster closed form at many frequencies, against the one that keeps all digits."""

from __future__ import annotations

import numpy as np
import pytest

from sobolev_batch import Mesh, icosphere
from sobolev_batch.spectral.exact.sampled import sampled_transform
from sobolev_batch.spectral.exact.triangles import exact_transform
from tests.support.shapes import box, tetrahedron

SLIVER = Mesh(np.array([(0, 0, 0), (1, 0, 0), (0.5, 1e-6, 0), (0.3, 0.2, 0.7)]), [[0, 1, 2], [0, 1, 3]])


@pytest.mark.parametrize("mesh", [box(), tetrahedron(), icosphere(3), SLIVER], ids=["box", "corner", "T_3", "sliver"])
@pytest.mark.parametrize("length", [0.0, 0.01, 1.0, 30.0, 1000.0])
def test_both_closed_forms_agree(mesh: Mesh, length: float) -> None:
    directions = np.random.default_rng(1).normal(size=(40, 3))
    # Along axes and diagonals, edges and whole faces have a single phase.
    special = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 1, 1], [1, -1, 0], [1e-9, 0, 1]])
    directions = np.concatenate([directions, special])
    frequencies = length * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    expected = exact_transform(mesh, frequencies)
    assert np.abs(sampled_transform(mesh, frequencies) - expected).max() <= 1e-9 * mesh.area


def test_no_frequencies_have_no_values() -> None:
    assert sampled_transform(box(), np.zeros((0, 3))).shape == (0,)
