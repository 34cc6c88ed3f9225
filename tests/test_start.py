"""What a process loads before its first answer: every worker and every command waits for it."""

from __future__ import annotations

import subprocess
import sys

import pytest

# Packages that take 50 ms or more to load and that a first field does without.
HEAVY = {
    *("bokeh", "cuda", "cufinufft", "cupy", "distributed", "fast_simplification", "fsspec", "matplotlib", "nibabel"),
    *("networkx", "pyvista", "tabulate", "trimesh", "vtkmodules", "zarr"),
}
LIBRARIES = HEAVY | {"dask", "finufft", "numpy", "pandas", "pydantic", "scipy", "xarray"}
FIRST_FIELD = """
import sobolev_batch as sb
sb.fourier_transform(sb.shapes.icosphere(1), sb.Lattice(xi_max=1.0, M=8))
"""
# Parts of SciPy that a first field may load: sizes of lattices, step functions, and what these load.
PARTS_OF_SCIPY = {"fft", "fftpack", "linalg", "sparse", "special", "version"}


@pytest.mark.process
@pytest.mark.parametrize(
    ("code", "unwanted"),
    [
        ("import sobolev_batch", LIBRARIES),
        # Help texts appear before anything computes.
        ("import sobolev_batch.cli", LIBRARIES),
        (FIRST_FIELD, HEAVY),
    ],
)
def test_a_first_use_loads_little(code: str, unwanted: set[str]) -> None:
    command = [sys.executable, "-c", f"{code}\nimport sys; print(*sys.modules)"]
    loaded = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert "sobolev_batch" in loaded
    assert not {name.split(".")[0] for name in loaded} & unwanted
    parts = {name.split(".")[1] for name in loaded if name.startswith("scipy.") and name[6] != "_"}
    assert parts <= PARTS_OF_SCIPY
