"""The command line: within this process, as a process of its own, and watched while it runs."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

import sobolev_batch as sb
from sobolev_batch import cli
from sobolev_batch.cli.interruption import Deadline
from sobolev_batch.shapes import icosphere

# The study of small_table, and a smaller one.
TOML = """
[study]
name = "small"
[lattice]
xi_max = 3.0
M = 16
[norm]
orders = [-10.0, -3.0]
[compare]
pairs = "all"
[reference]
source = "sphere"
[[family]]
name = "ico"
source = "icosphere"
levels = [0, 1, 2, 3]
"""
STUDY = TOML.replace('"small"', '"cli"').replace("[0, 1, 2, 3]", "[0, 1]")

LATTICE = "[lattice]\nxi_max = 3.0\nM = 16"
_NAN = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 nan 0\n3 0 1 2\n"

COMMAND = [sys.executable, "-m", "sobolev_batch"]


def write_toml(folder: Path) -> Path:
    path = folder / "study.toml"
    path.write_text(TOML)
    return path


def ball(level: int, radius: float = 1.0) -> sb.Mesh:
    """A ball in millimetres, away from the origin."""
    return sb.Mesh(30 * radius * icosphere(level).vertices + [100.0, 0, 0], icosphere(level).triangles)


def write_inputs(folder: Path) -> None:
    """Write studies and meshes, and some that are refused."""
    for name, mesh in {"1.off": ball(1), "3.off": ball(3)}.items():
        sb.write_mesh(mesh, folder / name)
    (folder / "nan.off").write_text(_NAN)
    (folder / "study.toml").write_text(STUDY)
    # Files that are refused.
    (folder / "broken.toml").write_text(STUDY.replace("M = 16", "m = 16"))
    (folder / "other.toml").write_text(STUDY.replace('"cli"', '"other"'))
    (folder / "lacking.toml").write_text(f'{STUDY}[[family]]\nname = "f"\nsource = "files"\npaths = ["*.xyz"]')
    (folder / "greedy.toml").write_text(STUDY.replace(LATTICE, '[accuracy]\nrtol = 0.1\nmemory = "1000TB"'))
    (folder / "taken").mkdir()
    (folder / "taken" / "precious").write_text("text")


class _Terminal(StringIO):
    def isatty(self) -> bool:
        return True


def call(
    *arguments: object, folder: Path = Path(), patience_seconds: float = 1e6, columns: int = 0
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end within this process, which has imported already what a new one takes seconds for.

    With a number of columns, it prints on a terminal.
    """
    stream = _Terminal if columns else StringIO
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", str(columns))
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["sobolev-batch", *map(str, arguments)])
        # Signals, warnings and log records are the test runner's, and so are its log handlers: the command is to set up
        # its own.
        patch.setattr(Deadline, "start", lambda deadline: None)
        patch.setattr(cli, "make_messages_visible", lambda: None)
        # How long it takes decides whether it says that it goes on.
        patch.setattr("sobolev_batch.cli.output._PATIENCE_SECONDS", patience_seconds)
        patch.setattr(logging.root, "handlers", [])
        patch.setattr(logging.root, "level", logging.root.level)
        # It tells of connections that earlier tests of this process left open.
        patch.setattr(logging.getLogger("asyncio"), "disabled", True)
        with (
            redirect_stdout(stream()) as printed,
            redirect_stderr(stream()) as errors,
            pytest.raises(SystemExit) as end,
        ):
            cli.main()
    assert isinstance(end.value.code, int)
    return subprocess.CompletedProcess(sys.argv, end.value.code, printed.getvalue(), errors.getvalue())


def output(*arguments: str, folder: Path, status: int = 0) -> str:
    """What a command prints, which ends with this status."""
    done = call(*arguments, folder=folder)
    assert done.returncode == status, done.stderr
    return done.stdout


def finished(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*map(str, words)], capture_output=True, text=True, check=False, **options)


def command(*arguments: object, folder: Path = Path(), **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a command to its end as a process, as users do: for exit statuses, logs and settings of a process."""
    return finished(*COMMAND, *arguments, cwd=folder, env={**os.environ, **environment})


@contextmanager
def started(*arguments: object, script: str | None = None) -> Iterator[subprocess.Popen[str]]:
    """Run a command, or a script, in a session of its own, as in a terminal of its own."""
    words = [*COMMAND, *map(str, arguments)] if script is None else [sys.executable, "-c", script]
    pipe = subprocess.PIPE
    process = subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True, start_new_session=True)
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def read_until(process: subprocess.Popen[str], text: str) -> str:
    """Return the standard error of a command, up to the line that holds a text."""
    assert process.stderr is not None
    output = ""
    for line in process.stderr:
        output += line
        if text in line:
            return output
    raise AssertionError(f"{text!r} did not appear: {output}")
