"""Settings of transforms: defaults, and what is out of range."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from sobolev_batch import InputError
from sobolev_batch.spectral.backends.arrays import ComplexDtype
from sobolev_batch.spectral.transform.settings import TransformSettings


@pytest.mark.parametrize(("dtype", "eps"), [("complex128", 1e-9), ("complex64", 1e-6)])
def test_eps_and_tolerance_follow_from_the_dtype(dtype: ComplexDtype, eps: float) -> None:
    settings = TransformSettings(dtype=dtype)
    assert (settings.eps, settings.tolerance) == (eps, eps)
    assert pickle.loads(pickle.dumps(settings)) == settings


def test_settings_are_replaced_one_by_one() -> None:
    settings = TransformSettings(1e-5, tolerance=1e-3)
    assert replace(settings, eps=1e-7) == TransformSettings(1e-7, tolerance=1e-3)


@pytest.mark.parametrize(
    ("eps", "dtype"), [(1e-15, "complex128"), (0.5, "complex128"), (1e-9, "complex64"), (np.nan, "complex128")]
)
def test_refuses_accuracies_out_of_reach(eps: float, dtype: str) -> None:
    with pytest.raises(InputError, match="eps must lie between"):
        TransformSettings(eps, dtype)  # type: ignore[arg-type]


def test_refuses_other_precisions() -> None:
    with pytest.raises(InputError, match="dtype must be"):
        TransformSettings(1e-6, "float64")  # type: ignore[arg-type]
