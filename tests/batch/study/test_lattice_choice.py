"""Studies that ask for an accuracy: what is chosen, kept, grown, refused and flagged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.batch import run as run_module
from sobolev_batch.batch.store.store import stored_choice
from sobolev_batch.batch.study import lattice_choice as search_module
from sobolev_batch.batch.study.lattice_choice import LatticeChoice
from sobolev_batch.batch.study.plan import make_plan
from sobolev_batch.results.tables.convergence import format_table
from sobolev_batch.spectral.adaptive.problem import Problem
from sobolev_batch.spectral.adaptive.solve import run_pilot
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.backends import ComplexDtype
from sobolev_batch.spectral.budget import NormEstimate
from tests.support.rectangles import Rectangles
from tests.support.studies import small_table, variable

# So high that one lattice is chosen, and no octaves.
RTOL = 5e-4
original = run_pilot


def on_lattice(lattice: sb.Lattice) -> Callable[[Problem], tuple[Any, sb.Lattice, ComplexDtype]]:
    """A pilot that finds another lattice."""

    def run(problem: Problem) -> tuple[Any, sb.Lattice, ComplexDtype]:
        distances, _, dtype = original(problem)
        return distances, lattice, dtype

    return run


def asking(rtol: float = RTOL, **changes: Any) -> sb.Study:
    own = {"accuracy": {"rtol": rtol}, "lattice": None, "norm": {"orders": [-10.0, -4.0]}}
    return sb.Study.from_table(small_table(**{**own, **changes}))


def test_every_distance_to_the_reference_is_as_accurate_as_asked(client: Client, store_path: Path) -> None:
    sb.run(asking(), store_path, client)
    tree = sb.open_store(store_path)
    convergence = tree["convergence"].to_dataset().drop_sel(mesh="reference")
    assert convergence["within"].all()
    assert (convergence["error"] <= RTOL * convergence["distance"]).all()
    for level in range(4):
        truth = sb.distance(sb.icosphere(level), sb.Sphere(), [-10.0, -4.0], rtol=1e-5)
        here = convergence.sel(mesh=f"ico/{level}")
        assert (
            np.abs(here["distance"].values - truth["distance"].values) <= here["error"] + truth["error"].values
        ).all()
    assert "!" not in format_table(tree).split("marked !")[0]
    assert f"at most {RTOL:g} of each distance" in format_table(tree)


def test_the_choice_is_kept_when_meshes_are_added(client: Client, store_path: Path, tmp_path: Path) -> None:
    sb.run(asking(), store_path, client)
    first = stored_choice(store_path)
    more = [{"name": "ico", "source": "icosphere", "levels": [0, 1, 2, 3, 4]}]
    summary = sb.run(asking(family=more), store_path, client)
    assert summary.computed == ("ico/4",)
    assert stored_choice(store_path) == first
    assert sb.run(asking(family=more), store_path, client).computed == ()
    # A mesh that reaches further hears what to do.
    trimesh.creation.box(extents=(20.0, 1.0, 1.0)).export(tmp_path / "far.off")
    far = {"name": "far", "source": "files", "paths": [str(tmp_path / "far.off")]}
    summary = sb.run(asking(family=[*more, far]), store_path, client)
    assert set(summary.failed) == {"far/far"}
    assert "that reach less far. Is this one in the same unit of length?" in summary.failed["far/far"]


def test_a_period_beyond_a_small_lattice_leads_to_octaves(tmp_path: Path) -> None:
    paths = [str(tmp_path / name) for name in ("first.ply", "moved.ply")]
    for path, offset in zip(paths, (0.0, 0.5), strict=True):
        mesh = Rectangles.tapered(35, 1 / 35, 0.3, offset).mesh()
        trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False).export(path)
    reference = {"source": "files", "paths": paths[:1]}
    family = [{"name": "moved", "source": "files", "paths": paths[1:]}]
    study = asking(0.1, norm={"orders": [-5.0]}, reference=reference, family=family)
    assert make_plan(study).choice.tail is not None


def test_a_lattice_that_turns_out_too_small_grows(
    client: Client, store_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = make_plan(asking()).choice
    small = sb.Lattice(0.6 * chosen.lattice.xi_max, chosen.lattice.M)
    monkeypatch.setattr(search_module, "run_pilot", on_lattice(small))
    summary = sb.run(asking(), store_path, client)
    grown = stored_choice(store_path)
    assert grown is not None
    assert "grown" in grown.reasons[-1]
    assert grown.lattice.xi_max > small.xi_max
    assert variable(sb.open_store(store_path), "convergence", "within").all()
    assert len(summary.computed) == 5


def test_what_falls_short_in_the_end_is_marked(
    client: Client, store_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_module, "_MOST_ROUNDS", 1)
    monkeypatch.setattr(search_module, "run_pilot", on_lattice(sb.Lattice(1.2, 12)))
    sb.run(asking(), store_path, client)
    convergence = sb.open_store(store_path)["convergence"].to_dataset().sel(mesh="ico/1", order=-4.0)
    assert not convergence["within"].item()
    line = next(line for line in format_table(sb.open_store(store_path)).splitlines() if line.startswith("ico/1"))
    assert "!" in line or "*" in line


def test_what_cannot_be_met_is_refused_before_anything_is_written(client: Client, store_path: Path) -> None:
    study = asking(accuracy={"rtol": 1e-7, "memory": "700MB"}, norm={"orders": [-2.0]})
    with pytest.raises(sb.AccuracyError, match=r"ico/\d: rtol 1e-07 is out of reach at order -2 .* can be reached"):
        sb.run(study, store_path, client)
    assert not store_path.exists()


def test_growth_goes_by_what_is_short() -> None:
    accuracy, orders = Accuracy(1e-3), (-4.0,)
    choice = LatticeChoice(sb.Lattice(3.0, 32), "complex128", (1.0,), (), "basis")

    def grown(truncation: float, aliasing: float, discretisation: float = 0.0) -> LatticeChoice | None:
        parts = [np.array([[value]]) for value in (1.0, truncation, aliasing, discretisation)]
        return choice.grown(NormEstimate(*parts), orders, accuracy)

    assert grown(1e-4, 1e-5) is None
    cut = grown(1e-2, 1e-5)
    assert cut is not None
    assert cut.lattice.xi_max > 3.0
    folded = grown(1e-4, 1e-2)
    assert folded is not None
    assert folded.lattice.spacing < choice.lattice.spacing
    # A copy up to rounding, whose fields are not exact enough to tell.
    assert grown(1e-2, 1e-2, discretisation=2.0) is None
    narrow = Accuracy(1e-3, 3.1e8)
    assert choice.grown(NormEstimate(*(np.array([[v]]) for v in (1.0, 0.9, 0.9, 0.0))), orders, narrow) is None


def test_the_reference_may_be_a_mesh_of_a_family(client: Client, store_path: Path) -> None:
    study = asking(reference={"source": "family", "family": "ico", "member": "3"})
    sb.run(study, store_path, client)
    convergence = sb.open_store(store_path)["convergence"].to_dataset()
    assert convergence["within"].sel(mesh=["ico/0", "ico/1", "ico/2"]).all()
    assert (convergence["distance"].sel(mesh="ico/3") == 0).all()


@pytest.mark.all
def test_another_accuracy_is_another_choice(client: Client, store_path: Path) -> None:
    sb.run(asking(), store_path, client)
    first = stored_choice(store_path)
    summary = sb.run(asking(1e-4), store_path, client)
    second = stored_choice(store_path)
    assert first is not None
    assert second is not None
    assert len(summary.computed) == 5
    assert second.lattice.xi_max > first.lattice.xi_max
    assert variable(sb.open_store(store_path), "fourier", "fourier").shape[1:] == second.lattice.shape
    assert variable(sb.open_store(store_path), "convergence", "within").all()
