"""The examples of docs/queries.md run unchanged, and answer their questions."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from distributed import Client

import sobolev_batch as sb
from tests.support.gallery import run_blocks, run_icospheres
from tests.support.repository import ROOT, blocks


def test_every_query_runs_and_answers(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = run_icospheres(tmp_path, client)
    monkeypatch.chdir(tmp_path)
    numbers = re.findall(r"^\*\*(\d+)\.", (ROOT / "docs" / "queries.md").read_text(encoding="utf-8"), re.M)
    assert numbers == [str(i + 1) for i in range(10)]
    assert len(blocks("docs/queries.md", "python")) == 13
    found = run_blocks("docs/queries.md")

    levels = [f"icosphere/{level}" for level in range(4)]
    assert found["rates"].index.tolist() == levels
    assert found["at_level"]["mesh"].values.tolist() == levels[3:]
    assert found["nearest"].is_monotonic_increasing
    assert found["part"].shape == (4, 4)
    assert (found["whole"].loc[levels, levels] == found["part"].to_pandas()).all(axis=None)
    lattice = found["fields"].sobolev.lattice
    field, reference = (sb.fourier_transform(surface, lattice) for surface in (sb.icosphere(3), sb.Sphere()))
    expected = sb.distance(field, reference, [-3.5, -2.25])["distance"].values
    assert found["another"]["distance"].values == pytest.approx(expected, rel=1e-6)
    assert found["norms"]["icosphere/1"] == pytest.approx(
        sb.norm(sb.icosphere(1), -4, lattice=lattice)["norm"].item(), rel=1e-6
    )
    assert set(found["pair"]) == {levels[0], levels[3]}
    assert found["along_axis"].loc[0.0].real == pytest.approx(sb.icosphere(3).area, rel=1e-6)
    assert found["by_wavelength"].sum() == pytest.approx(1, rel=1e-10)
    assert found["by_wavelength"].index.is_monotonic_increasing
    # An inscribed mesh lacks area and lies inside: at its vertices, next to the sphere, the sphere has more.
    assert (found["w"].values < 0).all()
    assert (sb.read_mesh(tmp_path / "icosphere-3.ply").vertices == sb.icosphere(3).vertices).all()
    assert 0 < found["share"].sel(mesh=levels[3], order=-10).item() < 1
    exported = pd.read_csv(tmp_path / "convergence.csv")
    assert len(exported) == 4 * len(study.orders)
    squares = exported["area_part"] ** 2 + exported["shape_part"] ** 2
    assert np.allclose(squares, exported["distance"] ** 2, rtol=1e-10)
