"""Compiled loops: the values of the array code they stand beside, for any triangles, and where they are kept."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from sobolev_batch import Mesh
from sobolev_batch.arrays import Complexes, Reals
from sobolev_batch.shapes import icosphere
from sobolev_batch.transform import exact
from sobolev_batch.transform.exact import exact_transform
from tests.support.shapes import box
from tests.transform.test_exact import SHAPES, oracle

Transform = Callable[[Mesh, Reals], Complexes]


def _soup(corners: Reals) -> Mesh:
    return Mesh(corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3))


def _random(scale: float = 1.0, offset: float = 0.0) -> Mesh:
    return _soup(scale * np.random.default_rng(2).normal(size=(200, 3, 3)) + offset)


def _slivers() -> Mesh:
    """Two corners of each triangle, or all three, are close together or the same, or on a line."""
    rng = np.random.default_rng(3)
    corners = rng.normal(size=(120, 3, 3))
    close = corners[:, :1] + np.repeat([1e-3, 1e-7, 1e-12, 0.0], 30)[:, None, None] * rng.normal(size=(120, 1, 3))
    corners[:, 1:2] = close
    corners[::3, 2] = corners[::3, 0] * 0.3 + corners[::3, 1] * 0.7 + 1e-6 * rng.normal(size=(40, 3))
    return _soup(corners)


MESHES: dict[str, Callable[[], Mesh]] = {
    "random": _random,
    "slivers": _slivers,
    "huge": lambda: _random(1e6),
    "tiny": lambda: _random(1e-9),
    "far off": lambda: _random(1.0, 1e4),
    "box": box,
    "sphere": lambda: icosphere(3),
}


def values(transform: Transform, mesh: Mesh, frequencies: Reals, *, compiled: bool) -> Complexes:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exact, "pays", lambda seconds: compiled)
        return transform(mesh, frequencies)


def _frequencies(mesh: Mesh) -> Reals:
    """Frequencies from far below the size of the mesh to far beyond, some along axes and diagonals."""
    rng = np.random.default_rng(4)
    directions = np.concatenate([rng.normal(size=(70, 3)), [[1, 0, 0], [0, 0, 1], [1, 1, 0], [1, -1, 0], [1e-9, 0, 1]]])
    size = float(np.ptp(mesh.vertices, axis=0).max())
    return np.asarray(directions * rng.choice([0.0, 1e-3, 0.1, 1.0, 10.0, 100.0], (75, 1)) / size)


@pytest.mark.parametrize("name", MESHES)
def test_loops_agree_with_arrays(name: str) -> None:
    mesh = MESHES[name]()
    frequencies = _frequencies(mesh)
    arrays, loops = (values(exact_transform, mesh, frequencies, compiled=compiled) for compiled in (False, True))
    assert np.abs(loops - arrays).max() <= 5e-14 * mesh.area


@pytest.mark.parametrize("shape", SHAPES)
def test_loops_agree_with_sixty_digits(shape: str) -> None:
    corners = SHAPES[shape]
    frequencies = np.array([[0.31, -0.22, 0.13], [-2.03, 5.07, 3.01]])
    found = values(exact_transform, Mesh(corners, [[0, 1, 2]]), frequencies, compiled=True)
    for frequency, value in zip(frequencies, found, strict=True):
        expected = oracle(corners, frequency)
        assert abs(value - expected) <= 1e-12 * abs(expected)


def test_loops_pass_on_what_is_no_number() -> None:
    frequencies = np.array([[1.0, 2.0, 3.0], [np.nan, 2.0, 3.0], [1.0, np.inf, 3.0], [3.0, 2.0, 1.0]])
    found = values(exact_transform, box(), frequencies, compiled=True)
    assert np.isnan(found).tolist() == [False, True, True, False]
    assert values(exact_transform, box(), frequencies[:0], compiled=True).shape == (0,)


def test_threads_change_nothing() -> None:
    mesh = icosphere(2)
    frequencies = _frequencies(mesh) * 3
    alone = values(exact_transform, mesh, frequencies, compiled=True)
    shared = values(partial(exact_transform, threads=3), mesh, frequencies, compiled=True)
    assert np.array_equal(alone, shared)


SMALL_WORK = """
import sys
import numpy as np
import sobolev_batch as sb
a, b = sb.shapes.icosphere(1), sb.shapes.icosphere(2)
sb.norm(a, -4.0, rtol=1e-2), sb.distance(a, b, -2.0, rtol=1e-1)
print("numba" in sys.modules)
from sobolev_batch.transform.exact import exact_transform
exact_transform(sb.shapes.icosphere(4), 5.0 * np.random.default_rng(0).normal(size=(6000, 3)))
print("numba" in sys.modules)
"""


@pytest.mark.slow
@pytest.mark.process
def test_only_work_of_seconds_loads_numba() -> None:
    command = [sys.executable, "-c", SMALL_WORK]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert printed == ["False", "True"]


def test_loops_work_where_nothing_can_be_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import numba

    # No folder can be made below a file.
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    (tmp_path / "__pycache__").touch()
    for name in ("HOME", "XDG_CACHE_HOME", "IPYTHONDIR"):
        monkeypatch.setenv(name, str(tmp_path / "__pycache__"))
    module = tmp_path / "doubling.py"
    module.write_text("from sobolev_batch.compiled import loop\n@loop\ndef doubled(x):\n    return 2 * x\n")
    spec = importlib.util.spec_from_file_location("doubling", module)
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    spec.loader.exec_module(loaded)
    assert loaded.doubled(3.0) == 6.0
