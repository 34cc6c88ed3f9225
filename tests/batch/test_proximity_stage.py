"""Hausdorff and Chamfer distances that a study asks for, in its store."""

from __future__ import annotations

import math
import os
import shutil
import signal
import threading
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import xarray as xr
from distributed import Client

import sobolev_batch as sb
from sobolev_batch import compiled
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.batch.proximity_stage import measure_proximity
from sobolev_batch.geometry import proximity
from sobolev_batch.store.field_arrays import Fields
from sobolev_batch.store.layout import Store
from sobolev_batch.store.records import Records
from sobolev_batch.study.plan import make_plan
from sobolev_batch.study.schema import ProximitySection
from tests.support.stores import assert_same_results
from tests.support.studies import small_table, variable

MESHES = ("ico/0", "ico/1", "ico/2", "ico/3")


class Killed(Exception):  # noqa: N818  # it stands for an end without a word, not for an error
    """The end of a run, at any of its steps."""


def study_of(folder: Path = Path(), **changes: Any) -> sb.Study:
    asked = {"reference": {"source": "icosphere", "levels": [4]}, "proximity": {"points": 300}}
    # Numbers are in the unit of the files, whatever that of the study is.
    asked["scaling"] = {"mode": "fixed", "scale": 0.5}
    return sb.Study.from_table(small_table(**{**asked, **changes}), folder=folder)


def measured(study: sb.Study, path: Path, client: Client) -> list[str]:
    """Run a study, and return the meshes whose distances were measured."""
    labels: list[str] = []

    def note(progress: Progress) -> None:
        if progress.stage == "proximity" and progress.label:
            labels.append(progress.label)

    sb.run(study, path, client, on_progress=note)
    return sorted(labels)


def assert_right(path: Path, study: sb.Study) -> None:
    """Every mesh's distances are those that the library finds; the reference has none."""
    plan, table = make_plan(study), xr.open_datatree(path, engine="zarr")["proximity"].to_dataset().load()
    meshes: Any = {row.label: row.member.load() for row in plan.rows}
    assert set(table["mesh"].values) == set(meshes)
    reference = meshes.pop(plan.reference)
    assert np.isnan(table["chamfer"].sel(mesh=plan.reference))
    for label, mesh in meshes.items():
        assert study.proximity is not None
        expected = sb.proximity(mesh, reference, points=study.proximity.points)
        found = {name: table[name].sel(mesh=label).item() for name in expected}
        assert found == pytest.approx(expected, rel=1e-12)


@pytest.fixture(scope="module")
def finished(threads: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with distances; not to be changed."""
    path = tmp_path_factory.mktemp("proximity") / "results.zarr"
    sb.run(study_of(), path, threads)
    return path


@pytest.fixture
def store(finished: Path, store_path: Path) -> Path:
    shutil.copytree(finished, store_path)
    return store_path


def test_what_a_change_of_the_study_measures(store: Path, threads: Client) -> None:
    assert_right(store, study_of())
    assert sb.verify(store).is_sound
    # Without a client: a cluster would be started, and say so.
    stages: list[str] = []
    sb.run(study_of(), store, on_progress=lambda progress: stages.append(progress.stage))
    assert stages == []
    grown = study_of(family=[{"name": "ico", "source": "icosphere", "levels": [0, 1, 2, 3, 5]}])
    assert measured(grown, store, threads) == ["ico/5"]
    assert_right(store, grown)
    assert measured(study_of(proximity={"points": 200}), store, threads) == [*MESHES]
    assert_right(store, study_of(proximity={"points": 200}))
    # What tables show was measured already.
    assert measured(study_of(proximity={"points": 200, "metrics": ["rms", "volume"]}), store, threads) == []
    assert {"rms", "rms_backward", "volume"} <= set(sb.table(store)) - {"hausdorff"}
    # The study's unit stays, and so do the fields of the meshes.
    other = study_of(reference={"source": "icosphere", "levels": [3]}, scaling={"mode": "none"})
    assert measured(other, store, threads) == [*MESHES]
    assert_right(store, other)


def test_distances_that_nobody_asks_for_any_more_go(store: Path, threads: Client) -> None:
    fields = Fields(Store(store)).complete_rows()
    assert measured(study_of(proximity=None), store, threads) == []
    assert "proximity" not in sb.open_store(store).children
    assert not (store / "proximity").exists()
    assert Fields(Store(store)).complete_rows() == fields
    # The records still have them.
    assert measured(study_of(), store, threads) == []
    assert_right(store, study_of())


@pytest.mark.parametrize("last", [1, 4])
def test_a_store_can_be_read_at_every_step_and_after_an_end_at_any(last: int, store: Path, threads: Client) -> None:
    changed, steps = study_of(proximity={"points": 100}), 0

    def look(progress: Progress) -> None:
        nonlocal steps
        steps += progress.stage == "proximity"
        tree = xr.open_datatree(store, engine="zarr").load()
        assert sb.open_store(store).children.keys() == tree.children.keys()
        if steps == last:
            raise Killed

    with pytest.raises(Killed):
        sb.run(changed, store, threads, on_progress=look)
    assert sb.verify(store).is_sound
    # Tasks that had begun may have ended besides.
    assert len(measured(changed, store, threads)) <= 5 - last
    assert_right(store, changed)


def test_meshes_that_cannot_be_measured(store_path: Path, tmp_path: Path, threads: Client) -> None:
    (tmp_path / "bad.off").write_text("OFF\n1 1 0\n0 0 0\n3 0 1 2\n")
    family = [
        {"name": "ico", "source": "icosphere", "levels": [1]},
        {"name": "bad", "source": "files", "paths": ["bad.off"]},
        {"name": "closed", "source": "sphere"},
    ]
    study = study_of(tmp_path, family=family)
    summary = sb.run(study, store_path, threads)
    assert ([*summary.failed], summary.not_compared) == (["bad/bad"], {})
    chamfer = variable(sb.open_store(store_path), "proximity", "chamfer")
    assert np.isfinite(chamfer.sel(mesh="ico/1"))
    assert np.isnan(chamfer.sel(mesh=["bad/bad", "closed/sphere", "reference"])).all()


def test_too_little_memory_is_foreseen_and_a_later_run_makes_up_for_it(
    store: Path, threads: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = study_of(proximity={"points": 100})
    with monkeypatch.context() as patched:
        patched.setattr(proximity, "POINT_BYTES", 1e13)
        summary = sb.run(study, store, threads)
    assert sorted(summary.not_compared) == [*MESHES]
    assert summary.not_compared["ico/0"].startswith("no proximity: it takes about")
    assert "start workers with more memory" in summary.not_compared["ico/0"]
    assert sb.status(store).not_compared == summary.not_compared
    assert f"ico/0: {summary.not_compared['ico/0']}" in str(sb.status(store))
    assert "takes about" in variable(sb.open_store(store), "proximity", "reason").sel(mesh="ico/0").item()
    assert measured(study, store, threads) == [*MESHES]
    assert sb.status(store).not_compared == {}
    assert_right(store, study)


def test_distances_do_not_depend_on_what_the_process_did_before(store: Path) -> None:
    here, plan, found = Store.open(store), make_plan(study_of()), []
    record, reference = Records(here).read()[1], Records(here).read()[-1]
    assert record is not None
    assert reference is not None
    pair = (plan.rows[1], record.facts.digest), (plan.rows[-1], reference.facts.digest)
    for key, seconds in (("after little", 0.0), ("after much", math.inf)):
        with compiled.by_itself(loops=False):
            compiled.pays(seconds)
            measured = measure_proximity(here, 1, record, key, pair, plan.similarity, ProximitySection(points=100))
        assert measured.proximity is not None
        found.append(measured.proximity.numbers)
    assert found[0] == found[1]


def test_a_mesh_that_has_changed_is_not_measured(store: Path, tmp_path: Path) -> None:
    here, plan = Store.open(store), make_plan(study_of())
    records = Records(here).read()
    digests = [record.facts.digest for record in records if record is not None]
    assert records[1] is not None
    pair = (plan.rows[2], digests[1]), (plan.rows[-1], digests[-1])
    record = measure_proximity(here, 1, records[1], "key", pair, plan.similarity, ProximitySection(points=100))
    assert record.proximity is not None
    assert "is not the mesh whose field is stored" in record.proximity.reason
    assert Records(here).read()[1] is not None
    assert sb.verify(store).is_sound


@pytest.mark.all
def test_a_worker_killed_in_the_middle(store_path: Path, finished: Path) -> None:
    killed = threading.Event()
    with local_client(2) as client:
        workers = sorted(client.run(os.getpid).values())

        def kill(progress: Progress) -> None:
            if progress.stage == "proximity" and not killed.is_set():
                killed.set()
                psutil.Process(workers[0]).send_signal(signal.SIGKILL)

        summary = sb.run(study_of(), store_path, client, on_progress=kill)
    assert killed.is_set()
    assert not summary.not_compared
    assert_same_results(store_path, finished)
    assert_right(store_path, study_of())


def test_a_closed_form_has_no_proximity() -> None:
    with pytest.raises(sb.errors.StudyError, match=r"the reference is not one but a Sphere; take a fine mesh"):
        make_plan(sb.Study.from_table(small_table(proximity={})))
