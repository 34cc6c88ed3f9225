"""The public names of the package: one list, imported when first used, old names for one more release."""

from __future__ import annotations

import subprocess
import sys

import pytest

import sobolev_batch as sb


def test_names_are_sorted_and_unknown_ones_refused() -> None:
    assert sb.__all__ == sorted(set(sb.__all__))
    assert {"Study", "plan", "run", "status", "table", "matrix", "report", "plot_convergence"} <= set(sb.__all__)
    assert dir(sb) == sb.__all__
    with pytest.raises(AttributeError, match="nothing"):
        sb.nothing  # type: ignore[attr-defined]  # noqa: B018


def test_an_old_name_works_with_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(vars(sb)["_RENAMED"], "Grid", "Lattice")
    with pytest.warns(DeprecationWarning, match="Grid is now called Lattice"):
        assert sb.Grid is sb.Lattice  # type: ignore[attr-defined]


def test_the_package_alone_imports_no_libraries() -> None:
    code = "import sys, sobolev_batch; assert not {'numpy', 'xarray', 'dask', 'zarr'} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
