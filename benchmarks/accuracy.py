"""A distance to a given accuracy: how long it takes and what a mesh takes in a store."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import xarray as xr

import sobolev_batch as sb
from benchmarks.paper import relative_distance
from benchmarks.table import Row, as_bytes, as_seconds, at_least, at_most
from benchmarks.timing import Effort, take_turns
from benchmarks.transforms import ORDER, Case

_RTOL = 1e-5
_SPEED_UP = at_least(16)
_STORED = at_most(1 / 16)

# The lattice of the paper's pipeline, to the same digits.
_PAPERS_INTERVALS = 128
_SAMPLE_BYTES = 16


def left_to_us(effort: Effort) -> Iterator[Row]:
    """Item 2: the lattice chosen for a given accuracy, with the error estimate."""
    level, intervals = (4, 64) if effort.quick else (7, _PAPERS_INTERVALS)
    what = f"T_{level}, rtol {_RTOL:g}"
    if not _chooses_lattices():
        yield Row("2", f"{what}: distance with its error", target=_SPEED_UP)
        return
    case = Case.from_level(level, intervals, effort)

    def papers(mesh: sb.Mesh) -> object:
        return relative_distance(case.papers(mesh), case.lattice, ORDER)

    ours, other = take_turns([_accurate_distance, papers], case.fresh_mesh, effort.repeats)
    yield Row("2", f"{what}: distance with its error", as_seconds(ours), as_seconds(other), other / ours, _SPEED_UP)
    found = _accurate_distance(case.mesh)
    near = found["distance"].item() / sb.norm(sb.shapes.Sphere(), ORDER)["norm"].item()
    far = relative_distance(case.papers(case.mesh), case.lattice, ORDER)
    difference = abs(near - far) / far
    yield Row("2", f"{what}: relative difference", f"{near:.6e}", f"{far:.6e}", difference, at_most(_RTOL))
    claimed = found["error"].item() / found["distance"].item()
    yield Row("2", f"{what}: relative error reported", ratio=claimed, target=at_most(_RTOL))


def stored_bytes(effort: Effort) -> Iterator[Row]:
    """Item 7: what the field of one mesh takes in a store, at the same digits as the paper's lattice."""
    level = 4 if effort.quick else 7
    what = f"T_{level}, rtol {_RTOL:g}: bytes stored per mesh"
    if not _chooses_lattices():
        yield Row("7", what, target=_STORED)
        return
    lattice = _chosen_lattice(_accurate_distance(sb.shapes.icosphere(level)))
    table = {
        "study": {"name": "stored"},
        "lattice": {"xi_max": lattice.xi_max, "M": lattice.M},
        "norm": {"orders": [ORDER]},
        "reference": {"source": "sphere"},
        "family": [{"name": "icosphere", "source": "icosphere", "levels": [level]}],
    }
    with TemporaryDirectory() as folder:
        summary = sb.run(sb.Study.from_table(table), Path(folder) / "stored.zarr", workers=1)
        files = (Path(summary.store) / "fourier").rglob("*")
        stored = sum(file.stat().st_size for file in files if file.is_file()) / len(summary.computed)
    whole = (_PAPERS_INTERVALS + 1) ** 3 * _SAMPLE_BYTES
    yield Row("7", what, as_bytes(stored), as_bytes(whole), stored / whole, _STORED)


def _accurate_distance(mesh: sb.Mesh) -> xr.Dataset:
    measured: Callable[..., xr.Dataset] = sb.distance
    return measured(mesh, sb.shapes.Sphere(), ORDER, rtol=_RTOL)


def _chosen_lattice(found: xr.Dataset) -> sb.Lattice:
    return sb.Lattice(float(found.attrs["xi_max"]), int(found.attrs["M"]))


def _chooses_lattices() -> bool:
    return "rtol" in inspect.signature(sb.distance).parameters
