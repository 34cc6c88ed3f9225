"""Runs of whole studies on a cluster of processes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.batch.analysis import tabulate
from sobolev_batch.batch.cluster.execution import Progress
from tests.support.studies import SMALL_LATTICE, small_table, variable


def test_stored_fields_and_tables_are_those_of_the_library(client: Client, finished_store: Path) -> None:
    tree = sb.open_store(finished_store)
    study = sb.Study.from_table(small_table())
    sphere = sb.fourier_transform(sb.Sphere(), SMALL_LATTICE)
    for level in range(4):
        field = variable(tree, "fourier", "fourier").sel(mesh=f"ico/{level}").drop_vars(["mesh", "quality"])
        expected = sb.fourier_transform(sb.icosphere(level), SMALL_LATTICE, threads=1)
        assert np.abs(field.values - expected.values).max() < 1e-13 * 4 * np.pi
        found = variable(tree, "convergence", "distance").sel(mesh=f"ico/{level}").values
        own = sb.distance(expected, sphere, study.orders)
        assert found == pytest.approx(own["distance"].values, rel=1e-12)
        for name, share in (("area_part", own["area_share"]), ("shape_part", 1 - own["area_share"])):
            stored_part = variable(tree, "convergence", name).sel(mesh=f"ico/{level}").values
            assert stored_part == pytest.approx((own["distance"] * share**0.5).values, rel=1e-8)
        # A field straight from the store serves as an argument too.
        assert sb.distance(field, sphere, -3.0)["distance"].item() == pytest.approx(found[1], rel=1e-12)
    matrix = variable(tree, "distances", "distance").sel(order=-10.0).values
    assert np.array_equal(matrix, matrix.T)
    assert (matrix.diagonal() == 0).all()
    a, b = (sb.fourier_transform(sb.icosphere(level), SMALL_LATTICE) for level in (2, 3))
    assert matrix[2, 3] == pytest.approx(sb.distance(a, b, -10.0)["distance"].item(), rel=1e-9)
    convergence = tree["convergence"].to_dataset()
    rates = convergence.sel(order=-3.0)["rate"].values
    assert np.isnan(rates[[0, 4]]).all()
    assert rates[3] == pytest.approx(2.0, abs=0.02)
    # At order -10 the coarse lattice's aliasing exceeds the distances: marked, and without a rate.
    assert not convergence.sel(order=-10.0)["resolved"].any()
    assert np.isnan(convergence.sel(order=-10.0)["rate"]).all()
    parts = convergence["truncation"] + convergence["aliasing"] + convergence["discretisation"]
    assert np.array_equal(parts, convergence["error"])
    # All pairs know their errors too, about as well as pair by pair.
    pair = sb.distance(a, b, study.orders)
    ours = tree["distances"].to_dataset().sel(mesh="ico/2", other="ico/3")
    assert ours["error"].values == pytest.approx(pair["error"].values, rel=0.3)


def test_mesh_facts_are_recorded(finished_store: Path) -> None:
    meshes = sb.open_store(finished_store)["meshes"].to_dataset()
    row = meshes.sel(mesh="ico/2")
    mesh = sb.icosphere(2)
    assert row["triangles"].item() == 320
    assert row["vertices"].item() == 162
    assert row["area"].item() == pytest.approx(mesh.area)
    assert row["digest"].item() == mesh.digest
    assert row["edge_length_max"].item() == pytest.approx(mesh.edge_lengths.max())
    assert row["status"].item() == "complete"
    assert row["worker"].item().startswith("tcp://127.0.0.1:")
    assert row["backend"].item() == "finufft"
    assert meshes["level"].values.tolist() == [0, 1, 2, 3, -1]


def test_a_run_counts_its_steps_and_a_second_one_has_none(client: Client, study: sb.Study, store_path: Path) -> None:
    def stamps() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in (store_path / "fourier" / "fourier" / "c").rglob("*")}

    steps: list[Progress] = []
    first = sb.run(study, store_path, client, on_progress=steps.append)
    assert len(first.computed) == 5
    assert first.reused == ()
    assert steps[0].stage == "cluster"
    fields = [step for step in steps if step.stage == "fields"]
    assert [step.done for step in fields] == list(range(6))
    assert {step.label for step in fields[1:]} == set(first.computed)
    reduction = [step for step in steps if step.stage == "reduction"]
    assert reduction[-1].done == reduction[-1].total > 0
    before = stamps()
    steps.clear()
    second = sb.run(study, store_path, client, on_progress=steps.append)
    assert second.computed == ()
    assert second.reused == first.computed
    assert steps == []
    assert stamps() == before
    with pytest.raises(sb.StoreError, match="another study"):
        sb.run(sb.Study.from_table(small_table(study={"name": "other"})), store_path, client)
    assert stamps() == before


def test_tables_of_an_older_version_are_made_anew(
    client: Client, study: sb.Study, store_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(tabulate, "TABLES_VERSION", tabulate.TABLES_VERSION - 1)
        sb.run(study, store_path, client)
    steps: list[Progress] = []
    assert sb.run(study, store_path, client, on_progress=steps.append).computed == ()
    assert {step.stage for step in steps} >= {"reduction"}
    steps.clear()
    sb.run(study, store_path, client, on_progress=steps.append)
    assert steps == []


def test_a_bad_mesh_is_recorded_and_stops_nothing(client: Client, tmp_path: Path, store_path: Path) -> None:
    trimesh.creation.box().export(tmp_path / "good.off")
    (tmp_path / "bad.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 nan 0\n3 0 1 2\n")
    trimesh.creation.box((9.0, 1.0, 1.0)).export(tmp_path / "large.off")
    family = [{"name": "f", "source": "files", "paths": ["*.off", "missing.ply"]}]
    study = sb.Study.from_table(small_table(family=family), folder=tmp_path)
    summary = sb.run(study, store_path, client)
    assert summary.computed == ("f/good", "reference")
    assert set(summary.failed) == {"f/bad", "f/large", "f/missing"}
    assert "1 of 3 vertices have NaN" in summary.failed["f/bad"]
    assert "holds only |coordinate| <" in summary.failed["f/large"]
    assert "cannot be read" in summary.failed["f/missing"]
    tree = sb.open_store(store_path)
    assert np.isnan(variable(tree, "convergence", "distance").sel(mesh=["f/bad", "f/large", "f/missing"]).values).all()
    assert np.isfinite(variable(tree, "convergence", "distance").sel(mesh="f/good").values).all()
    assert np.isnan(variable(tree, "distances", "distance").sel(mesh="f/good", other="f/bad").values).all()
    assert variable(tree, "meshes", "status").sel(mesh="f/bad").item() == "failed"
    # Mended, it is computed, and nothing else is.
    trimesh.creation.box().export(tmp_path / "bad.off")
    assert sb.run(study, store_path, client).computed == ("f/bad",)


def test_distances_to_the_reference_alone(client: Client, finished_store: Path, store_path: Path) -> None:
    table = small_table(compare=None)
    sb.run(sb.Study.from_table(table), store_path, client)
    found = variable(sb.open_store(store_path), "distances", "distance")
    assert found["other"].values.tolist() == ["reference"]
    whole = variable(sb.open_store(finished_store), "distances", "distance").sel(other=["reference"])
    assert np.allclose(found.to_numpy(), whole.to_numpy(), rtol=1e-12, atol=0)
