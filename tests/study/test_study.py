"""Study files: what is accepted, and what is refused, with the key, what was found and what is allowed."""

from __future__ import annotations

import os
import re
import sys
import time
import tomllib
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel

import sobolev_batch as sb
from sobolev_batch import Lattice, Study
from sobolev_batch.errors import OrderError
from sobolev_batch.shapes import Similarity
from sobolev_batch.sources.files import FileSource
from sobolev_batch.sources.names import quoted
from sobolev_batch.sources.registry import Source, source_type_of
from sobolev_batch.study.plan import make_plan
from sobolev_batch.study.schema import StudyDocument, models_in
from tests.support.members import KINDS
from tests.support.repository import ROOT, blocks
from tests.support.studies import changed, small_table

FULL = """
study = { name = "two words", title = "A title" }
lattice = { xi_max = 4, M = 32 }
norm.orders = [-2, -3.5, -2]
compare.pairs = "all"
transform = { eps = 1e-6, dtype = "complex64", quadrature = 5 }
reference = { source = "family", family = "ico" }
scaling = { mode = "fixed", scale = 0.5 }
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
    assert (study.transform.eps, study.transform.dtype, study.transform.quadrature) == (1e-6, "complex64", 5)
    assert study.object.scaling == Similarity(0.5)
    assert [family.name for family in study.object.families] == ["ico", "thin"]
    assert study.object.folder == tmp_path


def keys_of(model: type[BaseModel]) -> dict[str, Any]:
    """Return the keys of a section and those below it, with their defaults."""
    keys = {name: field.default for name, field in model.model_fields.items()}
    for part in (part for field in model.model_fields.values() for part in models_in(field.annotation)):
        keys |= {} if issubclass(part, Source) else keys_of(part)
    return keys


@pytest.mark.extras
def test_the_reference_of_study_files_names_every_key_and_source_with_its_defaults() -> None:
    text = (ROOT / "docs" / "studies.md").read_text(encoding="utf-8")
    keys = keys_of(StudyDocument)
    assert {"rtol", "backend", "origin", "member"} < set(keys)
    rows = {row[0]: row[1] for row in re.findall(r"^\| `([\w-]+)` \|(.*)$", text, re.MULTILINE)}
    for key in keys:
        assert re.search(rf"[`\[]{key}[`\]]", text), key
    for name in {str(table["source"]) for table in KINDS.values()}:
        for key in source_type_of(name).model_fields:
            assert f"`{key}`" in rows[name], (name, key)
        for key, default in re.findall(r"`(\w+)` = (-?[\d.]+)", rows[name]):
            assert source_type_of(name).model_fields[key].default == float(default), (name, key)
    defaults = re.findall(r"^\| `(\w+)` \| `(.+?)` \|", text.partition("## Sources")[0], re.MULTILINE)
    assert len(defaults) > 8
    for key, default in defaults:
        value = keys[key]
        assert (list(value) if isinstance(value, tuple) else value) == tomllib.loads(f"x = {default}")["x"], key


@pytest.mark.extras
def test_its_example_and_the_workflows_are_valid(tmp_path: Path) -> None:
    study, lattice, listed = blocks("docs/studies.md", "toml")
    (tmp_path / "remeshed.csv").write_text(blocks("docs/studies.md", "csv")[0])

    def read(text: str) -> Study:
        (tmp_path / "study.toml").write_text(text)
        return Study.from_toml(tmp_path / "study.toml")

    reference = read(study).object.reference
    assert isinstance(reference, FileSource)
    assert reference.paths == ("original.ply",)
    assert read(study).title == "Scans of a statue, decimated"
    assert read(study.replace("[accuracy]\nrtol = 1e-3\n", lattice)).lattice == Lattice(5.0, 64)
    coarse, fine = read(f"{study}\n{listed}").object.families[1].source.members(tmp_path)
    assert (coarse.name, fine.name, dict(fine.metadata)["tool_seconds"]) == ("coarse", "fine", 12.1)
    for name in ("icosphere", "cortex", "cortex-fitted", "torus"):
        assert Study.from_toml(ROOT / "workflows" / f"{name}.toml").name == name


def test_python_may_give_arrays_paths_and_sizes() -> None:
    table = small_table()
    table["norm"]["orders"] = np.array([-3.0, -2.0])
    table["lattice"] = {"xi_max": np.float32(3.0), "M": np.int64(16)}
    table["family"].append({"name": "f", "source": "files", "paths": (Path("a.ply"),)})
    study = Study.from_table(table)
    assert (study.orders, study.lattice) == ((-3.0, -2.0), Lattice(3.0, 16))
    assert study.table["norm"]["orders"] == [-3.0, -2.0]
    assert study.table["family"][1]["paths"] == ["a.ply"]
    for memory in ("4GB", 4_000_000_000, 4e9):
        accuracy = Study.from_table(small_table(accuracy={"rtol": 0.1, "memory": memory}, lattice=None)).accuracy
        assert accuracy is not None
        assert accuracy.allowed_bytes == 4e9
    with pytest.raises(OrderError, match="below -1/2"):
        replace(study, orders=(-0.5,))


@pytest.mark.parametrize("name", ["a", "two words", "Größe", "日本", "..a", "-", "a" * 100, "😀", "5%"])
def test_names_may_be_of_any_script(name: str) -> None:
    study = Study.from_table({**changed("family.0.name", name), "study": {"name": name}})
    assert (study.name, study.object.families[0].name) == (name, name)


@pytest.mark.slow
def test_a_study_knows_what_its_sources_need() -> None:
    sphere = {"source": "icosphere", "levels": [3]}
    remeshed = {"source": "remesh", "mesh": sphere, "triangles": [100]}
    decimated = {"name": "a", "source": "decimate", "mesh": remeshed, "triangles": [50]}
    assert Study.from_table(small_table()).libraries == ()
    assert Study.from_table(small_table(family=[decimated])).libraries == ("pyacvd",)
    assert Study.from_table(small_table(reference=remeshed)).libraries == ("pyacvd",)


def refusal(table: Any) -> str:
    """What a study is refused with; one line, of a length that can be read."""
    with pytest.raises(sb.errors.StudyError) as caught:
        sb.Study.from_table(table)
    return orderly(str(caught.value))


def orderly(message: str) -> str:
    assert message.isprintable(), message
    assert len(message) < 2000
    # Words of the validator and names of the code are not those of studies.
    assert not re.search(r"pydantic|validat|dictionar|tuple|Input should|_\w*Section|_Header", message), message
    return message


FAMILY = "[[family]] 1 (named 'ico')"
DECIMATED = {"name": "d", "source": "decimate", "triangles": [9]}

# A sentence for each kind of problem.
SENTENCES = [
    ("norm.orders", -4.0, "[norm]: orders must be a list, found -4.0"),
    ("norm.orders", [-2.0, "-6"], "[norm]: entry 2 of orders must be a number, found '-6'"),
    ("compare.pairs", "refrence", "[compare]: pairs must be 'all' or 'reference', found 'refrence'"),
    ("norm.orders", [], "[norm]: orders must have at least 1 item, found []"),
    ("norm.order", [-2.0], "[norm]: order is unknown; did you mean orders?"),
    ("norm.width", 1, "[norm]: width is unknown; known are orders"),
    ("lattice", {"xi_max": 5.0}, "[lattice]: M is missing"),
    ("norm", [-2.0], "[norm] must be a table, found [-2.0]"),
    ("scaling.length_unit", "mm", "[scaling]: length_unit is unknown; known are mode, scale, origin"),
    ("units", "mm", "units is unknown; known are mesh, reference, family, scaling, study, lattice, accuracy, norm, "
     "compare, transform, proximity, object, objects"),
    ("accurracy", {}, "[accurracy] is unknown; did you mean accuracy?"),
    ("accuracy", {"rtol": 0.1}, "either a [lattice] or an [accuracy] is needed, and not both"),
    ("transform.quadrature", 1.5, "[transform]: quadrature must be text in quotes or a whole number, found 1.5"),
    ("family.0.levels", [13], f"{FAMILY}: entry 1 of levels must be less than or equal to 12, found 13"),
    ("reference", {"source": "family", "family": "icos"}, "[reference]: no family is named 'icos'; did you mean ico?"),
    ("family.0.name", "reference", "family: no family can be named 'reference': it is the label of the reference"),
]  # fmt: skip


# Key, value, and what the message holds: the place and what is allowed.
PLACES: list[tuple[str, Any, str]] = [
    ("study", "scans", "study must be a table"),
    ("study.name", "", r"\[study\]: name: 1 to 100 visible characters are needed.*it is empty"),
    ("study.name", "a/b", "without / and .*it holds '/', found 'a/b'"),
    ("lattice.M", 17, "M must be an even integer from 2 to 2048, found 17"),
    ("lattice.M", True, r"\[lattice\]: M must be a whole number, found true"),
    ("norm.orders", [-0.5], r"\[norm\]: .* orders below -1/2, found -0.5"),
    ("norm.orders", [-1.0 - k for k in range(101)], "orders: at most 100 entries are allowed, found 101"),
    ("transform.eps", 1e-20, "eps must lie between 1e-14 and 0.1"),
    ("scaling.scale", 2.0, "scale and origin belong to mode = 'fixed'"),
    ("reference", sb.shapes.Sphere(), "reference must be a table"),
    ("reference", {"source": "spere"}, r"\[reference\]: no source is named 'spere'; did you mean sphere"),
    ("reference", {"source": "sphere", "center": [0, 0]}, r"\[reference\]: entry 3 of center is missing"),
    ("reference", {"source": "torus", "R": 1.0, "r": 2.0}, r"\[reference\]: .*0 < r < R"),
    ("family", ["files"], r"\[\[family\]\] 1 must be a table"),
    ("family", [{**DECIMATED, "mesh": "a.ply"}], r"no mesh is named 'a.ply'; the study has no section \[mesh.NAME\]"),
    ("reference", "a b.ply", r'\[mesh.NAME\]; for a file, write \{ source = "files", paths = \["a b.ply"\] \}$'),
    ("family", [{**DECIMATED, "mesh": ["a.ply"]}], "mesh: must be a table that names a source"),
    ("mesh", {"a/b": {"source": "sphere"}}, r"^\[mesh.a/b\]: .*it holds '/'"),
    ("mesh", {"ball": {"source": "sphere", "radius": "x"}}, r"^\[mesh.ball\]: radius must be a number, found 'x'$"),
    ("mesh", {"ball": {**DECIMATED, "mesh": "bal"}}, r"^\[mesh.ball\]: no mesh is named 'bal'; did you mean ball\?"),
    ("mesh", {"a": {**DECIMATED, "mesh": "b"}, "b": {**DECIMATED, "mesh": "a"}}, "'a' is made from itself, or"),
    ("mesh", {"a": 3, "b": {"mesh": "a"}}, r"^\[mesh.a\] must be a table, found 3; \[mesh.b\] must be a table"),
    ("family", [{**DECIMATED, "mesh": {"source": "files", "path": []}}], r"named 'd'\): mesh.path is unknown; .*paths"),
    ("family", [{**DECIMATED, "mesh": {"paths": ["a.ply"]}}], "source is missing"),
    ("reference.radius", 1 << 2000, "reference.radius: an integer of TOML has 64 bits, found an integer of 2001 bits"),
    ("study.mesh", "ball", r"\[study\]: mesh is unknown; known are name, title"),
    ("family", [{"name": "d", "source": "decimate", "within": True}], "within must be a number or text.*, found true"),
    ("family", [{"name": "d", "source": "decimate", "within": float("inf")}], "within: .*found 'inf'"),
    ("family", [{"name": "f", "source": "flow", "mesh": DECIMATED, "times": [None]}], "finite number, found None"),
]  # fmt: skip


BALL = {"ball": {"source": "sphere"}}
# Several changes at once.
CHANGES: list[tuple[dict[str, Any], str]] = [
    ({"lattice": None, "accuracy": {"rtol": 2.0}}, r"\[accuracy\]: rtol must be a number between 0 and 1, found 2.0"),
    ({"lattice": None, "accuracy": {"rtol": 0.1, "memory": "much"}}, r"\[accuracy\]: memory must .*, found 'much'"),
    ({"lattice": None, "accuracy": {"rtol": 0.1}, "transform": {"eps": 1e-9}}, r"an \[accuracy\] chooses eps"),
    ({"lattice": None}, r"either a \[lattice\] or an \[accuracy\] is needed"),
    ({"mesh": BALL, "reference": {"mesh": "ball", "colour": 1}}, "unknown; known are radius, center, source$"),
    (
        {"reference": {"source": "sphere", "colour": 1, "glow": 2}},
        r"known are [\w, ]+; \[reference\]: glow is unknown$",
    ),
    ({"mesh": BALL, "reference": "bal"}, r"^reference: no mesh is named 'bal'; did you mean ball\?$"),
]
HIDDEN = ["a\nb", "a\x1b[31mb", "a\xa0b", "a\u202eb", "a\u200bb", "a\ud800b", " a"]
KEYS = ["a\nb", "x" * 10_000, "\u202ename", "", "a.b", " "]
REFUSED: list[tuple[Any, str]] = [
    *((changed(path, value), f"^{re.escape(text)}$") for path, value, text in SENTENCES),
    *((changed(path, value), part) for path, value, part in PLACES),
    *((small_table(**changes), part) for changes, part in CHANGES),
    *((changed(key, name), r"it holds the invisible character U\+|begins or ends with")
      for name in HIDDEN for key in ("study.name", "family.0.name", "study.title")),
    (changed("study.name", ".."), "a folder has this name in every other one"),
    *((changed("study", {"name": "a", key: 1}), " is unknown; ") for key in KEYS),
    *((table, "a study is a mapping of sections, such as .*, found ") for table in (None, "study.toml", ["study"], 3)),
]  # fmt: skip


@pytest.mark.parametrize(("table", "part"), REFUSED, ids=range(len(REFUSED)))
def test_a_refusal_names_the_key_what_was_found_and_what_is_allowed(table: Any, part: str) -> None:
    assert re.search(part, refusal(table))


def test_families_without_a_mesh_are_made_of_the_reference() -> None:
    ball = {"source": "icosphere", "levels": [2]}
    coarse = {"source": "decimate", "triangles": [100]}
    kinds: list[dict[str, Any]] = [
        {"source": "flow", "times": [0.1]},
        {"source": "command", "command": ["made", "{input}", "{output}"]},
        coarse,
    ]
    for kind in kinds:
        of_one, of_reference = ({"name": "f", **kind, **mesh} for mesh in ({"mesh": ball}, {}))
        named, unnamed = (
            Study.from_table(small_table(reference=ball, family=[one])).object.members for one in (of_one, of_reference)
        )
        assert {label: one.fingerprint() for label, (_, one) in named.items()} == {
            label: one.fingerprint() for label, (_, one) in unnamed.items()
        }
    made_of_nothing = Study.from_table(small_table(reference=coarse))
    with pytest.raises(sb.errors.StudyError, match="mesh is missing, and no reference can take its place; give one"):
        assert made_of_nothing.object.members


def test_all_problems_are_listed_at_once_up_to_ten() -> None:
    table = changed("lattice.M", "x")
    table["compare"]["pairs"], table["family"][0]["name"] = 3, ""
    del table["reference"]
    message = refusal(table)
    for part in ("[lattice]: M ", "[compare]: pairs ", "[reference] is missing", "[[family]] 1 (named ''): name"):
        assert part in message
    many = refusal(changed("norm.orders", ["x"] * 100))
    assert many.count("must be a number") == 10
    assert many.endswith("; and 90 more")


@pytest.mark.parametrize(("one", "other"), [("Ico", "ico"), ("STRASSE", "straße"), ("caf\u00e9", "cafe\u0301")])
def test_two_families_of_one_name_are_refused(one: str, other: str) -> None:
    table = small_table(family=[{"name": name, "source": "icosphere", "levels": [0]} for name in (one, other, "third")])
    message = refusal(table)
    assert message.startswith("family: names must differ by more than case and accents, found ")
    assert repr(one) in message
    assert "third" not in message


@pytest.mark.parametrize("name", ["os:system", "sobolev_batch.sources.files:FileSource", "../f", "x" * 9999])
def test_sources_are_looked_up_and_never_imported(name: str) -> None:
    loaded = set(sys.modules)
    assert f"{FAMILY}: no source is named " in refusal(changed("family.0.source", name))
    assert set(sys.modules) == loaded


def test_large_and_deep_tables_are_refused_before_they_take_memory() -> None:
    deep: Any = 1
    for _ in range(1000):
        deep = {"mesh": [deep]}
    tables = {
        "nested more than 20 deep": changed("family.0.mesh", deep),
        "it has 10000000 characters, 1000 are allowed": changed("study.title", "x" * 10**7),
        "levels: at most 1000 entries": changed("family.0.levels", [30] * 100_000),
        "keys must be strings": changed("study", {3: "x"}),
    }
    tracemalloc.start()
    try:
        for reason, table in tables.items():
            assert reason in refusal(table)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 48 << 20


FILES: dict[str, tuple[bytes, str]] = {
    "empty": (b"", r"\[study\] is missing"),
    "syntax": (b"[study]\nname = scans\n", r"not a TOML file: Invalid value \(at line 2, column 8\): 'name = scans'"),
    "twice": (b"[norm]\n[norm]\n", "not a TOML file: Cannot declare .*line 2"),
    "Latin-1": ('[study]\nname = "ü"\n'.encode("latin-1"), "not a TOML file: .*save it as UTF-8"),
    "deep": (b"a = " + b"[" * 100_000, "nested too deeply"),
    "deep key": (b"study" + b".a" * 60 + b" = 1", "nested more than 20 deep"),
    "many digits": (b"a = " + b"9" * 10_000, "not a TOML file"),
    "impossible date": (b"a = 2026-13-45", "not a TOML file"),
    "large": (b"# " + b"x" * (5 << 20), f"at most {4 << 20} bytes; globs"),
}


@pytest.mark.parametrize(("content", "reason"), FILES.values(), ids=FILES.keys())
def test_files_that_are_no_studies(tmp_path: Path, content: bytes, reason: str) -> None:
    path = tmp_path / "s.toml"
    path.write_bytes(content)
    start = time.process_time()
    with pytest.raises(sb.errors.StudyError, match=reason) as caught:
        sb.Study.from_toml(path)
    assert orderly(str(caught.value)).startswith(f"{path}: ")
    assert time.process_time() - start < 5


def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    reasons = {"pipe": "it is a pipe", "zero": "it is a pipe, a socket or a device", "": "it is a folder"}
    for name, reason in {**reasons, "no": "No such file", "a\0b": "(null byte|null character)"}.items():
        with pytest.raises(sb.errors.StudyError, match=f"cannot be read: .*{reason}"):
            sb.Study.from_toml(tmp_path / name)


def test_a_study_finds_its_files_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers, which plan its objects, may have been started elsewhere."""
    sb.write_mesh(sb.shapes.icosphere(1), tmp_path / "ball.ply")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    study = Study.from_table(small_table(family=[{"name": "one", "source": "files", "paths": ["*.ply"]}]))
    monkeypatch.chdir("elsewhere")
    assert "one/ball" in study.object.members


@pytest.mark.parametrize(
    "call",
    [
        sb.read_mesh,
        sb.Study.from_toml,
        sb.run,
        sb.open_store,
        sb.status,
        sb.table,
        lambda path: sb.write_mesh(sb.shapes.icosphere(0), path),
    ],
)
def test_what_is_no_path_is_refused_by_its_type(call: Callable[[Any], object]) -> None:
    with pytest.raises(sb.errors.InputError, match=r"^a path is a text or a pathlib.Path, found int$"):
        call(7)


def test_whoever_passes_the_table_of_a_study_is_told_what_makes_a_study_of_it() -> None:
    with pytest.raises(sb.errors.StudyError, match=r"Study\.from_table"):
        sb.run(small_table())  # type: ignore[arg-type]


_KEYS = "study lattice accuracy norm reference family name xi_max M rtol orders source levels mesh radius paths scale"
_WORDS = ["reference", "all", "auto", "files", "icosphere", "sphere", "decimate", "family", "ico", "none", "fixed", ""]
_scalars = st.integers(-2, 20) | st.just(1 << 64) | st.floats() | st.booleans() | st.sampled_from(_WORDS) | st.dates()
_keys = st.sampled_from(_KEYS.split()) | st.text(max_size=5)
_values = st.recursive(
    _scalars, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(_keys, inner, max_size=5), max_leaves=9
)
_fuzz = settings(derandomize=True, deadline=None, max_examples=40, suppress_health_check=[HealthCheck.too_slow])


@_fuzz
@given(path=st.sampled_from(["study", "lattice.M", "norm.orders", "reference", "family", "family.0.x"]), value=_values)
def test_damaged_studies_end_in_a_plan_or_a_study_error(path: str, value: Any) -> None:
    try:
        make_plan(sb.Study.from_table(changed(path, value)))
    except sb.errors.InputError as error:
        orderly(str(error))
    assert len(quoted(value)) <= 80
