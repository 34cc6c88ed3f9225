"""The public names of the package: one list, imported when first used."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest

import sobolev_batch as sb


def test_names_are_sorted_and_unknown_ones_refused() -> None:
    assert sb.__all__ == sorted(set(sb.__all__))
    assert {"Study", "plan", "run", "status", "table", "matrix", "report", "plot"} <= set(sb.__all__)
    assert dir(sb) == sb.__all__
    with pytest.raises(AttributeError, match="nothing"):
        sb.nothing  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.process
def test_the_package_alone_imports_no_libraries() -> None:
    code = "import sys, sobolev_batch; assert not {'numpy', 'xarray', 'dask', 'zarr'} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_integers_of_numpy_are_whole_numbers() -> None:
    few: Any = np.int64(3)
    small: Any = np.int8(100)
    goal: Any = np.int64(40)
    assert sb.Lattice(1.0, small) == sb.Lattice(1.0, 100)
    # As an integer of 8 bits, 100 times 100 is 16.
    assert len(sb.Torus(2.0, 1.0).mesh(small, small).triangles) == 20_000
    assert len(sb.icosphere(few).triangles) == 1280
    fitted = sb.refine(sb.icosphere(0), sb.Sphere(), -4.0, triangles=goal, steps=few)
    assert 20 < len(fitted.mesh.triangles) <= 40
    for wrong in (True, np.True_, 3.0, "3"):
        with pytest.raises(sb.InputError, match="level must be an integer"):
            sb.icosphere(wrong)  # type: ignore[arg-type]
