"""Counts of the work behind public calls: they catch a second transform of one mesh, which no result shows.

A count is the same on each machine, where seconds are not. A change that raises a count changes the table.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from io import BufferedReader
from pathlib import Path
from typing import Any

import finufft
import pytest
import xarray as xr

import sobolev_batch as sb
from sobolev_batch.geometry.formats import parsing
from sobolev_batch.sources import files
from sobolev_batch.sources.command import CommandSource
from sobolev_batch.tables.other_orders import table_at
from sobolev_batch.transform import kinds
from sobolev_batch.transform.exact import exact_transform
from tests.support.commands import call, write_toml
from tests.support.studies import SMALL_LATTICE, small_table

COARSE, FINE, SPHERE = sb.shapes.icosphere(1), sb.shapes.icosphere(2), sb.shapes.Sphere()


def run_study(store: str, *levels: int) -> None:
    """Run a study of some icospheres in threads of this process, where calls are counted."""
    family = [{"name": "ico", "source": "icosphere", "levels": list(levels)}]
    sb.run(sb.Study.from_table(small_table(family=family)), f"memory://counts-{store}")


# Each call, with the most NUFFTs, points in them and terms of exact transforms that it may take, and why it takes them.
WORK: dict[str, tuple[Callable[[], object], int, int, int, str]] = {
    "distance of a mesh from itself": (
        lambda: sb.distance(FINE, FINE, -4.0, lattice=SMALL_LATTICE),
        *(0, 0, 0),
        "equal surfaces are equal by their triangles",
    ),
    "norm of a mesh": (
        lambda: sb.norm(FINE, -4.0, lattice=SMALL_LATTICE),
        *(1, 19_200, 10_240),
        "one field, probed at 32 frequencies",
    ),
    "distance of two meshes": (
        lambda: sb.distance(COARSE, FINE, -4.0, lattice=SMALL_LATTICE),
        *(2, 28_160, 1_265_000),
        "one field of each mesh, probed at 32 frequencies, and exact values beyond the lattice, which take 0.01 s",
    ),
    "distances at three orders": (
        lambda: sb.distance(COARSE, FINE, [-2.0, -4.0, -6.0], lattice=SMALL_LATTICE),
        *(2, 28_160, 1_265_000),
        "all orders share the fields, their probes, and the values beyond the lattice",
    ),
    "distance of a mesh from a sphere": (
        lambda: sb.distance(FINE, SPHERE, -4.0, lattice=SMALL_LATTICE),
        *(1, 19_200, 10_240),
        "the transform of a sphere is a formula",
    ),
    "distance to an accuracy": (
        lambda: sb.distance(COARSE, FINE, -4.0, rtol=0.05),
        *(2, 4_202, 25_600),
        "the lattice is chosen from exact values, before one coarse field of each mesh",
    ),
    "distance to a high accuracy": (
        lambda: sb.distance(sb.shapes.icosphere(4), SPHERE, -10.0, rtol=7e-4),
        *(2, 23_040, 491_520),
        "a field, probed at common frequencies and at as many of its own, and a coarse one beyond, probed at few",
    ),
    "gradient": (
        lambda: sb.fitting.gradient(COARSE, SPHERE, -4.0, lattice=SMALL_LATTICE),
        *(10, 99_680, 0),
        "a field and two sums at the nodes, at two accuracies, and four fields for the share of the target's error",
    ),
    "verdict on equal meshes": (
        lambda: sb.testing.same_surface(FINE, FINE),
        *(0, 0, 0),
        "equal surfaces are equal by their triangles",
    ),
    "verdict far from its tolerance": (
        lambda: sb.testing.same_surface(COARSE, FINE, tolerance=1e-3, order=-4.0),
        *(3, 47_340, 25_600),
        "a rough norm of the reference, and the two fields on one lattice",
    ),
    "verdict near its tolerance": (
        lambda: sb.testing.same_surface(COARSE, FINE, tolerance=0.1, order=-4.0),
        *(5, 22_144, 51_200),
        "a rough norm of the reference, and the two fields on two lattices",
    ),
    "study of one mesh": (
        partial(run_study, "one", 1),
        *(1, 8_960, 5_040),
        "its field, probed for an order far off too; the reference is a sphere",
    ),
    "study of two meshes": (
        partial(run_study, "two", 1, 2),
        *(2, 28_160, 25_200),
        "one field of each mesh, whatever is compared with it",
    ),
    "second run of a study": (
        partial(run_study, "second", 0, 1),
        *(0, 0, 0),
        "its fields are stored, with their probes",
    ),
}


def work_of(call: Callable[[], object]) -> dict[str, int]:
    """Count NUFFTs, their points, and the terms of exact transforms: pairs of a triangle and a frequency."""
    # Appending is safe from several threads.
    events: list[tuple[str, int]] = []

    class Plan(finufft.Plan):  # type: ignore[misc]
        def setpts(self, *coordinates: Any, **targets: Any) -> Any:
            self.point_count = len(coordinates[0])
            return super().setpts(*coordinates, **targets)

        def execute(self, *arguments: Any, **settings: Any) -> Any:
            events.extend((("transforms", 1), ("points", self.point_count)))
            return super().execute(*arguments, **settings)

    def counting(values: Callable[..., Any]) -> Callable[..., Any]:
        def transform(mesh: sb.Mesh, frequencies: Any, *others: Any) -> Any:
            events.append(("exact", len(mesh.triangles) * len(frequencies)))
            return values(mesh, frequencies, *others)

        return transform

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finufft, "Plan", Plan)
        patch.setattr(kinds, "exact_transform", counting(exact_transform))
        call()
    return {name: sum(count for kind, count in events if kind == name) for name in ("transforms", "points", "exact")}


@pytest.mark.parametrize("name", WORK)
def test_a_call_takes_no_more_work_than_its_row(name: str) -> None:
    call, *most, reason = WORK[name]
    if name == "second run of a study":
        assert work_of(call)["transforms"] == 2
    work = work_of(call)
    assert all(count <= limit for count, limit in zip(work.values(), most, strict=True)), (work, most, reason)


def test_a_count_sees_each_transform() -> None:
    # Else all rows would hold of a count that sees nothing.
    norm = WORK["norm of a mesh"][0]
    one, two = work_of(norm), work_of(lambda: (norm(), norm()))
    assert min(one.values()) > 0
    assert two == {name: 2 * count for name, count in one.items()}


def test_fields_that_are_kept_are_probed_for_other_orders_too() -> None:
    mesh = sb.shapes.icosphere(1)
    once = work_of(lambda: sb.norm(mesh, -4.0, lattice=SMALL_LATTICE))["exact"]
    assert work_of(lambda: sb.fourier_transform(mesh, SMALL_LATTICE, order=-4.0))["exact"] > once
    assert work_of(partial(run_study, "kept", 1))["exact"] > once


# How often a run lists a source, checks a mesh, and asks for the version of a program; and reads each file as a whole.
Counts = Counter[str]


@pytest.fixture
def counts(monkeypatch: pytest.MonkeyPatch) -> Counts:
    """Count what happens in this process. Files count as written long ago, so that their digests may be kept."""
    counted: Counts = Counter()

    class Counted(BufferedReader):
        def read(self, size: int | None = -1, /) -> bytes:
            data = super().read(size)
            counted[f"bytes of {Path(self.name).name}"] += len(data)
            return data

        def readinto(self, buffer: Any, /) -> int:
            length = super().readinto(buffer)
            counted[f"bytes of {Path(self.name).name}"] += length
            return length

    def counting(kind: type, name: str, what: str) -> None:
        own = getattr(kind, name)

        def call(*arguments: Any) -> Any:
            # Predictions are made from a small shape of each size, once in a process.
            counted[what] += kind is not sb.Mesh or len(arguments[2]) > 1000
            return own(*arguments)

        monkeypatch.setattr(kind, name, call)

    opened, now = parsing.open_regular, time.time_ns
    for module in (parsing, files):
        monkeypatch.setattr(module, "open_regular", lambda path: Counted(opened(path).detach()))
    monkeypatch.setattr(time, "time_ns", lambda: now() + 10**10)
    counting(files.FileSource, "members", "lists of files")
    counting(CommandSource, "members", "lists of a command")
    counting(sb.Mesh, "__init__", "meshes")
    return counted


def five_files(folder: Path, **changes: Any) -> sb.Study:
    """Return a study of five mesh files and a file for the reference, in another place and unit."""
    for number in range(6):
        mesh = sb.shapes.icosphere(5)
        name = "reference" if number == 5 else f"mesh{number}"
        sb.write_mesh(sb.Mesh(mesh.vertices * (30 + number), mesh.triangles), folder / f"{name}.ply")
    family = [{"name": "f", "source": "files", "paths": ["mesh*.ply"]}]
    reference = {"source": "files", "paths": ["reference.ply"]}
    return sb.Study.from_table(small_table(**{"family": family, "reference": reference, **changes}), folder=folder)


def test_a_run_lists_and_reads_and_checks_once(tmp_path: Path, counts: Counts) -> None:
    study = five_files(tmp_path)
    counts.clear()
    assert len(sb.run(study, "memory://settled.zarr").computed) == 6
    # The families and the reference; five meshes in their tasks, and the reference for the plan and in its task.
    assert (counts["lists of files"], counts["meshes"]) == (2, 7)
    for file in tmp_path.glob("*.ply"):
        # For the plan and in the task, and some headers.
        assert counts[f"bytes of {file.name}"] // file.stat().st_size == 2, file
    counts.clear()
    assert len(sb.run(study, "memory://settled.zarr").reused) == 6
    assert (counts["lists of files"], counts["meshes"]) == (2, 1)
    assert counts["bytes of mesh0.ply"] < 0.5 * (tmp_path / "mesh0.ply").stat().st_size


@pytest.mark.slow
def test_a_plan_that_looks_at_meshes_reads_none_of_them_twice(tmp_path: Path, counts: Counts) -> None:
    study = five_files(tmp_path, lattice=None, accuracy={"rtol": 0.3}, norm={"orders": [-4.0]})
    counts.clear()
    plan = sb.plan(study, "memory://looked-at.zarr")
    assert (len(plan.object.labels), plan.object.doubtful) == (6, {})
    assert counts["lists of files"] == 2
    for file in tmp_path.glob("*.ply"):
        assert counts[f"bytes of {file.name}"] // file.stat().st_size == 1, file


def test_the_command_builds_the_tables_that_it_prints_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[str] = []

    def counted(tree: xr.DataTree, *arguments: Any) -> xr.Dataset:
        built.append(str(tree.attrs["title"]))
        return table_at(tree, *arguments)

    monkeypatch.setattr("sobolev_batch.tables.convergence.table_at", counted)
    done = call("run", write_toml(tmp_path), "--store", "memory://printed.zarr")
    assert "Verdict at order -10" in done.stdout
    assert built == ["small"]


@pytest.mark.process
def test_the_version_of_a_program_is_asked_once_where_anything_is_missing(tmp_path: Path, counts: Counts) -> None:
    asked, version = tmp_path / "asked", tmp_path / "version"
    version.write_text("1.0")
    command = {
        "source": "command",
        "mesh": {"source": "icosphere", "levels": [1]},
        "command": ["cp", "{input}", "{output}", "-{n}"],
        "version": ["sh", "-c", f"echo >> {asked}; cat {version}"],
    }

    def run(*options: str) -> tuple[int, int, int]:
        """Return how many meshes were made, how often the version was asked, and how often each family was listed."""
        families = [{**command, "name": name, "n": list(options)} for name in ("one", "two")]
        counts.clear()
        asked.write_text("")
        summary = sb.run(
            sb.Study.from_table(small_table(family=families)), "memory://versions.zarr", allow_commands=True
        )
        return len(summary.computed), len(asked.read_text()), counts["lists of a command"] // 2

    assert run("f", "p", "v") == (7, 1, 1)
    assert run("f", "p", "v") == (0, 0, 1)
    assert run("f", "p", "v", "u") == (2, 1, 1)
    # Of another version they are other meshes, and the study is listed again. A finished study stays as it is.
    version.write_text("1.1")
    assert run("f", "p", "v", "u") == (0, 0, 1)
    assert run("f", "p", "v", "u", "L") == (10, 1, 2)
    assert run("f", "p", "v", "u", "L") == (0, 0, 1)
