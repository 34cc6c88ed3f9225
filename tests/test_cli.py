"""The command line: what it prints for people and programs, errors in one line, exit statuses."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from distributed import Client
from plyfile import PlyData

import sobolev_batch as sb
from sobolev_batch.shapes import icosphere
from sobolev_batch.tables import FORMATS
from tests.support.commands import COMMAND, STUDY, call, command, finished

pytestmark = pytest.mark.process

STORE, LATTICE = "storage/cli.zarr", "[lattice]\nxi_max = 3.0\nM = 16"
NAN = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 nan 0\n3 0 1 2\n"


def ball(level: int, radius: float = 1.0) -> sb.Mesh:
    """A ball in millimetres, away from the origin."""
    return sb.Mesh(30 * radius * icosphere(level).vertices + [100.0, 0, 0], icosphere(level).triangles)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a study that a process has run, and with meshes."""
    folder = tmp_path_factory.mktemp("cli")
    for name, mesh in {"1.off": ball(1), "3.off": ball(3), "start.ply": ball(1), "target.ply": ball(3, 1.05)}.items():
        sb.write_mesh(mesh, folder / name)
    (folder / "nan.off").write_text(NAN)
    (folder / "study.toml").write_text(STUDY)
    # Files that are refused.
    (folder / "broken.toml").write_text(STUDY.replace("M = 16", "m = 16"))
    (folder / "other.toml").write_text(STUDY.replace('"cli"', '"other"'))
    (folder / "lacking.toml").write_text(f'{STUDY}[[family]]\nname = "f"\nsource = "files"\npaths = ["*.xyz"]')
    (folder / "greedy.toml").write_text(STUDY.replace(LATTICE, '[accuracy]\nrtol = 0.1\nmemory = "1000TB"'))
    (folder / "taken").mkdir()
    (folder / "taken" / "precious").write_text("text")
    sb.write_mesh(ball(1).moved(1e-3, (0.0, 0.0, 0.0)), folder / "small.ply")
    done = command("run", "study.toml", "--workers", "1", folder=folder)
    assert done.returncode == 0, done.stderr
    (folder / "run.txt").write_text(f"{done.stdout}\0{done.stderr}")
    return folder


def output(*arguments: str, folder: Path, status: int = 0) -> str:
    """What a command prints, which ends with this status."""
    done = call(*arguments, folder=folder)
    assert done.returncode == status, done.stderr
    return done.stdout


def test_run_prints_tables_and_plain_progress(folder: Path) -> None:
    shown, progress = (folder / "run.txt").read_text().split("\0")
    assert re.search(r"^ico/1 +80 +0\.5823 +\S+ % ± \S+ % +\S+ ± \S+ +\S+ ± \S+ +\d+ %$", shown, re.M)
    assert f"3 computed, 0 reused, 0 failed; store: {STORE}" in shown
    assert re.search(r"^below 5 %: ico ", shown, re.M)
    assert max(map(len, shown.splitlines())) <= 100
    assert re.search(r"http://127\.0\.0\.1:\d+/status", progress)
    assert re.search(r"^\[3/3\] \S+: complete, \d+\.\d\d s$", progress, re.M)


def test_a_second_run_reuses_everything_as_plan_and_status_say(folder: Path) -> None:
    done = call("run", "study.toml", folder=folder)
    # No cluster was started.
    assert (done.returncode, done.stderr) == (0, "")
    assert "0 computed, 3 reused, 0 failed" in done.stdout
    plan = output("plan", "study.toml", folder=folder)
    assert f"{STORE}, 3 of 3 already stored" in plan
    assert "xi_max 3, M 16" in plan
    assert "0 of 3 already stored" in output("plan", "study.toml", "--store", "elsewhere.zarr", folder=folder)
    assert not (folder / "elsewhere.zarr").exists()
    first, second = output("status", STORE, folder=folder).splitlines()
    assert first == f"{STORE}: 3 of 3 complete, 0 failed, 0 to go"
    assert re.match(r"done; by process \d+ on ", second)
    (folder / "asking.toml").write_text(STUDY.replace(LATTICE, "[accuracy]\nrtol = 1e-2"))
    assert len(re.findall("^chosen: ", output("plan", "asking.toml", folder=folder), re.M)) == 3


def test_a_part_of_a_study_and_then_the_rest(folder: Path) -> None:
    arguments = ("run", "study.toml", "--store", "part.zarr", "--workers", "1")
    shown = output(*arguments, "--only", "ico/[0]", folder=folder)
    assert "2 computed, 0 reused, 0 failed" in shown
    assert re.search(r"^ico/0 +20 ", shown, re.M)
    assert re.search(r"^ico/1( +missing){6}$", shown, re.M)
    assert "2 of 3 complete, 0 failed, 1 to go" in output("status", "part.zarr", folder=folder, status=3)
    assert "1 computed, 2 reused, 0 failed" in output(*arguments, folder=folder)
    columns = ["mesh", "order", "distance", "error", "rate"]
    part, whole = (sb.table(folder / store)[columns] for store in ("part.zarr", STORE))
    pd.testing.assert_frame_equal(part, whole, rtol=1e-12)


def test_tables_as_files_of_other_programs(folder: Path, tmp_path: Path) -> None:
    whole = sb.table(folder / STORE)
    output("export", STORE, str(tmp_path / "t.csv"), "--to", "csv", folder=folder)
    frame = pd.read_csv(tmp_path / "t.csv")
    assert frame.columns.tolist() == whole.columns.tolist()
    assert frame["distance"].tolist() == whole["distance"].tolist()
    for style, library in (("parquet", "pyarrow"), ("netcdf", "h5netcdf")):
        path = tmp_path / f"t.{style}"
        if find_spec(library) is None:
            done = call("export", STORE, path, "--to", style, folder=folder)
            assert done.returncode == 2
            assert f"{library}" in done.stderr
            assert "pip install 'sobolev-batch[export]'" in done.stderr
        elif style == "parquet":
            output("export", STORE, str(path), "--to", style, folder=folder)
            pd.testing.assert_frame_equal(pd.read_parquet(path), whole, check_dtype=False)
        else:
            output("export", STORE, str(path), "--to", style, folder=folder)
            tree = xr.open_datatree(path, engine=library)
            assert tree["convergence"].to_dataset()["family"].values.tolist() == ["ico", "ico", "reference"]
            assert json.loads(tree.attrs["study"])["name"] == "cli"


def test_tables_in_every_format_at_lists_of_orders(folder: Path) -> None:
    frames = {
        style: output("table", STORE, "--format", style, "--order=-3, -10", "--order", "-3.7,-3", folder=folder)
        for style in FORMATS
    }
    rows = json.loads(frames["json"])
    assert list(dict.fromkeys(row["order"] for row in rows)) == [-3.0, -10.0, -3.7]
    assert [row["distance"] for row in rows] == pd.read_csv(StringIO(frames["csv"]))["distance"].tolist()
    number = next(text for text in frames["text"].splitlines() if text.startswith("ico/1")).split()[3]
    assert f"{number} % ±" in frames["markdown"]
    assert rf"{number} \% ±" in frames["latex"]
    matrix = output("table", "matrix", STORE, "--format", "csv", folder=folder)
    assert len(matrix.splitlines()) == 1 + 2 * 3 * 3
    options = ("--format", "json", "--below", "500%", "--order", "-3")
    (row,) = json.loads(output("table", "smallest", STORE, *options, folder=folder))
    assert row["mesh"] == "ico/0"


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


def test_compare_is_exact_to_1_per_cent_without_options(folder: Path) -> None:
    shown = output("compare", "1.off", "3.off", folder=folder)
    value, error = map(float, re.findall(r"1\.off differs from 3\.off by (\S+) % ± (\S+) % at order -2", shown)[0])
    # One digit is shown of the error, rounded up.
    assert error <= 0.02 * value
    assert re.search(r"^order -2: distance \S+ ± \S+ \(truncation", shown, re.M)
    assert re.search(r"in radii of 3\.off, 30 file units each \(scale 0\.033\d*, origin 100 ", shown)


def test_compare_to_an_accuracy_and_on_a_lattice(folder: Path) -> None:
    sampled = output("compare", "1.off", "3.off", "--order", "-2", "--rtol", "1e-2", folder=folder)
    assert re.search(r"^xi_max \d\S*, M \d+, complex64.*, seed 0$", sampled, re.M)
    assert re.search(r"^order -2: distance \S+ ± \S+ \(truncation \S+, aliasing \S+, discretisation", sampled, re.M)
    options = ("--order=-4,-6", "--xi-max", "3", "--M", "24", "--yardsticks", "--proximity", "--witness", "new/w")
    shown = output("compare", "1.off", "3.off", *options, folder=folder)
    assert re.findall(r"^1\.off .* 3\.off .* at order (-\d)", shown, re.M) == ["-4", "-6"]
    for yardstick in (r"moved by \S+ %", r"with noise of \S+ %", r"decimated to \d+ triangles"):
        assert len(re.findall(rf"^  3\.off {yardstick}", shown, re.M)) == 2
    near = sb.proximity(*(sb.read_mesh(folder / name) for name in ("1.off", "3.off")))
    lengths = [f"{near[f'hausdorff{way}']:.4g}" for way in ("_forward", "_backward", "")]
    assert re.search(rf"^Hausdorff, at least +{' +'.join(lengths)}$", shown, re.M)
    assert re.search(rf"^Chamfer, the sum of both means: {near['chamfer']:.3f}\d* ± \S+ \(s\.e\.\)$", shown, re.M)
    for written, own in (("new/w-a.ply", "1.off"), ("new/w-b.ply", "3.off")):
        assert np.array_equal(sb.read_mesh(folder / written).vertices, sb.read_mesh(folder / own).vertices)
        distances = PlyData.read(folder / written)["vertex"].data["distance"]
        # Both are inscribed in one sphere.
        assert 0 <= distances.max() <= near["hausdorff"]
        assert ("a.ply" in written) == bool((distances < 1e-9).all())


def test_compare_names_units_and_defects(folder: Path) -> None:
    ball = sb.shapes.icosphere(2)
    part = sb.Mesh(100 * ball.vertices, np.vstack([ball.triangles[1:], ball.triangles[5:6]]))
    inverted = sb.Mesh(100 * ball.vertices, ball.triangles[:, ::-1])
    sb.write_mesh(part, folder / "part.off")
    sb.write_mesh(inverted, folder / "inverted.off")
    files = ("part.off", "inverted.off", "--order=-4", "--unit", "mm")
    picture = ("--proximity", "--witness", "new/where.svg")
    done = [call("compare", *files, *more, folder=folder) for more in (picture, ("--no-scaling",))]
    scaled, kept = (one.stdout + one.stderr for one in done)
    for shown in (scaled, kept):
        assert re.search(r"part\.off: 3 open edges, .* 1 duplicate triangle, counted twice$", shown, re.M)
        assert "inverted.off: all triangles face inwards\n" in shown
    assert "distances of orders are in radii of inverted.off, 100 mm each" in scaled
    assert scaled.index("witness: new/where.svg\n") > scaled.index("\nB: volume ")
    drawn = (folder / "new" / "where.svg").read_text(encoding="utf-8")
    assert {">part.off<", ">inverted.off<", ">distance to the closest point of the other mesh, in mm<"} <= set(
        re.findall(r">[^<>]+<", drawn)
    )
    assert "wavelengths above 1 mm" not in scaled
    assert "wavelengths above 1 mm weigh alike" in kept
    assert "in mm; the radius of inverted.off is 100\n" in kept


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
    found = document("compare", "turned.off", "still.off", "--order=-4", "--align", folder=folder)
    assert found["before"] > 0.1
    assert found["orders"][0]["relative"] < 1e-9


def test_the_exit_status_of_a_verdict(folder: Path) -> None:
    # As exactly as the package itself computes it.
    first, third = (sb.read_mesh(folder / name) for name in ("1.off", "3.off"))
    similarity = sb.shapes.Similarity.to_unit_ball(third)
    pair = similarity.apply(first), similarity.apply(third)
    truth = sb.distance(*pair, -4, rtol=1e-4)["relative"].item()
    for file, below, status, word in (
        ("3.off", "1e-6", 0, "same"),
        ("1.off", "20%", 0, "same"),
        ("1.off", "0.01", 1, "different"),
        ("1.off", repr(truth), 4, "undecided"),
    ):
        done = call("compare", file, "3.off", "--below", below, "--order", "-4", folder=folder)
        assert (done.returncode, done.stderr) == (status, "")
        assert done.stdout.startswith(f"{file}: {word}")
        assert done.stdout.count("\n") == 1


def document(*arguments: str, folder: Path, status: int = 0) -> dict[str, Any]:
    """The JSON document that is all that a command prints."""
    table: dict[str, Any] = json.loads(output(*arguments, "--format", "json", folder=folder, status=status))
    return table


def test_json_has_the_numbers_that_texts_round(folder: Path) -> None:
    options = ("--order=-4,-3", "--xi-max", "3", "--M", "24", "--proximity")
    found = document("compare", "1.off", "3.off", *options, folder=folder)
    first, third = (sb.read_mesh(folder / name) for name in ("1.off", "3.off"))
    similarity = sb.shapes.Similarity.to_unit_ball(third)
    pair = similarity.apply(first), similarity.apply(third)
    expected = sb.distance(*pair, [-4.0, -3.0], lattice=sb.Lattice(3.0, 24))
    assert [row["order"] for row in found["orders"]] == [-4.0, -3.0]
    for name in ("distance", "error", "relative", "relative_error"):
        assert [row[name] for row in found["orders"]] == pytest.approx(expected[name].values.tolist(), rel=1e-9)
    truncation = expected["error_part"].sel(part="truncation").values.tolist()
    assert [row["truncation"] for row in found["orders"]] == pytest.approx(truncation, rel=1e-9)
    assert (found["scale"], found["a"]) == (similarity.scale, "1.off")
    assert found["area_change"] == pytest.approx(first.area / third.area - 1)
    assert found["proximity"]["hausdorff"] == sb.proximity(first, third)["hausdorff"]
    verdict = document("compare", "1.off", "3.off", "--below", "0.01", folder=folder, status=1)
    assert verdict["outcome"] == "different"
    assert 0.01 < verdict["lower"] < verdict["distance"] < verdict["upper"]


def test_json_of_studies_and_stores(folder: Path) -> None:
    plan = document("plan", "study.toml", folder=folder)
    assert (plan["study"], plan["stored"], plan["lattice"]) == ("cli", plan["labels"], {"xi_max": 3.0, "M": 16})
    status = document("status", STORE, folder=folder)
    assert (status["complete"], status["run"]["state"], status["seconds_left"]) == (3, "done", None)
    checked = document("verify", STORE, folder=folder)
    assert (checked["is_sound"], checked["total"], checked["fields"]) == (True, 3, {})


def test_a_command_that_is_silent_says_that_it_goes_on(folder: Path) -> None:
    done = call("compare", "1.off", "3.off", folder=folder, patience_seconds=0.0)
    assert done.stdout == output("compare", "1.off", "3.off", folder=folder)
    assert re.fullmatch(r"compare: \d+ s so far\n", done.stderr)


def test_what_mesh_files_hold(folder: Path) -> None:
    whole = ball(1)
    sb.write_mesh(sb.Mesh(whole.vertices, whole.triangles[2:]), folder / "open.off")
    shown = output("info", "1.off", "open.off", folder=folder)
    assert re.findall(r"^(\S+): (\d+) triangles, 42 vertices$", shown, re.M) == [("1.off", "80"), ("open.off", "78")]
    assert "closed, all triangles face outwards" in shown
    assert "none: it is not closed" in shown
    closed, opened = document("info", "1.off", "open.off", folder=folder)["files"]
    assert [closed["area"], closed["volume"]] == pytest.approx([whole.area, whole.volume])
    assert closed["box"] == pytest.approx(np.array([whole.vertices.min(axis=0), whole.vertices.max(axis=0)]))
    assert closed["smallest_angle"] == pytest.approx(whole.smallest_angles.min())
    assert closed["aspect_ratio"] == pytest.approx(whole.aspect_ratios.max())
    assert (closed["boundary_edges"], opened["volume"]) == (0, None)
    assert opened["boundary_edges"] > 0
    assert f"{opened['boundary_edges']} open edges" in shown


def test_an_error_is_no_difference(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("broken")

    monkeypatch.setattr("sobolev_batch.testing.verdict.same_surface", fail)
    for options in (("--below", "0.1"), ("--below=0.1",)):
        done = call("compare", "1.off", "3.off", *options, folder=folder)
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr == "error: RuntimeError: broken (--debug shows where)\n"


def test_fit_writes_a_nearer_mesh_in_the_unit_of_its_files(folder: Path) -> None:
    options = ("--order", "-4", "--steps", "10", "--refine-to", "120")
    shown = output("fit", "start.ply", "target.ply", "-o", "fitted.obj", *options, folder=folder)
    before, after = re.findall(r"^(?:before|after): +differs by (\S+) % .*, Hausdorff ≥ (\S+), Chamfer", shown, re.M)
    assert float(after[0]) < float(before[0]) / 3
    assert 1.5 < float(before[1]) < 10  # millimetres
    fitted, target = (sb.read_mesh(folder / name) for name in ("fitted.obj", "target.ply"))
    assert 80 < len(fitted.triangles) <= 120
    centre = (fitted.vertices.min(axis=0) + fitted.vertices.max(axis=0)) / 2
    assert centre == pytest.approx([100, 0, 0], abs=2)
    assert fitted.area == pytest.approx(target.area, rel=0.05)


def test_the_options_of_fit_reach_it(folder: Path) -> None:
    start, target = icosphere(1), icosphere(2)
    half = sb.Mesh(start.vertices, start.triangles[start.vertices[start.triangles][:, :, 2].mean(axis=1) > 0.1])
    sb.write_mesh(half, folder / "half.ply")
    sb.write_mesh(target, folder / "ball.ply")
    arguments = ("half.ply", "ball.ply", "-o", "out.ply", "--steps", "2", "--no-scaling", "--order", "-4")
    shown = output("fit", *arguments, "--keep-boundary", "--smoothing", "8", folder=folder)
    expected = sb.fit(half, target, -4.0, steps=2, keep_boundary=True, smoothing=8.0)
    np.testing.assert_allclose(sb.read_mesh(folder / "out.ply").vertices, expected.mesh.vertices, atol=1e-12)
    assert all(f"note: {remark}" in shown for remark in expected.remarks)


def test_fit_notes_that_a_file_has_too_few_digits(folder: Path) -> None:
    for name in ("start", "target"):
        sb.write_mesh(sb.read_mesh(folder / f"{name}.ply").moved(1.0, (-5e6, -4e5, 0.0)), folder / f"far-{name}.ply")
    for suffix, is_noted in (("stl", True), ("ply", False)):
        arguments = ("far-start.ply", "far-target.ply", "-o", f"far.{suffix}", "--steps", "1", "--order", "-4")
        assert ("too few digits" in output("fit", *arguments, folder=folder)) == is_noted


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


# What is refused in one line, and a part of it that names what was found.
REFUSED = [
    ("run no.toml", "no.toml: cannot be read"),
    ("run broken.toml", "[lattice]: m is unknown; did you mean M?"),
    ("run study.toml --store taken", "not empty and holds no store"),
    ("run study.toml --store typo/results.zarr", "/typo to hold the store; make it first"),
    ("run study.toml --store 1.off", "it is a file"),
    ("run study.toml --store /proc/x.zarr", "/proc/x.zarr: the store cannot be written"),
    (f"run other.toml --store {STORE}", "it holds a store of another study"),
    ("run study.toml --only ico/11 --store none.zarr", "is 'ico/11'; did you mean ico/1?"),
    ("run greedy.toml", "memory of 1.0PB is more than there is"),
    ("run lacking.toml --store none.zarr", "matches no file"),
    ("status nothing.zarr", "it holds no store of a study"),
    ("unlock nothing.zarr", "it holds no store of a study"),
    (f"table smallest {STORE} --below much", "found 'much'"),
    (f"table {STORE} --order -0.4", "below -1/2, found -0.4"),
    (f"plot {STORE} --output study.toml", "study.toml: no files can be written there"),
    (f"plot {STORE} --output none --family co*", "no family 'co*', only ico, reference"),
    (f"plot {STORE} --output none --mesh ico/11", "no mesh 'ico/11', did you mean 'ico/1'?"),
    (f"witness {STORE} --mesh scan*", "matches 'scan*'"),
    (f"witness {STORE} --output study.toml", "study.toml: no files can be written there"),
    (f"report {STORE} --mesh r*", "matches 'r*'; its labels are such as 'ico/0', 'ico/1'"),
    ("compare a.ply b.ply", "a.ply: cannot be read"),
    ("compare 1.off 3.off --order -4 --M 0", "M must be an even integer"),
    ("compare 1.off 3.off --order -1 --rtol 1e-6", "rtol 1e-06 is out of reach at order -1"),
    ("fit start.ply target.ply -o ./target.ply", "this is the target, which would be lost"),
    ("fit small.ply target.ply -o f.ply", "the start is 0.06 units wide and the target 63"),
    ("fit start.ply target.ply -o f.ply --refine-to 80", "80 triangles already"),
]
# What the parser refuses, with the usage.
MISUSED = [
    ("run", "STUDY"),
    ("fly", "fly"),
    (f"table {STORE} --format xml", "xml"),
    (f"table {STORE} --order -3;-10", "'-3;-10' is neither a number nor a list of numbers"),
    (f"table {STORE} --below 1%", "No such option"),
    (f"table smallest {STORE}", "Missing option '--below'"),
    (f"table time {STORE} --factor 1", "1.0 is not in the range x>1.0"),
    (f"export {STORE} t.nc --to netcdf --order -3", "netcdf has the orders of the study"),
    (f"plot {STORE} --format gif", "'gif' is not one of 'png', 'svg', 'pdf'"),
    ("compare 1.off 3.off --rtol 1e-3 --M 64", "--rtol chooses the lattice"),
    ("compare 1.off 3.off --below 0.1 --proximity --rtol 0.1", "leave out --proximity, --rtol"),
    ("compare 1.off 3.off --below 0.1 --order -2,-4", "--below takes one --order"),
]


@pytest.mark.parametrize(("line", "message"), REFUSED + MISUSED, ids=[line[:60] for line, _ in REFUSED + MISUSED])
def test_wrong_input_gives_one_line_or_the_usage_and_status_2(folder: Path, line: str, message: str) -> None:
    done = call(*line.split(), folder=folder)
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
    assert message in " ".join(done.stderr.split())
    if (line, message) in MISUSED:
        assert "Usage:" in done.stderr
    else:
        assert re.match(r"^error: .*\n$", done.stderr)
    assert (folder / "taken" / "precious").read_text() == "text"
    assert not any((folder / name).exists() for name in ("none", "none.zarr", "typo"))


def test_a_process_ends_in_the_same_way(folder: Path) -> None:
    done = command("status", "nothing.zarr", folder=folder)
    assert (done.returncode, done.stdout) == (2, "")
    assert re.match(r"^error: .*it holds no store of a study.*\n$", done.stderr)
    assert "Traceback" in command("--debug", "status", "nothing.zarr", folder=folder).stderr


def test_failed_meshes_give_status_3_and_are_shown_as_missing(folder: Path, client: Client) -> None:
    study = STUDY.replace('"cli"', '"partly"') + '\n[[family]]\nname = "f"\nsource = "files"\npaths = ["nan.off"]\n'
    (folder / "partly.toml").write_text(study)
    assert client.scheduler is not None
    done = call("run", "partly.toml", "--scheduler", client.scheduler.address, folder=folder)
    assert done.returncode == 3
    assert re.search(r"^f/nan( +missing){6}$", done.stdout, re.M)
    assert "1 of 3 vertices have NaN" in done.stdout
    assert "Traceback" not in done.stderr
    shown = output("status", "storage/partly.zarr", folder=folder, status=3)
    assert "3 of 4 complete, 1 failed, 0 to go\nf/nan: " in shown


def test_nothing_answers_at_the_scheduler(folder: Path) -> None:
    with dask.config.set({"distributed.comm.timeouts.connect": "0.5s"}):
        done = call("run", "study.toml", "--store", "new.zarr", "--scheduler", "tcp://127.0.0.1:9", folder=folder)
    assert done.returncode == 1
    assert "error: no Dask scheduler answers at 'tcp://127.0.0.1:9' within 0.5 s" in done.stderr
    assert not (folder / "new.zarr").exists()


COMMANDS = "compare export fit info init plan plot prune report run status submit table unlock verify witness"
# Libraries that take long to import.
NUMERICS = "numpy scipy pandas xarray dask distributed zarr fsspec pydantic matplotlib finufft psutil tabulate"
HELP = """
import sys
from click.testing import CliRunner
from sobolev_batch.cli import cli

tables = [["table", name, "--help"] for name in cli.commands["table"].commands]
for arguments in (["--help"], *([name, "--help"] for name in cli.commands), *tables):
    shown = CliRunner().invoke(cli, arguments, env={"COLUMNS": "80"})
    assert shown.exit_code == 0
    print(shown.output)
print(*cli.commands, file=sys.stderr)
assert not set(sys.modules) & set(sys.argv[1:]), set(sys.modules) & set(sys.argv[1:])
"""


def test_help_imports_nothing_that_computes() -> None:
    done = finished(sys.executable, "-c", HELP, *NUMERICS.split())
    assert done.returncode == 0, done.stderr
    assert sorted(done.stderr.split()) == COMMANDS.split()
    assert max(map(len, done.stdout.splitlines())) <= 80
    # Every option has a sentence.
    for text in re.findall(r"^  -.*(?:\n {10,}.*)*", done.stdout, re.MULTILINE):
        assert re.search(r"\w[)']?\.( |$)", " ".join(text.split())), text


def test_shells_complete_commands_and_options() -> None:
    program = "import sys; sys.argv = ['sobolev-batch']; from sobolev_batch.cli import main; main()"
    for typed, expected in (("table STORE --o", "--order"), ("table ti", "time")):
        asked = {"COMP_WORDS": f"sobolev-batch {typed}", "COMP_CWORD": str(len(typed.split()))}
        environment = {**os.environ, "_SOBOLEV_BATCH_COMPLETE": "bash_complete", **asked}
        done = finished(sys.executable, "-c", program, env=environment)
        assert (done.returncode, done.stdout.split()) == (0, [f"plain,{expected}"])
