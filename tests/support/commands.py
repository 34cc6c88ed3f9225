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

from sobolev_batch import cli
from sobolev_batch.cli import common
from sobolev_batch.cli.interruption import Deadline

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

COMMAND = [sys.executable, "-m", "sobolev_batch"]


def write_toml(folder: Path) -> Path:
    path = folder / "study.toml"
    path.write_text(TOML)
    return path


def call(*arguments: object, folder: Path = Path(), patience_seconds: float = 1e6) -> subprocess.CompletedProcess[str]:
    """Run a command to its end within this process, which has imported already what a new one takes seconds for."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["sobolev-batch", *map(str, arguments)])
        # Signals, warnings and log records are the test runner's, and so are its log handlers: the command is to set up
        # its own.
        patch.setattr(Deadline, "start", lambda deadline: None)
        patch.setattr(cli, "make_messages_visible", lambda: None)
        # How long it takes decides whether it says that it goes on.
        patch.setattr(common, "_PATIENCE_SECONDS", patience_seconds)
        patch.setattr(logging.root, "handlers", [])
        patch.setattr(logging.root, "level", logging.root.level)
        # It tells of connections that earlier tests of this process left open.
        patch.setattr(logging.getLogger("asyncio"), "disabled", True)
        with (
            redirect_stdout(StringIO()) as output,
            redirect_stderr(StringIO()) as errors,
            pytest.raises(SystemExit) as end,
        ):
            cli.main()
    assert isinstance(end.value.code, int)
    return subprocess.CompletedProcess(sys.argv, end.value.code, output.getvalue(), errors.getvalue())


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
