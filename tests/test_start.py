"""What a process loads before its first field: every worker and every command waits for it."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

pytestmark = pytest.mark.process

# Parts of SciPy that a first field may load: sizes of lattices, step functions, and what these load.
PARTS_OF_SCIPY = {"scipy.fft", "scipy.fftpack", "scipy.linalg", "scipy.sparse", "scipy.special"}
# Packages that take 50 ms or more to load and that a first field does without.
HEAVY = {
    *("bokeh", "distributed", "fast_simplification", "fsspec", "matplotlib", "nibabel", "networkx"),
    *("pyvista", "tabulate", "trimesh", "vtkmodules", "zarr"),
}

FIRST_FIELD = """
import json, sys
import sobolev_batch as sb
sb.fourier_transform(sb.icosphere(1), sb.Lattice(xi_max=1.0, M=8))
print(json.dumps(sorted(sys.modules)))
"""


def test_a_first_field_loads_little() -> None:
    command = [sys.executable, "-c", FIRST_FIELD]
    loaded = set(json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout))
    assert not loaded & HEAVY
    parts = {name for name in loaded if name.startswith("scipy.") and name[6] != "_" and name.count(".") == 1}
    assert parts - {"scipy.version"} <= PARTS_OF_SCIPY


def test_the_package_alone_imports_no_libraries() -> None:
    code = "import sys, sobolev_batch; assert not {'numpy', 'xarray', 'dask', 'zarr'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
