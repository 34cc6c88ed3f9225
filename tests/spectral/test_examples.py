"""Examples in the docstrings of the numerics."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import pytest

import sobolev_batch
from sobolev_batch import spectral

MODULES = [module.name for module in pkgutil.walk_packages(spectral.__path__, f"{spectral.__name__}.")]


@pytest.mark.parametrize("name", MODULES)
def test_examples_print_what_they_show(name: str) -> None:
    assert not doctest.testmod(importlib.import_module(name)).failed


@pytest.mark.parametrize("name", ["distance", "inner_product", "norm", "proportion", "spectrum", "witness"])
def test_every_metric_has_an_example(name: str) -> None:
    assert ">>> " in getattr(sobolev_batch, name).__doc__
