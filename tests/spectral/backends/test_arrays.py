"""Array operations that the backends do not share with NumPy."""

from __future__ import annotations

import numpy as np

from sobolev_batch.spectral.backends.arrays import combine, cosine_and_sine, sums_of_runs
from tests.support.fake_device import Array, Device


def test_the_exceptions_agree_with_numpy() -> None:
    rng = np.random.default_rng(7)
    device = Device()
    rows, values = rng.normal(size=(3, 50)), rng.normal(size=50)
    starts = np.array([0, 3, 4, 20, 49])
    for coefficients in (rng.normal(size=3), rng.normal(size=(5, 3))):
        found = combine(coefficients, device.upload(rows))
        assert isinstance(found, Array)
        assert np.abs(found.host - coefficients @ rows).max() < 1e-14
    sums = sums_of_runs(device.upload(values), device.upload(starts))
    assert np.abs(sums.host - np.add.reduceat(values, starts)).max() < 1e-14


def test_both_are_as_good_as_the_library_functions() -> None:
    rng = np.random.default_rng(31)
    phases = np.concatenate(
        [rng.uniform(-100, 100, 10_000), np.pi * np.arange(-9, 10), [0.0, 1e-300, np.nextafter(np.pi, 0)]]
    )
    cosines, sines = cosine_and_sine(phases)
    assert np.abs(cosines - np.cos(phases)).max() < 1e-15
    assert np.abs(sines - np.sin(phases)).max() < 1e-15
