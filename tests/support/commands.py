"""The command line as a process of its own, watched while it runs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

TOML = """
study.name = "small"
norm.orders = [-10.0, -3.0]
lattice = { xi_max = 3.0, M = 16 }
reference.source = "sphere"
[[family]]
name = "ico"
source = "icosphere"
levels = [0, 1, 2, 3]
"""

COMMAND = [sys.executable, "-m", "sobolev_batch"]


def write_toml(folder: Path) -> Path:
    """The small study as a file."""
    path = folder / "study.toml"
    path.write_text(TOML)
    return path


def command(*arguments: object) -> subprocess.CompletedProcess[str]:
    """A command, run to its end."""
    return subprocess.run([*COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=200, check=False)


@contextmanager
def started(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """A command that runs in a session of its own, as in a terminal of its own."""
    process = subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def read_until(process: subprocess.Popen[str], text: str) -> str:
    """What a command says on standard error, up to the line that holds a text."""
    assert process.stderr is not None
    said = ""
    for line in process.stderr:
        said += line
        if text in line:
            return said
    raise AssertionError(f"never said {text!r}: {said}")


def call(*arguments: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*COMMAND, *arguments],
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=120,
        check=False,
        env={**os.environ, **environment},
    )


STUDY = """
[study]
name = "cli"
[lattice]
xi_max = 3.0
M = 16
[norm]
orders = [-10.0, -3.0]
[reference]
source = "sphere"
[[family]]
name = "ico"
source = "icosphere"
levels = [0, 1]
"""
