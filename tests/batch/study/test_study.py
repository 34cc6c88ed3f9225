"""Study files: what is accepted, and that every error names its place in one line."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel

from sobolev_batch import Lattice, Study, StudyError
from sobolev_batch.batch.study.schema import FamilyReferenceSection, FamilySection, StudyDocument
from sobolev_batch.surfaces.sources.registry import Source, keys_by_source
from tests.support.repository import blocks
from tests.support.studies import changed, small_table

WORKFLOWS = Path(__file__).parents[3] / "workflows"

FULL = """
[study]
name = "two words"
title = "A title"
[lattice]
xi_max = 4
M = 32
[norm]
orders = [-2, -3.5, -2]
pairs = "reference"
[transform]
eps = 1e-7
dtype = "complex64"
quadrature = 5
[reference]
source = "family"
family = "ico"
[scaling]
mode = "fixed"
scale = 0.5
[[family]]
name = "ico"
source = "icosphere"
levels = [1, 2]
[[family]]
name = "thin"
source = "decimate"
mesh = { source = "icosphere", levels = [2] }
triangles = [100]
"""


def test_reads_every_key(tmp_path: Path) -> None:
    path = tmp_path / "study.toml"
    path.write_text(FULL.replace("1e-7", "1e-6"))
    study = Study.from_toml(path)
    assert (study.name, study.title) == ("two words", "A title")
    assert study.lattice == Lattice(4.0, 32)
    assert study.orders == (-2.0, -3.5)
    assert study.pairs == "reference"
    assert (study.transform.eps, study.transform.dtype) == (1e-6, "complex64")
    assert study.transform.quadrature.method == 5
    assert study.scaling.fixed.scale == 0.5
    assert [family.name for family in study.families] == ["ico", "thin"]
    assert study.folder == tmp_path


def keys_of(model: type[BaseModel]) -> set[str]:
    """Of a section and those below it."""
    found = set(model.model_fields)
    for field in model.model_fields.values():
        for part in (field.annotation, *get_args(field.annotation)):
            if inspect.isclass(part) and issubclass(part, BaseModel) and not issubclass(part, Source):
                found |= keys_of(part)
    return found


def test_the_reference_of_study_files_names_every_key_and_source() -> None:
    text = (WORKFLOWS.parent / "docs" / "studies.md").read_text(encoding="utf-8")
    keys = keys_of(StudyDocument) | keys_of(FamilyReferenceSection) | keys_of(FamilySection)
    assert {"rtol", "backend", "origin", "member"} < keys
    rows = {row[0]: row[1] for row in re.findall(r"^\| `([\w-]+)` \|(.*)$", text, re.MULTILINE)}
    for key in keys:
        assert re.search(rf"[`\[]{key}[`\]]", text), key
    sources = keys_by_source()
    assert "decimate" in sources
    for name, keys_of_source in sources.items():
        for key in keys_of_source:
            assert f"`{key}`" in rows[name], (name, key)


def test_its_example_is_valid(tmp_path: Path) -> None:
    study, lattice, listed, besides = blocks("docs/studies.md", "toml")
    (tmp_path / "study.toml").write_text(study)
    assert Study.from_toml(tmp_path / "study.toml").title == "Scans of a statue, decimated"
    (tmp_path / "study.toml").write_text(study.replace("[accuracy]\nrtol = 1e-3\n", lattice))
    assert Study.from_toml(tmp_path / "study.toml").lattice == Lattice(5.0, 64)
    (tmp_path / "study.toml").write_text(f"{study}\n{besides}")
    asked = Study.from_toml(tmp_path / "study.toml")
    assert asked.proximity == 20_000
    (tmp_path / "study.toml").write_text(f"{study}\n{listed}")
    (tmp_path / "remeshed.csv").write_text(blocks("docs/studies.md", "csv")[0])
    coarse, fine = Study.from_toml(tmp_path / "study.toml").families[1].source.members(tmp_path)
    assert (coarse.name, fine.name, dict(fine.metadata)["tool_seconds"]) == ("coarse", "fine", 12.1)


@pytest.mark.parametrize("name", ["icosphere", "cortex"])
def test_the_workflows_are_valid(name: str) -> None:
    assert Study.from_toml(WORKFLOWS / f"{name}.toml").name == name


BROKEN = [
    ("study.nam", "x", "[study]: unknown key nam: did you mean name?"),
    ("stdy", {}, "unknown section [stdy]: did you mean [study]?"),
    (
        "study.name",
        "",
        "[study]: name: a name is 1 to 100 visible characters, blanks only between them, without / and \\; it is",
    ),
    ("study.name", "a/b", "without / and \\; it holds '/', found 'a/b'"),
    ("study.name", "a\nb", "it holds the invisible character U+000A"),
    ("study.name", " a", "it begins or ends with a blank"),
    ("study.name", "x" * 10_000, "it has 10000 characters, 100 are allowed"),
    ("study.name", 3, '[study]: name must be text in quotes, such as name = "3", found 3'),
    ("lattice.M", 17, "M must be an even integer from 2 to 2048, found 17"),
    ("lattice.M", 16.0, "[lattice]: M must be a whole number, such as M = 16, found 16.0"),
    ("lattice.M", "16", "[lattice]: M must be a whole number, such as M = 16, found '16'"),
    ("lattice.M", True, "[lattice]: M must be a whole number, such as M = 64, found true"),
    ("lattice.xi_max", -1.0, "xi_max must be positive"),
    ("lattice.xi_max", float("nan"), "[lattice]: xi_max must be a finite number"),
    ("norm.orders", [-0.5], "orders below -1/2, found -0.5"),
    ("norm.orders", [-2.0, 1], "orders below -1/2, found 1"),
    ("norm.orders", [], "[norm]: orders must be a list with 1 or more entries"),
    ("norm.orders", -2.0, "[norm]: orders must be a list, such as orders = [-2.0], found -2.0"),
    ("norm.orders", ["-2"], "[norm]: entry 1 of orders must be a number, such as -2"),
    ("norm.pairs", "some", "[norm]: pairs must be 'all' or 'reference'"),
    ("transform.eps", 1e-20, "eps must lie between 1e-14 and 0.1"),
    ("transform.dtype", "float64", "[transform]: dtype must be 'complex128' or 'complex64'"),
    ("transform.quadrature", "gauss9", "quadrature must be"),
    ("scaling.scale", 2.0, "scale and origin belong to mode = 'fixed'"),
    ("scaling.mode", "fixed", "scale and origin belong to mode = 'fixed'"),
    ("reference", {}, '[reference]: source is missing; add it, such as source = "files"'),
    ("reference", {"source": "spere"}, "[reference]: no source is named 'spere'; known are decimate, ellipsoid, "),
    ("reference", {"source": "os.system"}, "[reference]: no source is named 'os.system'"),
    ("reference", {"source": "sphere", "radius": 0}, "[reference]: radius must be above 0"),
    ("reference", {"source": "sphere", "radius": "1"}, "[reference]: radius must be a number, such as radius = 1.0"),
    ("reference", {"source": "family", "family": "no"}, "[reference]: no family is named 'no'"),
    ("family", [], "at least one [[family]] is needed"),
    ("family", {}, "write [[family]], with two brackets on each side"),
    ("family.0.name", "reference", "no family can be named 'reference'"),
    ("family.0.name", "../up", "[[family]] 1 (named '../up'): name: a name is 1 to 100 visible characters"),
    ("family.0.levels", [0, 1.5], "[[family]] 1 (named 'ico'): entry 2 of levels must be a whole number"),
    ("family.0.levels", [13], "[[family]] 1 (named 'ico'): entry 1 of levels must be at most 12"),
    ("family.0.level", [1], "[[family]] 1 (named 'ico'): unknown key level: did you mean levels?"),
]


@pytest.mark.parametrize(("path", "value", "message"), BROKEN)
def test_broken_studies_name_the_place_on_one_line(path: str, value: Any, message: str) -> None:
    with pytest.raises(StudyError) as caught:
        Study.from_table(changed(path, value))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_family_names_that_differ_by_case_only_are_twins() -> None:
    twins = [{"name": name, "source": "icosphere", "levels": [0]} for name in ("Ico", "ico")]
    with pytest.raises(StudyError, match="'Ico', 'ico' twice"):
        Study.from_table(small_table(family=twins))


def test_all_offenders_are_listed() -> None:
    table = changed("lattice.M", "x")
    table["norm"]["pairs"] = 3
    del table["reference"]
    with pytest.raises(StudyError, match=r"\[lattice\]: M .*\[norm\]: pairs .*\[reference\] is missing"):
        Study.from_table(table)


@pytest.mark.parametrize("content", [b"[study", b"\xff\xfe", b"a = 1\na = 2\n"])
def test_files_that_are_not_toml(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    with pytest.raises(StudyError, match=r"bad\.toml: not a TOML file"):
        Study.from_toml(path)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r"no\.toml: cannot be read: No such file"):
        Study.from_toml(tmp_path / "no.toml")


def asking(**accuracy: Any) -> Study:
    table = small_table(accuracy=accuracy)
    del table["lattice"]
    return Study.from_table(table)


@pytest.mark.parametrize("memory", ["4GB", 4_000_000_000, 4e9])
def test_memory_is_a_size(memory: str | float) -> None:
    study = asking(rtol=0.1, memory=memory)
    assert study.accuracy is not None
    assert study.accuracy.allowed_bytes == 4e9


@pytest.mark.slow
def test_a_study_knows_what_its_sources_need() -> None:
    sphere = {"source": "icosphere", "levels": [3]}
    remeshed = {"source": "remesh", "mesh": sphere, "triangles": [100]}
    decimated = {"name": "a", "source": "decimate", "mesh": remeshed, "triangles": [50]}
    assert Study.from_table(small_table()).libraries == ()
    assert Study.from_table(small_table(family=[decimated])).libraries == ("pyacvd",)
    assert Study.from_table(small_table(reference=remeshed)).libraries == ("pyacvd",)
