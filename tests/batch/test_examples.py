"""Examples in docstrings of studies, stores and clusters."""

from __future__ import annotations

import doctest
from importlib import import_module
from pkgutil import walk_packages

import pytest

from sobolev_batch import batch

MODULES = [module.name for module in walk_packages(batch.__path__, f"{batch.__name__}.")]


@pytest.mark.parametrize("name", MODULES)
def test_examples(name: str) -> None:
    assert not doctest.testmod(import_module(name), optionflags=doctest.ELLIPSIS).failed


def test_there_are_some() -> None:
    finder = doctest.DocTestFinder(exclude_empty=True)
    assert any(test.examples for test in finder.find(import_module("sobolev_batch.batch.study.study")))
