"""The commands of the extras: what they print and write, errors in one line, exit statuses."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.shapes import icosphere
from tests.support.commands import COMMAND, ball, call, output, write_inputs

STORE = "storage/cli.zarr"


@pytest.fixture(scope="module")
def folder(threads: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the store of a study, and with meshes."""
    folder = tmp_path_factory.mktemp("extras")
    write_inputs(folder)
    meshes = {"start": ball(1), "target": ball(3, 1.05), "small": ball(1).moved(1e-3, (0.0, 0.0, 0.0))}
    for name, mesh in meshes.items():
        sb.write_mesh(mesh, folder / f"{name}.ply")
    (folder / "storage").mkdir()
    sb.run(folder / "study.toml", folder / STORE, threads)
    return folder


def test_meshes_by_patterns(folder: Path, tmp_path: Path) -> None:
    shown = output("witness", STORE, "--mesh", "*/[1]", "--order=-3", "--output", str(tmp_path / "w"), folder=folder)
    (path,) = shown.split()
    assert b"witness_minus_3" in Path(path).read_bytes()[:2000]
    assert len(output("witness", STORE, "--mesh", "ico/*", "--output", str(tmp_path), folder=folder).split()) == 2


def test_plot_draws_every_picture_at_an_order_that_is_not_stored(folder: Path) -> None:
    formats = ("--format", "svg", "--format", "png")
    options = (*formats, "--family", "i*", "--x", "vertices", "--order", "-3.5", "--size", "84x60mm")
    done = call("plot", STORE, "--output", "pictures", "--mesh", "ico/1", *options, folder=folder)
    assert (done.returncode, done.stderr) == (0, "")
    paths = [folder / line for line in done.stdout.split()]
    assert {path.stem for path in paths} == {"convergence", "matrix", "spectrum", "energy", "witness-0001-ico-1"}
    assert all(path.read_bytes()[:5] in (b"\x89PNG\r", b"<?xml") for path in paths)
    drawn = (folder / "pictures" / "convergence.svg").read_text(encoding="utf-8")
    assert re.search('width="238.11.* height="170.07', drawn)  # points


@pytest.mark.slow
def test_compare_aligns_first(folder: Path) -> None:
    first = sb.shapes.Ellipsoid((3.0, 2.0, 1.0)).mesh(2)
    turned = first.vertices @ [[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]] + [0.5, 0.0, 0.2]
    sb.write_mesh(sb.Mesh(turned, first.triangles), folder / "turned.off")
    sb.write_mesh(first, folder / "still.off")
    shown = output("compare", "turned.off", "still.off", "--order=-4", "--align", folder=folder)
    assert float(re.findall(r"^where it is in the file: (\S+) % ±", shown, re.M)[0]) > 10
    # Half a turn around an axis of the ellipsoid may be added.
    assert re.search(r"^moved: rotated by (36\.8699|143\.13|180) degrees", shown, re.M)
    # Which sentence follows depends on rounding.
    assert shown.index("moved: ") < shown.index("turned.off ")
    # Rounding is no rotation, and without symmetry no turn serves as well.
    coarse = sb.shapes.icosphere(1)
    lopsided = coarse.vertices * (1 + coarse.vertices @ [[0.3], [0.2], [0.1]])
    for name, shift in (("lopsided", 0.0), ("shifted", 0.25)):
        sb.write_mesh(sb.Mesh(np.add(lopsided, [shift, 0.0, 0.0]), coarse.triangles), folder / f"{name}.off")
    shown = output("compare", "shifted.off", "lopsided.off", "--order=-4", "--align", folder=folder)
    assert "moved: shifted by (-0.25 0 0)\n" in shown
    found = json.loads(
        output("compare", "turned.off", "still.off", "--order=-4", "--align", "--format", "json", folder=folder)
    )
    assert found["before"] > 0.1
    assert found["orders"][0]["relative"] < 1e-9
    # So do verdicts.
    for question in (("--within", "0.01"), ("--within", "1%")):
        assert call("compare", "turned.off", "still.off", *question, folder=folder).returncode == 1
        judged = json.loads(
            output("compare", "turned.off", "still.off", *question, "--align", "--format", "json", folder=folder)
        )
        assert np.shape(judged["motion"]) == (4, 4)


@pytest.mark.slow
def test_compare_draws_where_meshes_differ(folder: Path) -> None:
    files = ("1.off", "3.off", "--order=-4", "--unit", "mm")
    shown = output("compare", *files, "--proximity", "--witness", "new/where.svg", folder=folder)
    assert shown.index("witness: new/where.svg\n") > shown.index("\nB: volume ")
    drawn = (folder / "new" / "where.svg").read_text(encoding="utf-8")
    assert {">1.off<", ">3.off<", ">distance to the closest point of the other mesh, in mm<"} <= set(
        re.findall(r">[^<>]+<", drawn)
    )


def test_fit_writes_a_nearer_mesh_in_the_unit_of_its_files(folder: Path) -> None:
    options = ("--order", "-4", "--steps", "10", "--refine-to", "119")
    shown = output("fit", "start.ply", "target.ply", "-o", "fitted.obj", *options, folder=folder)
    before, after = re.findall(r"^(?:before|after): +differs by (\S+) % .*, Hausdorff ≥ (\S+), Chamfer", shown, re.M)
    assert float(after[0]) < float(before[0]) / 3
    assert 1.5 < float(before[1]) < 10  # millimetres
    fitted, target = (sb.read_mesh(folder / name) for name in ("fitted.obj", "target.ply"))
    # A closed mesh has an even number.
    assert 80 < len(fitted.triangles) < 119
    assert f"note: it has {len(fitted.triangles)} triangles instead of 119" in shown
    centre = (fitted.vertices.min(axis=0) + fitted.vertices.max(axis=0)) / 2
    assert centre == pytest.approx([100, 0, 0], abs=2)
    assert fitted.area == pytest.approx(target.area, rel=0.05)


def test_the_options_of_fit_reach_it(folder: Path) -> None:
    start, target = icosphere(1), icosphere(2)
    half = sb.Mesh(start.vertices, start.triangles[start.vertices[start.triangles][:, :, 2].mean(axis=1) > 0.1])
    sb.write_mesh(half, folder / "half.ply")
    sb.write_mesh(target, folder / "ball.ply")
    arguments = ("half.ply", "ball.ply", "-o", "out.ply", "--steps", "2", "--no-scaling", "--order", "-4")
    output("fit", *arguments, "--keep-boundary", "--smoothing", "8", folder=folder)
    expected = sb.fit(half, target, -4.0, steps=2, keep_boundary=True, smoothing=8.0)
    np.testing.assert_allclose(sb.read_mesh(folder / "out.ply").vertices, expected.mesh.vertices, atol=1e-12)


def test_fit_notes_that_a_file_has_too_few_digits(folder: Path) -> None:
    for name in ("start", "target"):
        sb.write_mesh(sb.read_mesh(folder / f"{name}.ply").moved(1.0, (-5e6, -4e5, 0.0)), folder / f"far-{name}.ply")
    for suffix, is_noted in (("stl", True), ("ply", False)):
        arguments = ("far-start.ply", "far-target.ply", "-o", f"far.{suffix}", "--steps", "1", "--order", "-4")
        assert ("single precision keeps" in output("fit", *arguments, folder=folder)) == is_noted


@pytest.mark.process
@pytest.mark.parametrize("request_to_end", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.all)])
def test_a_fit_that_is_asked_to_end_writes_the_best_so_far(folder: Path, request_to_end: signal.Signals) -> None:
    # So fine that a step takes longer than this process to hear of one.
    sb.write_mesh(ball(5), folder / "fine.ply")
    arguments = ("fit", "fine.ply", "target.ply", "-o", "best.ply", "--order", "-4", "--smoothing", "1000")
    main, worker = pty.openpty()
    process = subprocess.Popen([*COMMAND, *arguments], cwd=folder, stdout=subprocess.PIPE, stderr=worker)
    os.close(worker)
    shown = b""
    while select.select([main], [], [], 0.1)[0] or process.poll() is None:
        try:
            data = os.read(main, 4096)
        except OSError:  # the other end was closed
            break
        # The bar of a terminal moves with the first step.
        if b"1%" in data and b"1%" not in shown:
            process.send_signal(request_to_end)
        shown += data
    printed = process.communicate(timeout=60)[0].decode()
    os.close(main)
    assert process.returncode == 0, shown
    assert "interrupted" in printed
    assert len(sb.read_mesh(folder / "best.ply").triangles) == 20480


# What is refused in one line, and a part of it that names what was found; or with the usage.
REFUSED = [
    (f"plot {STORE} --output study.toml", "study.toml: no files can be written there"),
    (f"plot {STORE} --output none --family co*", "no family 'co*', only ico, reference"),
    (f"plot {STORE} --output none --mesh ico/11", "no mesh 'ico/11'; did you mean 'ico/1'?"),
    (f"witness {STORE} --mesh scan*", "matches 'scan*'"),
    (f"witness {STORE} --output study.toml", "study.toml: no files can be written there"),
    (f"report {STORE} --mesh r*", "matches 'r*'; its labels are such as 'ico/0', 'ico/1'"),
    # Before anything is read; what could be written is not touched.
    (f"report {STORE}x --output none/r.html", "none/r.html: the report cannot be written there"),
    ("compare no.ply no.ply --report none/page.html --within 1", "none/page.html: the report cannot be written there"),
    ("compare no.ply no.ply --report . --within 1%", ".: the report cannot be written there: Is a directory"),
    ("compare no.ply no.ply --report start.ply", "no.ply: cannot be read"),
    ("compare no.ply no.ply --report none", "no.ply: cannot be read"),
    ("fit start.ply no.ply -o target.ply", "no.ply: cannot be read"),
    ("fit start.ply target.ply -o ./target.ply", "this is the target, which would be lost"),
    ("fit small.ply target.ply -o f.ply", "the start is 0.06 units wide and the target 63"),
    ("fit start.ply target.ply -o f.ply --refine-to 80", "80 triangles already"),
]
MISUSED = [
    (f"table time {STORE} --factor 1", "1.0 is not in the range x>1.0"),
    (f"table league {STORE} --against {STORE} --x edge_length", "leave out --by and --x"),
    (f"table league {STORE} --most 2", "name it with --against"),
    (f"plot {STORE} --format gif", "'gif' is not one of 'png', 'svg', 'pdf'"),
]


@pytest.mark.parametrize(("line", "message"), REFUSED + MISUSED)
def test_wrong_input_gives_one_line_or_the_usage_and_status_2(folder: Path, line: str, message: str) -> None:
    done = call(*line.split(), folder=folder)
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
    assert message in " ".join(done.stderr.split())
    if (line, message) in MISUSED:
        assert "Usage:" in done.stderr
    else:
        assert re.match(r"^error: .*\n$", done.stderr)
    assert not (folder / "none").exists()
