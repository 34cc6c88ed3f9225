"""Names of files, labels and messages that hold control characters: none reaches a terminal, a table or a page."""

from __future__ import annotations

import csv
import html
import io
import json
import logging
import os
import re
import shutil
import subprocess
import tomllib
import unicodedata
import warnings
from pathlib import Path
from xml.etree import ElementTree

import pandas as pd
import pytest
from matplotlib.figure import Figure

import sobolev_batch as sb
from sobolev_batch import Study, run
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.cli.output import overwrite, progress_bar
from sobolev_batch.html import table_html
from sobolev_batch.results.figures.style import escaped, shortened
from sobolev_batch.results.tables.defaults import FORMATS, Format
from sobolev_batch.results.tables.matrix import format_matrix
from sobolev_batch.results.tables.smallest import format_smallest
from sobolev_batch.results.tables.text import machine_table, printed_table, prose
from sobolev_batch.surfaces.sources import files
from sobolev_batch.visible import VisibleRecord, visible, visible_lines
from tests.support.commands import COMMAND

pytestmark = pytest.mark.process

# The title of a terminal, a bell, a line of its own, a turn of the direction of text, and a byte that is no UTF-8.
HOSTILE = "evil\x1b]0;owned\x07\nerror: \x9b31m\u202e\u2028\udcff"
SHOWN = r"evil\x1b]0;owned\x07\nerror: \x9b31m\u202e\u2028\udcff"
# A store holds text as UTF-8.
LABEL, SHOWN_LABEL = HOSTILE.removesuffix("\udcff"), SHOWN.removesuffix(r"\udcff")
# All of this is allowed in the name of a family.
FAMILY = "=1+1|`id` <img src=x> $x_1$ %&#~^{} [a](b) *_b_*"
TOML = f"""
[study]
name = "hostile"
title = '{FAMILY}'
[lattice]
xi_max = 3.0
M = 16
[norm]
orders = [-10.0]
[reference]
source = "sphere"
[[family]]
name = '{FAMILY}'
source = "icosphere"
levels = [0, 1]
[[family]]
name = "files"
source = "files"
paths = ["*/*.obj"]
"""
DIRECTIONS = {"\u061c", "\u200e", "\u200f", *map(chr, range(0x202A, 0x202F)), *map(chr, range(0x2066, 0x206A))}


def is_harmful(character: str) -> bool:
    """Tell whether a terminal obeys a character, or shows the next ones elsewhere or not at all."""
    return unicodedata.category(character) in ("Cc", "Cs", "Zl", "Zp") or character in DIRECTIONS


def harmful(text: str) -> list[str]:
    """The characters of an output that should be escapes; the lines of it end."""
    return [character for character in text if character != "\n" and is_harmful(character)]


def printed(*arguments: object, folder: Path) -> tuple[int, str, str]:
    """Run a command as a process, and return its status and what it printed, byte for byte."""
    done = subprocess.run(
        [*COMMAND, *map(str, arguments)], capture_output=True, cwd=folder, check=False, stdin=subprocess.DEVNULL
    )
    output, errors = (part.decode("utf-8", "surrogateescape") for part in (done.stdout, done.stderr))
    assert harmful(output) == harmful(errors) == []
    # No name began a line of its own, but in tracebacks.
    assert "--debug" in arguments or "\nerror: \\x9b" not in f"\n{output}\n{errors}"
    return done.returncode, output, errors


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study with hostile names, of which one file is no mesh, and what its run printed."""
    folder = tmp_path_factory.mktemp("hostile")
    (folder / HOSTILE).mkdir()
    sb.write_mesh(sb.icosphere(1), folder / HOSTILE / "good.obj")
    (folder / HOSTILE / "broken.obj").write_text("v 1 2\x1b[31m\n")
    sb.write_mesh(sb.icosphere(2), folder / f"{HOSTILE}.ply")
    # What is listed and not there is logged by the driver.
    listed = TOML.replace('"*/*.obj"', f'"*/*.obj", {json.dumps(LABEL + "/gone.obj")}')
    (folder / "study.toml").write_text(listed)
    status, output, errors = printed("run", "study.toml", "--workers", "1", folder=folder)
    assert status == 3
    (folder / "run.out").write_text(output)
    (folder / "run.err").write_text(errors)
    return folder


@pytest.fixture(scope="module")
def foreign(folder: Path) -> str:
    """A store whose labels this package would not have written."""
    (folder / "foreign").mkdir()
    sb.write_mesh(sb.icosphere(1), folder / "foreign" / f"{LABEL}.obj")
    (folder / "foreign" / f"{LABEL}2.obj").write_text("no mesh")
    table = tomllib.loads(TOML.replace("*/*.obj", "foreign/*.obj"))
    with pytest.MonkeyPatch.context() as patch, local_client(1) as client:
        patch.setattr(files, "label_problem", lambda name: None)
        run(Study.from_table(table, folder=folder), folder / "foreign.zarr", client)
    return "foreign.zarr"


@pytest.mark.parametrize(
    "character", [*map(chr, range(0x20)), "\x7f", "\x80", "\x9b", "\u2029", "\ud800", *sorted(DIRECTIONS)]
)
def test_harmful_characters_are_escapes(character: str) -> None:
    shown = visible(f"a{character}b")
    assert re.fullmatch(r"a\\([nrt]|x[0-9a-f]{2}|u[0-9a-f]{4})b", shown)
    assert visible(shown) == shown


def test_other_characters_stay() -> None:
    text = "Ärger, 日本, שלום, 👩‍🚀, \u00a0 and \\x1b"
    assert visible(text) == text
    assert visible_lines("a\nb\rc") == "a\nb\\rc"


def test_a_run_shows_names_and_reasons(folder: Path) -> None:
    output, errors = (folder / "run.out").read_text(), (folder / "run.err").read_text()
    assert f"files/broken: failed, {folder}/{SHOWN}/broken.obj: " in errors
    assert f"files/broken is failed: {folder}/{SHOWN}/broken.obj: " in output
    assert f"WARNING sobolev_batch.batch.study.plan: files/gone: {folder}/{SHOWN_LABEL}/gone.obj: " in errors


@pytest.mark.all
@pytest.mark.parametrize(
    "arguments",
    [
        ("status", "storage/hostile.zarr"),
        ("plan", "study.toml", "--store", f"{HOSTILE}/new.zarr"),
        ("table", f"{HOSTILE}/none.zarr"),
        ("release", f"{HOSTILE}.zarr"),
        ("compare", f"{HOSTILE}/good.obj", f"{HOSTILE}/broken.obj"),
        ("compare", f"{HOSTILE}.ply", f"{HOSTILE}/good.obj", "--yardsticks", "--xi-max", "2", "--M", "16"),
        ("compare", f"{HOSTILE}.ply", f"{HOSTILE}/good.obj", "--below", "1%"),
        ("fit", f"{HOSTILE}/good.obj", f"{HOSTILE}/good.obj", "-o", f"{HOSTILE}/none/a.obj"),
        ("--debug", "run", f"{HOSTILE}.toml"),
        ("table", "storage/hostile.zarr", "--format", HOSTILE),
        ("table", "storage/hostile.zarr", f"--{HOSTILE}"),
        ("table", "storage/hostile.zarr", HOSTILE),
        ("plot", "storage/hostile.zarr", "--output", f"{HOSTILE}/plots"),
    ],
    ids=lambda arguments: " ".join(arguments[:1]),
)
def test_commands_show_names_of_files(folder: Path, arguments: tuple[str, ...]) -> None:
    _, output, errors = printed(*arguments, folder=folder)
    assert r"evil\x1b]0;owned\x07" in output + errors


@pytest.mark.parametrize("key", ["title", "name"])
def test_studies_with_hostile_titles_and_names_are_refused(folder: Path, key: str) -> None:
    # TOML spells them as JSON does.
    line = f"{key} = {json.dumps(LABEL)}"
    (folder / "refused.toml").write_text(re.sub(rf"(?m)^{key} = .*$", lambda _: line, TOML))
    status, _, errors = printed("run", "refused.toml", folder=folder)
    assert status == 2
    assert "it holds the invisible character U+001B" in errors


@pytest.mark.parametrize(
    "style", [pytest.param(style, marks=[] if style in ("csv", "json") else pytest.mark.all) for style in FORMATS]
)
def test_tables_of_hostile_labels(folder: Path, foreign: str, style: Format) -> None:
    _, output, _ = printed("table", foreign, "--format", style, folder=folder)
    tree = sb.open_store(folder / foreign)
    for text in (output, format_matrix(tree, style), format_smallest(tree, style, below=0.9)):
        assert harmful(text) == []
        if style == "json":
            # Programs get the names.
            assert any(LABEL in str(value) for row in json.loads(text) for value in row.values())
        elif style == "csv":
            cells = [cell for row in csv.reader(io.StringIO(text)) for cell in row]
            assert any(SHOWN_LABEL in cell for cell in cells)
            assert any(cell.startswith("'=1+1|") for cell in cells)
            assert not any(cell.startswith(("=", "@")) for cell in cells)
        elif style == "latex":
            assert r"\textbackslash{}x1b]0;" in text
        elif style == "markdown":
            assert r"evil\\x1b\]0;" in text
        else:
            assert r"evil\x1b]0;" in text


@pytest.mark.all
def test_status_and_verify_name_hostile_labels(folder: Path, foreign: str) -> None:
    shutil.copytree(folder / foreign, folder / "damaged.zarr")
    chunks = folder / "damaged.zarr" / "fourier" / "fourier" / "c"
    chunk = max(path for path in (chunks / "2").rglob("*") if path.is_file())
    chunk.write_bytes(b"damaged")
    status, output, _ = printed("verify", "damaged.zarr", folder=folder)
    assert status == 1
    assert f"files/{SHOWN_LABEL}: " in output
    status, output, _ = printed("status", foreign, folder=folder)
    assert status == 3
    assert f"files/{SHOWN_LABEL}2: " in output


@pytest.mark.all
def test_pages_of_hostile_labels(folder: Path, foreign: str) -> None:
    status, _, _ = printed("report", foreign, folder=folder)
    assert status == 0
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert [character for character in harmful(page) if character != "\t"] == []
    assert f"/<wbr>{SHOWN_LABEL}" in page
    (data,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page)
    assert f"files/{SHOWN_LABEL}" in json.loads(data)["matrix"]["labels"]
    (text,) = re.findall(r'<pre id="study" tabindex="0"><code>(.*?)</code>', page, re.DOTALL)
    assert tomllib.loads(html.unescape(text)) == tomllib.loads(TOML.replace("*/*.obj", "foreign/*.obj"))


@pytest.mark.all
def test_pictures_of_hostile_labels(folder: Path, foreign: str) -> None:
    status, output, _ = printed("plot", foreign, "--format", "svg", "--output", "pictures", folder=folder)
    assert status == 0
    pictures = [Path(folder, line) for line in output.splitlines()]
    assert len(pictures) > 4
    for picture in pictures:
        # It could not be read with control characters.
        ElementTree.parse(picture)
        assert harmful(picture.read_text(encoding="utf-8")) == []


def test_spreadsheets_run_nothing() -> None:
    texts = ["=1+1", "+1", "-1+1", "@SUM(A1)", "\t=1", "\r=1", "＝1", "a=1", "", "1"]
    frame = pd.DataFrame({"=name": texts, "number": -1.5, "mixed": [-1.5, "-x", None] * 3 + [2]})
    read = list(csv.reader(io.StringIO(machine_table(frame, "csv"))))
    assert read[0] == ["'=name", "number", "mixed"]
    expected = ["'=1+1", "'+1", "'-1+1", "'@SUM(A1)", r"\t=1", r"\r=1", "'＝1", "a=1", "", "1"]
    assert [row[0] for row in read[1:]] == expected
    assert {row[1] for row in read[1:]} == {"-1.5"}
    assert [row[2] for row in read[1:4]] == ["-1.5", "'-x", ""]
    # The data themselves stay.
    assert frame["=name"].tolist() == texts


def test_markdown_has_neither_html_nor_links_nor_more_cells() -> None:
    name = r"a\|b `c` <img src=x> &lt; [d](e) *f* _g_ h_i $j$ ~k~ #l"
    shown = r"a\\\|b \`c\` \<img src=x\> \&lt; \[d\](e) \*f\* \_g\_ h_i \$j\$ \~k\~ \#l"
    table = printed_table([[name, "1"]], ["mesh", name], "markdown")
    assert table.count(shown) == 2
    assert prose([name, "b\nc"], "markdown") == f"{shown}\nb\\\\nc"


def test_latex_has_no_commands_and_no_options() -> None:
    name = "\\input{x} $y$ %z & # ~ ^ _\n"
    table = printed_table([["a", "1"], ["[9pt]", "2"], ["* b", "3"], [name, "4"]], ["mesh", "n"], "latex")
    assert not re.search(r"^\s*[\[*]", table, re.MULTILINE)
    assert not re.search(r"\\input|(?<!\\)[$%#_~^]", table)
    assert prose(["a\n\\input{x}", "b"], "latex") == "% a\\n\\input{x}\n% b"


def test_text_tables_stay_tables() -> None:
    table = printed_table([[HOSTILE, "1"], ["b", HOSTILE]], ["mesh", HOSTILE], "text")
    assert harmful(table) == []
    assert len(table.splitlines()) == 4


def test_notebooks_show_escapes() -> None:
    table = table_html(f"a {HOSTILE}", [(HOSTILE, f"b {HOSTILE}")])
    assert harmful(table) == []
    assert table.count(SHOWN) == 3


def test_plots_show_escapes() -> None:
    assert escaped(HOSTILE) == SHOWN
    assert harmful(shortened(HOSTILE)) == []
    assert len(shortened(HOSTILE, 24)) == 24
    figure = Figure()
    figure.subplots().set_title(escaped(HOSTILE))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure.savefig(io.BytesIO(), format="svg")


def test_lines_that_are_updated_in_place(capsys: pytest.CaptureFixture[str]) -> None:
    overwrite(f"1 done, {HOSTILE}")
    # Elsewhere than on a terminal, click leaves out the sequence that clears the line.
    assert capsys.readouterr().out == f"\r1 done, {SHOWN}"
    with progress_bar(1, HOSTILE) as bar:
        bar.update(1)
    assert harmful(capsys.readouterr().err) == []


def test_log_records_are_one_line_and_tracebacks_are_visible() -> None:
    try:
        raise OSError(HOSTILE)
    except OSError as error:
        record = VisibleRecord("a", logging.ERROR, "b", 1, "%s: %d", (HOSTILE, 2), (OSError, error, None))
    text = logging.Formatter("%(message)s").format(record)
    assert text.splitlines()[0] == f"{SHOWN}: 2"
    assert harmful(text) == []
    assert "OSError: evil\\x1b" in text


def test_messages_of_workers_reach_the_terminal_as_escapes(folder: Path) -> None:
    script = (
        "import logging, warnings\n"
        "from sobolev_batch.batch.cluster.clients import local_client\n"
        "def work(text):\n"
        "    logging.getLogger('sobolev_batch').error('says %s', text)\n"
        "    warnings.warn(text)\n"
        "if __name__ == '__main__':\n"
        "    with local_client(1) as client:\n"
        f"        client.submit(work, {HOSTILE!r}).result()\n"
    )
    (folder / "work.py").write_text(script)
    python = COMMAND[0]
    done = subprocess.run([python, "work.py"], capture_output=True, cwd=folder, check=True)
    errors = done.stderr.decode("utf-8", "surrogateescape")
    assert f"says {SHOWN}\n" in errors
    assert f"UserWarning: {SHOWN}\n" in errors
    assert harmful(errors) == []


@pytest.mark.all
def test_first_studies_of_hostile_folders(tmp_path: Path) -> None:
    name = HOSTILE.replace("\udcff", "")
    (tmp_path / name).mkdir()
    for level in range(3):
        sb.write_mesh(sb.icosphere(level), tmp_path / name / f"a_{level}.ply")
    (tmp_path / name / os.fsdecode(b"b\xff.ply")).write_bytes(b"")
    status, _, errors = printed("init", ".", folder=tmp_path)
    assert status == 2
    assert errors.startswith("error: . holds no mesh file that can be read: evil\\x1b]0;")
    status, output, _ = printed("init", name, folder=tmp_path)
    assert status == 0
    assert r"left out: b\udcff.ply: " in output
    text = (tmp_path / "study.toml").read_text(encoding="utf-8")
    assert harmful(text) == []
    assert Study.from_toml(tmp_path / "study.toml").families


def test_all_commands_print_through_one_module() -> None:
    package = Path(sb.__file__).parent
    for path in package.rglob("*.py"):
        if path.name not in ("output.py", "visible.py", "__main__.py"):
            # An example may print.
            code = re.sub(r'""".*?"""', "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
            assert not re.search(r"click\.(echo|secho|progressbar)|\bprint\(|std(out|err)\.write", code), path
