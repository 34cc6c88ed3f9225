"""What is computed again after a change; the same store whatever the workers, and however often a task is done."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from subprocess import PIPE
from typing import Any

import numpy as np
import pandas as pd
import pytest
import trimesh
from distributed import Client

from sobolev_batch import Study, open_store, run, table, verify
from sobolev_batch.batch.cluster.clients import local_client, thread_client
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.batch.prune import prune
from sobolev_batch.batch.status import status
from sobolev_batch.errors import StoreError
from sobolev_batch.store.layout import Store
from sobolev_batch.store.location import Location
from sobolev_batch.store.metadata import SCHEMA_VERSION
from sobolev_batch.store.records import Records
from sobolev_batch.study import plan as plan_module
from tests.support.stores import assert_same_results, contents
from tests.support.studies import balls, small_table, variable

ALL = ("f/a", "f/b", "reference")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a", "b"):
        trimesh.creation.box().export(tmp_path / f"{name}.off")
    return tmp_path


def study_of(folder: Path, **changes: Any) -> Study:
    family = [{"name": "f", "source": "files", "paths": ["*.off"]}]
    return Study.from_table(small_table(family=family, **changes), folder=folder)


def written(store: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in (store / "fourier/fourier/c").rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("changes", "computed"),
    [
        ({}, ()),
        ({"norm": {"orders": [-7.0, -3.0]}}, ()),
        ({"compare": None}, ()),
        ({"study": {"name": "small", "title": "another title"}}, ()),
        ({"transform": {"backend": "cpu"}}, ()),
        ({"transform": {"eps": 1e-7}}, ALL),
        ({"transform": {"quadrature": 4}}, ALL),
        ({"scaling": {"mode": "fixed", "scale": 0.5}}, ALL),
    ],
)
def test_a_change_of_the_study(
    changes: dict[str, Any], computed: tuple[str, ...], folder: Path, store_path: Path, client: Client
) -> None:
    assert run(study_of(folder), store_path, client).computed == ALL
    before, pairs = written(store_path), variable(open_store(store_path), "distances", "distance").load()
    assert run(study_of(folder, **changes), store_path, client).computed == computed
    after = written(store_path)
    assert {path for path in after if after[path] != before[path]} == (set(after) if computed else set())
    tree = open_store(store_path)
    distances, others = (variable(tree, name, "distance") for name in ("convergence", "distances"))
    assert distances["order"].values.tolist() == changes.get("norm", {}).get("orders", [-10.0, -3.0])
    assert np.isfinite(distances.values).all()
    assert others["other"].values.tolist() == (["reference"] if "compare" in changes else [*ALL])
    if "compare" in changes:
        assert np.allclose(others, pairs.sel(other=["reference"]), rtol=1e-12, atol=0)


def test_meshes_that_the_study_has_no_longer_are_verified_and_counted_apart(
    folder: Path, store_path: Path, threads: Client
) -> None:
    run(study_of(folder), store_path, threads)
    (folder / "b.off").unlink()
    run(study_of(folder), store_path, threads)
    found = verify(store_path)
    assert (found.complete, found.total, found.removed, status(store_path).total) == (2, 2, 1, 2)
    assert "2 of 2 surfaces complete, their fields read back, with 1 that the study has no longer" in str(found)
    prune(Location.parse(store_path), is_dry=False)
    assert (verify(store_path).total, verify(store_path).removed) == (2, 0)


@pytest.mark.parametrize("changes", [{"scaling": {"mode": "fixed", "scale": 0.5}}, {"transform": {"eps": 1e-7}}])
def test_tables_of_fields_that_are_replaced_are_withdrawn_first(
    changes: dict[str, Any], folder: Path, store_path: Path, client: Client
) -> None:
    run(study_of(folder), store_path, client)

    def interrupt(progress: Progress) -> None:
        if progress.stage == "fields" and progress.done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(study_of(folder, **changes), store_path, client, on_progress=interrupt)
    tree = open_store(store_path)
    assert "convergence" not in tree.children
    assert tree["fourier"].to_dataset()["quality"].values.tolist() == [""] * 3
    assert run(study_of(folder, **changes), store_path, client).failed == {}
    assert verify(store_path).is_sound


@pytest.mark.parametrize(
    ("meshes", "octaves", "again"),
    [
        # Beyond a given lattice, fields are compared with a reference that has flat faces, and beyond octaves.
        ([trimesh.creation.box((1.0, 1.0, height)) for height in (1.0, 0.5)], 0, ("f/a", "f/b")),
        ([trimesh.creation.icosphere(subdivisions=2, radius=radius) for radius in (0.6, 0.5)], 0, ()),
        ([trimesh.creation.icosphere(subdivisions=2, radius=radius) for radius in (0.6, 0.5)], 1, ("f/a", "f/b")),
        # Octaves are sampled around the normals of flat faces.
        ([trimesh.creation.icosphere(subdivisions=2, radius=0.6), trimesh.creation.box()], 1, ("f/a", "f/b")),
    ],
)
def test_distances_are_those_to_the_reference_of_the_study(
    meshes: list[trimesh.Trimesh], octaves: int, again: tuple[str, ...], folder: Path, store_path: Path, client: Client
) -> None:
    lattice = {**small_table()["lattice"], "octaves": octaves}
    for name, mesh in zip("ab", meshes, strict=True):
        mesh.export(folder / f"{name}.off")
    for name, computed in (("a", ("f/a", "f/b")), ("b", again)):
        reference = {"source": "family", "family": "f", "member": name}
        study = study_of(folder, scaling={"mode": "fixed", "scale": 1.0}, reference=reference, lattice=lattice)
        assert run(study, store_path, client).computed == computed
        distances = variable(open_store(store_path), "convergence", "distance")
        assert distances.mesh[(distances == 0).all("order")].values.tolist() == [f"f/{name}"]


@pytest.mark.parametrize(
    ("names", "first", "changes"),
    [
        ((), {}, {"scaling": {"mode": "fixed", "scale": 0.5}}),
        (("o", "p"), {}, {"transform": {"eps": 1e-7}}),
        ((), {"lattice": None, "accuracy": {"rtol": 0.3}}, {"accuracy": {"rtol": 0.1}}),
    ],
)
def test_a_run_of_a_part_loses_no_field_that_it_leaves_out(
    names: tuple[str, ...],
    first: dict[str, Any],
    changes: dict[str, Any],
    folder: Path,
    store_path: Path,
    threads: Client,
) -> None:
    """Nor does any table mix those of two studies."""
    of_objects = {"object": balls(**dict.fromkeys(names, 1.0))} if names else {}
    study, other = study_of(folder, **of_objects, **first), study_of(folder, **of_objects, **first | changes)
    run(study, store_path, threads)
    before = table(store_path)
    with pytest.raises(StoreError, match="1 fields that this run of a part leaves out would be lost, such as f/b; run"):
        run(other, store_path, threads, only=["f/a"])
    assert verify(store_path).is_sound
    assert run(study, store_path, threads).computed == ()
    pd.testing.assert_frame_equal(table(store_path), before)
    # Who names all that has a field loses nothing.
    again = {label.rpartition("/")[2] for label in run(other, store_path, threads, only=["f/*"]).computed}
    assert again == {"a", "b", "reference"}


@pytest.mark.parametrize("names", [(), ("o", "p")])
def test_a_run_of_a_part_leaves_other_meshes_that_changed_to_the_next(
    names: tuple[str, ...], folder: Path, store_path: Path, client: Client
) -> None:
    """Also where it computes nothing itself."""
    radii = balls(**dict.fromkeys(names, 1.0))
    study, others = (
        study_of(folder, **({"object": radii} if radii else {})),
        {f"{name}/f/b" for name in names} or {"f/b"},
    )
    run(study, store_path, client)
    trimesh.creation.box((1.0, 1.0, 0.5)).export(folder / "b.off")
    assert run(study, store_path, client, only=["f/a"]).computed == ()
    rows = table(store_path)
    assert set(rows["mesh"][rows["status"] == "missing"]) == {"f/b"}
    assert set(run(study, store_path, client).computed) == others


def test_a_changed_file_and_changed_numerics(
    folder: Path, store_path: Path, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(study_of(folder), store_path, client)
    trimesh.creation.box((1.0, 1.0, 0.5)).export(folder / "b.off")
    assert run(study_of(folder), store_path, client).computed == ("f/b",)
    # The same content with another date is no change.
    (folder / "a.off").touch()
    assert run(study_of(folder), store_path, client).computed == ()
    monkeypatch.setattr(plan_module, "NUMERICS_VERSION", -1)
    assert run(study_of(folder), store_path, client).computed == ALL


def test_a_store_of_another_schema_is_refused_and_left_alone(folder: Path, store_path: Path, client: Client) -> None:
    run(study_of(folder), store_path, client)
    root = store_path / "zarr.json"
    document = json.loads(root.read_text())
    for version in (1, 2, 99, "3", None):
        document["attributes"]["schema_version"] = version
        root.write_text(json.dumps(document))
        before = contents(store_path)
        message = f"its schema has version {version}, this program reads {SCHEMA_VERSION}; run the study"
        for use in (open_store, status, lambda place: run(study_of(folder), place, client)):
            with pytest.raises(StoreError, match=message):
                use(store_path)
        assert before == contents(store_path)


def test_a_file_that_changes_while_the_study_goes_on(folder: Path, store_path: Path, client: Client) -> None:
    original = (folder / "b.off").read_bytes()

    def change(progress: Progress) -> None:
        if progress.stage == "cluster":
            trimesh.creation.box((1.0, 1.0, 0.5)).export(folder / "b.off")

    summary = run(study_of(folder), store_path, client, on_progress=change)
    assert list(summary.failed) == ["f/b"]
    assert "was changed while the study was going on" in summary.failed["f/b"]
    (folder / "b.off").write_bytes(original)
    assert run(study_of(folder), store_path, client).computed == ("f/b",)
    distances = variable(open_store(store_path), "convergence", "distance")
    assert np.array_equal(distances.sel(mesh="f/a").values, distances.sel(mesh="f/b").values)


@pytest.mark.parametrize(
    "cluster",
    [partial(thread_client, 4), *(pytest.param(partial(local_client, n), marks=pytest.mark.all) for n in (1, 3))],
)
def test_workers_and_threads(
    cluster: Callable[[], AbstractContextManager[Client]], study: Study, finished_store: Path, store_path: Path
) -> None:
    with cluster() as client:
        run(study, store_path, client)
    # Bit for bit; what is summed over tiles of other sizes, to rounding.
    assert_same_results(store_path, finished_store)


# Two processes that do the same tasks at the same time, again and again.
TWICE = """
import os, sys
from sobolev_batch import Study
from sobolev_batch.study.plan import make_plan
from sobolev_batch.store.workspace import Workspace
from sobolev_batch.store.layout import Store
from sobolev_batch.store.location import Location
from sobolev_batch.store.records import Records
from sobolev_batch.batch.field_tasks import Job, compute_mesh
from tests.support.studies import small_table

plan = make_plan(Study.from_table(small_table()))
store = Store.open(sys.argv[1])
print("ready", flush=True)
sys.stdin.readline()
for i, row in Workspace.for_plan(store, plan).rows.items():
    if row.label == "reference":
        continue
    job = Job(store, i, row, plan)
    for _ in range(5):
        Records(store).write(i, None)
        assert compute_mesh(job, plan.blocks).status == "complete"
"""


@pytest.mark.process
def test_the_same_task_twice_at_once(study: Study, finished_store: Path, store_path: Path, threads: Client) -> None:
    run(study, store_path, threads)
    start = partial(
        subprocess.Popen, [sys.executable, "-c", TWICE, str(store_path)], stdin=PIPE, stdout=PIPE, text=True
    )
    with start() as one, start() as other:
        for twin in (one, other):
            assert twin.stdout is not None
            assert twin.stdout.readline() == "ready\n"
        # The end of their input is the word to go on.
        for twin in (one, other):
            assert twin.stdin is not None
            twin.stdin.close()
    assert (one.returncode, other.returncode) == (0, 0)
    assert_same_results(store_path, finished_store)
    # Facts as text, since those of a sphere hold NaN.
    ours, clean = (
        [(str(record.facts), record.quality, record.checksums) for record in Records(Store.open(path)).read() if record]
        for path in (store_path, finished_store)
    )
    assert ours == clean
    assert run(study, store_path, threads).computed == ()
