"""Study files: what is accepted, and that every error names its place in one line."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel

from sobolev_batch import Lattice, OrderError, Similarity, Study
from sobolev_batch.batch.study.schema import StudyDocument, models_in
from sobolev_batch.surfaces.sources.files import FileSource
from sobolev_batch.surfaces.sources.registry import Source, source_type_of
from tests.support.members import KINDS
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

[compare]
pairs = "all"
[transform]
eps = 1e-6
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
    # With the byte order mark of some editors.
    path.write_text(FULL, encoding="utf-8-sig")
    study = Study.from_toml(path)
    assert (study.name, study.title) == ("two words", "A title")
    assert study.lattice == Lattice(4.0, 32)
    assert study.orders == (-2.0, -3.5)
    assert study.pairs == "all"
    assert (study.transform.eps, study.transform.dtype) == (1e-6, "complex64")
    assert study.transform.quadrature == 5
    assert study.scaling == Similarity(0.5)
    assert [family.name for family in study.families] == ["ico", "thin"]
    assert study.folder == tmp_path


def keys_of(model: type[BaseModel]) -> set[str]:
    """Of a section and those below it."""
    below = (part for field in model.model_fields.values() for part in models_in(field.annotation))
    return set(model.model_fields).union(*(keys_of(part) for part in below if not issubclass(part, Source)))


def test_the_reference_of_study_files_names_every_key_and_source() -> None:
    text = (WORKFLOWS.parent / "docs" / "studies.md").read_text(encoding="utf-8")
    keys = keys_of(StudyDocument)
    assert {"rtol", "backend", "origin", "member"} < keys
    rows = {row[0]: row[1] for row in re.findall(r"^\| `([\w-]+)` \|(.*)$", text, re.MULTILINE)}
    for key in keys:
        assert re.search(rf"[`\[]{key}[`\]]", text), key
    for name in {str(table["source"]) for table in KINDS.values()}:
        for key in source_type_of(name).model_fields:
            assert f"`{key}`" in rows[name], (name, key)


def test_its_example_and_the_workflows_are_valid(tmp_path: Path) -> None:
    study, lattice, named, listed, besides = blocks("docs/studies.md", "toml")
    rest = 'study.name = "x"\nlattice = { xi_max = 3.0, M = 16 }\nnorm.orders = [-2.0]\n'
    (tmp_path / "study.toml").write_text(rest + named)
    reference = Study.from_toml(tmp_path / "study.toml").reference
    assert isinstance(reference, FileSource)
    assert reference.paths == ("bunny.ply",)
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
    for name in ("icosphere", "cortex", "torus"):
        assert Study.from_toml(WORKFLOWS / f"{name}.toml").name == name


def test_python_may_give_arrays_and_paths() -> None:
    table = small_table()
    table["norm"]["orders"] = np.array([-3.0, -2.0])
    table["lattice"] = {"xi_max": np.float32(3.0), "M": np.int64(16)}
    table["family"].append({"name": "f", "source": "files", "paths": (Path("a.ply"),)})
    study = Study.from_table(table)
    assert (study.orders, study.lattice) == ((-3.0, -2.0), Lattice(3.0, 16))
    assert study.table["norm"]["orders"] == [-3.0, -2.0]
    assert study.table["family"][1]["paths"] == ["a.ply"]


def test_the_constructor_refuses_orders_without_a_norm() -> None:
    with pytest.raises(OrderError, match="below -1/2"):
        replace(Study.from_table(small_table()), orders=(-0.5,))


@pytest.mark.parametrize("name", ["a", "two words", "Größe", "日本", "..a", "-", "a" * 100, "😀", "5%"])
def test_names_may_be_of_any_script(name: str) -> None:
    study = Study.from_table({**changed("family.0.name", name), "study": {"name": name}})
    assert (study.name, study.families[0].name) == (name, name)


@pytest.mark.parametrize("memory", ["4GB", 4_000_000_000, 4e9])
def test_memory_is_a_size(memory: str | float) -> None:
    study = Study.from_table(small_table(accuracy={"rtol": 0.1, "memory": memory}, lattice=None))
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
