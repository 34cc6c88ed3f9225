"""Malformed studies: refused before anything is made, naming the key, what was found and what to do."""

from __future__ import annotations

import codecs
import os
import re
import sys
import time
import tracemalloc
import unicodedata
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sobolev_batch import Study, StudyError
from sobolev_batch.batch.study.plan import make_plan
from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.sources.names import caseless_key, name_problem, quoted
from tests.support.mesh_files import off
from tests.support.shapes import BOX_TRIANGLES, BOX_VERTICES
from tests.support.studies import changed, small_table

OFF_BOX = off(BOX_VERTICES, BOX_TRIANGLES)
MOST_BYTES = 4 << 20


def refusal(table: dict[str, Any]) -> str:
    """What a study is refused with; one line, of a length that can be read."""
    with pytest.raises(StudyError) as caught:
        Study.from_table(table)
    return orderly(str(caught.value))


def orderly(message: str) -> str:
    assert message.isprintable(), message
    assert len(message) < 2000
    return message


# Names.

UNSEEN = {
    "newline": "a\nb",
    "tab": "a\tb",
    "NUL": "a\0b",
    "escape": "a\x1b[31mb",
    "next line": "a\x85b",
    "no-break space": "a\xa0b",
    "soft hyphen": "a\xadb",
    "zero-width space": "a\u200bb",
    "zero-width joiner": "a\u200db",
    "right-to-left mark": "a\u200fb",
    "line separator": "a\u2028b",
    "right-to-left override": "a\u202eb",
    "isolate": "a\u2066b",
    "byte order mark": "\ufeffab",
    "ideographic space": "a\u3000b",
    "Hangul filler": "a\u3164b",
    "combining joiner": "a\u034fb",
    "variation selector": "a\ufe0fb",
    "empty Braille cell": "\u2800",
    "tag": "a\U000e0041b",
    "variation selector of the supplement": "a\U000e0100b",
    "lone surrogate": "a\ud800b",
    "private use": "a\ue000b",
    "unassigned": "a\u0378b",
}


@pytest.mark.parametrize("name", UNSEEN.values(), ids=UNSEEN.keys())
def test_names_and_titles_hold_nothing_unseen(name: str) -> None:
    code = next(f"U+{ord(c):04X}" for c in name if c not in "ab[31m")
    for key in ("study.name", "family.0.name", "study.title"):
        message = refusal(changed(key, name))
        assert f"it holds the invisible character {code}" in message
        assert "visible characters" in message
        assert key.rsplit(".", 1)[1] in message


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("", "it is empty"),
        (" ", "it begins or ends with a blank"),
        ("a ", "it begins or ends with a blank"),
        ("../a", "it holds '/'"),
        ("/etc/passwd", "it holds '/'"),
        ("a\\b", r"it holds '\\\\'"),
        ("x" * 101, "it has 101 characters, 100 are allowed"),
        ("x" * 10_000, "it has 10000 characters, 100 are allowed"),
    ],
)
def test_names_say_in_words_what_they_may_hold(name: str, reason: str) -> None:
    for key in ("study.name", "family.0.name"):
        message = refusal(changed(key, name))
        assert reason.replace("\\\\\\\\", "\\\\") in message
        assert "a name is 1 to 100 visible characters, blanks only between them, without / and \\" in message
        assert "[^" not in message


@pytest.mark.parametrize("name", ["a", "two words", "Größe", "日本", "naïve", "..a", "-", "a" * 100, "😀", "5%"])
def test_other_names_are_taken(name: str) -> None:
    table = changed("family.0.name", name)
    table["study"]["name"] = name
    study = Study.from_table(table)
    assert (study.name, study.families[0].name) == (name, name)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("ico", "ico"),
        ("Ico", "ico"),
        ("STRASSE", "straße"),
        ("caf\u00e9", "cafe\u0301"),
        ("CAFE\u0301", "caf\u00e9"),
        ("\u212bngström", "ångström"),
        ("ΣΑΣ", "σας"),
    ],
)
def test_two_families_of_one_name_are_refused(one: str, other: str) -> None:
    table = small_table(family=[{"name": name, "source": "icosphere", "levels": [0]} for name in (one, other, "third")])
    with pytest.raises(StudyError) as caught:
        Study.from_table(table)
    message = str(caught.value)
    assert message.startswith("family: names must differ by more than case and the spelling of accents, found ")
    assert repr(one) in message
    assert repr(other) in message
    assert "third" not in message
    assert message.endswith("rename one")


@pytest.mark.parametrize("name", ["reference", "Reference", "REFERENCE"])
def test_no_family_is_called_reference(name: str) -> None:
    assert "family: no family can be named 'reference'" in refusal(changed("family.0.name", name))


# Sources.


@pytest.mark.parametrize(
    "name",
    [
        "os:system",
        "os.system",
        "sobolev_batch.surfaces.sources.files:FileSource",
        "__import__('os')",
        "../files",
        "files\n",
        "x" * 10_000,
    ],
)
def test_sources_are_looked_up_and_never_imported(name: str) -> None:
    loaded = set(sys.modules)
    message = refusal(changed("family.0.source", name))
    assert "[[family]] 1 (named 'ico'): no source is named " in message
    assert name[:8].strip() in message
    assert "known are decimate, ellipsoid, ellipsoid-levels, files, fit, flow, icosphere" in message
    assert set(sys.modules) == loaded


# Sizes: refused before memory is spent, with what was asked and what is allowed.

OVERSIZED: dict[str, tuple[str, Any, str, str]] = {
    "level": ("family.0.levels", [30], "entry 1 of levels .*30", "12"),
    "levels": ("family.0.levels", [1] * 1_000_00, "levels: .*100000", "1000"),
    "levels that are all wrong": ("family.0.levels", [30] * 100_000, "levels: .*100000", "1000"),
    "lattice": ("lattice.M", 10**6, "M must be .*1000000", "2048"),
    "orders": ("norm.orders", [-1.0 - k for k in range(10**5)], "orders: .*100000", "100"),
    "order": ("norm.orders", [-(10.0**5)], "-100000", "-100"),
    "many digits": ("lattice.M", 1 << 20_000, "lattice.M: .*20001 bits", str(2**63 - 1)),
    "radius": ("reference.radius", 1 << 64, "reference.radius: .*65 bits", str(2**63 - 1)),
    "text": ("study.title", "x" * 10**7, "study.title: .*10000000", "10000"),
    "title": ("study.title", "x" * 2000, "title: .*2000", "1000"),
    "triangles": (
        "family",
        [{"name": "d", "source": "decimate", "mesh": {"source": "icosphere", "levels": [1]}, "triangles": [10**12]}],
        r"named 'd'\): entry 1 of triangles .*1000000000000",
        "1000000000",
    ),
    "paths": ("family", [{"name": "f", "source": "files", "paths": ["a"] * 100_001}], "paths: .*100001", "100000"),
    "path": ("family", [{"name": "f", "source": "files", "paths": ["a" * 20_000]}], "paths.0: .*20000", "10000"),
    "xi_max": ("lattice.xi_max", 1e300, "xi_max .*1e[+]300", r"1e[+]50"),
    "small xi_max": ("lattice.xi_max", 5e-324, "xi_max .*4.94066e-324", "1e-50"),
    "quadrature": ("transform.quadrature", 10**6, "quadrature .*1000000", "50"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("path", "value", "asked", "allowed"), OVERSIZED.values(), ids=OVERSIZED.keys())
def test_sizes_beyond_the_bounds_are_refused_with_both_numbers(path: str, value: Any, asked: str, allowed: str) -> None:
    table = changed(path, value)
    tracemalloc.start()
    try:
        message = refusal(table)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert re.search(asked, message), message
    assert re.search(rf"(?<!\d){allowed}(?!\d)", message), message
    assert peak_bytes < 48 << 20


@pytest.mark.slow
def test_all_values_together_are_bounded() -> None:
    families = [{"name": f"f{i}", "source": "files", "paths": ["a"] * 10_000} for i in range(101)]
    assert "the study has more than 1000000 values" in refusal(small_table(family=families))


def test_of_many_offenders_the_first_are_listed() -> None:
    message = refusal(changed("norm.orders", ["x"] * 100))
    assert message.count("must be a number") == 10
    assert message.endswith("; and 90 more")


@pytest.mark.slow
@pytest.mark.parametrize("depth", [21, 1000, 200_000])
def test_deep_tables_are_refused(depth: int) -> None:
    deep: Any = 1
    for level in range(depth):
        deep = {"mesh": deep} if level % 2 else [deep]
    message = refusal(changed("family.0.mesh", deep))
    assert message.startswith("family.0.mesh.")
    assert message.endswith("nested more than 20 deep")


@pytest.mark.parametrize("key", ["a\nb", "x" * 10_000, "\u202ename", "", "a.b", " "])
def test_unknown_keys_are_named_on_one_line(key: str) -> None:
    table = small_table()
    table["study"][key] = 1
    assert "[study]: unknown key " in refusal(table)


def test_keys_must_be_strings() -> None:
    assert "study: keys must be strings" in refusal(small_table(study={3: "x"}))


# Files.


def test_duplicate_keys_and_tables_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    for text in ('[study]\nname = "a"\nname = "b"\n', "[norm]\n[norm]\n", "a = 1\n[a]\n", "a = {b = 1, b = 2}\n"):
        path.write_text(text)
        with pytest.raises(StudyError, match=r"s\.toml: not a TOML file: .*line"):
            Study.from_toml(path)


FILES: dict[str, tuple[bytes, str]] = {
    "empty": (b"", r"\[study\] is missing"),
    "byte order mark": (codecs.BOM_UTF8 + b"[study]\n", "begins with a byte order mark; save it as UTF-8 without one"),
    "UTF-16": ("[study]\n".encode("utf-16"), "not a TOML file: .*save it as UTF-8"),
    "Latin-1": ('[study]\nname = "ü"\n'.encode("latin-1"), "not a TOML file: .*save it as UTF-8"),
    "NUL": (b"a = 1\0", "not a TOML file"),
    "deep lists": (b"a = " + b"[" * 100_000, "nested too deeply"),
    "deep tables": (b"a = " + b"{a = " * 100_000, "nested too deeply"),
    "long key": (b"a" + b".a" * 100_000 + b" = 1", "a key has 100 dotted parts or more"),
    "long quoted key": (b'"a"' + b' . "a"' * 100_000 + b" = 1", "a key has 100 dotted parts or more"),
    "long header": (b"[a" + b".a" * 100_000 + b"]", "a key has 100 dotted parts or more"),
    "long word": (b"a" * 1_000_000, "not a TOML file"),
    "deep key": (b"study" + b".a" * 60 + b" = 1", "nested more than 20 deep"),
    "many digits": (b"a = " + b"9" * 10_000, "not a TOML file"),
    "many hexadecimal digits": (b"[lattice]\nM = 0x" + b"f" * 10_000, "lattice.M: integers go up to .* 40000 bits"),
    "impossible date": (b"a = 2026-13-45", "not a TOML file"),
    "100 MB": (b"# " + b"x" * (100 << 20), f"at most {MOST_BYTES} bytes, found {(100 << 20) + 2}; globs"),
}


@pytest.mark.parametrize(("content", "reason"), FILES.values(), ids=FILES.keys())
def test_files_that_are_no_studies(tmp_path: Path, content: bytes, reason: str) -> None:
    path = tmp_path / "s.toml"
    path.write_bytes(content)
    start = time.process_time()
    with pytest.raises(StudyError, match=reason) as caught:
        Study.from_toml(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert len(str(caught.value)) < 2000
    assert time.process_time() - start < 20


def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    pipe, device, loop = tmp_path / "pipe.toml", tmp_path / "zero.toml", tmp_path / "loop.toml"
    os.mkfifo(pipe)
    device.symlink_to("/dev/zero")
    loop.symlink_to(loop)
    reasons = {pipe: "it is a pipe", device: "it is a pipe, a socket or a device", tmp_path: "Is a directory"}
    for path, reason in {**reasons, loop: "Too many levels", tmp_path / "a\0b": "null byte"}.items():
        with pytest.raises(StudyError, match=f"cannot be read: .*{reason}"):
            Study.from_toml(path)


# Files of meshes: their names and where they may lie.


def plan_of_files(folder: Path, *paths: str) -> list[str]:
    study = Study.from_table(
        small_table(family=[{"name": "f", "source": "files", "paths": list(paths)}]), folder=folder
    )
    return [row.label for row in make_plan(study).rows][:-1]


def refused_files(folder: Path, *paths: str) -> str:
    with pytest.raises(StudyError) as caught:
        plan_of_files(folder, *paths)
    message = str(caught.value)
    assert message.startswith("family 'f': paths: ")
    return orderly(message)


def put(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(OFF_BOX)


@pytest.mark.parametrize(
    "stem", ["a\nb", "a\x1b[2Jb", "a\u202eb", "a\u200bb", "a\u2028b", " a", "a\\b", "a\x85b", "\udcff"]
)
def test_stems_that_would_be_misleading_labels_are_refused(tmp_path: Path, stem: str) -> None:
    try:
        put(tmp_path, f"{stem}.off")
    except OSError:
        pytest.skip("this file system has no such names")
    # What is no Unicode cannot be named in a study, but a glob finds it.
    for path in ("*.off", f"{stem}.off")[: 1 if stem == "\udcff" else 2]:
        message = refused_files(tmp_path, path)
        assert "is no label: it " in message
        assert message.endswith("; rename the file")


def test_files_in_different_folders_or_formats_are_told_apart(tmp_path: Path) -> None:
    put(tmp_path, "one/A.off", "two/a.off", "b.off", "b.obj")
    labels = plan_of_files(tmp_path, "**/*.o*")
    assert [label.rsplit("/", 2)[1:] for label in labels if label.endswith(("/A.off", "/a.off"))] == [
        ["one", "A.off"],
        ["two", "a.off"],
    ]
    assert {"f/b.off", "f/b.obj"} < set(labels)
    assert len({caseless_key(label) for label in labels}) == len(labels) == 4


@pytest.mark.parametrize(("one", "other"), [("A", "a"), ("caf\u00e9", "cafe\u0301"), ("STRASSE", "straße")])
def test_twins_in_one_folder_are_refused(tmp_path: Path, one: str, other: str) -> None:
    put(tmp_path, f"{one}.off", f"{other}.off")
    if len(list(tmp_path.iterdir())) < 2:
        pytest.skip("this file system does not tell them apart")
    message = refused_files(tmp_path, "*.off")
    assert "differ only in case or in the encoding of accents; rename one" in message
    assert one in message
    assert other in message


def test_globs_do_not_leave_their_folder_through_links(tmp_path: Path) -> None:
    put(tmp_path, "study/meshes/a.off", "elsewhere/secret.off")
    folder = tmp_path / "study"
    (folder / "meshes" / "link.off").symlink_to("../../elsewhere/secret.off")
    for glob in ("meshes/*.off", "**/*.off", "meshes/l*"):
        message = refused_files(folder, glob)
        assert "a link out of" in message
        assert "secret.off" in message
        assert message.endswith("name such files by their paths")
    # A path that is named is meant, wherever it leads.
    assert plan_of_files(folder, "meshes/link.off", "../elsewhere/secret.off") == ["f/secret", "f/link"]
    (folder / "meshes" / "link.off").unlink()
    # A link within the folder leads to nothing that was not there.
    (folder / "meshes" / "inner.off").symlink_to("a.off")
    assert plan_of_files(folder, "meshes/*.off") == ["f/a", "f/inner"]


def test_globs_do_not_leave_their_folder_through_linked_folders(tmp_path: Path) -> None:
    put(tmp_path, "study/a.off", "elsewhere/secret.off")
    folder = tmp_path / "study"
    (folder / "up").symlink_to("../elsewhere")
    assert plan_of_files(folder, "**/*.off") == ["f/a"]
    assert "a link out of" in refused_files(folder, "*/*.off")
    assert "goes back up behind a wildcard" in refused_files(folder, "u*/../../elsewhere/*.off")
    # What stands before the wildcard is named by the study, and therefore meant.
    assert plan_of_files(folder, "up/*.off") == plan_of_files(folder, "../elsewhere/*.off") == ["f/secret"]
    assert plan_of_files(folder, f"{tmp_path}/elsewhere/*.off") == ["f/secret"]


def test_loops_of_links_and_repeated_wildcards_end(tmp_path: Path) -> None:
    put(tmp_path, *(f"{'d/' * depth}a{depth}.off" for depth in range(12)))
    for name in ("one", "two"):
        (tmp_path / "d" / name).symlink_to(".")
    assert len(plan_of_files(tmp_path, "**/*.off")) == 12
    assert len(plan_of_files(tmp_path, "/".join(["**"] * 12) + "/*.off")) == 12


@pytest.mark.parametrize("glob", ["*.ply", "none/*.off", "*" * 300 + "z", "a[.off", "**/none/*", "a*\n"])
def test_globs_that_match_nothing_are_refused(tmp_path: Path, glob: str) -> None:
    put(tmp_path, "a.off")
    message = refused_files(tmp_path, glob)
    assert f"matches no file below {tmp_path}" in message
    assert message.endswith("correct it, or put files there")


def test_paths_that_no_file_can_have_are_refused(tmp_path: Path) -> None:
    assert "NUL" in refused_files(tmp_path, "a\0b.off")
    assert "NUL" in refused_files(tmp_path, "a\0*.off")
    assert "1000 are allowed" in refused_files(tmp_path, "x" * 5000 + ".off")


# Anything else.

_KEYS = [
    "study",
    "lattice",
    "accuracy",
    "norm",
    "transform",
    "reference",
    "family",
    "scaling",
    "name",
    "title",
    "xi_max",
]
_KEYS += [
    "M",
    "rtol",
    "memory",
    "orders",
    "pairs",
    "eps",
    "dtype",
    "quadrature",
    "backend",
    "source",
    "levels",
    "mesh",
]
_KEYS += ["radius", "center", "paths", "triangles", "mode", "scale", "origin", "member", "sphere", "distribution"]
_WORDS = ["reference", "all", "auto", "files", "icosphere", "sphere", "decimate", "family", "ico", "none", "fixed", ""]
_scalars = (
    st.integers()
    | st.integers(-2, 20)
    | st.sampled_from([20, 64, 2000, 20_000]).map(lambda bits: 1 << bits)
    | st.floats()
    | st.booleans()
    | st.text(max_size=8)
    | st.sampled_from(_WORDS)
    | st.dates()
    | st.times()
    | st.datetimes()
)
_keys = st.sampled_from(_KEYS) | st.text(max_size=5)
_values = st.recursive(
    _scalars, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(_keys, inner, max_size=5), max_leaves=12
)
_fuzz = settings(derandomize=True, deadline=None, max_examples=100, suppress_health_check=[HealthCheck.too_slow])


def _ends_well(table: dict[str, Any]) -> None:
    try:
        study = Study.from_table(table)
    except StudyError as error:
        orderly(str(error))
    else:
        assert study.orders
        assert study.families


@pytest.mark.slow
@_fuzz
@given(table=st.dictionaries(_keys, _values, max_size=6))
def test_any_tables_end_in_a_study_or_a_study_error(table: dict[str, Any]) -> None:
    _ends_well(table)


@pytest.mark.slow
@_fuzz
@given(data=st.data())
def test_damaged_studies_end_in_a_study_or_a_study_error(data: st.DataObject) -> None:
    table = small_table(
        scaling={"mode": "fixed", "scale": 0.5, "origin": [0, 0, 0]}, transform={"eps": 1e-6, "quadrature": 5}
    )
    for _ in range(data.draw(st.integers(1, 3))):
        place: Any = table
        while True:
            entries = list(place) if isinstance(place, dict) else list(range(len(place)))
            if not entries:
                break
            key = data.draw(st.sampled_from(entries))
            if isinstance(place[key], dict | list) and data.draw(st.integers(0, 3)):
                place = place[key]
                continue
            if data.draw(st.booleans()):
                place[key] = data.draw(_values)
            else:
                del place[key]
            break
    _ends_well(table)


@pytest.mark.slow
@_fuzz
@given(
    xi_max=st.floats(),
    radius=st.floats() | st.just(1.0),
    scale=st.floats(),
    mode=st.sampled_from(["reference", "fixed"]),
)
def test_numbers_at_the_ends_of_their_range_end_in_a_plan_or_an_error(
    xi_max: float, radius: float, scale: float, mode: str
) -> None:
    scaling = {"mode": "fixed", "scale": scale} if mode == "fixed" else {"mode": mode}
    reference = {"source": "sphere", "radius": radius}
    table = small_table(lattice={"xi_max": xi_max, "M": 2048}, reference=reference, scaling=scaling)
    try:
        make_plan(Study.from_table(table))
    except InputError as error:
        orderly(str(error))


@pytest.mark.slow
@_fuzz
@given(content=st.binary(max_size=200) | st.text(max_size=200).map(lambda text: text.encode("utf-8", "surrogatepass")))
def test_any_file_ends_in_a_study_or_a_study_error(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_bytes(content)
    with pytest.raises(StudyError, match=r"any\.toml: "):
        Study.from_toml(path)


@_fuzz
@given(text=st.text(max_size=120))
def test_names_without_a_flaw_are_seen_as_they_are(text: str) -> None:
    reason = name_problem(text, 100, "/")
    if reason is None:
        assert text.isprintable()
        assert text == text.strip()
        assert 1 <= len(text) <= 100
        assert "/" not in text
        assert caseless_key(unicodedata.normalize("NFC", text)) == caseless_key(
            unicodedata.normalize("NFD", text.upper().lower())
        ) or (text.upper().lower() != text.lower())
    else:
        assert reason.isprintable()


@pytest.mark.slow
@_fuzz
@given(value=_values)
def test_values_are_shown_on_one_line(value: Any) -> None:
    assert len(orderly(quoted(value))) <= 80
