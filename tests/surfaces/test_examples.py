"""Examples in the docstrings of surfaces run as they stand."""

from __future__ import annotations

import doctest
from importlib import import_module
from pkgutil import walk_packages

import pytest

import sobolev_batch
from sobolev_batch import surfaces

MODULES = [module.name for module in walk_packages(surfaces.__path__, f"{surfaces.__name__}.") if not module.ispkg]


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_run(name: str) -> None:
    if name.endswith(".proximity"):
        pytest.importorskip("vtkmodules", reason="VTK comes with the extra 'vtk'")
    failures, _ = doctest.testmod(import_module(name))
    assert failures == 0


def test_every_public_name_of_surfaces_has_an_example() -> None:
    values = [getattr(sobolev_batch, name) for name in sobolev_batch.__all__]
    ours = [value for value in values if value.__module__.startswith(surfaces.__name__)]
    assert len(ours) >= 16
    assert not [value.__name__ for value in ours if ">>> " not in (value.__doc__ or "")]
