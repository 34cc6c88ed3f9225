"""What is computed again after a change: what depends on it, and nothing else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from distributed import Client

from sobolev_batch import StoreError, Study, open_store, run, verify
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.batch.store.metadata import SCHEMA_VERSION
from sobolev_batch.batch.study import plan as plan_module
from sobolev_batch.results.status import Status
from tests.support.stores import contents
from tests.support.studies import small_table, variable

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
    before = written(store_path)
    assert run(study_of(folder, **changes), store_path, client).computed == computed
    after = written(store_path)
    assert {path for path in after if after[path] != before[path]} == (set(after) if computed else set())
    orders = changes.get("norm", {}).get("orders", [-10.0, -3.0])
    tree = open_store(store_path)
    assert variable(tree, "convergence", "order").values.tolist() == orders
    assert np.isfinite(variable(tree, "convergence", "distance").values).all()


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


def test_distances_are_those_to_the_reference_of_the_study(folder: Path, store_path: Path, client: Client) -> None:
    trimesh.creation.box((1.0, 1.0, 0.5)).export(folder / "b.off")
    for name, computed in (("a", ("f/a", "f/b")), ("b", ())):
        reference = {"source": "family", "family": "f", "member": name}
        study = study_of(folder, scaling={"mode": "fixed", "scale": 1.0}, reference=reference)
        assert run(study, store_path, client).computed == computed
        distances = variable(open_store(store_path), "convergence", "distance")
        assert distances.mesh[(distances == 0).all("order")].values.tolist() == [f"f/{name}"]


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
        for use in (open_store, Status.from_store, lambda place: run(study_of(folder), place, client)):
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
    tree = open_store(store_path)
    distances = variable(tree, "convergence", "distance")
    assert np.array_equal(distances.sel(mesh="f/a").values, distances.sel(mesh="f/b").values)
