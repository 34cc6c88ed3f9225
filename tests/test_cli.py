"""The command line: output, errors in one line, exit status."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import shlex
import signal
import subprocess
import sys
from itertools import combinations
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
import trimesh

import sobolev_batch as sb
from sobolev_batch import icosphere
from sobolev_batch.results.tables.formatting import Digits
from tests.support.commands import COMMAND, STUDY, call, command
from tests.support.drawing import obstacle

pytestmark = pytest.mark.process


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a study that has been run once."""
    folder = tmp_path_factory.mktemp("cli")
    (folder / "study.toml").write_text(STUDY)
    done = command("run", "study.toml", "--workers", "1", folder=folder)
    assert done.returncode == 0, done.stderr
    (folder / "run.out").write_text(done.stdout)
    (folder / "run.err").write_text(done.stderr)
    return folder


def test_run_prints_tables_and_plain_progress(folder: Path) -> None:
    output, errors = (folder / "run.out").read_text(), (folder / "run.err").read_text()
    assert "Sobolev distance of order -10 to reference" in output
    number = r"\d+(\.\d+)?"
    row = rf"ico/1 +80 +0\.5823 +{number} % ± {number} % +{number} ± {number} +{number} ± {number} +\d+ %\n"
    assert re.search(row, output)
    assert "3 computed, 0 reused, 0 failed; store: storage/cli.zarr" in output
    assert re.search(r"dashboard: http://127\.0\.0\.1:\d+/status", errors)
    assert re.search(r"\[3/3\] \S+: complete, \d+\.\d\d s", errors)
    assert max(map(len, output.splitlines())) <= 100


def test_a_second_run_reuses_everything_and_starts_no_cluster(folder: Path) -> None:
    done = command("run", "study.toml", folder=folder)
    assert done.returncode == 0
    assert "0 computed, 3 reused, 0 failed" in done.stdout
    assert "dashboard" not in done.stderr


def test_plan_and_status(folder: Path) -> None:
    plan = call("plan", "study.toml", folder=folder)
    assert plan.returncode == 0
    assert "3 in 1 family, reference reference" in plan.stdout
    assert "xi_max 3, M 16, spacing 0.375, half period 1.33333" in plan.stdout
    assert "41.6KB per surface, 124.8KB in all" in plan.stdout
    assert "storage/cli.zarr, 3 of 3 already stored" in plan.stdout
    fresh = call("plan", "study.toml", "--store", "elsewhere.zarr", folder=folder)
    assert "elsewhere.zarr, 0 of 3 already stored" in fresh.stdout
    assert not (folder / "elsewhere.zarr").exists()
    status = call("status", "storage/cli.zarr", folder=folder)
    first, second = status.stdout.splitlines()
    assert first == "storage/cli.zarr: 3 of 3 complete, 0 failed, 0 to go"
    assert re.match(r"done; by process \d+ on .*, begun .*Z, ended .*Z$", second)


def test_tables_in_every_format(folder: Path) -> None:
    outputs = {
        style: call("table", "storage/cli.zarr", "--format", style, "--order", "-3", folder=folder).stdout
        for style in ("text", "csv", "json", "markdown", "latex")
    }
    records = json.loads(outputs["json"])
    assert [record["mesh"] for record in records] == ["ico/0", "ico/1"]
    assert {record["order"] for record in records} == {-3.0}
    relative = Digits.percent(records[1]["relative"], records[1]["relative_error"]).together
    assert relative in outputs["text"]
    assert relative in outputs["markdown"]
    assert relative.replace("%", r"\%") in outputs["latex"]
    header, _, line = (row.split(",") for row in outputs["csv"].splitlines()[:3])
    assert header[:4] == ["order", "mesh", "family", "name"]
    assert float(line[header.index("distance")]) == records[1]["distance"]
    assert records[0]["rate"] is None
    assert r"\toprule" in outputs["latex"]
    assert "| ico/1" in outputs["markdown"]


def test_orders_come_in_lists_and_meshes_by_patterns(folder: Path) -> None:
    def orders(*arguments: str) -> list[float]:
        done = call("table", "storage/cli.zarr", "--format", "json", *arguments, folder=folder)
        assert done.returncode == 0, done.stderr
        return list(dict.fromkeys(record["order"] for record in json.loads(done.stdout)))

    assert orders("--order", "-3,-10") == [-3.0, -10.0]
    assert orders("--order=-3, -10", "--order", "-3.7,-3") == [-3.0, -10.0, -3.7]
    listed = call("table", "storage/cli.zarr", "--order", "-3;-10", folder=folder)
    assert (listed.returncode, listed.stdout) == (2, "")
    assert "'-3;-10' is neither a number nor a list of numbers such as -4,-6" in " ".join(listed.stderr.split())
    done = call("witness", "storage/cli.zarr", "--mesh", "*/[1]", "--order", "-3,-4", "--output", "w", folder=folder)
    assert [Path(line).name for line in done.stdout.split()] == ["0001-ico-1.ply"]
    assert "witness_minus_3" in (folder / "w" / "0001-ico-1.ply").read_bytes()[:2000].decode("ascii", "replace")
    done = call("witness", "storage/cli.zarr", "--mesh", "ico/*", "--output", "w", folder=folder)
    assert len(done.stdout.split()) == 2


def test_matrices(folder: Path) -> None:
    done = call("table", "storage/cli.zarr", "--matrix", "--order", "-3", folder=folder)
    assert "order -3, in % of the norm of reference" in done.stdout
    assert re.search(r"^3 reference( +\d+(\.\d+)?\(\d+\)){2}$", done.stdout, re.M), done.stdout
    lines = call("table", "storage/cli.zarr", "--matrix", "--format", "csv", folder=folder).stdout.splitlines()
    assert len(lines) == 1 + 2 * 3 * 3


def test_the_smallest_mesh_below_a_bound(folder: Path) -> None:
    (record,) = json.loads(
        call("table", "storage/cli.zarr", "--below", "500%", "--order", "-3", "--format", "json", folder=folder).stdout
    )
    assert record["mesh"] == "ico/0"
    none = call("table", "storage/cli.zarr", "--below", "0.001 %", folder=folder)
    assert none.stdout.startswith("Smallest mesh below 0.001 % of the norm of reference, order -10\n")
    assert "nearest: ico/1" in none.stdout
    refused = call("table", "storage/cli.zarr", "--below", "much", folder=folder)
    assert refused.returncode == 2
    assert "a fraction is a positive number such as 0.01, or a text such as '1%', found 'much'" in refused.stderr
    both = call("table", "storage/cli.zarr", "--below", "1%", "--matrix", folder=folder)
    assert both.returncode == 2
    assert "ask for one of them" in both.stderr


def test_plot_draws_every_picture(folder: Path) -> None:
    done = call("plot", "storage/cli.zarr", "--output", "pictures", folder=folder)
    names = ["convergence", "transform", "matrix", "map", "spectrum", "energy"]
    if obstacle() is None:
        names += ["witness-0001-ico-1", "witness-0000-ico-0", "witness"]
        assert done.stderr == ""
    else:
        assert re.match(r"^not drawn with their witness functions: ico/1, ico/0: .*\n$", done.stderr)
    assert done.stdout.split() == [f"pictures/{name}.png" for name in names]
    for name in done.stdout.split():
        assert (folder / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.all
def test_plot_for_a_paper(folder: Path) -> None:
    place = ("plot", "storage/cli.zarr", "--output", "paper")
    chosen = ("--family", "i*", "--x", "vertices", "--order", "-3", "--size", "84x60mm")
    done = call(*place, *chosen, "--format", "svg,pdf", "--format", "pdf", folder=folder)
    files = done.stdout.split()
    assert files[:4] == [f"paper/{name}.{ending}" for name in ("convergence", "transform") for ending in ("svg", "pdf")]
    assert all((folder / name).exists() for name in files)
    text = (folder / "paper" / "convergence.svg").read_text(encoding="utf-8")
    assert "number of vertices" in text
    # In points.
    assert 'width="238.11' in text
    assert 'height="170.07' in text


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (("--family", "co*"), "the study has no family 'co*', only ico, reference"),
        (("--format", "png,gif"), "'gif' is none of png, svg, pdf"),
        (("--size", "6"), "a size is WIDTHxHEIGHT"),
    ],
)
def test_plots_that_cannot_be_had(folder: Path, option: tuple[str, str], words: str) -> None:
    done = call("plot", "storage/cli.zarr", "--output", "none", *option, folder=folder)
    assert done.returncode == 2
    assert words in done.stderr
    assert not (folder / "none").exists()


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two files that hold triangulated spheres."""
    folder = tmp_path_factory.mktemp("pair")
    for level in (1, 3):
        mesh = icosphere(level)
        trimesh.Trimesh(2.0 * mesh.vertices, mesh.triangles, process=False).export(folder / f"{level}.off")
    return folder


def test_compare_to_an_accuracy(pair: Path) -> None:
    done = call("compare", "1.off", "3.off", "--order", "-6", "--rtol", "1e-3", folder=pair)
    assert done.returncode == 0
    assert re.search(r"^xi_max \d\.\d+, M \d+, complex", done.stdout, re.M)
    sentence = r"^1\.off differs from 3\.off by (\S+) % ± (\S+) % at order -6"
    value, error = map(float, re.findall(sentence, done.stdout)[0])
    # One digit is shown of the error, rounded up.
    assert error <= 2e-3 * value
    assert re.search(r"^order -6: distance 0\.\d+ ± 0\.\d+ \(truncation", done.stdout, re.M)


@pytest.mark.parametrize(("option", "words"), [("--M", "M must be an even integer"), ("--xi-max", "xi_max must be")])
def test_zero_is_no_lattice(pair: Path, option: str, words: str) -> None:
    done = call("compare", "1.off", "3.off", "--order", "-4", option, "0", folder=pair)
    assert done.returncode == 2
    assert words in done.stderr


def test_an_accuracy_out_of_reach_is_wrong_input(pair: Path) -> None:
    done = call("compare", "1.off", "3.off", "--order", "-1", "--rtol", "1e-6", folder=pair)
    assert done.returncode == 2
    assert re.search(r"^error: .*rtol 1e-06 is out of reach at order -1", done.stderr)
    assert done.stderr.count("\n") == 1
    done = call("compare", "1.off", "3.off", "--rtol", "1e-3", "--M", "64", folder=pair)
    assert done.returncode == 2
    assert "--rtol chooses the lattice" in done.stderr


def test_files_with_equal_triangles_need_no_computation(pair: Path) -> None:
    done = call("compare", "3.off", "3.off", "--order", "-0.6", "--rtol", "1e-2", folder=pair)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("3.off and 3.off are identical: they have the same triangles.\nscale ")
    assert call("compare", "3.off", "3.off", folder=pair).stdout == done.stdout


def test_an_accuracy_at_a_low_order_says_what_was_sampled(pair: Path) -> None:
    done = call("compare", "1.off", "3.off", "--order", "-1", "--rtol", "1e-1", folder=pair)
    assert re.search(r"^xi_max .*, \d+ octaves up to \d.*, seed 0$", done.stdout, re.MULTILINE)
    number, texts = re.findall(r"^order -1: distance \S+ ± (\S+) \((.*)\)", done.stdout, re.MULTILINE)[0]
    parts = re.findall(r"\d\.?\d*e[+-]\d+", texts)
    assert len(parts) == 4
    # The sum is rounded up to one digit.
    assert 0.5 * float(number) < sum(map(float, parts)) < 1.1 * float(number)


def test_plan_says_what_an_accuracy_leads_to(folder: Path) -> None:
    text = (
        '[study]\nname = "asking"\n[accuracy]\nrtol = 1e-3\n[norm]\norders = [-8]\n'
        '[reference]\nsource = "sphere"\n[[family]]\nname = "a"\nsource = "icosphere"\nlevels = [0, 2]\n'
    )
    (folder / "asking.toml").write_text(text)
    done = call("plan", "asking.toml", folder=folder)
    assert done.returncode == 0
    assert re.search(
        r"^accuracy: +rtol 0\.001 of every distance to reference; 2.0GB for a transform, M <= \d+$", done.stdout, re.M
    )
    assert len(re.findall(r"^chosen: ", done.stdout, re.M)) == 3


def test_compare_two_files(pair: Path) -> None:
    done = call("compare", "1.off", "3.off", "--order", "-4", "--order", "-2", "--M", "64", folder=pair)
    assert done.returncode == 0, done.stderr
    assert re.match(
        r"1\.off differs from 3\.off by \S+ % ± \S+ % at order -4; \d+ % of it is lost area\.\n"
        r"1\.off differs from 3\.off by \S+ % ± \S+ % at order -2; \d+ % of it is lost area\.\n"
        r"order -4: distance 0\.\d+ ± .*\norder -2: distance \S+ ± \S+ \(truncation .*\)\n"
        r"scale 0\.5\d*, origin \S+ \S+ \S+\n$",
        done.stdout,
    )


def test_compare_is_exact_to_1_per_cent_without_options(pair: Path) -> None:
    done = call("compare", "1.off", "3.off", folder=pair)
    value, error = map(float, re.findall(r"by (\S+) % ± (\S+) % at order -2", done.stdout)[0])
    # One digit is shown of the error, rounded up.
    assert error <= 0.02 * value
    assert re.search(r"^xi_max ", done.stdout, re.M)


def test_compare_writes_where_meshes_differ(pair: Path, tmp_path: Path) -> None:
    done = call("compare", "1.off", "3.off", "--order", "-4", "--witness", str(tmp_path / "new" / "w"), folder=pair)
    assert re.search(r"\n1\.off has less area near \(.*\); witness: \S+-a\.ply \S+-b\.ply\n$", done.stdout)
    for label, name in (("a", "1.off"), ("b", "3.off")):
        written, own = sb.read_mesh(tmp_path / "new" / f"w-{label}.ply"), sb.read_mesh(pair / name)
        np.testing.assert_array_equal(written.vertices, own.vertices)


def test_compare_names_changes_that_are_as_far_away(pair: Path) -> None:
    options = ("--order", "-4", "--xi-max", "3", "--M", "24", "--yardsticks")
    done = call("compare", "1.off", "3.off", *options, folder=pair)
    assert done.returncode == 0, done.stderr
    assert re.search(
        r"^At order -4, 1\.off is as far from 3\.off as\n"
        r"  3\.off moved by \S+ % of its radius,\n"
        r"  3\.off with noise of \S+ % of its radius,\n"
        r"  3\.off decimated to \d+ triangles\.\n",
        done.stdout,
        re.M,
    )


@pytest.mark.parametrize(
    ("files", "below", "status", "start"),
    [
        (("3.off", "3.off"), "1e-6", 0, "same surface: relative distance 0 ± 0 "),
        (("1.off", "3.off"), "0.2", 0, "same surface: "),
        (("1.off", "3.off"), "0.01", 1, "different surfaces: "),
    ],
)
def test_the_exit_status_of_a_verdict(files: tuple[str, str], below: str, status: int, start: str, pair: Path) -> None:
    done = call("compare", *files, "--below", below, folder=pair)
    assert (done.returncode, done.stderr) == (status, "")
    (line,) = done.stdout.splitlines()
    assert line.startswith(f"{files[0]}: {start}")
    assert f"at order -4, {'within' if status == 0 else 'above'} rtol {float(below):g}" in line


def test_what_cannot_be_told_has_an_exit_status_of_its_own(pair: Path) -> None:
    # As exactly as the package itself computes it.
    first, third = (sb.read_mesh(pair / name) for name in ("1.off", "3.off"))
    truth = float(sb.distance(first, third, -4, rtol=1e-4)["distance"] / sb.norm(third, -4, rtol=1e-4)["norm"])
    done = call("compare", "1.off", "3.off", "--no-scaling", "--below", repr(truth), folder=pair)
    assert done.returncode == 4
    assert done.stdout.startswith("1.off: undecided: ")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--proximity", "--rtol", "0.1"), "gives a verdict and no numbers; leave out --proximity, --rtol"),
        (("--order", "-2", "--order", "-4"), "--below takes one --order"),
        (("--below", "1"), "--below takes a fraction between 0 and 1, or 0 and 100 %, found 1"),
    ],
)
def test_a_verdict_takes_no_options_of_numbers(options: tuple[str, ...], message: str, pair: Path) -> None:
    done = call("compare", "1.off", "3.off", "--below", "0.1", *options, folder=pair)
    assert done.returncode == 2
    assert message in done.stderr


def test_compare_two_files_by_proximity(pair: Path) -> None:
    done = call("compare", "1.off", "3.off", "--proximity", folder=pair)
    assert done.returncode == 0, done.stderr
    assert re.search(r"\nHausdorff at least 6\.\d\de-02, Chamfer 8\.\d{4}e-02 ± \de-04 \(s\.e\.\)\n$", done.stdout)


BAD = [
    (("run", "no.toml"), "no.toml: cannot be read: No such file or directory"),
    (("run", "broken.toml"), "[lattice]: unknown key m: did you mean M?"),
    (("run", "order.toml"), "orders below -1/2, found -0.5"),
    (("run", "odd.toml"), "M must be an even integer"),
    (("run", "outside.toml"), "holds only |coordinate| < 1/(2h) = 0.666667"),
    (("run", "study.toml", "--store", "taken"), "not empty and holds no store"),
    (("run", "study.toml", "--store", "/proc/x.zarr"), "/proc/x.zarr: the store cannot be written"),
    (("run", "other.toml", "--store", "storage/cli.zarr"), "a store of another study is there"),
    (("status", "nothing.zarr"), "no store of a study is there"),
    (("table", "nothing.zarr"), "no store of a study is there"),
    (("table", "storage/cli.zarr", "--order", "-0.4"), "finite only for orders below -1/2, found -0.4"),
    (("compare", "a.ply", "b.ply"), "a.ply: cannot be read"),
    (("compare", "nan.off", "nan.off"), "nan.off: 1 of 3 vertices have NaN"),
    (("plot", "storage/cli.zarr", "--output", "study.toml"), "study.toml: pictures cannot be written there"),
    (("plot", "storage/cli.zarr", "--witness", "ico/11"), "no mesh 'ico/11', did you mean 'ico/1'?"),
    (("witness", "storage/cli.zarr", "--mesh", "ico/11"), "no mesh 'ico/11', did you mean 'ico/1'?"),
    (("witness", "storage/cli.zarr", "--mesh", "scan*"), "no computed mesh with triangles that matches 'scan*'; its"),
    (("report", "storage/cli.zarr", "--witness", "r*"), "that matches 'r*'; its labels are such as 'ico/0', 'ico/1'"),
    (
        ("run", "study.toml", "--store", "huge.zarr", "--memory", "1000TB"),
        "memory of a worker of 1.0PB is more than there is",
    ),
    (("run", "greedy.toml"), "[accuracy]: memory of 1.0PB is more than there is"),
    (("plan", "greedy.toml"), "[accuracy]: memory of 1.0PB is more than any worker has"),
    (("compare", "one.off", "two.off", "--rtol", "0.1", "--memory", "1000TB"), "memory of 1.0PB is more than there is"),
    (("compare", "one.off", "two.off", "--below", "1%", "--memory", "1000TB"), "memory of 1.0PB is more than there is"),
    (("witness", "storage/cli.zarr", "--mesh", "reference"), "'reference' is the reference: its witness is zero"),
    (("witness", "storage/cli.zarr", "--output", "study.toml"), "study.toml: no files can be written there"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD, ids=[" ".join(arguments) for arguments, _ in BAD])
def test_wrong_input_gives_one_line_and_status_2(folder: Path, arguments: tuple[str, ...], message: str) -> None:
    (folder / "broken.toml").write_text(STUDY.replace("M = 16", "m = 16"))
    (folder / "order.toml").write_text(STUDY.replace("-3.0", "-0.5"))
    (folder / "odd.toml").write_text(STUDY.replace("M = 16", "M = 17"))
    outside = STUDY.replace("M = 16", "M = 8").replace('"sphere"', '"icosphere"\nlevels = [1]')
    (folder / "outside.toml").write_text(outside)
    (folder / "other.toml").write_text(STUDY.replace('"cli"', '"other"'))
    greedy = STUDY.replace("[lattice]\nxi_max = 3.0\nM = 16", '[accuracy]\nrtol = 0.1\nmemory = "1000TB"')
    (folder / "greedy.toml").write_text(greedy)
    (folder / "taken").mkdir(exist_ok=True)
    (folder / "taken" / "precious").write_text("text")
    (folder / "nan.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 nan 0\n3 0 1 2\n")
    for name, x in (("one.off", 1), ("two.off", 2)):
        (folder / name).write_text(f"OFF\n3 1 0\n0 0 0\n{x} 0 0\n0 1 0\n3 0 1 2\n")
    done = call(*arguments, folder=folder)
    assert done.returncode == 2, done.stderr
    assert message in done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""
    assert (folder / "taken" / "precious").read_text() == "text"


@pytest.mark.parametrize(
    "arguments",
    [
        ("compare", "one.off", "two.off", "--rtol", "0.1", "--memory", "1000TB"),
        ("run", "study.toml", "--store", "huge.zarr", "--memory", "1000TB"),
    ],
)
def test_more_memory_than_there_is_is_refused(folder: Path, arguments: tuple[str, ...]) -> None:
    for name, x in (("one.off", 1), ("two.off", 2)):
        (folder / name).write_text(f"OFF\n3 1 0\n0 0 0\n{x} 0 0\n0 1 0\n3 0 1 2\n")
    done = call(*arguments, folder=folder)
    assert done.returncode == 2
    assert re.search(r"error: (the )?memory (of a worker )?of 1\.0PB is more than there is", done.stderr), done.stderr


COMMANDS = "compare fit init league plan plot release report run status submit table verify witness"
# Libraries that take long to import.
NUMERICS = "numpy scipy pandas xarray dask distributed zarr fsspec pydantic trimesh matplotlib finufft psutil tabulate"
HELP = """
import sys
from click.testing import CliRunner
from sobolev_batch.cli import cli

for arguments in (["--help"], *([name, "--help"] for name in cli.commands)):
    shown = CliRunner().invoke(cli, arguments, env={"COLUMNS": sys.argv[1]})
    assert shown.exit_code == 0
    print(shown.output)
print(*cli.commands, file=sys.stderr)
assert not set(sys.modules) & set(sys.argv[2:]), set(sys.modules) & set(sys.argv[2:])
"""


@pytest.mark.parametrize("columns", ["80", "100"])
def test_help_imports_nothing_that_computes(columns: str) -> None:
    arguments = [sys.executable, "-c", HELP, columns, *NUMERICS.split()]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert sorted(done.stderr.split()) == COMMANDS.split()
    assert max(map(len, done.stdout.splitlines())) <= int(columns)
    assert "..." not in done.stdout.replace("[ARGS]...", "")
    # Every option says in sentences what it does.
    for text in re.findall(r"^  -.*(?:\n {10,}.*)*", done.stdout, re.MULTILINE):
        words = " ".join(text.split())
        assert re.search(r"\w[)']?\.( |$)", words), words


def test_shells_complete_commands_and_options() -> None:
    environment = {"_SOBOLEV_BATCH_COMPLETE": "bash_source"}
    script = [sys.executable, "-c", "from sobolev_batch.cli import cli; cli(prog_name='sobolev-batch')"]
    source = subprocess.run(script, capture_output=True, text=True, check=False, env={**os.environ, **environment})
    assert "complete -o nosort -F _sobolev_batch_completion sobolev-batch" in source.stdout
    asked = {"_SOBOLEV_BATCH_COMPLETE": "bash_complete", "COMP_WORDS": "sobolev-batch table --o", "COMP_CWORD": "2"}
    found = subprocess.run(script, capture_output=True, text=True, check=False, env={**os.environ, **asked})
    assert found.stdout.split() == ["plain,--order", "plain,--over-time"]


def test_wrong_input_ends_a_process_in_the_same_way(folder: Path) -> None:
    done = command("status", "nothing.zarr", folder=folder)
    assert (done.returncode, done.stdout) == (2, "")
    assert re.match(r"^error: .*no store of a study is there.*\n$", done.stderr)
    done = command("fly", folder=folder)
    assert done.returncode == 2
    assert "Usage:" in done.stderr


def test_failed_meshes_give_status_3_and_are_shown_as_missing(folder: Path) -> None:
    (folder / "bad.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 nan 0\n3 0 1 2\n")
    study = STUDY.replace('"cli"', '"partly"') + '\n[[family]]\nname = "f"\nsource = "files"\npaths = ["bad.off"]\n'
    (folder / "partly.toml").write_text(study)
    done = command("run", "partly.toml", "--workers", "1", folder=folder)
    assert done.returncode == 3
    assert re.search(r"f/bad( +missing){6}\n", done.stdout)
    assert "f/bad is failed: " in done.stdout
    assert "1 of 3 vertices have NaN" in done.stdout
    assert "Traceback" not in done.stderr
    status = call("status", "storage/partly.zarr", folder=folder)
    assert status.returncode == 3
    assert "3 of 4 complete, 1 failed, 0 to go\nf/bad: " in status.stdout


def test_nothing_answers_at_the_scheduler(folder: Path) -> None:
    with dask.config.set({"distributed.comm.timeouts.connect": "0.5s"}):
        done = call("run", "study.toml", "--store", "new.zarr", "--scheduler", "tcp://127.0.0.1:9", folder=folder)
    assert done.returncode == 1
    assert "error: no Dask scheduler answers at 'tcp://127.0.0.1:9' within 0.5 s" in done.stderr
    assert not (folder / "new.zarr").exists()


def test_usage_errors_have_status_2(folder: Path) -> None:
    for arguments in (
        ("run",),
        ("fly",),
        ("table", "storage/cli.zarr", "--format", "xml"),
        ("run", "study.toml", "--workers", "0"),
    ):
        done = call(*arguments, folder=folder)
        assert done.returncode == 2, arguments
        assert "Usage:" in done.stderr


def test_debug_shows_the_traceback(folder: Path) -> None:
    done = command("--debug", "run", "no.toml", folder=folder)
    assert "Traceback" in done.stderr
    assert done.returncode == 1


@pytest.mark.all
def test_a_terminal_gets_a_bar(folder: Path) -> None:
    master, slave = pty.openpty()
    process = subprocess.Popen(
        [*COMMAND, "run", "study.toml", "--store", "bar.zarr", "--workers", "1"],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=slave,
        env={**os.environ, "COLUMNS": "80", "TERM": "xterm"},
    )
    os.close(slave)
    shown = b""
    while select.select([master], [], [], 60)[0]:
        try:
            data = os.read(master, 4096)
        except OSError:  # the other end was closed
            break
        if not data:
            break
        shown += data
    os.close(master)
    assert process.wait(60) == 0
    assert b"transforms" in shown
    assert b"3/3" in shown
    assert b"[3/3] " not in shown


@pytest.fixture
def balls(tmp_path: Path) -> Path:
    """A folder with a coarse ball and a finer, larger one, in millimetres and away from the origin."""
    for name, level, radius in (("start", 2, 30.0), ("target", 4, 31.0)):
        ball = icosphere(level)
        trimesh.Trimesh(radius * ball.vertices + [100.0, 0, 0], ball.triangles, process=False).export(
            tmp_path / f"{name}.ply"
        )
    return tmp_path


def test_fit_writes_a_nearer_mesh_in_the_unit_of_its_files(balls: Path) -> None:
    done = command("fit", "start.ply", "target.ply", "-o", "fitted.obj", "--order", "-4", "--steps", "20", folder=balls)
    assert done.returncode == 0, done.stderr
    numbers = (
        r"differs by (\S+) % ± \S+ %, distance \S+ ± \S+, Hausdorff ≥ (\S+), "
        r"Chamfer (\S+), smallest angle (\S+) degrees"
    )
    before, after = (re.search(rf"{word}: +{numbers}", done.stdout) for word in ("before", "after"))
    assert before is not None
    assert after is not None
    assert float(after[1]) < float(before[1]) / 5
    assert 0.9 < float(before[2]) < 2.0  # millimetres
    assert float(after[2]) < float(before[2])
    assert max(map(len, done.stdout.splitlines())) <= 130
    fitted = trimesh.load_mesh(balls / "fitted.obj")
    assert fitted.bounds.mean(axis=0) == pytest.approx([100.0, 0, 0], abs=0.05)
    assert fitted.area == pytest.approx(4 * 3.14159265 * 31.0**2, rel=0.01)


@pytest.mark.all
def test_the_options_of_fit_reach_it(balls: Path) -> None:
    ball = icosphere(2)
    upper = ball.vertices[ball.triangles][:, :, 2].mean(axis=1) > 0.1
    half = sb.Mesh(ball.vertices, ball.triangles[upper])
    sb.write_mesh(half, balls / "half.ply")
    sb.write_mesh(icosphere(4), balls / "ball.ply")
    similarity = sb.Similarity.to_unit_ball(icosphere(4))
    assert similarity.scale == pytest.approx(1, rel=1e-12)
    sets: list[tuple[list[str], dict[str, Any]]] = [
        (["--keep-boundary"], {"keep_boundary": True}),
        (["--smoothing", "8"], {"smoothing": 8.0}),
        (["--order", "-4"], {"order": -4.0}),
        ([], {}),
    ]
    found = []
    for options, settings in sets:
        done = call("fit", "half.ply", "ball.ply", "-o", "out.ply", "--steps", "3", *options, folder=balls)
        assert done.returncode == 0, done.stderr
        expected = sb.fit(half, icosphere(4), **{"order": -2.0, **settings}, steps=3)
        found.append(np.asarray(sb.read_mesh(balls / "out.ply").vertices))
        np.testing.assert_allclose(found[-1], expected.mesh.vertices, rtol=0, atol=1e-3)
        assert all(f"note: {remark}" in done.stdout for remark in expected.remarks)
    assert min(np.abs(one - other).max() for one, other in combinations(found, 2)) > 4e-3


@pytest.mark.all
def test_fit_keeps_the_unit_if_asked(balls: Path) -> None:
    arguments = ("start.ply", "target.ply", "-o", "f.ply", "--steps", "1")
    scaled, own = (call("fit", *arguments, *more, folder=balls).stdout for more in ((), ("--no-scaling",)))
    numbers = [re.search(r"before: differs by .*, distance (\S+)", text) for text in (scaled, own)]
    assert numbers[0] is not None
    assert numbers[1] is not None
    # The square root of a length of some 30 units, and more.
    assert float(numbers[1][1]) > 5 * float(numbers[0][1])


def test_fit_says_that_a_file_has_too_few_digits(balls: Path) -> None:
    for name in ("start", "target"):
        mesh = sb.read_mesh(balls / f"{name}.ply")
        sb.write_mesh(mesh.moved(1.0, (-5e6, -4e5, 0.0)), balls / f"{name}.ply")
    for suffix, is_enough in (("stl", False), ("ply", True)):
        arguments = ("start.ply", "target.ply", "-o", f"far.{suffix}", "--steps", "1")
        done = call("fit", *arguments, folder=balls)
        assert done.returncode == 0, done.stderr
        assert ("have too few digits: vertices are off by up to 0.2" in done.stdout) != is_enough


@pytest.mark.all
def test_fit_leaves_an_old_file_until_the_new_one_is_whole(balls: Path) -> None:
    before = (balls / "start.ply").read_bytes()
    arguments = ["fit", "start.ply", "target.ply", "-o", "start.ply", "--refine-to", "20000", "--steps", "1"]
    program = f"ulimit -f 300; exec {shlex.join([*COMMAND, *arguments])}"
    done = subprocess.run(["bash", "-c", program], cwd=balls, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "start.ply: the mesh cannot be written there: File too large" in done.stderr
    assert (balls / "start.ply").read_bytes() == before
    assert sorted(path.name for path in balls.iterdir()) == ["start.ply", "target.ply"]


def test_fit_refines_to_a_number_of_triangles(balls: Path) -> None:
    arguments = ("start.ply", "target.ply", "-o", "fitted.ply", "--refine-to", "500", "--order", "-4", "--steps", "5")
    done = call("fit", *arguments, folder=balls)
    assert done.returncode == 0, done.stderr
    found = re.match(r"(\d+) triangles; \d+ steps; all steps are taken\n", done.stdout)
    assert found is not None
    assert 480 < int(found[1]) <= 500
    fitted = trimesh.load_mesh(balls / "fitted.ply")
    assert len(fitted.faces) == int(found[1])
    assert fitted.is_watertight
    assert fitted.bounds.mean(axis=0) == pytest.approx([100.0, 0, 0], abs=0.1)


@pytest.mark.parametrize("request_to_end", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.all)])
def test_an_interrupted_fit_writes_the_best_so_far(balls: Path, request_to_end: signal.Signals) -> None:
    # So fine that a step takes longer than this process to hear of one.
    ball = icosphere(5)
    trimesh.Trimesh(30 * ball.vertices + [100.0, 0, 0], ball.triangles, process=False).export(balls / "start.ply")
    arguments = ("start.ply", "target.ply", "-o", "fitted.ply", "--order", "-4", "--smoothing", "1000")
    main, worker = pty.openpty()
    process = subprocess.Popen(
        [*COMMAND, "fit", *arguments], cwd=balls, stdout=subprocess.PIPE, stderr=worker, stdin=subprocess.DEVNULL
    )
    os.close(worker)
    shown = b""
    # The bar moves with the first step.
    while b"1%" not in shown and process.poll() is None:
        shown += os.read(main, 4096)
    process.send_signal(request_to_end)
    while select.select([main], [], [], 0.1)[0] or process.poll() is None:
        try:
            if not os.read(main, 4096):
                break
        except OSError:
            break
    output = process.communicate()[0].decode()
    os.close(main)
    assert process.returncode == 0, shown
    assert "it was interrupted" in output
    assert len(trimesh.load_mesh(balls / "fitted.ply").faces) == 20480


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("start.ply", "target.ply", "-o", "fitted.step"), "meshes are written as .ply, .obj, .off, .stl"),
        (("start.ply", "target.ply", "-o", "nowhere/fitted.ply"), "there is no folder nowhere"),
        (("start.ply", "target.ply", "-o", "f.ply", "--order", "-0.4"), "only for orders below -1/2, found -0.4"),
        (("start.ply", "target.ply", "-o", "f.ply", "--steps", "0"), "steps must be a whole number from 1 on"),
        (("lost.ply", "target.ply", "-o", "f.ply"), "lost.ply"),
        (("start.ply", "target.ply", "-o", "./target.ply"), "this is the target, which would be lost"),
        (("start.ply", "target.ply", "-o", "folder.ply"), "something that is no file is there already"),
        (("start.ply", "target.ply", "-o", f"{'x' * 300}.ply"), "cannot be written there: File name too long"),
        (("small.ply", "target.ply", "-o", "f.ply"), "the start is 0.06 units wide and the target 62"),
        (("start.ply", "target.ply", "-o", "f.ply", "--refine-to", "320"), "320 triangles already: ask for more than"),
    ],
)
def test_a_fit_that_cannot_be_is_refused_in_one_line(balls: Path, arguments: tuple[str, ...], message: str) -> None:
    (balls / "folder.ply").mkdir()
    sb.write_mesh(sb.read_mesh(balls / "start.ply").moved(1e-3, (0.0, 0.0, 0.0)), balls / "small.ply")
    done = call("fit", *arguments, folder=balls)
    assert done.returncode in (1, 2)
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
