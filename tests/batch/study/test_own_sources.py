"""Examples of docs/surfaces.md run as they stand, with the packages of their sources installed."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
from distributed import Client

from sobolev_batch import Sphere, Study, check_source, fourier_transform, open_store, run
from sobolev_batch.surfaces.sources import registry
from sobolev_batch.surfaces.sources.registry import parse_source
from tests.support.mesh_files import off
from tests.support.repository import blocks
from tests.support.shapes import BOX_TRIANGLES, BOX_VERTICES
from tests.support.studies import small_table, variable

PAGE = "docs/surfaces.md"


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The packages of the page, installed."""
    site = tmp_path / "site"
    sources = [text for text in blocks(PAGE, "toml") if text.startswith("[project.")]
    modules = [text for text in blocks(PAGE, "python") if "(sb.Source)" in text]
    names = []
    for entry_point, module in zip(sources, modules, strict=True):
        match = re.fullmatch(r'\[project\.entry-points\."(.*)"\]\n(.*) = "(\w+)(:\w+)"\n', entry_point)
        assert match is not None
        group, source, name, value = match.groups()
        info = site / f"{name}-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[{group}]\n{source} = {name}{value}\n")
        (site / f"{name}.py").write_text(module)
        names.append(name)
    monkeypatch.syspath_prepend(str(site))
    registry._registry.cache_clear()
    yield
    registry._registry.cache_clear()
    for name in names:
        sys.modules.pop(name, None)


@pytest.mark.slow
def test_the_examples_in_python_run(capsys: pytest.CaptureFixture[str]) -> None:
    exec("".join(blocks(PAGE, "python")[:2]), {})
    first, second = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"\[[\d.e-]+ +[\d.e-]+\] ± \[[\d.e-]+ +[\d.e-]+\]", first)
    assert float(second.split()[0]) > 1.6**2


@pytest.mark.slow
@pytest.mark.usefixtures("packages")
def test_the_example_of_a_surface_runs_and_resumes(tmp_path: Path, threads: Client) -> None:
    (study_text,) = (text for text in blocks(PAGE, "toml") if text.startswith("[study]"))

    def computed(text: str) -> tuple[str, ...]:
        (tmp_path / "study.toml").write_text(text)
        return run(Study.from_toml(tmp_path / "study.toml"), tmp_path / "results.zarr", threads).computed

    on_unit = study_text + '\n[scaling]\nmode = "none"\n'
    assert computed(on_unit) == ("ball/wavy-ball", "reference")
    study = Study.from_toml(tmp_path / "study.toml")
    assert study.lattice is not None
    ball = variable(open_store(tmp_path / "results.zarr"), "fourier", "fourier").sel(mesh="ball/wavy-ball").values
    assert np.abs(ball - fourier_transform(Sphere(), study.lattice).values).max() < 1e-8 * 4 * np.pi
    assert computed(on_unit) == ()
    assert computed(on_unit.replace("height = 0.1", "height = 0.11")) == ("reference",)
    distances = variable(open_store(tmp_path / "results.zarr"), "convergence", "distance")
    assert 0.01 < distances.sel(mesh="ball/wavy-ball").item() < 3


@pytest.mark.slow
@pytest.mark.usefixtures("packages")
def test_the_example_of_an_archive_runs_and_resumes(tmp_path: Path, threads: Client) -> None:
    def write_archive(**scales: float) -> None:
        with ZipFile(tmp_path / "scans.zip", "w") as archive:
            for name, scale in scales.items():
                archive.writestr(f"boxes/{name}.off", off(scale * BOX_VERTICES, BOX_TRIANGLES))

    table = small_table(family=[{"name": "scan", "source": "zip", "archive": "scans.zip"}])
    write_archive(small=0.2, large=0.3)
    study = Study.from_table(table, folder=tmp_path)
    store = tmp_path / "results.zarr"
    assert run(study, store, threads).computed == ("scan/boxes/large.off", "scan/boxes/small.off", "reference")
    write_archive(small=0.1, large=0.3)
    assert run(study, store, threads).computed == ("scan/boxes/small.off",)


@pytest.mark.usefixtures("packages")
def test_the_examples_conform(tmp_path: Path) -> None:
    check_source(parse_source({"source": "wavy-ball"}))
    (text,) = (text for text in blocks(PAGE, "python") if "def test_" in text)
    namespace: dict[str, Any] = {}
    exec(text, namespace)
    namespace["test_the_source_conforms"](tmp_path)
