"""The sources `command` and `function`: parameters, limits, what is kept, and what may run."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest

import sobolev_batch as sb
from sobolev_batch.sources.command import RemeshedMember
from sobolev_batch.sources.mesh_cache import MeshCache
from sobolev_batch.sources.registry import Member, parse_source
from sobolev_batch.store.location import Location
from tests.support.commands import call
from tests.support.members import BALL, SilentError, listed, loaded
from tests.support.processes import wait_until
from tests.support.studies import balls, small_table

COPY: dict[str, Any] = {"source": "command", "mesh": BALL, "command": ["cp", "{input}", "{output}"]}
# A triangle of which a corner is nowhere, for printf.
NOT_FINITE = (
    r"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    r"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 nan\n3 0 1 2\n"
)
# It leaves a file behind for each time that it runs.
COUNTED = {**COPY, "command": ["sh", "-c", "echo >> {log}; cp {input} {output}"]}


def halved(mesh: sb.Mesh, size: float = 0.5, *, flip: bool = False) -> Any:
    return size * mesh.vertices, mesh.triangles[:, ::-1] if flip else mesh.triangles


HALVED: dict[str, Any] = {"source": "function", "function": halved, "mesh": BALL, "version": "1"}


def made(table: dict[str, Any], place: Path, *, may_run: bool = True, folder: Path = Path()) -> tuple[Member, ...]:
    """Return the members of a table whose meshes are kept in a place."""
    return parse_source(table).with_cache(MeshCache(Location(str(place)), may_run)).members(folder)


def test_lists_are_swept_and_every_value_is_known(tmp_path: Path) -> None:
    family = made({**HALVED, "size": [0.25, 2.0], "flip": False}, tmp_path)
    assert listed(family) == [("0.25", -1), ("2", -1)]
    assert family[0].metadata == (("size", 0.25), ("flip", "false"))
    assert loaded(family[0]).area == pytest.approx(sb.shapes.icosphere(3).area / 16)
    several = made({**HALVED, "size": [0.25, 2.0], "flip": [True, False]}, tmp_path)
    assert [member.name for member in several][:2] == ["size=0.25,flip=true", "size=0.25,flip=false"]
    assert len({member.fingerprint_digest() for member in several}) == 4
    assert made(HALVED, tmp_path)[0].name == "3"
    with pytest.raises(ValueError, match="at most 1000 meshes are allowed, and its lists make 10000"):
        made({**HALVED, "a": list(range(100)), "b": list(range(100))}, tmp_path)


def test_the_version_of_a_function_is_known_where_its_source_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    # As on workers, which have the functions of a script or a notebook without the file.
    table = {"source": "function", "function": halved, "mesh": BALL}
    source = parse_source(table)
    (before,) = source.members(Path())

    def lost(function: object) -> str:
        raise OSError("could not get source code")

    monkeypatch.setattr("inspect.getsource", lost)
    (after,) = pickle.loads(pickle.dumps(source)).members(Path())
    assert after.fingerprint() == before.fingerprint()
    with pytest.raises(ValueError, match=r'source of .*halved is not at hand; give "version"'):
        parse_source(table)


def test_a_time_without_a_unit_is_in_seconds() -> None:
    times = {"60": 60, 60: 60, "0.5": 0.5, "1 min": 60, "10 ms": 0.01}
    assert {given: parse_source({**COPY, "timeout": given}).timeout for given in times} == times  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("change", "refusal"),
    [
        ({"timeot": 3}, "timeot is unknown: it is no key .* and the command has no {timeot} for it"),
        ({"command": ["cp", "{input}", "{output}", "{n}"]}, "the command has {n}, and no parameter has this name"),
        ({"command": ["true", "{input}"]}, "the command has no {output}"),
        ({"command": []}, "command"),
        ({"timeout": "soon"}, "a number of seconds, or a time such as '10 min'"),
        ({"largest_output": "much"}, "a positive number of bytes"),
        ({"output": "mesh"}, "the suffix of a mesh format"),
        ({"n": [{}], "command": ["a", "{output}", "{n}"]}, "n must be a number, a text, true, false or a list of them"),
    ],
)
def test_a_wrong_table_is_refused_before_anything_runs(change: dict[str, Any], refusal: str) -> None:
    with pytest.raises(ValueError, match=refusal):
        parse_source({**COPY, **change})


@pytest.mark.process
def test_a_mesh_is_made_once_and_found_again(tmp_path: Path) -> None:
    log, place = tmp_path / "log", tmp_path / "kept"
    table = {**COUNTED, "log": str(log)}
    first, again = made(table, place)[0], pickle.loads(pickle.dumps(made(table, place)[0]))
    assert loaded(first).digest == loaded(again).digest == sb.shapes.icosphere(3).digest
    assert len(log.read_text()) == 1
    cost = again.cost()
    assert cost is not None
    assert cost.exit_status == 0
    assert cost.make_cpu_seconds > 0
    # Where it may not run, what is kept is found, and nothing else.
    assert loaded(made(table, place, may_run=False)[0]) is not None
    with pytest.raises(sb.errors.MeshError, match=r"may not run.*--allow-commands"):
        made(table, tmp_path / "elsewhere", may_run=False)[0].load()
    # What is damaged is made again.
    (ply,) = place.glob("*.ply")
    ply.write_bytes(ply.read_bytes()[:-100] + bytes(100))
    assert loaded(first).digest == sb.shapes.icosphere(3).digest
    assert len(log.read_text()) == 2


@pytest.mark.process
def test_all_that_a_mesh_depends_on_is_in_its_fingerprint(tmp_path: Path) -> None:
    (tmp_path / "copy.sh").write_text("cp $1 $2")
    table = {**COPY, "command": ["sh", "{folder}/copy.sh", "{input}", "{output}"], "version": ["echo", "1.0"]}

    def digest(**changes: Any) -> str:
        return made({**table, **changes}, tmp_path / "kept", folder=tmp_path)[0].fingerprint_digest()

    first = digest()
    assert digest() == first
    assert first not in {
        digest(mesh={"source": "icosphere", "levels": [2]}),
        digest(version=["echo", "1.1"]),
        digest(output=".off"),
        digest(command=[*table["command"], "{output}"]),
    }
    # It is found once for all meshes of a family.
    log = tmp_path / "versions"
    asking = {**COPY, "command": ["cp", "{input}", "{output}", "{n}"], "n": [1, 2, 3]}
    made({**asking, "version": ["sh", "-c", f"echo >> {log}"]}, tmp_path / "kept")
    assert len(log.read_text()) == 1
    # Readers know the version that was found last.
    reader = made(table, tmp_path / "kept", may_run=False, folder=tmp_path)[0]
    assert reader.fingerprint_digest() == first
    (tmp_path / "copy.sh").write_text("cat $1 > $2")
    assert (changed := digest()) != first
    # A version that was damaged is another one, until a run asks again.
    for version in (tmp_path / "kept").glob("version-*"):
        version.write_bytes(b"\xff")
    assert digest() != changed
    (tmp_path / "copy.sh").unlink()
    with pytest.raises(sb.errors.MeshError, match=r"copy\.sh"):
        digest()


@pytest.mark.process
@pytest.mark.parametrize(
    ("command", "reason"),
    [
        ("echo broken >&2; exit 7", "sh ended with exit status 7: broken"),
        ("kill -9 $$", "sh was ended by SIGKILL"),
        ("kill -40 $$", "sh was ended by signal 40"),
        ("echo done", r"sh wrote no mesh \(output\.ply\): done"),
        ("echo nonsense > {output}", "sh wrote what cannot be used: "),
        (f"printf '{NOT_FINITE}' > {{output}}", "sh wrote what cannot be used: 1 of 3 vertices have NaN"),
        ("sleep 1000 & sleep 1000", r"it was ended after 0\.3 s, its timeout"),
        ("yes > flood", "it was ended after it had written"),
        ("yes", "it was ended after it had written"),
        ("rm -r $PWD; echo gone >&2; exit 7", "sh ended with exit status 7: gone"),
        ("rm -r $PWD; echo done", r"sh wrote no mesh \(output\.ply\): done"),
    ],
)
def test_a_program_that_fails_says_why(tmp_path: Path, command: str, reason: str) -> None:
    timeout = 0.3 if "sleep" in command else 60
    limits = {"timeout": timeout, "largest_output": 100_000}
    member = made({**COPY, "command": ["sh", "-c", command + " # {output}"], **limits}, tmp_path)[0]
    with pytest.raises(sb.errors.MeshError, match=reason):
        member.load()
    cost = member.cost()
    assert cost is not None
    assert cost.exit_status != 0 or any(word in command for word in ("done", "nonsense", "nan"))


@pytest.mark.process
def test_a_program_ends_with_the_process_that_waits_for_it(tmp_path: Path) -> None:
    apart = "setsid sh -c 'echo $$; sleep 1000'" if sys.platform == "linux" else "echo $$"
    both = "until [ $(wc -l < begun) = 2 ]; do sleep 0.01; done; mv begun numbers"
    script = f"cd {tmp_path}; echo $$ > begun; {apart} >> begun & sleep 1000 & {both}; sleep 1000"
    run = (
        "import sobolev_batch as sb; from sobolev_batch.sources.programs import run_command; "
        f"run_command(sb.shapes.icosphere(0), ['sh', '-c', {script!r}], ('.ply', '.ply'), 1000.0, 10**9)"
    )
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    waiting = subprocess.Popen([sys.executable, "-c", run], env=os.environ | {"TMPDIR": str(scratch)})
    wait_until((tmp_path / "numbers").exists)
    assert len(list(scratch.iterdir())) == 1
    waiting.kill()
    waiting.wait()
    wait_until(lambda: not list(scratch.iterdir()))
    for number in map(int, (tmp_path / "numbers").read_text().split()):
        assert not psutil.pid_exists(number) or psutil.Process(number).status() == psutil.STATUS_ZOMBIE


@pytest.mark.process
def test_a_process_that_is_killed_before_its_program_begins_leaves_no_folder(tmp_path: Path) -> None:
    run = (
        "import os; import sobolev_batch as sb; from sobolev_batch.sources import programs; "
        "programs.write_mesh = lambda *_: os.kill(os.getpid(), 9); "
        "programs.run_command(sb.shapes.icosphere(0), ['true'], ('.ply', '.ply'), 1000.0, 10**9)"
    )
    ended = subprocess.run([sys.executable, "-c", run], env=os.environ | {"TMPDIR": str(tmp_path)})
    assert ended.returncode == -9
    wait_until(lambda: not list(tmp_path.iterdir()))


@pytest.mark.process
def test_a_mesh_whose_files_changed_while_it_was_made_is_not_kept(tmp_path: Path) -> None:
    (tmp_path / "copy.sh").write_text("cp $1 $2; echo >> $0")
    table = {**COPY, "command": ["sh", "{folder}/copy.sh", "{input}", "{output}"]}
    member = made(table, tmp_path / "kept", folder=tmp_path)[0]
    with pytest.raises(sb.errors.MeshError, match="changed while it was made; run the study again"):
        member.load()
    assert not (tmp_path / "kept").exists()


@pytest.mark.process
def test_a_program_without_a_scratch_folder_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "gone"))
    with pytest.raises(sb.errors.MeshError, match=r"no scratch folder: .*gone.*set TMPDIR"):
        made(COPY, tmp_path)[0].load()


@pytest.mark.process
def test_a_program_that_is_not_there_or_prints_no_version_is_named(tmp_path: Path) -> None:
    with pytest.raises(sb.errors.MeshError, match="no-such-remesher cannot be started on this machine"):
        made({**COPY, "command": ["no-such-remesher", "{output}"]}, tmp_path)[0].load()
    with pytest.raises(sb.errors.StudyError, match="no-such-remesher is not installed, or not on the PATH"):
        made({**COPY, "version": ["no-such-remesher"]}, tmp_path)
    for words, problem in ((["yes"], "it was ended after it had written"), (["false"], "ended with exit status 1")):
        with pytest.raises(sb.errors.StudyError, match=f"version: {words[0]}: .*{problem}"):
            made({**COPY, "version": words}, tmp_path)


@pytest.mark.process
@pytest.mark.extras
def test_formats_of_other_remeshers(tmp_path: Path) -> None:
    member = made({**COPY, "input": ".mesh", "output": ".mesh"}, tmp_path)[0]
    assert loaded(member).area == pytest.approx(sb.shapes.icosphere(3).area, rel=1e-12)
    with pytest.raises(sb.errors.MeshError, match=r"meshes are written as .*; found the suffix '\.nope'"):
        made({**COPY, "input": ".nope"}, tmp_path)[0].load()


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (RuntimeError("no convergence"), "broken: RuntimeError: no convergence$"),
        (SystemExit(3), "broken: SystemExit: 3$"),
        # So do panics of libraries in Rust.
        (BaseException("panicked"), "broken: BaseException: panicked$"),
        (SilentError(), "broken: SilentError: SilentError$"),
        (RuntimeError("long " * 10**6), "^.{1000,3000}$"),
    ],
)
def test_a_function_that_raises_is_named(tmp_path: Path, error: BaseException, reason: str) -> None:
    def broken(mesh: sb.Mesh) -> sb.Mesh:
        raise error

    with pytest.raises(sb.errors.MeshError, match=reason):
        made({**HALVED, "function": broken}, tmp_path)[0].load()


@pytest.mark.process
def test_a_study_of_remeshers_keeps_what_fails_apart(tmp_path: Path) -> None:
    ball = {"source": "icosphere", "levels": [2]}
    run_in_shell = {"source": "command", "mesh": ball, "command": ["sh", "-c", "{line} # {output}", "{folder}"]}
    table = small_table(
        reference=ball,
        family=[
            {**COUNTED, "name": "copy", "mesh": ball, "log": str(tmp_path / "log")},
            {"name": "bad", **run_in_shell, "line": ["exit 3", "kill -9 $$", "sleep 100"], "timeout": 0.3},
            {"name": "half", "source": halved, "mesh": ball, "size": [0.5, 1.0]},
        ],
    )
    study = sb.Study.from_table(table)
    store = tmp_path / "small.zarr"
    with pytest.raises(sb.errors.StudyError, match=rf"the study runs commands: .*{Path.cwd()}.*--allow-commands"):
        sb.run(study, store)
    assert not store.exists()
    summary = sb.run(study, store, workers=1, allow_commands=True)
    assert set(summary.failed) == {"bad/exit 3", "bad/kill -9 $$", "bad/sleep 100"}
    tree = sb.open_store(store)
    distances = tree["convergence"]["distance"].sel(order=-3.0)
    assert distances.sel(mesh="copy/2") == distances.sel(mesh="half/1") == 0 != distances.sel(mesh="half/0.5")
    assert float(distances["exit_status"].sel(mesh="bad/exit 3")) == 3
    assert distances["make_seconds"].sel(mesh=["copy/2", "half/0.5"]).notnull().all()
    assert float(distances["size"].sel(mesh="half/0.5")) == 0.5
    (league,) = sb.league(store, -3.0, by="cost")
    assert (
        league.meshes["make_seconds"].tolist()
        == sb.table(store, -3.0).dropna(subset="distance")["make_seconds"].tolist()
    )
    assert "front of the means" in call("table", "league", store, "--by", "cost", "--x", "make_cpu_seconds").stdout
    # What is stored names the function, whose meshes are found without it.
    assert json.dumps(json.loads(tree.attrs["study"])["table"]["family"][2]["function"]).endswith('halved"')
    from sobolev_batch.extras.figures.remade import StudyMeshes

    meshes = StudyMeshes.from_tree(tree, ".")
    assert meshes.make("half/0.5")[0].area == pytest.approx(sb.shapes.icosphere(2).area / 4)
    assert isinstance(meshes.members["copy/2"][1], RemeshedMember)
    # A second study beside it finds what was made.
    sb.run(study, tmp_path / "again.zarr", workers=1, allow_commands=True)
    assert len((tmp_path / "log").read_text()) == 1


@pytest.mark.extras
def test_methods_without_a_size_in_common_have_a_plot_by_cost(tmp_path: Path) -> None:
    half = {"name": "half", "source": halved, "mesh": {"source": "icosphere", "levels": [2]}, "size": [0.5, 1.0]}
    coarse = {"name": "coarse", "source": "icosphere", "levels": [0]}
    table = small_table(object=balls(a=1.0, b=1.1), family=[half, coarse])
    place = "memory://by-cost.zarr"
    sb.run(sb.Study.from_table(table), place)
    call("plot", place, "--output", tmp_path / "half", "--family", "half")
    assert {path.name for path in (tmp_path / "half").iterdir()} == {"league.png", "league-by-cost.png"}
    done = call("plot", place, "--output", tmp_path)
    assert done.stdout == f"{tmp_path / 'league-by-cost.png'}\n"
    assert "no common range of sizes" in done.stderr
    assert "compare them by cost (table league --by cost" in done.stderr
    assert call("plot", place, "--output", tmp_path, "--x", "triangles").returncode == 2
    by_cost = call("table", "league", place, "--by", "cost").stdout
    assert "coarse is left out: no mesh has a distance and make_seconds." in by_cost
