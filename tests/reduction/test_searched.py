"""Families of meshes within tolerances: what a study stores holds, and a search goes on wherever it was ended."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import tomli_w
from distributed import Client

import sobolev_batch as sb
from sobolev_batch import compiled
from sobolev_batch.geometry import closest, proximity
from sobolev_batch.reduction import limit as limits
from sobolev_batch.reduction import searched
from sobolev_batch.reduction.limit import Limit
from sobolev_batch.sources.mesh_cache import MeshCache
from sobolev_batch.sources.registry import Member, load_mesh
from sobolev_batch.store.location import Location
from sobolev_batch.store.workspace import Workspace
from sobolev_batch.study.plan import Plan
from sobolev_batch.tables.convergence import format_table
from tests.batch.test_reduce import EndedError, disc, farthest, found_by, lumpy
from tests.support.commands import call, output
from tests.support.processes import with_certificates

DECIMATED: dict[str, Any] = {"name": "decimated", "source": "decimate", "within": "1 mm"}
# A remesher of Python alone, which makes discs of this many edges.
RINGS = """
import math, sys
count = max(3, round(2 * math.pi / float(sys.argv[2])))
angles = [2 * math.pi * k / count for k in range(count)]
with open(sys.argv[1], "w") as file:
    print(f"OFF\\n{count + 1} {count} 0\\n0 0 0", file=file)
    for angle in angles:
        print(math.cos(angle), math.sin(angle), 0.0, file=file)
    for k in range(count):
        print(3, 0, 1 + k, 1 + (k + 1) % count, file=file)
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with two scans, in centimetres."""
    (tmp_path / "scans").mkdir()
    sb.write_mesh(lumpy(2), tmp_path / "scans" / "a.ply")
    sb.write_mesh(lumpy(2, 2.0), tmp_path / "scans" / "b.ply")
    return tmp_path


def table(*families: dict[str, Any], name: str = "{object}", **sections: Any) -> dict[str, Any]:
    """A study of all scans, or of the one of a name."""
    return {
        "study": {"name": "scans", "length_unit": "cm"},
        "lattice": {"xi_max": 3.0, "M": 16},
        "norm": {"orders": [-4.0]},
        "reference": {"source": "files", "paths": [f"scans/{name}.ply"]},
        "family": list(families),
        **sections,
    }


def member(folder: Path, family: dict[str, Any], *, may_run: bool = True, **sections: Any) -> Member:
    """The first mesh of a family of the study of one scan."""
    study = sb.Study.from_table(table(family, name="a", **sections), folder=folder)
    cache = MeshCache(Location(str(folder / "made-meshes")), may_run)
    return next(iter(study.with_cache(cache).object.members.values()))[1]


def test_meshes_of_two_objects_hold_and_are_those_of_reduce(client: Client, folder: Path) -> None:
    # The largest deviation of the second one is 0.3 % below it.
    within = ["1 mm", 0.0627]
    proximity = {"metrics": ["hausdorff"], "points": 100}
    described = table({**DECIMATED, "within": within}, proximity=proximity)
    study = sb.Study.from_table(described, folder=folder)
    assert list(study.objects["a"].members) == ["decimated/1mm", "decimated/0.0627", "reference"]
    store = folder / "scans.zarr"
    sb.plan(study, store)
    assert not (folder / "made-meshes").exists()
    said: list[str] = []
    assert not sb.run(study, store, client=client, on_progress=lambda step: said.append(str(step))).failed
    assert "searching meshes of decimated: each takes several trials, unless it is kept from before" in said[:2]
    rows = sb.table(store).set_index(["object", "mesh"])
    for name in ("a", "b"):
        original = sb.read_mesh(folder / "scans" / f"{name}.ply")
        for tolerance, label in zip((0.1, 0.0627), study.objects[name].members, strict=False):
            row = rows.loc[name, label]
            found = found_by(folder / "scans" / f"{name}.ply", within=tolerance)
            assert found.bracket.best is not None
            assert row["triangles"] == found.bracket.best.triangles < 320
            assert row["target_tolerance"] == pytest.approx(tolerance)
            assert row["make_seconds"] > 0
            assert row["hausdorff"] <= row["hausdorff_upper"] <= tolerance
            cache = MeshCache(Location(str(folder / "made-meshes")))
            kept = load_mesh(study.with_cache(cache).objects[name].members[label][1])
            assert found.mesh is None or kept.digest == found.mesh.digest
            assert farthest(kept, original) <= tolerance
    before = {path.name: path.stat().st_mtime_ns for path in (folder / "made-meshes").iterdir()}
    again = sb.run(sb.Study.from_table(described, folder=folder), store, client=client)
    assert again.computed == ()
    assert {path.name: path.stat().st_mtime_ns for path in (folder / "made-meshes").iterdir()} == before


def test_a_run_prints_the_fewest_triangles_first(client: Client, folder: Path) -> None:
    scans = {"source": "files", "paths": [str(folder / "scans" / "{object}.ply")]}
    (folder / "study.toml").write_text(tomli_w.dumps(table(DECIMATED, reference=scans)))
    assert client.scheduler is not None
    with with_certificates(client):
        shown = output("run", "study.toml", "--scheduler", client.scheduler.address, folder=folder)
    means = sb.table(folder / "storage" / "scans.zarr").query("triangles < 320")["triangles"]
    assert shown.startswith("League by triangles, over 2 objects")
    assert f"{np.exp(np.log(means).mean()):.3g}" in shown.splitlines()[4].replace(",", "")


@pytest.mark.parametrize("allow_commands", [False, True])
def test_a_plan_takes_the_mesh_of_a_first_trial_for_that_of_a_search(
    allow_commands: bool, folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delattr(searched, "tried")
    described = table({**DECIMATED, "within": ["1 mm", "2 mm"]}, accuracy={"rtol": 0.1})
    del described["lattice"]
    study = sb.Study.from_table(described, folder=folder)
    found = sb.plan(study, folder / "scans.zarr", allow_commands=allow_commands)
    assert [*found.objects] == ["a", "b"]
    for one in found.objects.values():
        assert one.unknown == ("decimated/1mm", "decimated/2mm")
        assert not one.doubtful
    assert not caplog.records
    assert not (folder / "made-meshes").exists()


@pytest.mark.parametrize("within", ["0.5 mm", "5 %"])
def test_a_trial_does_not_depend_on_what_the_process_did_before(within: str, folder: Path) -> None:
    search, found = member(folder, DECIMATED | {"within": within}).search, []  # type: ignore[attr-defined]
    for seconds in (0.0, math.inf):
        with compiled.by_itself(loops=False):
            compiled.pays(seconds)
            trial, _ = limits.tried(*search.trial(search.begun(), 200.0))
        found.append(replace(trial, seconds=0.0))
    assert found[0] == found[1]


def test_a_search_goes_on_where_it_was_ended(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[float] = []

    def counted(reference: Any, one: Any, limit: Any, size: float) -> Any:
        if len(tried) == ended:
            raise EndedError
        tried.append(size)
        return limits.tried(reference, one, limit, size)

    monkeypatch.setattr(searched, "tried", counted)
    # None at first.
    ended = -1
    whole = load_mesh(member(folder, DECIMATED))
    sizes = list(tried)
    assert len(sizes) > 2
    assert load_mesh(member(folder, DECIMATED)).digest == whole.digest
    assert tried == sizes
    with pytest.raises(sb.errors.MeshError, match=r"no search may run here"):
        load_mesh(member(folder, {**DECIMATED, "within": "2 mm"}, may_run=False))
    assert load_mesh(member(folder, DECIMATED, may_run=False)).digest == whole.digest
    for ended in range(1, len(sizes)):
        tried.clear()
        for path in (folder / "made-meshes").iterdir():
            path.unlink()
        with pytest.raises(EndedError):
            load_mesh(member(folder, DECIMATED))
        ended = -1
        assert load_mesh(member(folder, DECIMATED)).digest == whole.digest
        # No size is tried twice.
        assert tried == sizes
    # The mesh alone is made again, from its last size.
    (kept,) = (folder / "made-meshes").glob("*.ply")
    kept.write_bytes(b"")
    tried.clear()
    assert load_mesh(member(folder, DECIMATED)).digest == whole.digest
    assert len(tried) == 1


def test_another_mesh_is_judged_against_the_reference(folder: Path) -> None:
    start, scan = {"source": "files", "paths": ["moved.ply"]}, sb.read_mesh(folder / "scans/a.ply")
    sb.write_mesh(sb.Mesh(np.add(scan.vertices, [0.03, 0.0, 0.0]), scan.triangles), folder / "moved.ply")
    moved = load_mesh(member(folder, {**DECIMATED, "mesh": start}))
    assert farthest(moved, lumpy(2)) <= 0.1
    assert len(load_mesh(member(folder, DECIMATED)).triangles) < len(moved.triangles) < 320
    # Already the mesh to start from is too far away.
    sb.write_mesh(sb.Mesh(np.add(scan.vertices, [0.2, 0.0, 0.0]), scan.triangles), folder / "moved.ply")
    with pytest.raises(
        sb.errors.MeshError, match=r"tolerance of 0\.1; nearest are \d+ triangles of the original itself, at least 0"
    ):
        member(folder, {**DECIMATED, "mesh": start}).load()


def test_a_remesher_that_makes_the_same_of_each_size_is_told(threads: Client, folder: Path) -> None:
    def same(mesh: sb.Mesh, triangles: int) -> sb.Mesh:
        return lumpy(1)

    family = {"name": "same", "source": same, "version": "1"}
    described = table({**family, "within": 0.5}, {**family, "name": "close", "within": 0.001}, DECIMATED, name="a")
    described["family"][1]["search"] = {"triangles": [20, 300]}
    store = folder / "scans.zarr"
    summary = sb.run(sb.Study.from_table(described, folder=folder), store, client=threads)
    told = [line for line in format_table(store).split("\n") if "sizes do not follow triangles" in line]
    assert sorted(line.split()[0] for line in told) == ["close/0.001", "same/0.5:"]
    assert "sizes do not follow triangles" in summary.failed["close/0.001"]
    rows = sb.table(store).set_index("mesh")[["reason", "remark"]]
    assert (rows != "").loc[["close/0.001", "same/0.5"]].values.tolist() == [[True, False], [False, True]]


def test_searches_differ_by_their_measure(folder: Path) -> None:
    def digest(**keys: Any) -> str:
        one = member(folder, {**DECIMATED, **keys})
        assert isinstance(one, searched.SearchedMember)
        return one.search.digest

    assert digest() == digest(measure="hausdorff")
    measures = ("hausdorff", "hausdorff_forward", "rms", "mean", "p95")
    assert len({digest(measure=measure) for measure in measures}) == len(measures)


def test_a_fraction_is_that_of_the_first_order(folder: Path) -> None:
    own = {**DECIMATED, "within": ["10 %"]}
    one, other = member(folder, own), member(folder, {**own, "order": -8})
    assert one.metadata == (("target_tolerance", 0.1), ("target_measure", "relative"))
    assert sb.testing.same_surface(load_mesh(one), lumpy(2), tolerance=0.1, order=-4.0).outcome == "same"
    assert len(load_mesh(other).triangles) < len(load_mesh(one).triangles) < 320


def test_the_measure_of_a_family_is_in_the_tables(client: Client, folder: Path) -> None:
    families = [
        {**DECIMATED, "name": measure, "within": within, "measure": measure}
        for measure, within in (("rms", "0.5 mm"), ("mean", "0.5 mm"), ("area", "2 %"), ("relative", 0.1))
    ]
    study = sb.Study.from_table(table(*families, name="a", proximity={"metrics": ["rms", "mean"]}), folder=folder)
    assert not sb.run(study, folder / "scans.zarr", client=client).failed
    rows = sb.table(folder / "scans.zarr").set_index("family")
    assert rows["target_measure"].to_dict() == {name: name for name in ("rms", "mean", "area", "relative")}
    # What the table says of them is what the searches have compared.
    for name in ("rms", "mean"):
        found = found_by(folder / "scans" / "a.ply", within=0.05, measure=name)
        assert found.bracket.best is not None
        assert rows.loc[name, "triangles"] == found.bracket.best.triangles < 320
        upper = rows.loc[name, name] + 2.5763 * rows.loc[name, f"{name}_error"]
        assert upper == pytest.approx(found.bracket.best.upper, rel=0.01)
        assert upper <= 0.05
    assert rows.loc["mean", "triangles"] < rows.loc["rms", "triangles"]
    same = load_mesh(member(folder, {**DECIMATED, "within": "10 %"}))
    assert rows.loc["relative", "triangles"] == len(same.triangles)


@pytest.mark.process
def test_a_command_is_searched_where_it_may_run(folder: Path) -> None:
    (folder / "rings.py").write_text(RINGS)
    sb.write_mesh(disc(lumpy(1), 2 * np.pi / 500), folder / "scans" / "a.ply")
    rings = {
        "name": "rings",
        "source": "command",
        "command": ["python", "{folder}/rings.py", "{output}", "{edge}"],
        "output": ".off",
        "within": "0.3 mm",
        "search": {"edge": [0.05, 1.5]},
    }
    study = table(rings, name="a", scaling={"mode": "none"})
    (folder / "study.toml").write_text(tomli_w.dumps(study))
    words = "run", str(folder / "study.toml"), "--store", str(folder / "scans.zarr"), "--workers", "1"
    refused = call(*words)
    assert (refused.returncode, "--allow-commands" in refused.stderr) == (2, True)
    done = call(*words, "--allow-commands")
    assert done.returncode == 0, done.stderr
    # 1 - cos(π/n) is at most 0.03 from n = 13 on.
    assert sb.table(folder / "scans.zarr")["triangles"].tolist() == [13]
    # Of the meshes of trials, only that one is kept.
    assert len(list((folder / "made-meshes").glob("*.ply"))) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"within": []}, "within must have at least 1 item"),
        ({"within": "1 furlong"}, "furlong"),
        ({"within": -1.0}, "a length is a positive number"),
        ({"within": "110 %"}, "below 1"),
        ({"within": ["1 %", "2 mm", "1%"]}, "'1 %' and '1%' are equal; remove one"),
        (
            {"within": "1 mm", "order": -2.0},
            "a fraction of the norm below 1, such as 1%, found '1 mm'; a length has no order",
        ),
        ({"measure": "rmse"}, "no measure is named 'rmse'; did you mean rms?"),
        ({"measure": "x"}, "no measure is named 'x'; known are relative, hausdorff"),
        ({"measure": "rms", "order": -2.0}, "rms has no order"),
        ({"measure": "rms", "within": "1 %"}, "rms is a length, found '1 %'"),
        ({"triangles": [100]}, "triangles is searched"),
        ({"search": {"levels": [1, 2]}}, "levels"),
        ({"search": {"triangles": [9, 4]}}, "the smaller one first"),
        ({"search": {"triangles": [-4, 100]}}, "between -4 and 100: each must be greater than or equal to 4"),
        ({"search": {"a": [1, 2], "b": [1, 2]}}, "one parameter is searched"),
        ({"search": {"triangles": [4]}}, "search"),
        ({"source": "command", "command": ["x", "{input}", "{output}"]}, "triangles"),
        ({"source": "command", "command": ["x", "{output}", "{h}"], "search": {"g": [0.1, 1.0]}}, "{h}"),
        ({"radios": 1.0}, "radios"),
        ({"mesh": "nobody"}, "no mesh is named 'nobody'"),
        ({"within": None, "triangles": [9], "search": {"triangles": [4, 9]}}, "within is missing"),
    ],
)
def test_wrong_families_are_refused(change: dict[str, Any], message: str, folder: Path) -> None:
    family = {key: value for key, value in {**DECIMATED, **change}.items() if value is not None}
    with pytest.raises(sb.errors.StudyError, match=rf"decimated.*{message}"):
        sb.Study.from_table(table(family, name="a"), folder=folder)


def test_lengths_need_a_unit_and_a_reference_of_its_own(folder: Path) -> None:
    study = table(DECIMATED, name="a")
    with pytest.raises(sb.errors.StudyError, match="length_unit"):
        sb.Study.from_table({**study, "study": {"name": "scans"}}, folder=folder)
    family = sb.Study.from_table({**study, "reference": {"source": "family", "family": "decimated"}}, folder=folder)
    with pytest.raises(sb.errors.StudyError, match=r"decimated.*a source of its own"):
        _ = family.object.members


@pytest.mark.process
def test_objects_planned_at_once_have_the_new_version_of_a_program(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = {"source": "command", "command": ["cp", "{input}", "{output}", "{n}"], "version": ["cat", "{folder}/V"]}
    swept = {"name": "swept", **command, "n": 4, "mesh": {"source": "files", "paths": ["scans/a.ply"]}}
    searching = {"name": "searched", **command, "within": "1 mm", "search": {"n": [4, 8]}}

    def study(name: str) -> sb.Study:
        made = sb.Study.from_table(table(swept, searching, name=name), folder=folder)
        return made.with_cache(MeshCache(Location(str(folder / "made-meshes")), may_run=True))

    def digests(one: sb.Study) -> dict[str, str]:
        return {label: member.fingerprint_digest() for label, (_, member) in one.object.members.items()}

    (folder / "V").write_text("1")
    first = digests(study("a"))
    (folder / "V").write_text("2")
    prepared = Workspace.prepared

    def meanwhile(location: Location, plan: Plan) -> Workspace:
        # One worker has planned by what the last run knew when another one asks for the version.
        assert {row.label: row.fingerprint for row in plan.rows} == first
        monkeypatch.setattr(Workspace, "prepared", prepared)
        Workspace.of_study(study("b"), Location(str(folder / "b.zarr")))
        return prepared(location, plan)

    monkeypatch.setattr(Workspace, "prepared", meanwhile)
    rows = Workspace.of_study(study("a"), Location(str(folder / "a.zarr"))).plan.rows
    assert {row.label: row.fingerprint for row in rows} == digests(study("a"))
    # Tasks find what was planned.
    assert [row.member.fingerprint_digest() for row in rows] == [row.fingerprint for row in rows]
    assert sum(row.fingerprint != first[row.label] for row in rows) == 2


def test_only_a_bias_asks_for_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    sides = Mock(side_effect=closest.signs)
    monkeypatch.setattr(proximity, "signs", sides)
    meshes = lumpy(1), lumpy(2)
    rms = Limit(0.1, "rms").bounds(*meshes)
    assert not sides.called
    bias = Limit(0.1, "bias").bounds(*meshes)
    assert sides.called
    assert 0 < bias[2] < rms[2] < math.inf
