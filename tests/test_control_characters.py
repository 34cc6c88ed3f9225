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
import sys
import tomllib
import unicodedata
from pathlib import Path
from xml.etree import ElementTree

import click
import pandas as pd
import pytest
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.cli import cli
from sobolev_batch.cli.output import EchoHandler, echo, lengthen, progress_bar, replace_line, show_usage_error
from sobolev_batch.sources import files
from sobolev_batch.tables import FORMATS
from sobolev_batch.tables.rendering import machine_table, printed_table, prose
from sobolev_batch.visible import VisibleRecord, visible, visible_lines
from tests.support.commands import COMMAND, call

pytestmark = pytest.mark.process

# The title of a terminal, a bell, a line of its own, a turn of the direction of text, and a byte that is no UTF-8.
HOSTILE = "evil\x1b]0;owned\x07\nerror: \x9b31m\u202e\u2028\udcff"
SHOWN = r"evil\x1b]0;owned\x07\nerror: \x9b31m\u202e\u2028\udcff"
# A store holds text as UTF-8.
LABEL, SHOWN_LABEL = HOSTILE.removesuffix("\udcff"), SHOWN.removesuffix(r"\udcff")
# All of this is allowed in the name of a family.
FAMILY = "=1+1|`id` <img src=x> $x_1$ %&#~^{} [a](b) *_b_*"
TOML = f"""
lattice = {{ xi_max = 3.0, M = 16 }}
norm.orders = [-10.0]
compare.pairs = "all"
reference.source = "sphere"
[study]
name = "hostile"
title = '{FAMILY}'
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


def harmful(text: str) -> set[str]:
    """The characters that a terminal obeys, or that show the next ones elsewhere or not at all; lines may end."""
    return {c for c in text if unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") or c in DIRECTIONS} - {"\n"}


def printed(*arguments: object, folder: Path) -> tuple[int, str]:
    """The status of a command, and what it printed, in which no name begins a line."""
    done = call(*arguments, folder=folder)
    text = done.stdout + done.stderr
    assert not harmful(text)
    assert "\nerror: \\x9b" not in f"\n{text}"
    return done.returncode, text


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with hostile names, a mesh and a file that is none."""
    folder = tmp_path_factory.mktemp("hostile")
    (folder / HOSTILE).mkdir()
    sb.write_mesh(sb.shapes.icosphere(1), folder / HOSTILE / "good.obj")
    sb.write_mesh(sb.shapes.icosphere(2), folder / f"{HOSTILE}.obj")
    (folder / HOSTILE / "broken.obj").write_text("v 1 2\x1b[31m\n")
    return folder


@pytest.fixture(scope="module")
def foreign(folder: Path, client: Client) -> str:
    """A store whose labels this package would not have written."""
    (folder / "foreign").mkdir()
    sb.write_mesh(sb.shapes.icosphere(1), folder / "foreign" / f"{LABEL}.obj")
    (folder / "foreign" / f"{LABEL}2.obj").write_text("no mesh")
    table = tomllib.loads(TOML.replace("*/*.obj", "foreign/*.obj"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "label_problem", lambda name: None)
        sb.run(sb.Study.from_table(table, folder=folder), folder / "foreign.zarr", client)
    return "foreign.zarr"


def test_harmful_characters_are_escapes_and_others_stay() -> None:
    for character in (*map(chr, range(0x20)), "\x7f", "\x80", "\x9b", "\u2029", "\ud800", *DIRECTIONS):
        shown = visible(f"a{character}b")
        assert re.fullmatch(r"a\\([nrt]|x[0-9a-f]{2}|u[0-9a-f]{4})b", shown)
        assert visible(shown) == shown
    text = "Ärger, 日本, שלום, 👩‍🚀, \u00a0 and \\x1b"
    assert visible(text) == text
    assert visible_lines("a\nb\rc") == "a\nb\\rc"
    record = VisibleRecord("a", logging.ERROR, "b", 1, "%s: %d", (HOSTILE, 2), (OSError, OSError(HOSTILE), None))
    text = logging.Formatter("%(message)s").format(record)
    assert text.splitlines()[0] == f"{SHOWN}: 2"
    assert not harmful(text)


def test_a_process_shows_names_and_reasons_of_its_workers_too(folder: Path) -> None:
    # What is listed and not there is logged by the driver; a worker cannot read what is broken.
    listed = TOML.replace('"*/*.obj"', f'"*/*.obj", {json.dumps(LABEL + "/gone.obj")}')
    (folder / "study.toml").write_text(listed)
    command = [*COMMAND, "run", "study.toml", "--workers", "1"]
    done = subprocess.run(command, capture_output=True, cwd=folder, check=False)
    output, errors = (part.decode("utf-8", "surrogateescape") for part in (done.stdout, done.stderr))
    assert done.returncode == 3
    assert not harmful(output + errors)
    assert f"files/broken: failed, {folder}/{SHOWN}/broken.obj: " in errors
    assert f"files/broken failed: {folder}/{SHOWN}/broken.obj: " in output
    assert f"warning: files/gone: {folder}/{SHOWN_LABEL}/gone.obj: " in errors


WORK = """
import logging, warnings
from sobolev_batch.batch.cluster.clients import local_client
def work(text):
    logging.getLogger("sobolev_batch").error("says %s", text)
    warnings.warn(text)
if __name__ == "__main__":
    with local_client(1) as client:
        client.submit(work, {}).result()
"""


def test_messages_of_workers_reach_the_terminal_as_escapes(folder: Path) -> None:
    (folder / "work.py").write_text(WORK.format(repr(HOSTILE)))
    done = subprocess.run([COMMAND[0], "work.py"], capture_output=True, cwd=folder, check=True)
    errors = done.stderr.decode("utf-8", "surrogateescape")
    assert f"says {SHOWN}\n" in errors
    assert f"UserWarning: {SHOWN}\n" in errors
    assert not harmful(errors)


def test_commands_show_names_of_files(folder: Path) -> None:
    for arguments in (
        ("table", f"{HOSTILE}/none.zarr"),
        ("table", HOSTILE, "--format", HOSTILE),
        ("table", HOSTILE, f"--{HOSTILE}"),
        ("unlock", f"{HOSTILE}.zarr"),
        ("compare", f"{HOSTILE}/good.obj", f"{HOSTILE}/broken.obj"),
        ("compare", f"{HOSTILE}.obj", f"{HOSTILE}/good.obj", "--within", "90%"),
        ("fit", f"{HOSTILE}/good.obj", f"{HOSTILE}/good.obj", "-o", f"{HOSTILE}/none/a.obj"),
        ("run", f"{HOSTILE}.toml"),
    ):
        assert r"evil\x1b]0;owned\x07" in printed(*arguments, folder=folder)[1], arguments
    for key in ("title", "name"):
        # TOML spells them as JSON does.
        before, _, after = re.split(rf"(?m)^({key} = .*)$", TOML, maxsplit=1)
        (folder / "refused.toml").write_text(f"{before}{key} = {json.dumps(LABEL)}{after}")
        status, text = printed("run", "refused.toml", folder=folder)
        assert status == 2
        assert "it holds the invisible character U+001B" in text


def test_commands_show_labels(folder: Path, foreign: str) -> None:
    texts = {style: printed("table", foreign, "--format", style, folder=folder)[1] for style in FORMATS}
    # Programs get the names.
    assert any(row["name"] == LABEL for row in json.loads(texts["json"]))
    cells = [cell for row in csv.reader(io.StringIO(texts["csv"])) for cell in row]
    assert {f"files/{SHOWN_LABEL}", f"'{FAMILY}"} <= set(cells)
    assert r"\textbackslash{}x1b]0;" in texts["latex"]
    assert r"evil\\x1b\]0;" in texts["markdown"]
    assert r"evil\x1b]0;" in texts["text"]
    shutil.copytree(folder / foreign, folder / "damaged.zarr")
    chunks = folder / "damaged.zarr" / "fourier" / "fourier" / "c"
    max(path for path in (chunks / "2").rglob("*") if path.is_file()).write_bytes(b"damaged")
    assert f"files/{SHOWN_LABEL}: " in printed("verify", "damaged.zarr", folder=folder)[1]
    assert f"files/{SHOWN_LABEL}2: " in printed("status", foreign, folder=folder)[1]


def test_pages_and_pictures_of_hostile_labels(folder: Path, foreign: str) -> None:
    assert printed("report", foreign, folder=folder)[0] == 0
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert harmful(page) <= {"\t"}
    assert f"/<wbr>{SHOWN_LABEL}" in page
    (data,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page)
    assert f"files/{SHOWN_LABEL}" in json.loads(data)["matrix"]["labels"]
    (text,) = re.findall(r'<pre id="study" tabindex="0"><code>(.*?)</code>', page, re.DOTALL)
    assert tomllib.loads(html.unescape(text)) == tomllib.loads(TOML.replace("*/*.obj", "foreign/*.obj"))
    _, output = printed("plot", foreign, "--format", "svg", "--output", "pictures", folder=folder)
    pictures = re.findall(r"^pictures/.*\.svg$", output, re.M)
    assert len(pictures) == 4
    for picture in pictures:
        # It could not be read with control characters.
        ElementTree.parse(folder / picture)
        assert not harmful((folder / picture).read_text(encoding="utf-8"))


def test_cells_are_neither_formulas_nor_markup_nor_commands() -> None:
    texts = ["=1+1", "+1", "-1+1", "@SUM(A1)", "\t=1", "\r=1", "＝1", "a=1", "", "1"]
    frame = pd.DataFrame({"=name": texts, "mixed": [-1.5, "-x", None] * 3 + [2]})
    read = list(csv.reader(io.StringIO(machine_table(frame, "csv"))))
    expected = ["'=1+1", "'+1", "'-1+1", "'@SUM(A1)", r"\t=1", r"\r=1", "'＝1", "a=1", "", "1"]
    assert [row[0] for row in read] == ["'=name", *expected]
    assert [row[1] for row in read[1:4]] == ["-1.5", "'-x", ""]
    # The data themselves stay.
    assert frame["=name"].tolist() == texts
    name = r"a\|b `c` <img src=x> &lt; [d](e) *f* _g_ h_i $j$ ~k~ #l"
    shown = r"a\\\|b \`c\` \<img src=x\> \&lt; \[d\](e) \*f\* \_g\_ h_i \$j\$ \~k\~ \#l"
    assert printed_table([[name, "1"]], ["mesh", name], "markdown").count(shown) == 2
    assert prose([name, "b\nc"], "markdown") == f"{shown}\nb\\\\nc"
    name = "\\input{x} $y$ %z & # ~ ^ _\n"
    table = printed_table([["a", "1"], ["[9pt]", "2"], ["* b", "3"], [name, "4"]], ["mesh", "n"], "latex")
    assert not re.search(r"^\s*[\[*]|\\input|(?<!\\)[$%#_~^]", table, re.MULTILINE)
    assert prose(["a\n\\input{x}", "b"], "latex") == "% a\\n\\input{x}\n% b"
    assert len(printed_table([[HOSTILE, "1"], ["b", HOSTILE]], ["mesh", HOSTILE], "text").splitlines()) == 4


def test_choices_of_an_option_that_lacks_are_indented(capsys: pytest.CaptureFixture[str]) -> None:
    option = click.Option(["--to"], type=click.Choice(["csv", "nc"]), required=True)
    show_usage_error(click.MissingParameter(param=option))
    show_usage_error(click.UsageError("a\tb"))
    assert capsys.readouterr().err.splitlines()[1:] == ["  csv,", "  nc", r"error: a\tb"]


def test_help_in_place_of_arguments_has_its_lines(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(click.ClickException) as caught:
        cli.main([], standalone_mode=False)
    show_usage_error(caught.value)
    shown = capsys.readouterr().err
    assert shown.startswith("Usage: ")
    assert "\\n" not in shown


def test_lines_that_are_updated_in_place(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    replace_line(f"1 done, {HOSTILE}", "")
    monkeypatch.undo()
    assert capsys.readouterr().out == f"\r\x1b[K1 done, {SHOWN}"
    with progress_bar(1, HOSTILE) as bar:
        bar.update(1)
    assert not harmful(capsys.readouterr().err)


def test_a_message_takes_the_place_of_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(logging.root, "handlers", [EchoHandler()])
    with progress_bar(3, "transforms") as bar:
        bar.update(1)
        echo("a message", err=True)
        bar.update(1)
        logging.getLogger("sobolev_batch").warning("a warning")
        bar.update(1)
    first, second, *bar_of_all = terminal.getvalue().split("\n")
    # Before it stands what was cleared.
    assert first.endswith("\r\x1b[Ka message")
    assert second.endswith("\r\x1b[Ka warning")
    assert "3/3" in bar_of_all[0]


def test_a_bar_that_is_full_goes_on_with_the_next_object() -> None:
    with progress_bar(1, "fields") as bar:
        bar.update(1)
        lengthen(bar, 3)
        bar.update(1)
        assert bar.pct == 0.5


def test_first_studies_of_hostile_folders(tmp_path: Path) -> None:
    (tmp_path / LABEL).mkdir()
    sb.write_mesh(sb.shapes.icosphere(0), tmp_path / LABEL / "a.ply")
    (tmp_path / os.fsdecode(b"b\xff.ply")).write_bytes(b"")
    status, text = printed("init", LABEL, folder=tmp_path)
    assert status == 2
    assert f"{SHOWN_LABEL}: its path cannot be in a study file" in text
    for level in range(3):
        sb.write_mesh(sb.shapes.icosphere(level), tmp_path / f"a_{level}.ply")
    status, text = printed("init", ".", folder=tmp_path)
    assert status == 0
    assert r"left out: b\udcff.ply: " in text
    assert not harmful((tmp_path / "study.toml").read_text(encoding="utf-8"))


def test_all_commands_print_through_one_module() -> None:
    for path in Path(sb.__file__).parent.rglob("*.py"):
        if path.name not in ("output.py", "visible.py", "__main__.py"):
            # An example may print.
            code = re.sub(r'""".*?"""', "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
            assert not re.search(r"click\.(echo|secho|progressbar)|\bprint\(|std(out|err)\.write", code), path
