"""The assertion passes on proof alone, and fails in one line that leads to the place where surfaces differ."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

import sobolev_batch as sb
from sobolev_batch.testing.verdict import write_difference


def test_it_returns_the_verdict_of_equal_surfaces_and_writes_nothing(tmp_path: Path) -> None:
    sphere = sb.icosphere(2)
    assert sb.assert_same_surface(sphere, sphere, witness=tmp_path / "same").outcome == "same"
    assert not list(tmp_path.iterdir())


def test_an_undecided_comparison_fails() -> None:
    truth = float(sb.distance(sb.Sphere(0.9), sb.Sphere(), -4.0)["distance"] / sb.norm(sb.Sphere(), -4.0)["norm"])
    with pytest.raises(AssertionError, match=r"^undecided: .*; take another rtol$"):
        sb.assert_same_surface(sb.Sphere(0.9), sb.Sphere(), rtol=truth, scaling=False)


@pytest.mark.slow
def test_the_files_show_the_place_of_a_lost_patch(tmp_path: Path) -> None:
    whole = sb.Mesh(1000 + 20 * sb.icosphere(4).vertices, sb.icosphere(4).triangles)
    heights = whole.vertices[whole.triangles].mean(axis=1)[:, 2]
    torn = sb.Mesh(whole.vertices, whole.triangles[heights < 1019.5])
    with pytest.raises(AssertionError) as failure:
        sb.assert_same_surface(torn, whole, witness=tmp_path / "new" / "part")
    message = str(failure.value)
    assert "\n" not in message
    files = [tmp_path / "new" / f"part-{label}.ply" for label in "ab"]
    assert message.endswith(f"witness: {files[0]} {files[1]}")
    match = re.search(r"a has less area near \((.*?)\)", message)
    assert match is not None
    assert np.array(match[1].split(","), dtype=float) == pytest.approx([1000, 1000, 1020], abs=2)
    for file, mesh in zip(files, (torn, whole), strict=True):
        data = PlyData.read(file)
        assert len(data["face"]) == len(mesh.triangles)
        vertices = data["vertex"].data
        lowest = np.nanargmin(vertices["witness_minus_4"])
        assert vertices["z"][lowest] > 1018
        assert vertices["witness_minus_4"][lowest] < 0
        assert "comparison part" in " ".join(data.comments)


@pytest.mark.slow
def test_a_place_that_cannot_be_written_leaves_the_failure_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(AssertionError, match=r"^different surfaces: .*; no witness: .*file"):
        sb.assert_same_surface(sb.icosphere(1), sb.icosphere(3), witness=tmp_path / "file" / "part")
    for witness in ("", ".", "a\0b", 3):
        with pytest.raises(AssertionError, match=r"^different surfaces: .*; no witness: "):
            sb.assert_same_surface(sb.icosphere(1), sb.icosphere(3), witness=witness)  # type: ignore[arg-type]


def test_equal_surfaces_differ_nowhere(tmp_path: Path) -> None:
    sphere = sb.icosphere(1)
    difference = write_difference(sphere, sphere, tmp_path / "w", -4.0)
    assert difference == f"they differ nowhere; witness: {tmp_path / 'w-a.ply'} {tmp_path / 'w-b.ply'}"


def test_surfaces_in_closed_form_have_no_files(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match=r"; no witness: neither surface is a mesh$"):
        sb.assert_same_surface(sb.Sphere(0.9), sb.Sphere(), witness=tmp_path / "part")
