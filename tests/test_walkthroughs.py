"""The walkthroughs of docs/walkthroughs.md run as printed, in a shell of their own, on files such as they are for."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import fast_simplification
import nibabel
import numpy as np
import pytest

import sobolev_batch as sb
from tests.support.processes import free_port
from tests.support.repository import ROOT

PAGE = (ROOT / "docs" / "walkthroughs.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", PAGE, re.M | re.S))
SIZES = (40, 80, 160, 320, 640)


def bumps(mesh: sb.Mesh, height: float, frequency: float = 5.0) -> sb.Mesh:
    """Return a mesh around the origin whose radius goes up and down."""
    radii = 1 + height * np.sin(frequency * mesh.vertices[:, :1]) * np.cos(frequency * mesh.vertices[:, 1:2])
    return sb.Mesh(radii * mesh.vertices, mesh.triangles)


def decimated(mesh: sb.Mesh, triangles: int, aggression: float = 7.0) -> sb.Mesh:
    vertices, faces = np.array(mesh.vertices), np.array(mesh.triangles, dtype=np.int32)
    return sb.Mesh(*fast_simplification.simplify(vertices, faces, target_count=triangles, agg=aggression))


def rough(mesh: sb.Mesh, share: float, seed: int = 0) -> sb.Mesh:
    """Return a mesh with noise of a share of its largest coordinate."""
    scale = share * np.abs(mesh.vertices).max()
    noise = np.random.default_rng(seed).normal(scale=scale, size=mesh.vertices.shape)
    return sb.Mesh(mesh.vertices + noise, mesh.triangles)


def write(mesh: sb.Mesh, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    sb.write_mesh(mesh, path)


def remeshers(folder: Path) -> None:
    ball = sb.shapes.icosphere(3)
    objects = {
        "egg": sb.shapes.Ellipsoid((1.0, 0.8, 0.6)).mesh(3),
        "torus": sb.shapes.Torus().mesh(36, 18),
        "bumps": bumps(ball, 0.1),
        "bean": sb.Mesh(ball.vertices**3 + ball.vertices, ball.triangles),
    }
    methods: dict[str, Callable[[sb.Mesh, int], sb.Mesh]] = {
        "mine": lambda mesh, count: rough(decimated(mesh, count), 0.01),
        "quick": lambda mesh, count: decimated(mesh, count, 9.0),
        "careful": lambda mesh, count: decimated(mesh, count, 3.0),
        "noisy": lambda mesh, count: rough(decimated(mesh, count), 0.03),
        "shrinking": lambda mesh, count: decimated(mesh, count).moved(0.97, (0.0, 0.0, 0.0)),
    }
    for name, mesh in objects.items():
        write(mesh, folder / "remeshers" / "objects" / f"{name}.ply")
        for count in SIZES:
            for method, make in methods.items():
                write(make(mesh, count), folder / "remeshers" / "out" / method / f"{name}_{count}.ply")
            write(decimated(mesh, count), folder / "new" / "mine" / f"{name}_{count}.ply")


def brains(folder: Path) -> None:
    """Two surfaces of each of three subjects, in millimetres, as FreeSurfer writes them."""
    for number, noise in (("01", 0.002), ("02", 0.004), ("03", 0.02)):
        surface = bumps(sb.shapes.icosphere(3), 0.1, 8.0 + int(number))
        for scan, mesh in (("scan", surface), ("rescan", rough(surface, noise))):
            path = folder / "brains" / f"s{number}" / scan / "lh.pial"
            path.parent.mkdir(parents=True)
            nibabel.freesurfer.write_geometry(path, 90 * mesh.vertices, mesh.triangles)


def scans(folder: Path) -> None:
    part = sb.shapes.Torus().mesh(24, 12)
    write(part, folder / "scans" / "part.ply")
    for number in range(210):
        place = "scans" if number < 200 else "later"
        write(rough(part, 0.001 * (1 + number % 7), number), folder / "scans" / place / f"scan_{number:03}.ply")


def statue(folder: Path) -> None:
    whole = bumps(sb.shapes.icosphere(4), 0.15)
    write(whole, folder / "statue.ply")
    write(decimated(whole, 500), folder / "simple.ply")


def part(folder: Path) -> None:
    ring = sb.shapes.Torus(40.0, 12.0)
    write(ring.mesh(144, 72), folder / "part" / "part.stl")
    for name, cells in (("rough", 16), ("middle", 32), ("fine", 96)):
        write(ring.mesh(cells, cells // 2), folder / "part" / "exported" / f"{name}.stl")
    write(ring.mesh(96, 48).moved(1 / 25.4, (0.0, 0.0, 0.0)), folder / "part" / "inches.stl")


# What makes the files, and what the reader is told to look for, as regular expressions.
SEEN: dict[str, tuple[Callable[[Path], None], *tuple[str, ...]]] = {
    "A remesher against others": (
        remeshers,
        r"League at order -4, over 4 objects",
        "take 9 or more",
        r"^mine +relative +undecided +0\.\d",
    ),
    "Surfaces of brains": (brains, "correlation with age: 0.9", "shows where s03 differs"),
    "Two hundred scans on a cluster": (scans, "201 of 201 complete", "211 of 211 complete", "nothing is damaged"),
    "A first look at two meshes": (
        statue,
        "simple.ply is as far from statue.ply as",
        "witness: where.png",
    ),
    "A part in millimetres": (
        part,
        r"25\.4 times as small",
        "exported  exported/middle",
        "same surface",
        "fine.stl: within 0.1 mm",
    ),
}


def test_every_walkthrough_has_files() -> None:
    assert list(SECTIONS) == list(SEEN)


@pytest.mark.all
@pytest.mark.parametrize("title", SEEN)
def test_it_runs_as_printed(title: str, tmp_path: Path) -> None:
    make_files, *seen = SEEN[title]
    make_files(tmp_path)
    text = SECTIONS[title].replace("8786", str(free_port()))
    commands = ""
    for language, block in re.findall(r"^```(\w+)\n(.*?)^```", text, re.M | re.S):
        if language == "sh":
            # Each begins where the reader has the files.
            commands += f"cd {tmp_path}\n{block}"
        else:
            first, content = block.split("\n", 1)
            (tmp_path / first.removeprefix("# ")).write_text(content)
    log = tmp_path / "log.txt"
    with log.open("w") as output:
        shell = subprocess.Popen(
            ["bash", "-e", "-x", "-c", commands],
            env=os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"},
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            assert shell.wait() == 0, log.read_text()
        finally:
            # A scheduler and workers outlive it.
            with suppress(ProcessLookupError):
                os.killpg(shell.pid, signal.SIGKILL)
    for words in seen:
        assert re.search(words, log.read_text(), re.M)
