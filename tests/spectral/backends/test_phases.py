"""Cosine and sine from the tangent of half the phase."""

from __future__ import annotations

import numpy as np

from sobolev_batch.spectral.backends.phases import cosine_and_sine


def test_both_are_as_good_as_the_library_functions() -> None:
    rng = np.random.default_rng(31)
    phases = np.concatenate(
        [rng.uniform(-100, 100, 10_000), np.pi * np.arange(-9, 10), [0.0, 1e-300, np.nextafter(np.pi, 0)]]
    )
    cosines, sines = cosine_and_sine(phases)
    assert np.abs(cosines - np.cos(phases)).max() < 1e-15
    assert np.abs(sines - np.sin(phases)).max() < 1e-15
