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

# Limit of every command, for a machine that does much else.
PATIENCE_SECONDS = 200
COMMAND = [sys.executable, "-m", "sobolev_batch"]


def write_toml(folder: Path) -> Path:
    """Write the small study to a file."""
    path = folder / "study.toml"
    path.write_text(TOML)
    return path


def command(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    return subprocess.run(
        [*COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=PATIENCE_SECONDS, check=False
    )


@contextmanager
def started(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """Run a command in a session of its own, as in a terminal of its own."""
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
    """Return the standard error of a command, up to the line that holds a text."""
    assert process.stderr is not None
    output = ""
    for line in process.stderr:
        output += line
        if text in line:
            return output
    raise AssertionError(f"{text!r} did not appear: {output}")


def call(*arguments: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder, with further variables in its environment."""
    return subprocess.run(
        [*COMMAND, *arguments],
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=PATIENCE_SECONDS,
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
