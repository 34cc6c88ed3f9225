"""Every way to write a study wrong that we know: the place, what was found, and an example that then works."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

import sobolev_batch as sb
from sobolev_batch.batch.study.schema import StudyDocument
from sobolev_batch.batch.study.suggestions import example_of
from sobolev_batch.surfaces.sources.registry import keys_by_source, source_type_of
from tests.support.studies import changed, small_table

STUDY = """\
[study]
name = "scans"

[accuracy]
rtol = 1e-2

[norm]
orders = [-4.0, -2.0]

[reference]
source = "sphere"

[[family]]
name = "fine"
source = "icosphere"
levels = [2, 3]

[[family]]
name = "ico"
source = "icosphere"
levels = [0, 1]
"""
ORDERS, RTOL, NAME, LEVELS = "orders = [-4.0, -2.0]", "rtol = 1e-2", 'name = "scans"', "levels = [0, 1]"
SPHERE, LATTICE, BEFORE = 'source = "sphere"', "[accuracy]\nrtol = 1e-2", "[norm]"
ICO = 'source = "icosphere"\nlevels = [0, 1]'
FAMILY = "[[family]] 2 (named 'ico'): "
DOUBLE = "[[family]]"

# What is replaced in the study, by what, and what the message says about it.
WRONG: list[tuple[str, str, str]] = [
    # The wrong kind of value.
    (ORDERS, "orders = -4.0", "[norm]: orders must be a list, such as orders = [-4.0], found -4.0"),
    (ORDERS, 'orders = "-6"', "[norm]: orders must be a list, such as orders = [-6], found '-6'"),
    (ORDERS, "orders = true", "[norm]: orders must be a list, such as orders = [-4.0], found true"),
    (ORDERS, "orders = {a = 1}", "[norm]: orders must be a list, such as orders = [-4.0], found {'a': 1}"),
    (ORDERS, 'orders = [-2.0, "-6"]', "[norm]: entry 2 of orders must be a number, such as -6, found '-6'"),
    (ORDERS, "orders = [[-2.0]]", "[norm]: entry 1 of orders must be a number, such as -2.0, found [-2.0]"),
    (ORDERS, "orders = [2026-01-01]", "[norm]: entry 1 of orders must be a number, such as -4.0, found datetime"),
    (RTOL, 'rtol = "1e-3"', "[accuracy]: rtol must be a number, such as rtol = 0.001, found '1e-3'"),
    (RTOL, "rtol = true", "[accuracy]: rtol must be a number, such as rtol = 1e-2, found true"),
    (RTOL, "rtol = [1e-3]", "[accuracy]: rtol must be a number, such as rtol = 0.001, found [0.001]"),
    (RTOL, f'{RTOL}\nbest_effort = "True"', "best_effort must be true or false, such as best_effort = true, found 'Tr"),
    (RTOL, f"{RTOL}\nbest_effort = 1", "best_effort must be true or false, such as best_effort = true, found 1"),
    (NAME, "name = 3", "[study]: name must be text in quotes, such as name = \"3\", found 3"),
    (NAME, 'name = ["a"]', "[study]: name must be text in quotes, such as name = \"a\", found ['a']"),
    (NAME, f"{NAME}\ntitle = 2.5", "[study]: title must be text in quotes, such as title = \"2.5\", found 2.5"),
    (LATTICE, "[lattice]\nxi_max = 5\nM = 64.0", "[lattice]: M must be a whole number, such as M = 64, found 64.0"),
    (LATTICE, '[lattice]\nxi_max = "5"\nM = 64', "[lattice]: xi_max must be a number, such as xi_max = 5.0, found '5'"),
    (LEVELS, "levels = 3", f"{FAMILY}levels must be a list, such as levels = [3], found 3"),
    (LEVELS, "levels = [0, 1.5]", f"{FAMILY}entry 2 of levels must be a whole number, such as 0, found 1.5"),
    (LEVELS, "levels = [0.0, 2.0]", f"{FAMILY}entry 2 of levels must be a whole number, such as 2, found 2.0"),
    (SPHERE, f'{SPHERE}\nradius = "2"', "[reference]: radius must be a number, such as radius = 2, found '2'"),
    (SPHERE, f"{SPHERE}\ncenter = 1", "[reference]: center must be a list, such as center = [0.0, 0.0, 0.0], found 1"),
    (SPHERE, f"{SPHERE}\ncenter = [0, 0]", "center must be a list of 3 entries, such as center = [0.0, 0.0, 0.0]"),
    (SPHERE, f"{SPHERE}\ncenter = [0, 0, 0, 0]", "center must be a list of at most 3 entries, such as center = ["),
    (SPHERE, 'source = "family"\nfamily = "ico"\nmember = 1', "[reference]: member must be text in quotes, such as"),
    (BEFORE, "[proximity]\npoints = 1e4\n[norm]", "points must be a whole number, such as points = 10000, found 10000"),
    (BEFORE, "[transform]\nquadrature = 1.5\n[norm]", "quadrature must be text in quotes or a whole number, such as"),
    # Values out of range.
    (ORDERS, "orders = []", "[norm]: orders must be a list with 1 or more entries, such as orders = [-4.0], found []"),
    (ORDERS, "orders = [-2.0, -0.5]", "[norm]: orders: the norm of a surface is finite only for orders below -1/2, fo"),
    (ORDERS, "orders = [4.0]", "[norm]: orders: the norm of a surface is finite only for orders below -1/2, found 4"),
    (ORDERS, "orders = [nan]", "[norm]: entry 1 of orders must be a finite number, such as -4.0, found nan"),
    (ORDERS, "orders = [-inf]", "[norm]: entry 1 of orders must be a finite number, such as -4.0, found -inf"),
    (ORDERS, f'{ORDERS}\npairs = "refrence"', "[norm]: pairs must be 'all' or 'reference', such as pairs = \"referenc"),
    (RTOL, "rtol = 2.0", "[accuracy]: rtol must lie between 0 and 1, found 2.0"),
    (RTOL, "rtol = nan", "[accuracy]: rtol must be a finite number, such as rtol = 1e-2, found nan"),
    (RTOL, f'{RTOL}\nmemory = "lots"', "[accuracy]: memory: memory must be a positive number of bytes, or a size such"),
    (NAME, 'name = ""', "[study]: name: a name is 1 to 100 visible characters"),
    (LATTICE, "[lattice]\nxi_max = 5\nM = 63", "[lattice]: M must be an even integer from 2 to 2048, found 63"),
    (LATTICE, "[lattice]\nxi_max = -5\nM = 64", "[lattice]: xi_max must be positive and finite, found -5.0"),
    (LATTICE, "[lattice]\nxi_max = 5\nM = 64\noctaves = 30", "octaves must be at most 24, such as octaves = 4, found"),
    (LEVELS, "levels = []", f"{FAMILY}levels must be a list with 1 or more entries, such as levels = [0, 1, 2], foun"),
    (LEVELS, "levels = [13]", f"{FAMILY}entry 1 of levels must be at most 12, such as 0, found 13"),
    (LEVELS, "levels = [-1]", f"{FAMILY}entry 1 of levels must be 0 or more, such as 0, found -1"),
    (SPHERE, f"{SPHERE}\nradius = 0", "[reference]: radius must be above 0.0, such as radius = 1.0, found 0"),
    (SPHERE, 'source = "torus"\nR = 1\nr = 2', "[reference]: a torus needs finite radii with 0 < r < R, found R = 1.0"),
    (BEFORE, '[transform]\ndtype = "complex65"\n[norm]', "dtype must be 'complex128' or 'complex64', such as dtype = "),
    (BEFORE, "[proximity]\npoints = 1\n[norm]", "[proximity]: points must be 2 or more, such as points = 10000, fou"),
    # Keys that are unknown, missing, or elsewhere.
    (ORDERS, "order = [-4.0]", "[norm]: unknown key order: did you mean orders?"),
    (ORDERS, f"{ORDERS}\nrtol = 1e-3", "[norm]: unknown key rtol: it belongs in [accuracy]"),
    (ORDERS, f"{ORDERS}\nwidth = 1", "[norm]: unknown key width: [norm] has orders, pairs"),
    (ORDERS, "", "[norm]: orders is missing; add it, such as orders = [-4.0]"),
    (RTOL, "tolerance = 1e-2", "[accuracy]: unknown key tolerance: [accuracy] has rtol, memory"),
    (RTOL, "rtoll = 1e-2", "[accuracy]: unknown key rtoll: did you mean rtol?"),
    (RTOL, f"{RTOL}\nxi_max = 5.0", "[accuracy]: unknown key xi_max: it belongs in [lattice]"),
    (RTOL, f"{RTOL}\npairz = 1", "[accuracy]: unknown key pairz: did you mean pairs in [norm]?"),
    (LATTICE, "[lattice]\nxi_max = 5\nm = 64", "[lattice]: unknown key m: did you mean M?"),
    (LATTICE, "[lattice]\nxi_max = 5", "[lattice]: M is missing; add it, such as M = 64"),
    (NAME, "", "[study]: name is missing; add it, such as name = \"scans\""),
    (NAME, f"{NAME}\nlevels = [1]", "[study]: unknown key levels: it is a key of the sources \"ellipsoid-levels\", "),
    (LEVELS, "level = [0]", f"{FAMILY}unknown key level: did you mean levels?"),
    (LEVELS, f"{LEVELS}\ntriangles = [80]", f"{FAMILY}unknown key triangles: it is a key of the sources \"decimate"),
    (LEVELS, f"{LEVELS}\nrtol = 1e-3", f"{FAMILY}unknown key rtol: it belongs in [accuracy]"),
    (LEVELS, "", f"{FAMILY}levels is missing; add it, such as levels = [0, 1, 2]"),
    (f'name = "ico"\n{ICO}', ICO, "[[family]] 2: name is missing; add it, such as name = \"scans\""),
    (f"[study]\n{NAME}", f"{NAME}\n", "unknown key name: it belongs in [study]; [study] is missing; add it, with name"),
    # Sources.
    (ICO, LEVELS, f"{FAMILY}source is missing; add it, such as source = \"files\""),
    (ICO, f'source = "icosfere"\n{LEVELS}', f"{FAMILY}no source is named 'icosfere'; known are decimate, ellipsoid, "),
    (ICO, f"source = 3\n{LEVELS}", f"{FAMILY}no source is named 3; known are decimate, ellipsoid, "),
    (ICO, 'source = "files"\npaths = "a.ply"', f"{FAMILY}paths must be a list, such as paths = [\"a.ply\"], found '"),
    (ICO, 'source = "decimate"\nmesh = "a.ply"\ntriangles = [9]', f"{FAMILY}mesh: must be a table that names a source"),
    (
        ICO,
        'source = "decimate"\ntriangles = [9]\nmesh = {source = "files", path = ["a.ply"]}',
        f"{FAMILY}mesh: unknown key path: did you mean paths?",
    ),
    (
        ICO,
        'source = "decimate"\ntriangles = [9]\nmesh = {source = "files", paths = 3}',
        f"{FAMILY}mesh: paths must be a list, such as paths = [\"meshes/*.ply\"], found 3",
    ),
    (
        ICO,
        'source = "decimate"\ntriangles = [9]\nmesh = {paths = ["a.ply"]}',
        f"{FAMILY}the table {{'paths': ['a.ply']}}: source is missing; add it",
    ),
    (SPHERE, 'source = "family"\nfamily = "icos"', "[reference]: no family is named 'icos'; did you mean 'ico'?"),
    (SPHERE, 'source = "family"\nfamily = "x"', "[reference]: no family is named 'x'; its families are ['fine', 'ic"),
    (SPHERE, 'source = "family"', "[reference]: family is missing; add it, such as family = \"scans\""),
    # Sections.
    ("[reference]", "[[reference]]", "write [reference], with one bracket on each side: a study has one; found [[refe"),
    ("[study]", "[[study]]", "write [study], with one bracket on each side"),
    ("[norm]", "[[norm]]", "write [norm], with one bracket on each side"),
    ("[accuracy]", "[accurracy]", "unknown section [accurracy]: did you mean [accuracy]?"),
    ("[reference]", "[Ref]", "unknown section [Ref]: did you mean [reference]?"),
    ("[norm]", "[plots]\n[norm]", "unknown section [plots]: a study has [study], "),
    (f"{DOUBLE}\nname = \"fine\"", "[[families]]\nname = \"fine\"", "unknown section [[families]]: did you mean [[f"),
    (f"[norm]\n{ORDERS}\n", "", "[norm] is missing; add it, with orders = [-4.0]"),
    (f"[reference]\n{SPHERE}\n", "", "[reference] is missing; add it, with source = \"sphere\""),
    (STUDY[STUDY.index(DOUBLE) :], "", "[[family]] is missing; add it, with name = \"spheres\", source = \"icospher"),
    (LATTICE, "", "either a [lattice] or an [accuracy] is needed, and not both"),
    (LATTICE, f"{LATTICE}\n[lattice]\nxi_max = 5\nM = 64", "either a [lattice] or an [accuracy] is needed, and not bo"),
    (LATTICE, f"{LATTICE}\n[transform]\neps = 1e-9", "an [accuracy] chooses eps and quadrature; take them out of [tra"),
    (BEFORE, "[scaling]\nscale = 2.0\n[norm]", "[scaling]: scale and origin belong to mode = 'fixed', which needs at "),
    (f"[norm]\n{ORDERS}", "", "[norm] is missing"),
    (f"[study]\n{NAME}", 'study = "scans"', "study must be a section: [study] on a line, and its keys below; found "),
    # TOML.
    (NAME, "name = scans", "not a TOML file: line 2, 'name = scans': text needs quotes: name = \"scans\""),
    (NAME, "name = two words", "text needs quotes: name = \"two words\""),
    (NAME, 'name = "scans', "a text lacks its closing quote"),
    (NAME, "name = 'scans", "a text lacks its closing quote"),
    (NAME, "name = “scans”", "write straight quotes"),
    (NAME, f"{NAME} # a\n{NAME}", "the key name is there twice; keep one"),
    (RTOL, "rtol == 1e-2", "not a TOML file: line 5, 'rtol == 1e-2': = is there twice; write one"),
    (RTOL, "rtol: 1e-2", "write = in place of the colon"),
    (RTOL, "rtol = .01", "a number has a digit before its point, such as 0.5"),
    (RTOL, "rtol = 1.e-2", "a number has a digit behind its point, such as 5.0"),
    (RTOL, "rtol =", "a value is missing behind ="),
    (RTOL, "rtol", "a line has a section, such as [norm], or a key and its value, such as rtol = 1e-2"),
    (RTOL, "// rtol", "a comment begins with #"),
    (RTOL, f"{RTOL}\nbest_effort = True", "write true, in small letters and without quotes"),
    (RTOL, f"{RTOL}\nmemory = None", "leave the key out to have its default"),
    (ORDERS, "orders = -4, -6", "a list needs brackets: orders = [-4, -6]"),
    (ORDERS, "orders = [-4 -6]", "a list has a comma between its entries and ends with ]"),
    (ORDERS, "orders = [-4, -6", "a list has a comma between its entries and ends with ]"),
    ("[norm]", "[norm", "the name of a section needs closed brackets, such as [norm]"),
    ("[norm]", "[accuracy]", "the section [accuracy] is there twice; make it one"),
    (ICO, 'source = "files"\npaths = ["C:\\meshes\\a.ply"]', "write / in place of each backslash, or single quotes"),
    (ICO, 'source = "files"\npaths = [a.ply]', "text needs quotes, such as paths = [\"a.ply\"]"),
    (ICO, 'source = "decimate"\nmesh = {source = "files",}', "a table in braces has commas between its keys only"),
    (RTOL, f"{RTOL} best_effort = true", "a line has one key and its value, and nothing else"),
]  # fmt: skip
VALIDATORS_WORDS = re.compile(
    r"input should|extra inputs|field required|valid (dictionary|list|tuple|number|string|integer|boolean)|union|"
    r"value_error|value error|validation error|pydantic|after validation|_section|_header|instance of",
    re.IGNORECASE,
)


def refusal(text: str, folder: Path) -> str:
    """Return what a study file is refused with, without its path."""
    path = folder / "study.toml"
    path.write_text(text)
    with pytest.raises(sb.StudyError) as caught:
        sb.Study.from_toml(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert message.isprintable()
    return message.removeprefix(f"{path}: ")


@pytest.mark.parametrize(("old", "new", "said"), WRONG, ids=[repr(new[:40]) for _, new, _ in WRONG])
def test_a_wrong_study_is_told_what_would_work(old: str, new: str, said: str, tmp_path: Path) -> None:
    start = STUDY.rindex(old)
    before, after = STUDY[:start], STUDY[start + len(old) :]
    message = refusal(before + new + after, tmp_path)
    assert said in message
    assert not VALIDATORS_WORDS.search(message), message
    suggested = re.search(r"(must be|missing; add it).*?, such as (\w+) = (.*?)(, found|; |$)", message)
    if suggested is None or suggested[2] == "source" or any(word in new for word in ("mesh", "tolerance")):
        return
    # What the message suggests then works.
    line = re.compile(rf"^{suggested[2]}\s*=.*$", re.M)
    assignment = f"{suggested[2]} = {suggested[3]}"
    corrected = line.sub(assignment, new) if line.search(new) else f"{new}\n{assignment}"
    (tmp_path / "study.toml").write_text(before + corrected.replace('family = "scans"', 'family = "ico"') + after)
    assert sb.Study.from_toml(tmp_path / "study.toml").families


def test_the_family_with_one_bracket_is_told_of_two(tmp_path: Path) -> None:
    only = STUDY[: STUDY.index("[[family]]")] + STUDY[STUDY.rindex("[[family]]") :]
    message = refusal(only.replace("[[family]]", "[family]"), tmp_path)
    assert message == "write [[family]], with two brackets on each side, before each; found [family], with one"
    for text in (STUDY.replace("[[family]]", "[family]"), STUDY.replace('[[family]]\nname = "ico"', "[family]")):
        assert "[[family]] needs two brackets on each side, before each family" in refusal(text, tmp_path)


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("norm.orders", [-2.0, "-6"], "entry 2 of orders must be a number, such as -6, found '-6'"),
        ("norm.orders", None, "orders must be a list, such as orders = [-4.0], found None"),
        ("norm", [-2.0], "norm must be a section: [norm] on a line, and its keys below; found [-2.0]"),
        ("norm", sb.Lattice(1.0, 8), "norm must be a section: [norm] on a line, and its keys below; found Lattice("),
        ("reference", sb.Sphere(), "reference must be a section: [reference] on a line, and its keys below; found Sph"),
        ("family", {"name": "a"}, "write [[family]], with two brackets on each side, before each; found [family]"),
        ("family", "files", "family must be written as sections, [[family]] before each, found 'files'"),
        ("family", ["files"], "family must be written as sections, [[family]] before each, found ['files']"),
        ("family", [], "at least one [[family]] is needed"),
        ("study", {3: "x"}, "study: keys must be strings"),
    ],
)
def test_wrong_tables_from_python_are_told_the_same(path: str, value: Any, said: str) -> None:
    with pytest.raises(sb.StudyError) as caught:
        sb.Study.from_table(changed(path, value))
    assert said in str(caught.value)
    assert not VALIDATORS_WORDS.search(str(caught.value))


@pytest.mark.parametrize("table", [None, "study.toml", ["study"], 3])
def test_what_is_no_table_is_refused(table: Any) -> None:
    with pytest.raises(sb.StudyError, match=r"a study is a mapping of sections, such as .*, found "):
        sb.Study.from_table(table)


def test_python_may_give_arrays_and_paths() -> None:
    table = small_table()
    table["norm"]["orders"] = np.array([-3.0, -2.0])
    table["lattice"] = {"xi_max": np.float32(3.0), "M": np.int64(16)}
    table["family"].append({"name": "f", "source": "files", "paths": (Path("a.ply"),)})
    study = sb.Study.from_table(table)
    assert (study.orders, study.lattice) == ((-3.0, -2.0), sb.Lattice(3.0, 16))
    assert study.table["norm"]["orders"] == [-3.0, -2.0]
    assert study.table["family"][1]["paths"] == ["a.ply"]


@pytest.mark.parametrize(
    ("name", "value"), [("orders", [-2.0]), ("lattice", (3.0, 16)), ("name", 3), ("proximity", True), ("folder", ".")]
)
def test_the_constructor_refuses_other_types(name: str, value: Any) -> None:
    study = sb.Study.from_table(small_table())
    with pytest.raises(sb.StudyError, match=rf"Study: {name} must be a value of type .*, found .*Study\.from_table"):
        sb.Study(**{**vars(study), name: value})
    with pytest.raises(sb.OrderError, match="below -1/2"):
        sb.Study(**{**vars(study), "orders": (-0.5,)})


def test_every_key_has_an_example_that_its_section_takes() -> None:
    for name, field in StudyDocument.model_fields.items():
        kinds: list[Any] = [field.annotation, *getattr(field.annotation, "__args__", ())]
        for model in [kind for kind in kinds if hasattr(kind, "model_fields")]:
            for key in model.model_fields:
                example = tomllib.loads(f"{key} = {example_of(model, key)}")
                assert not [error for error in _errors(model, example) if error[:1] == (key,)], (name, key)


def test_every_key_of_a_source_has_an_example_that_it_takes() -> None:
    for source, keys in keys_by_source().items():
        for key in keys:
            model = source_type_of(source)
            example = tomllib.loads(f"{key} = {example_of(model, key)}")
            assert not [error for error in _errors(model, example) if error[:1] == (key,)], (source, key)


def _errors(model: Any, values: dict[str, Any]) -> list[tuple[Any, ...]]:
    try:
        model.model_validate(values)
    except ValidationError as error:
        return [item["loc"] for item in error.errors()]
    return []
