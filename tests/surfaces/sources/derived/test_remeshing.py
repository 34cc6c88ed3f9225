"""The source `remesh`."""

from __future__ import annotations

import re
import sys
from importlib.metadata import PackageNotFoundError

import numpy as np
import pytest

from sobolev_batch import MeshError, icosphere
from tests.support.members import BALL, listed, loaded, members


def test_remeshed_surfaces_are_even_and_have_about_the_counts_asked_for() -> None:
    pytest.importorskip("pyacvd", reason="remeshing needs the extra `studies`")
    found = members({"source": "remesh", "mesh": BALL, "triangles": [320, 80, 80]})
    assert listed(found) == [("80", 0), ("320", 1)]
    for member, count in zip(found, (80, 320), strict=True):
        mesh = loaded(member)
        assert abs(len(mesh.triangles) - count) <= 4
        assert (mesh.counts.boundary_edges, mesh.counts.nonmanifold_edges) == (0, 0)
        assert mesh.areas.std() < 0.5 * mesh.areas.mean()
        assert mesh.area == pytest.approx(icosphere(3).area, rel=0.1)
        assert np.linalg.norm(mesh.vertices, axis=1) == pytest.approx(np.ones(len(mesh.vertices)), abs=0.06)


def test_remeshing_gives_the_same_mesh_every_time() -> None:
    pytest.importorskip("pyacvd", reason="remeshing needs the extra `studies`")
    (member,) = members({"source": "remesh", "mesh": BALL, "triangles": [80]})
    assert loaded(member).digest == loaded(member).digest


def test_the_fingerprint_of_a_remeshing_names_its_library(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pyacvd", reason="remeshing needs the extra `studies`")
    (member,) = members({"source": "remesh", "mesh": BALL, "triangles": [80]})
    before = dict(member.fingerprint())
    assert before["triangles"] == 80
    monkeypatch.setattr("sobolev_batch.surfaces.sources.derived.remeshing.installed_version", lambda name: f"{name} 99")
    assert "pyacvd 99" in dict(member.fingerprint()).values()


def test_remeshing_without_its_library_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyacvd", None)
    (member,) = members({"source": "remesh", "mesh": BALL, "triangles": [80]})
    with pytest.raises(MeshError, match=re.escape("pip install 'sobolev-batch[studies]'")):
        member.load()


def test_planning_a_remeshing_without_its_library_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(distribution: str) -> str:
        if distribution == "pyacvd":
            raise PackageNotFoundError(distribution)
        return "1.0"

    monkeypatch.setattr("sobolev_batch.surfaces.sources.fingerprints.version", version)
    (member,) = members({"source": "remesh", "mesh": BALL, "triangles": [80]})
    with pytest.raises(MeshError, match=re.escape("pip install 'sobolev-batch[studies]'")):
        member.fingerprint()
