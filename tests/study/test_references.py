"""Studies of smooth surfaces, and the examples of docs/surfaces.md, with the packages of their sources installed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from distributed import Client

import sobolev_batch as sb
from sobolev_batch import Study, fourier_transform, open_store, run
from sobolev_batch.shapes import Sphere
from sobolev_batch.sources import check_source, registry
from sobolev_batch.sources.registry import SurfaceMember, parse_source
from sobolev_batch.study.plan import make_plan
from tests.support.repository import ROOT, blocks, install
from tests.support.shapes import BOX_TRIANGLES, BOX_VERTICES, Roof
from tests.support.studies import SMALL_LATTICE, small_table, variable

RING = {"R": 2.0, "r": 0.8, "center": [5.0, 0.0, 1.0]}
EGG = {"axes": [2.0, 1.4, 0.8]}


def torus_table(**changes: Any) -> dict[str, Any]:
    """Grids of a torus against the torus, in a few seconds."""
    ring = {"source": "torus", **RING}
    family = [{"name": "grid", **ring, "levels": [0, 1, 2, 3]}]
    own = {"lattice": {"xi_max": 3.0, "M": 20}, "norm": {"orders": [-3.0, -5.0]}, "reference": ring, "family": family}
    return small_table(**{**own, **changes})


def egg_table(**changes: Any) -> dict[str, Any]:
    """Stretched icospheres against the ellipsoid."""
    family = {"name": "ico", "source": "ellipsoid", **EGG, "levels": [0, 1, 2, 3, 4]}
    return torus_table(reference={"source": "ellipsoid", **EGG}, family=[family], **changes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("table", "levels", "unit"),
    # The reference's bounding sphere becomes the unit sphere at the origin.
    [(torus_table(), 4, sb.shapes.Torus(2.0 / 2.8, 0.8 / 2.8)), (egg_table(), 5, sb.shapes.Ellipsoid((1.0, 0.7, 0.4)))],
    ids=["torus", "ellipsoid"],
)
def test_refinements_converge_with_second_order(
    threads: Client, store_path: Path, table: dict[str, Any], levels: int, unit: sb.shapes.Torus | sb.shapes.Ellipsoid
) -> None:
    study = sb.Study.from_table(table)
    summary = sb.run(study, store_path, threads)
    assert (len(summary.computed), summary.failed) == (levels + 1, {})
    tree = sb.open_store(store_path)
    stored = variable(tree, "fourier", "fourier").sel(mesh="reference")
    assert study.lattice is not None
    expected = sb.fourier_transform(unit, study.lattice, threads=1, order=study.orders)
    assert np.abs(stored.values - expected.values).max() < 1e-8 * unit.area
    convergence = tree["convergence"].to_dataset()
    for order in (-3.0, -5.0):
        found = convergence.sel(order=order)
        *distances, own = found["distance"].values
        ratios = np.divide(distances[:-1], distances[1:])
        assert (ratios > 3).all()
        assert ratios[-1] == pytest.approx(4.0, rel=0.02)
        assert found["rate"].values[-2] == pytest.approx(2.0, abs=0.02)
        assert own == 0
    row = tree["meshes"].to_dataset().sel(mesh="reference")
    assert (row["status"].item(), row["triangles"].item()) == ("complete", 0)
    assert row["points"].item() > 500
    assert row["area"].item() == pytest.approx(unit.area, rel=1e-12)


@pytest.mark.slow
def test_blocks_of_a_smooth_surface_make_the_same_store(threads: Client, tmp_path: Path) -> None:
    family = [{"name": "grid", "source": "torus", **RING, "levels": [1]}]
    whole = sb.Study.from_table(torus_table(family=family))
    blocks = replace(whole, largest_chunk_bytes=20_000)
    assert len(make_plan(blocks).blocks) > 3
    fields, errors = [], []
    for name, study in (("whole.zarr", whole), ("blocks.zarr", blocks)):
        sb.run(study, tmp_path / name, threads)
        tree = sb.open_store(tmp_path / name)
        fields.append(variable(tree, "fourier", "fourier").sel(mesh="reference").values)
        errors.append(variable(tree, "norms", "error_part").sel(mesh="reference", part="discretisation").values)
    assert np.abs(fields[0] - fields[1]).max() < 1e-8 * sb.shapes.Torus(2.0, 0.8).area
    assert errors[0] == pytest.approx(errors[1], rel=3.0)


@pytest.mark.slow
def test_a_reference_that_does_not_settle_is_a_failed_row(
    threads: Client, store_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sobolev_batch.transform.resolution.MOST_NODES", 1 << 14)
    family = [{"name": "f", "source": "torus", "R": 1.0, "r": 0.4}]
    study = sb.Study.from_table(torus_table(family=family))
    member = SurfaceMember("own", -1, Roof(), {"test": 1})
    object.__setattr__(study.object, "reference", SimpleNamespace(members=lambda folder: (member,)))
    summary = sb.run(study, store_path, threads)
    assert set(summary.failed) == {"reference"}
    assert "not settled to 1e-09 of its area with 16384 nodes" in summary.failed["reference"]


PAGE = "docs/surfaces.md"


def install_example(site: Path, of: str) -> str:
    """Install the package of the page with an entry point of a group into a folder, and return the module's name."""
    (entry_point,) = (text for text in blocks(PAGE, "toml") if f"sobolev_batch.{of}" in text)
    match = re.fullmatch(r'\[project\.entry-points\."(.*)"\]\n(.*) = "(\w+):(\w+)"\n', entry_point)
    assert match is not None
    group, key, name, value = match.groups()
    (module,) = (text for text in blocks(PAGE, "python") if re.search(rf"^(class )?{value}\b", text, re.MULTILINE))
    install(site, name, f"[{group}]\n{key} = {name}:{value}\n", module)
    return name


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The package of the page with a source, installed."""
    name = install_example(tmp_path / "site", of="sources")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    registry.sources_by_name.cache_clear()
    yield
    registry.sources_by_name.cache_clear()
    sys.modules.pop(name, None)


@pytest.mark.slow
def test_the_examples_in_python_run(capsys: pytest.CaptureFixture[str]) -> None:
    exec("".join(blocks(PAGE, "python")[:3]), {})
    first, *_, finest, last = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"\[[\d.e-]+ +[\d.e-]+ *\] ± \[[\d.e-]+ +[\d.e-]+ *\]", first)
    # The rate is quadratic in the edge length.
    assert float(finest.split()[2]) == pytest.approx(2, abs=0.1)
    assert float(last.split()[0]) > 1.6**2


@pytest.mark.slow
@pytest.mark.usefixtures("package")
def test_the_example_of_a_surface_runs_and_resumes(tmp_path: Path, threads: Client) -> None:
    def computed(height: float) -> tuple[str, ...]:
        family = [{"name": "ball", "source": "wavy-ball", "height": 0.0}]
        reference = {"source": "wavy-ball", "height": height}
        study = Study.from_table(small_table(reference=reference, family=family, scaling={"mode": "none"}))
        return run(study, tmp_path / "results.zarr", threads).computed

    assert computed(0.1) == ("ball/wavy-ball", "reference")
    ball = variable(open_store(tmp_path / "results.zarr"), "fourier", "fourier").sel(mesh="ball/wavy-ball").values
    assert np.abs(ball - fourier_transform(Sphere(), SMALL_LATTICE).values).max() < 1e-8 * 4 * np.pi
    assert computed(0.1) == ()
    assert computed(0.11) == ("reference",)
    distances = variable(open_store(tmp_path / "results.zarr"), "convergence", "distance")
    assert ((distances.sel(mesh="ball/wavy-ball") > 0.01) & (distances.sel(mesh="ball/wavy-ball") < 3)).all()


@pytest.mark.process
def test_the_example_of_a_format_is_read(tmp_path: Path) -> None:
    install_example(tmp_path / "site", of="formats")
    np.savez(tmp_path / "box.npz", vertices=BOX_VERTICES, triangles=BOX_TRIANGLES)
    command = [sys.executable, "-m", "sobolev_batch", "info", "box.npz"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path / "site"), str(ROOT)])}
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert "box.npz: 12 triangles, 8 vertices" in done.stdout


@pytest.mark.usefixtures("package")
def test_the_example_conforms() -> None:
    check_source(parse_source({"source": "wavy-ball"}))
    (text,) = (text for text in blocks(PAGE, "python") if "def test_" in text)
    namespace: dict[str, Any] = {}
    exec(text, namespace)
    namespace["test_the_source_conforms"]()
