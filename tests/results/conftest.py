"""A store that several modules read."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.results.spheres import make_study


@pytest.fixture(scope="session")
def spheres(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """The store of a study of spheres, and the folder of its files."""
    folder = tmp_path_factory.mktemp("spheres")
    place = "memory://spheres.zarr"
    make_study(folder, place)
    return place, folder
