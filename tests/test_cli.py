"""The command line: what it prints for people and programs, errors in one line, exit statuses."""

from __future__ import annotations

import errno
import json
import logging
import os
import re
import sys
import threading
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
from sobolev_batch.cli.output import echo, patience, show_step
from sobolev_batch.tables import FORMATS
from tests.geometry.test_deviation import plate
from tests.support.commands import LATTICE, STUDY, ball, call, command, finished, output, write_inputs
from tests.support.processes import with_certificates
from tests.support.repository import install
from tests.support.stores import full_disk

pytestmark = pytest.mark.process

STORE = "storage/cli.zarr"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a study that a process has run, and with meshes."""
    folder = tmp_path_factory.mktemp("cli")
    write_inputs(folder)
    done = command("run", "study.toml", "--workers", "1", folder=folder)
    assert done.returncode == 0, done.stderr
    (folder / "run.txt").write_text(f"{done.stdout}\0{done.stderr}")
    return folder


def test_run_prints_the_verdict_first_and_plain_progress(folder: Path) -> None:
    shown, progress = (folder / "run.txt").read_text().split("\0")
    assert f"3 computed, 0 reused, 0 failed; store: {STORE}" in shown
    assert " ".join(shown.splitlines()[:3]).count("Of 2 meshes, ico/1 is nearest to ") == 1
    assert "Sobolev distance of order" not in shown
    assert f"sobolev-batch table {STORE}\n" in shown
    assert re.search(r"^below 5 %: ico ", shown, re.M)
    shown = output("run", "study.toml", "--tables", folder=folder)
    assert re.search(r"^ico/1 +80 +0\.5823 +\S+ % ± \S+ % +\S+ ± \S+ +\d+ % +\S+ ± \S+$", shown, re.M)
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
    shown = output(*arguments, "--only", "ico/[0]", "--tables", folder=folder)
    assert "2 computed, 0 reused, 0 failed" in shown
    assert re.search(r"^ico/0 +20 ", shown, re.M)
    assert re.search(r"^ico/1( +missing){5}$", shown, re.M)
    assert "2 of 3 complete, 0 failed, 1 to go" in output("status", "part.zarr", folder=folder, status=3)
    assert "1 computed, 2 reused, 0 failed" in output(*arguments, folder=folder)
    columns = ["mesh", "order", "distance", "error", "rate"]
    part, whole = (sb.table(folder / store)[columns] for store in ("part.zarr", STORE))
    pd.testing.assert_frame_equal(part, whole, rtol=1e-12)


def test_a_file_is_whole_or_the_one_that_was_there(folder: Path, tmp_path: Path) -> None:
    for name, library in (("t.csv", "csv"), ("t.parquet", "pyarrow"), ("t.nc", "h5netcdf")):
        if find_spec(library) is None:
            continue
        (tmp_path / name).write_text("before")
        with full_disk(1000):
            done = call("export", STORE, "--output", tmp_path / name, folder=folder)
        assert (done.returncode, (tmp_path / name).read_text()) == (2, "before")
        assert f"{name}: the file cannot be written there: File too large" in done.stderr
    with full_disk(1000):
        done = call("report", STORE, "--output", tmp_path / "t.csv", folder=folder)
    assert (done.returncode, (tmp_path / "t.csv").read_text()) == (2, "before")
    assert {path.name for path in tmp_path.iterdir()} <= {"t.csv", "t.parquet", "t.nc"}
    (tmp_path / "link.csv").symlink_to("t.csv")
    for path in (tmp_path / "link.csv", Path("/dev/null")):
        output("export", STORE, "--output", str(path), "--format", "csv", folder=folder)
    assert (tmp_path / "link.csv").is_symlink()
    assert (tmp_path / "t.csv").read_text().startswith("order,mesh")
    assert Path("/dev/null").is_char_device()


def test_tables_as_files_of_other_programs(folder: Path, tmp_path: Path) -> None:
    whole = sb.table(folder / STORE)
    output("export", STORE, "-o", str(tmp_path / "t.csv"), folder=folder)
    unknown = call("export", STORE, "--output", tmp_path / "t.dat", folder=folder)
    assert unknown.returncode == 2
    assert "--format" in unknown.stderr
    frame = pd.read_csv(tmp_path / "t.csv", dtype={"distance": str})  # pandas 2 rounds numbers that it reads
    assert frame.columns.tolist() == whole.columns.tolist()
    assert frame["distance"].map(float).tolist() == whole["distance"].tolist()
    for style, library in (("parquet", "pyarrow"), ("netcdf", "h5netcdf")):
        path = tmp_path / f"t.{style}"
        if find_spec(library) is None:
            done = call("export", STORE, "--output", path, "--format", style, folder=folder)
            assert done.returncode == 2
            assert f"{library}" in done.stderr
            assert "pip install 'sobolev-batch[export]'" in done.stderr
        elif style == "parquet":
            output("export", STORE, "--output", str(path), "--format", style, folder=folder)
            pd.testing.assert_frame_equal(pd.read_parquet(path), whole, check_dtype=False)
        else:
            output("export", STORE, "--output", str(path), "--format", style, folder=folder)
            tree = xr.open_datatree(path, engine=library)
            assert tree["convergence"].to_dataset()["family"].values.tolist() == ["ico", "ico", "reference"]
            assert json.loads(tree.attrs["study"])["name"] == "cli"
            assert (tree.attrs["Conventions"], tree.attrs["history"][-20:]) == ("CF-1.11", "sobolev-batch export")
            units = {v.attrs.get("units", "") for node in tree.subtree for v in node.variables.values()}
            assert units <= {"", "1", "s", "degree", "byte"}


def test_tables_in_every_format_at_lists_of_orders(folder: Path) -> None:
    frames = {
        style: output("table", STORE, "--format", style, "--order=-3, -10", "--order", "-3.7,-3", folder=folder)
        for style in FORMATS
    }
    rows = json.loads(frames["json"])
    assert list(dict.fromkeys(row["order"] for row in rows)) == [-3.0, -10.0, -3.7]
    # Texts: pandas 2 rounds numbers that it reads.
    read = pd.read_csv(StringIO(frames["csv"]), dtype={"distance": str})
    assert [row["distance"] for row in rows] == read["distance"].map(float).tolist()
    number = next(text for text in frames["text"].splitlines() if text.startswith("ico/1")).split()[3]
    assert f"{number} % ±" in frames["markdown"]
    assert rf"{number} \% ±" in frames["latex"]
    matrix = output("table", "matrix", STORE, "--format", "csv", folder=folder)
    assert len(matrix.splitlines()) == 1 + 2 * 3 * 3
    options = ("--format", "json", "--below", "99%", "--order", "-3")
    (row,) = json.loads(output("table", "smallest", STORE, *options, folder=folder))
    assert row["mesh"] == "ico/0"


def test_compare_is_exact_to_1_per_cent_without_options(folder: Path) -> None:
    shown = output("compare", "1.off", "3.off", folder=folder)
    # What it means, and nothing of how it was computed.
    assert re.search(
        r"^At order -2, this is as far as 3\.off moved by (\S+) % of its radius, \S+ file units\.$", shown, re.M
    )
    assert not re.search("xi_max|^order -2: ", shown, re.M)
    shown = output("compare", "1.off", "3.off", "--verbose", folder=folder)
    value, error = map(float, re.findall(r"1\.off differs from 3\.off by (\S+) % ± (\S+) % at order -2", shown)[0])
    # One digit is shown of the error, rounded up.
    assert error <= 0.02 * value
    assert re.search(r"^order -2: distance \S+ ± \S+ \(truncation", shown, re.M)
    assert re.search(r"in radii of 3\.off, 30 file units each \(scale 0\.033\d*, origin 100 ", shown)


def test_compare_to_an_accuracy_and_on_a_lattice(folder: Path) -> None:
    sampled = output("compare", "1.off", "3.off", "--order", "-2", "--rtol", "1e-2", "--verbose", folder=folder)
    assert re.search(r"^xi_max \d\S*, M \d+, complex64.*, seed 0$", sampled, re.M)
    assert re.search(r"^order -2: distance \S+ ± \S+ \(truncation \S+, aliasing \S+, discretisation", sampled, re.M)
    options = ("--order=-4,-6", "--xi-max", "3", "--M", "24", "--proximity", "--witness", "new/w")
    shown = output("compare", "1.off", "3.off", *options, folder=folder)
    assert re.findall(r"^1\.off .* 3\.off .* at order (-\d)", shown, re.M) == ["-4", "-6"]
    assert len(re.findall(r"^At order -\d, this is as far as 3\.off moved by \S+ %", shown, re.M)) == 2
    near = sb.proximity(*(sb.read_mesh(folder / name) for name in ("1.off", "3.off")))
    bounds = r"(\S+)(?: to (\S+))?(?: file units)?, at \(.*\)"
    of_both = rf"^The largest deviation of 1\.off and 3\.off from each other is {bounds}\.$"
    deviations = [
        re.findall(of_both, shown.splitlines()[0])[0],
        *re.findall(rf"^largest deviation, . to .: {bounds}$", shown, re.M),
    ]
    for (lower, upper), way in zip(deviations, ("", "_forward", "_backward"), strict=True):
        assert float(lower) == pytest.approx(near[f"hausdorff{way}"], rel=1e-3, abs=1e-9)
        assert float(upper or lower) == pytest.approx(near[f"hausdorff_upper{way}"], rel=1e-3, abs=1e-9)
    assert re.search(rf"^mean +{near['mean_forward']:.4g} ", shown, re.M)
    chamfer = rf"^Chamfer, the sum of both means: {near['chamfer']:.3f}\d* ± \S+ file units \(s\.e\.\)$"
    assert re.search(chamfer, shown, re.M)
    assert len(re.findall(r"^[AB]: volume \S+ file units\^3, area \S+ file units\^2, ", shown, re.M)) == 2
    for written, own in (("new/w-a.ply", "1.off"), ("new/w-b.ply", "3.off")):
        assert np.array_equal(sb.read_mesh(folder / written).vertices, sb.read_mesh(folder / own).vertices)
        columns = PlyData.read(folder / written)["vertex"].data
        distances = columns["distance"]
        # Both are inscribed in one sphere.
        assert 0 <= distances.max() <= near["hausdorff"]
        assert ("a.ply" in written) == bool((distances < 1e-9).all())
        assert columns["signed_distance"][distances > 1e-9] == pytest.approx(distances[distances > 1e-9])
    assert f"\nmean distance of A, positive outside of B and negative inside: {near['bias']:.2f}" in shown


def test_info_goes_on_past_a_file_that_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "empty.ply").touch()
    done = call("info", tmp_path / "empty.ply", "1.off", folder=folder)
    assert (done.returncode, done.stdout.startswith("1.off: 80 triangles")) == (2, True)
    assert re.fullmatch(r"error: \S*empty\.ply: .+\n", done.stderr)


def test_compare_tells_files_of_one_name_apart_and_rounding_from_a_deviation(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    for name in ("1.off", "other/1.off"):
        sb.write_mesh(sb.Mesh(sb.shapes.icosphere(1).vertices + 7, sb.shapes.icosphere(1).triangles), tmp_path / name)
    other = str(Path("other", "1.off"))
    first, second = output("compare", "1.off", other, "--unit", "mm", folder=tmp_path).splitlines()
    assert first.startswith(f"The largest deviation of 1.off and {other} from each other is 0 mm, at (")
    assert second == f"1.off and {other} are identical: they cover the same surface."


def test_compare_names_units_and_defects(folder: Path) -> None:
    ball = sb.shapes.icosphere(2)
    part = sb.Mesh(100 * ball.vertices, np.vstack([ball.triangles[1:], ball.triangles[5:6]]))
    shells = np.vstack([100 * ball.vertices, 10 * ball.vertices])
    inverted = sb.Mesh(shells, np.vstack([ball.triangles, ball.triangles + len(ball.vertices)])[:, ::-1])
    sb.write_mesh(part, folder / "part.off")
    sb.write_mesh(inverted, folder / "inverted.off")
    files = ("part.off", "inverted.off", "--order=-4", "--unit", "mm", "--verbose")
    done = [call("compare", *files, *more, folder=folder) for more in ((), ("--no-scaling",))]
    scaled, kept = (one.stdout + one.stderr for one in done)
    for shown in (scaled, kept):
        assert re.search(r"part\.off: 3 open edges, .* 1 duplicate triangle, counted twice$", shown, re.M)
        assert "inverted.off: all triangles face inwards\n" in shown
        assert shown.count("inverted.off: components that lie inside others: 1\n") == 1
        assert "part.off: components" not in shown
    assert "Sobolev distances are in radii of inverted.off, 100 mm each" in scaled
    assert "wavelengths above 1 mm" not in scaled
    assert "wavelengths above 1 mm weigh alike" in kept
    assert "in mm; the radius of inverted.off is 100\n" in kept


def test_the_exit_status_of_a_verdict(folder: Path) -> None:
    # As exactly as the package itself computes it.
    first, third = (sb.read_mesh(folder / name) for name in ("1.off", "3.off"))
    similarity = sb.shapes.Similarity.to_unit_ball(third)
    pair = similarity.apply(first), similarity.apply(third)
    truth = sb.distance(*pair, -4, rtol=1e-4)["relative"].item()
    for file, below, status, word in (
        ("3.off", "1e-4%", 0, "same"),
        ("1.off", "20%", 0, "same"),
        ("1.off", "1 %", 1, "different"),
        ("1.off", f"{100 * truth!r}%", 4, "undecided"),
    ):
        done = call("compare", file, "3.off", "--within", below, "--order", "-4", folder=folder)
        assert (done.returncode, done.stderr) == (status, "")
        assert done.stdout.startswith(f"{file}: {word}")
        assert done.stdout.count("\n") == 1


def test_rounding_is_no_distance(folder: Path) -> None:
    # The same square in other triangles, turned so that coordinates are rounded.
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    corners = np.array([[0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0], [4, 3, 0]]) @ turn.T
    sb.write_mesh(sb.Mesh(corners, [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]), folder / "square.ply")
    sb.write_mesh(sb.Mesh(corners, [[0, 1, 2], [0, 2, 3]]), folder / "same.ply")
    shown = output("compare", "square.ply", "same.ply", "--proximity", "--order=-4", folder=folder)
    rows = re.findall(r"^(?:mean|RMS|\d\d % within|normals, \w+) {2,}(.*)$", shown, re.M)
    assert [set(row.replace(" deg", "").split()) for row in rows] == [{"0"}] * 7
    # Nor has a place more digits than are of use, or a mean of nothing an error.
    assert not re.search(r"\d{7}|\N{MULTIPLICATION SIGN} 10", shown)


def test_a_hole_that_was_closed_is_seen(folder: Path) -> None:
    for name, hole in (("full.off", False), ("hole.off", True)):
        sb.write_mesh(plate(hole), folder / name)
    shown = output("compare", "full.off", "hole.off", "--proximity", "--order=-4", "--unit", "mm", folder=folder)
    assert re.search(r"^largest deviation, A to B: 2\.99\d*( to 3\.0\d*)? mm, at \(0, 0, 0\)$", shown, re.M)
    assert re.search(r"^largest deviation, B to A: 0 mm, at ", shown, re.M)
    for length, unit, status, answer in (
        ("3.1", (), 0, "within 3.1: largest deviation "),
        ("0.31cm", ("--unit", "mm"), 0, "within 3.1 mm: largest deviation "),
        ("2", (), 1, "not within 2: largest deviation "),
        ("10%", (), 0, "same surface: "),
        ("1e-4 %", (), 1, "different surfaces: "),
    ):
        done = call("compare", "full.off", "hole.off", "--within", length, *unit, folder=folder)
        assert (done.returncode, done.stdout.count("\n")) == (status, 1), done.stderr
        assert done.stdout.startswith(f"full.off: {answer}")
        assert (" of full.off" in done.stdout) == ("largest" in answer)
    (folder / "other").mkdir()
    sb.write_mesh(plate(True), folder / "other/full.off")
    for length in ("2", "1e-4 %"):  # Folders tell files of one name apart.
        done = call("compare", "other/full.off", "full.off", "--within", length, folder=folder)
        assert done.stdout.startswith("other/full.off: "), done.stderr
    # It names the mesh that has the point, and the area, whichever comes first.
    turned = output("compare", "hole.off", "full.off", "--within", "2", folder=folder, status=1)
    assert [" of full.off" in part for part in turned.split(";")] == [True, True]
    one_way = output("compare", "hole.off", "full.off", "--within", "2", "--one-way", folder=folder)
    assert one_way.startswith("hole.off: within 2: largest deviation ")
    for more in ((), ("--within", "2%")):
        wrong = call("compare", "hole.off", "full.off", "--one-way", *more, folder=folder)
        assert (wrong.returncode, "--one-way" in wrong.stderr) == (2, True)
    found = document("compare", "full.off", "hole.off", "--within", "2", folder=folder, status=1)
    assert (found["outcome"], found["length"], found["unit"]) == ("not within", 2.0, None)
    assert 2 < found["forward"]["lower"] == found["lower"] <= found["upper"]
    # The rim has the radius 3.
    assert np.linalg.norm(found["place"]) < 1
    # What is 2 from the rim of the hole is a millionth of the plate.
    share, error = found["beyond"]
    assert 0 <= share < 4 * error < 1e-3
    assert found["beyond_of"] == "a"
    assert found["doubt"] is None
    large = sb.read_mesh(folder / "full.off")
    sb.write_mesh(sb.Mesh(25.4 * large.vertices, large.triangles), folder / "inches.off")
    asked = ("compare", "inches.off", "full.off", "--within", "2")
    doubt = document(*asked, folder=folder, status=1)["doubt"]
    assert "25.4 times as large" in doubt
    assert f"; {doubt}\n" in output(*asked, folder=folder, status=1)
    assert document("compare", "hole.off", "full.off", "--within", "2", folder=folder, status=1)["beyond_of"] == "b"
    assert document("compare", "hole.off", "full.off", "--within", "4", folder=folder)["beyond_of"] is None


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
    assert found["deviation"]["backward"]["upper"] == found["proximity"]["hausdorff_upper_backward"]
    assert len(found["deviation"]["forward"]["place"]) == 3
    verdict = document("compare", "1.off", "3.off", "--within", "1%", folder=folder, status=1)
    assert verdict["outcome"] == "different"
    assert 0.01 < verdict["lower"] < verdict["distance"] < verdict["upper"]


def test_json_of_studies_and_stores(folder: Path) -> None:
    plan = document("plan", "study.toml", folder=folder)
    one = plan["objects"][""]
    assert (plan["study"], one["stored"], one["lattice"]) == ("cli", one["labels"], {"xi_max": 3.0, "M": 16})
    status = document("status", STORE, folder=folder)
    assert (status["complete"], status["run"]["state"], status["seconds_left"]) == (3, "done", None)
    checked = document("verify", STORE, folder=folder)
    assert (checked["is_sound"], checked["total"], checked["fields"]) == (True, 3, {})


def test_a_command_that_is_silent_says_that_it_goes_on(folder: Path) -> None:
    done = call("compare", "1.off", "3.off", folder=folder, patience_seconds=0.0)
    assert done.stdout == output("compare", "1.off", "3.off", folder=folder)
    assert re.fullmatch(r"(compare: \d+ s so far.*\n)+", done.stderr)


def test_a_command_that_has_told_something_still_says_that_it_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_PATIENCE_SECONDS", "_SECONDS_BETWEEN_LINES"):
        monkeypatch.setattr(f"sobolev_batch.cli.output.{name}", 0.0)
    has_step = threading.Event()
    monkeypatch.setattr("click.echo", lambda text, **_: has_step.set() if "s so far: octaves" in text else None)
    with patience("compare"):
        echo("note: in another unit", err=True)
        show_step("octaves")
        assert has_step.wait(60)


def test_a_terminal_has_prose_on_lines_of_its_width(folder: Path) -> None:
    for line in (("info", "1.off"), ("compare", "1.off", "3.off")):
        done, whole = call(*line, folder=folder, columns=40, patience_seconds=0.0), output(*line, folder=folder)
        assert max(map(len, done.stdout.splitlines())) <= 40 < max(map(len, whole.splitlines()))
        assert done.stdout.split() == whole.split()
        assert ("\n    " in done.stdout) == (line[0] == "info"), "an item of a list goes on below itself"
    # What stood there while it computed is gone.
    assert done.stderr.removeprefix("\r\x1b[K").startswith("compare: 0 s so far")
    assert done.stderr.endswith("\r\x1b[K")
    refused = call("info", "1.off", "no file of this name.off", folder=folder, columns=40).stderr
    assert max(map(len, refused.removeprefix("\r\x1b[K").splitlines())) <= 40


def test_a_terminal_has_data_and_commands_as_they_are(folder: Path) -> None:
    for line in (("table", STORE, "--format", "csv"), ("info", "1.off", "--format", "json"), ("schema",)):
        assert call(*line, folder=folder, columns=40).stdout == output(*line, folder=folder)
    assert f"all distances: sobolev-batch table {STORE}" in call("run", "study.toml", folder=folder, columns=40).stdout
    # Rows of a table that has no room are left to the terminal.
    assert "------  ------" in call("table", STORE, folder=folder, columns=25).stdout


def test_what_mesh_files_hold(folder: Path) -> None:
    whole = ball(1)
    # Far from each other, two triangles are missing.
    sb.write_mesh(sb.Mesh(whole.vertices, whole.triangles[1:-1]), folder / "open.off")
    shown = output("info", "1.off", "open.off", folder=folder)
    assert re.findall(r"^(\S+): (\d+) triangles, 42 vertices$", shown, re.M) == [("1.off", "80"), ("open.off", "78")]
    assert re.findall("(.*) boundary loops", shown) == ["  2"]
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
    assert (closed["boundary_loops"], opened["boundary_loops"]) == (0, 2)


@pytest.mark.parametrize(
    ("turned", "doubled", "reason"),
    [
        (3, 0, "normals flip"),
        (0, 1, "edges have more than two triangles"),
        (3, 1, "edges have more than two triangles and normals flip"),
    ],
)
def test_why_a_closed_mesh_has_no_volume(folder: Path, turned: int, doubled: int, reason: str) -> None:
    whole = ball(1)
    triangles = whole.triangles.copy()
    triangles[:turned] = triangles[:turned, ::-1]
    sb.write_mesh(
        sb.Mesh(whole.vertices, np.concatenate([triangles, triangles[40 : 40 + doubled]])), folder / "odd.off"
    )
    shown = output("info", "odd.off", folder=folder)
    assert re.findall(r", volume (.*)$", shown, re.M) == [f"none: {reason}"]


def test_an_error_is_no_difference(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("broken")

    monkeypatch.setattr("sobolev_batch.cli.comparison.same_surface", fail)
    for options in (("--within", "10%"), ("--within=10%",)):
        done = call("compare", "1.off", "3.off", *options, folder=folder)
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr == "error: RuntimeError: broken (--debug shows where)\n"


# What is refused in one line, and a part of it that names what was found.
REFUSED = [
    ("compare 1.off 3.off --within 0.1mm", "name it, as unit='mm'"),
    ("compare 1.off 3.off --within -1", "a length is a positive number"),
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
    ("status nothing.zarr", "nothing.zarr: it does not exist"),
    ("unlock nothing.zarr", "nothing.zarr: it does not exist"),
    ("status taken", "taken: it holds no store of a study"),
    ("status 1.off", "1.off: it holds no store of a study"),
    (f"table smallest {STORE} --below much", "found 'much'"),
    (f"table smallest {STORE} --below 5", "below 1, such as '1%', found '5'"),
    (f"table {STORE} --order -0.4", "below -1/2, found -0.4"),
    ("compare a.ply b.ply", "a.ply: cannot be read"),
    ("compare 1.off 3.off --order -4 --M 0", "M must be an even integer"),
    ("compare 1.off 3.off --order -1 --rtol 1e-6", "rtol 1e-06 is out of reach at order -1"),
]
# What the parser refuses, with the usage.
MISUSED = [
    ("run", "STUDY"),
    ("fly", "fly"),
    (f"table {STORE} --format xml", "xml"),
    (f"table {STORE} --order -3;-10", "'-3;-10' is neither a number nor a list of numbers"),
    (f"table {STORE} --below 1%", "No such option"),
    (f"table smallest {STORE}", "Missing option '--below'"),
    (f"export {STORE} -o t.nc --format netcdf --order -3", "netcdf has the orders of the study"),
    ("compare 1.off 3.off --rtol 1e-3 --M 64", "--rtol chooses the lattice"),
    ("compare 1.off 3.off --within 10% --proximity --rtol 0.1", "leave out --proximity, --rtol"),
    ("compare 1.off 3.off --within 10% --order -2,-4", "--within takes one --order"),
    ("compare 1.off 3.off --within 100%", "less than 100 %, found 100%"),
    ("compare 1.off 3.off --threshold 1", "--threshold goes with --proximity or --report"),
    ("compare 1.off 3.off --within 1 --order -2 --proximity", "leave out --order, --proximity"),
    ("compare 1.off 3.off --within 1% --unit mm", "leave out --unit"),
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
    assert re.match(r"^error: nothing.zarr: it does not exist\n$", done.stderr)
    assert "Traceback" in command("--debug", "status", "nothing.zarr", folder=folder).stderr


def test_what_dask_says_of_its_own_code_is_left_out(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def lose(store: object) -> None:
        try:
            raise RuntimeError("deep inside")
        except RuntimeError:
            log.exception("")
            log.exception("Worker died")
        raise sb.errors.ClusterError("the scheduler was lost")

    log = logging.getLogger("distributed.of_a_test")
    log.setLevel(logging.ERROR)
    # As in a process whose log was set up before Dask's.
    monkeypatch.setattr(log.parent, "propagate", True)
    monkeypatch.setattr("sobolev_batch.batch.status.status", lose)
    done = call("status", "x.zarr", folder=folder)
    assert (done.returncode, done.stderr) == (1, "error: Worker died\nerror: the scheduler was lost\n")


def test_a_full_disk_has_a_status_of_its_own(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("sobolev_batch.store.location.FolderStore.put", fail)
    done = call("run", "study.toml", "--store", "full.zarr", folder=folder)
    assert done.returncode == 5
    assert re.match(r"error: full\.zarr: the store cannot be written: No space left on device; make room", done.stderr)


def test_failed_meshes_give_status_3_and_are_shown_as_missing(folder: Path, client: Client) -> None:
    study = STUDY.replace('"cli"', '"partly"') + '\n[[family]]\nname = "f"\nsource = "files"\npaths = ["nan.off"]\n'
    (folder / "partly.toml").write_text(study)
    assert client.scheduler is not None
    with with_certificates(client):
        done = call("run", "partly.toml", "--scheduler", client.scheduler.address, folder=folder)
    assert done.returncode == 3
    assert re.search(r"^missing +f/nan$", done.stdout, re.M)
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


# Those of the extras are beside them.
COMMANDS = "compare info plan prune run status submit table unlock verify"
# Libraries that take long to import.
NUMERICS = "numpy scipy pandas xarray dask distributed zarr fsspec pydantic matplotlib finufft psutil tabulate"
HELP = """
import sys
import click
from click.testing import CliRunner
from sobolev_batch.cli import cli

context = click.Context(cli)
names, table = cli.list_commands(context), cli.get_command(context, "table")
tables = [["table", name, "--help"] for name in table.list_commands(context)]
for arguments in (["--help"], *([name, "--help"] for name in names), *tables):
    shown = CliRunner().invoke(cli, arguments, env={"COLUMNS": "80"})
    assert shown.exit_code == 0
    print(shown.output)
print(*names, file=sys.stderr)
assert not set(sys.modules) & set(sys.argv[1:]), set(sys.modules) & set(sys.argv[1:])
"""


def test_help_imports_nothing_that_computes() -> None:
    done = finished(sys.executable, "-c", HELP, *NUMERICS.split())
    assert done.returncode == 0, done.stderr
    assert set(COMMANDS.split()) <= set(done.stderr.split())
    assert max(map(len, done.stdout.splitlines())) <= 80
    # No line about a command is cut.
    assert not re.search(r"^  \w.*\.\.\.$", done.stdout, re.MULTILINE)
    # Every option has a sentence.
    for text in re.findall(r"^  -.*(?:\n {10,}.*)*", done.stdout, re.MULTILINE):
        assert re.search(r"\w[)']?\.( |$)", " ".join(text.split())), text


OTHERS = """
import click

@click.command()
def tidy():
    click.echo("tidied")

@click.command()
@click.argument("store")
def ages(store):
    click.echo(f"ages of {store}")
"""
ENTRY_POINTS = "[sobolev_batch.commands]\ntidy = tidy_meshes:tidy\ntable ages = tidy_meshes:ages\nlost = nowhere:lost\n"


def test_other_packages_add_commands_that_are_loaded_when_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path, "tidy_meshes", ENTRY_POINTS, OTHERS)
    monkeypatch.syspath_prepend(str(tmp_path))
    shown = call("--help").stdout + call("table", "--help").stdout
    for name in ("tidy", "ages", "lost"):
        assert re.search(rf"^  {name} +See the package tidy_meshes\.$", shown, re.M)
    assert "tidy_meshes" not in sys.modules
    assert call("tidy").stdout == "tidied\n"
    assert call("table", "ages", "x.zarr").stdout == "ages of x.zarr\n"
    lost = call("lost")
    assert (lost.returncode, lost.stdout) == (1, "")
    assert "No module named 'nowhere'" in lost.stderr
    sys.modules.pop("tidy_meshes")


def test_shells_complete_commands_and_options() -> None:
    program = "import sys; sys.argv = ['sobolev-batch']; from sobolev_batch.cli import main; main()"
    for typed, expected in (("table STORE --o", "--order"), ("table ma", "matrix")):
        asked = {"COMP_WORDS": f"sobolev-batch {typed}", "COMP_CWORD": str(len(typed.split()))}
        environment = {**os.environ, "_SOBOLEV_BATCH_COMPLETE": "bash_complete", **asked}
        done = finished(sys.executable, "-c", program, env=environment)
        assert (done.returncode, done.stdout.split()) == (0, [f"plain,{expected}"])
