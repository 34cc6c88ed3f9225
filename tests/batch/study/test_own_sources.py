"""The examples of docs/surfaces.md run as they stand, that of a package with a source of its own installed."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sobolev_batch import Sphere, Study, fourier_transform, open_store, run
from sobolev_batch.batch.cluster.clients import thread_client
from sobolev_batch.surfaces.sources import registry as sources
from tests.support.studies import variable

PAGE = Path(__file__).parents[3] / "docs" / "surfaces.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The example's package, installed; the text of its study."""
    site = tmp_path / "site"
    info = site / "wavy_ball-1.0.dist-info"
    info.mkdir(parents=True)
    entry_points, study = blocks("toml")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: wavy-ball\nVersion: 1.0\n")
    found = re.fullmatch(r'\[project\.entry-points\."(.*)"\]\n(.*) = "(.*)"\n', entry_points)
    assert found is not None
    (info / "entry_points.txt").write_text("[{}]\n{} = {}\n".format(*found.groups()))
    (site / "wavy_ball.py").write_text(blocks("python")[2])
    monkeypatch.syspath_prepend(str(site))
    sources._registry.cache_clear()
    yield study
    sources._registry.cache_clear()
    sys.modules.pop("wavy_ball", None)


def test_the_examples_in_python_run(capsys: pytest.CaptureFixture[str]) -> None:
    exec("".join(blocks("python")[:2]), {})
    first, second = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"\[[\d.e-]+ +[\d.e-]+\] ± \[[\d.e-]+ +[\d.e-]+\]", first)
    assert float(second.split()[0]) > 1.6**2


def test_the_example_of_a_package_runs_and_resumes(package: str, tmp_path: Path) -> None:
    def go(text: str) -> tuple[str, ...]:
        (tmp_path / "study.toml").write_text(text)
        return run(Study.from_toml(tmp_path / "study.toml"), tmp_path / "results.zarr", client).computed

    on_unit = package + '\n[scaling]\nmode = "none"\n'
    with thread_client(1) as client:
        assert go(on_unit) == ("ball/wavy-ball", "reference")
        study = Study.from_toml(tmp_path / "study.toml")
        assert study.lattice is not None
        ball = variable(open_store(tmp_path / "results.zarr"), "fourier", "fourier").sel(mesh="ball/wavy-ball").values
        assert np.abs(ball - fourier_transform(Sphere(), study.lattice).values).max() < 1e-8 * 4 * np.pi
        assert go(on_unit) == ()
        assert go(on_unit.replace("height = 0.1", "height = 0.11")) == ("reference",)
        distances = variable(open_store(tmp_path / "results.zarr"), "convergence", "distance")
        assert 0.01 < distances.sel(mesh="ball/wavy-ball").item() < 3
