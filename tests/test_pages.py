"""The pages run as printed, and do what they say: README, tutorial, queries, fitting, moving, formats, testing."""

from __future__ import annotations

import ast
import re
import runpy
import shlex
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.geometry.formats.by_name import mesh_format
from tests.support.commands import call
from tests.support.mesh_files import BOXES
from tests.support.repository import ROOT, blocks, run_blocks, run_icospheres
from tests.support.studies import balls, methods_of, small_table


@pytest.mark.all
def test_the_examples_of_the_readme_and_of_stores_run(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run_icospheres(tmp_path, client)
    monkeypatch.chdir(tmp_path)
    made = small_table(norm=None, compare=None, object=balls(small=0.9, ball=1.0), family=methods_of())
    sb.run(sb.Study.from_table(made), "storage/brain.zarr", client)
    found = run_blocks("README.md")
    assert re.search(r"array\(\[0\.[1-9]\d+", capsys.readouterr().out)
    assert len(found["meshes"]["relative"]) == 8
    found = run_blocks("docs/store.md")
    assert found["distance"] > 0


@pytest.mark.all
def test_the_tutorial_runs_and_is_right(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_icospheres(tmp_path, client)
    monkeypatch.chdir(tmp_path)
    (commands,) = blocks("docs/tutorial.md", "sh")
    for line in commands.splitlines():
        program, *arguments = shlex.split(line)
        assert program == "sobolev-batch"
        done = call(*arguments)
        assert done.returncode == 0, done.stderr
    assert {path.name for path in tmp_path.iterdir()} >= {"pictures", "report.html"}

    results = run_blocks("docs/tutorial.md")
    assert results["certain"] is True
    assert results["excess"] < 0

    # The description of stores has every group and every variable of a store.
    text = (ROOT / "docs" / "store.md").read_text(encoding="utf-8")
    for group in results["tree"].subtree:
        for name in (*group.data_vars, *group.coords, *group.attrs):
            assert f"`{name}`" in text, (group.path, name)


def test_the_table_of_weights() -> None:
    text = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (-\d+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$", text, re.MULTILINE)
    assert len(rows) == 4
    for order, *wavelengths in rows:
        for weight, wavelength in zip((1 / 2, 1 / 10, 1 / 100), map(float, wavelengths), strict=True):
            assert (1 + wavelength**-2) ** float(order) == pytest.approx(weight, rel=0.12)


@pytest.mark.parametrize(
    ("page", "families"),
    [
        ("docs/fitting.md", ["fitted"]),
        ("docs/remeshers.md", ["mmg"]),
    ],
)
def test_the_study_of_a_page_is_valid(page: str, families: list[str], tmp_path: Path) -> None:
    (text,) = blocks(page, "toml")
    (tmp_path / "study.toml").write_text(text)
    study = sb.Study.from_toml(tmp_path / "study.toml")
    assert [family.name for family in study.object.families] == families


def test_a_lattice_takes_the_place_of_the_accuracy() -> None:
    with_accuracy, lattice, *_ = blocks("docs/studies.md", "toml")
    on_lattice = re.sub(r"^\[accuracy\].*?\n\n", lattice + "\n", with_accuracy, flags=re.M | re.S)
    assert sb.Study.from_table(tomllib.loads(on_lattice)).lattice == sb.Lattice(5.0, 64)


def study_of_the_readme() -> dict[str, Any]:
    """The study that the README begins with, and the family that it appends."""
    study, family = map(tomllib.loads, blocks("README.md", "toml"))
    assert study == tomllib.loads((ROOT / "workflows/brain.toml").read_text(encoding="utf-8"))
    return {**study, "family": [*study["family"], *family["family"]]}


def test_the_study_of_the_readme_is_that_of_its_file() -> None:
    study = sb.Study.from_table(study_of_the_readme(), folder=ROOT / "workflows")
    assert len(study.objects) == 10
    for one in study.objects.values():
        assert [family.name for family in one.families] == ["decimated", "remeshed", "mine"]
        assert len(one.members) == 10


@pytest.mark.all
def test_the_study_of_the_readme_runs(client: Client, tmp_path: Path) -> None:
    table = study_of_the_readme()
    table["object"] = [one for one in table["object"] if one["name"].startswith(("infl", "sphere"))]
    for family in table["family"]:
        family["triangles"] = [500]
    study = sb.Study.from_table(table, folder=ROOT / "workflows")
    summary = sb.run(study, tmp_path / "brain.zarr", client, allow_commands=True)
    assert (len(summary.computed), summary.failed) == (4 * 4, {})


def test_the_studies_of_leagues_are_valid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("objects/cow.ply", "objects/statue.ply", "out/quick/cow_500.ply"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()
    by_names, one_object, meshes = blocks("docs/leagues.md", "toml")
    Path("meshes.csv").write_text(blocks("docs/leagues.md", "csv")[0])
    found = [
        sb.Study.from_table(tomllib.loads(text))
        for text in (by_names, by_names + one_object, by_names.partition("[reference]")[0] + meshes)
    ]
    assert [list(one.objects) for one in found] == [["cow", "statue"], ["cow"], ["cow"]]
    assert [[family.name for family in one.objects["cow"].families] for one in found] == [
        ["quick", "decimated"],
        ["quick", "decimated"],
        ["quick"],
    ]
    assert {name: one.lacking for name, one in found[0].objects.items() if one.lacking} == {"statue": ("quick",)}


@pytest.mark.slow
def test_the_page_about_remeshers_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # A file, since a study needs the source of its function.
    (tmp_path / "squeezed.py").write_text(blocks("docs/remeshers.md", "python")[0])
    runpy.run_path(str(tmp_path / "squeezed.py"))
    text = (ROOT / "docs" / "remeshers.md").read_text(encoding="utf-8")
    assert f"\n    {capsys.readouterr().out}" in text


def test_pictures_of_the_pages_are_described() -> None:
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "docs").glob("*.md")]
    descriptions = [description for text in texts for description in re.findall(r"!\[(.*?)\]\(", text)]
    assert len(descriptions) > 5
    assert min(map(len, descriptions)) > 20


def test_every_query_runs_and_answers(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = run_icospheres(tmp_path, client)
    monkeypatch.chdir(tmp_path)
    numbers = re.findall(r"^\*\*(\d+)\.", (ROOT / "docs" / "queries.md").read_text(encoding="utf-8"), re.M)
    assert numbers == [str(i + 1) for i in range(10)]
    answers = [block for block in blocks("docs/queries.md", "python")[1:] if "sb." not in block][: len(numbers)]
    # Each is one expression, or two, and none needs this package.
    assert [len(ast.parse(block).body) for block in answers] == [1, 1, 1, 1, 1, 2, 1, 1, 1, 1]
    found = run_blocks("docs/queries.md")

    levels = [f"icosphere/{level}" for level in range(4)]
    frame = sb.table("storage/icosphere.zarr", -10).set_index("mesh").loc[levels]
    assert found["fewest"].sel(family="icosphere") == frame["triangles"][frame["relative"] < 0.05].min() == 320
    assert found["best"] == levels[3]
    assert found["rates"].sel(family="icosphere") == pytest.approx(frame["rate"].median()) == pytest.approx(2, abs=0.05)
    assert found["winners"].values.tolist() == levels[3:] * len(study.orders)
    assert found["area_share"].values == pytest.approx((frame["area_part"] / frame["distance"]) ** 2)
    assert found["certain"].values == pytest.approx(frame["distance"].where(frame["resolved"]), nan_ok=True)
    assert set(found["limits"].values) <= {*found["convergence"]["part"].values}
    assert found["cost"].sel(family="icosphere") == frame["seconds"][frame["relative"] < 0.05].min()
    assert set(found["farthest"].item()) == {levels[0], "reference"}
    assert found["other_order"].sel(mesh=levels).values == pytest.approx(
        found["another"]["distance"].sel(mesh=levels, order=-3.5).values, rel=1e-12
    )
    of_order = sb.table("storage/icosphere.zarr", -4).set_index("mesh")["distance"]
    assert found["bands"].sum("radius_bins").sel(mesh=levels).values == pytest.approx(of_order[levels] ** 2, rel=1e-12)
    assert found["to_another"].index.tolist() == [levels[1], levels[2], levels[3]]
    expected = sb.distance(
        sb.shapes.icosphere(3), sb.shapes.Sphere(), [-3.5, -2.25], lattice=sb.Lattice.from_field(found["fields"])
    )
    assert found["another"]["distance"].sel(mesh=levels[3]).values == pytest.approx(
        expected["distance"].values, rel=1e-6
    )
    assert found["along_axis"].loc[0.0].real == pytest.approx(sb.shapes.icosphere(3).area, rel=1e-6)
    assert found["by_wavelength"].sum() == pytest.approx(1, rel=1e-10)
    # An inscribed mesh lacks area and lies inside: at its vertices, next to the sphere, the sphere has more.
    assert (found["w"].values < 0).all()
    assert len(pd.read_csv(tmp_path / "convergence.csv")) == 4 * len(study.orders)


@pytest.mark.all
def test_the_page_about_fits_runs_and_comes_nearer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert len(blocks("docs/fitting.md", "python")) == 4
    results = run_blocks("docs/fitting.md")
    fitted = results["fitted"]
    assert fitted.after.distance < fitted.before.distance / 4
    assert sb.read_mesh(tmp_path / "fitted.ply").area == pytest.approx(fitted.mesh.area)
    assert results["refined"].after.distance < fitted.after.distance
    value, _ = results["squared"](results["start"].vertices.ravel())
    assert results["found"].fun < value / 10
    head, rebuilt = results["head"], results["rebuilt"]
    assert rebuilt.after.distance < rebuilt.before.distance / 50
    # The ears are there: their tips are where no point of the ball was.
    tips = np.asarray(head.vertices)[np.linalg.norm(head.vertices, axis=1) > 0.95]
    assert np.linalg.norm(np.asarray(rebuilt.mesh.vertices)[:, None] - tips, axis=2).min(axis=0).max() < 0.12


@pytest.mark.all
def test_the_page_about_surfaces_that_move_runs(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    carried, files = blocks("docs/moving.md", "toml")
    study = tomllib.loads(carried)
    simulated = {**study, "family": [*study["family"], *tomllib.loads(files)["family"]]}
    monkeypatch.chdir(tmp_path)
    Path("frames").mkdir()
    Path("storage").mkdir()
    for number, radius in ((0, 1.0), (0.25, 1.1)):
        sb.write_mesh(
            sb.Mesh(radius * np.asarray(sb.shapes.icosphere(2).vertices), sb.shapes.icosphere(2).triangles),
            f"frames/t{number}.ply",
        )
    sb.run(sb.Study.from_table(simulated), "storage/study.zarr", client)
    results = run_blocks("docs/moving.md")
    assert results["found"]["family"].values.tolist() == ["level 3", "simulated"]
    assert results["found"]["remesh_time"].sel(family="simulated", order=-2.0).item() == 0.25


def test_the_workflow_of_a_flow_is_a_valid_study() -> None:
    study = sb.Study.from_toml(ROOT / "workflows/flow.toml")
    levels = [family.source.members(ROOT) for family in study.object.families]
    assert [len(members) for members in levels] == [14, 14, 14]


def test_the_page_about_formats_names_each_and_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    formats = {mesh_format(Path(f"scan{ending}")) for ending, _ in BOXES.values()}
    assert {f"`{name}`" for name in formats if name[0] == "."} <= set(re.findall(r"`\.\w+`", page))
    monkeypatch.chdir(tmp_path)
    results = run_blocks("docs/formats.md")
    assert sb.read_mesh("fitted.glb").area == pytest.approx(results["fitted"].area, rel=1e-6)


@pytest.mark.slow
def test_the_page_about_test_suites_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert len(blocks("docs/testing.md", "python")) == 3
    results = run_blocks("docs/testing.md")
    assert capsys.readouterr().out.startswith("same surface: relative distance 0.27 % ± 0.07 % at order -2")
    results["test_mesher"]((96, 48))
