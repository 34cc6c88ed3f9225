"""Ctrl-C and its like: the command ends, says how to continue, and continues."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sobolev_batch.batch.storage.lock import LOCK_KEY
from tests.support.commands import call, read_until, started, write_toml

# Alone it takes two; a machine may have much else to do.
_SECONDS = 240


def interrupted(process: subprocess.Popen[str], number: int = signal.SIGINT) -> tuple[str, str]:
    """Interrupt a command as a terminal does, every process of it at once; what it still says."""
    os.killpg(process.pid, number)
    return process.communicate(timeout=_SECONDS)


@pytest.mark.parametrize(
    ("line", "number", "status", "words"),
    [
        ("dashboard:", signal.SIGINT, 130, "interrupted; the same command continues"),
        ("[2/5]", signal.SIGINT, 130, "interrupted; the same command continues"),
        ("[5/5]", signal.SIGINT, 130, "interrupted; the same command continues"),
        ("[2/5]", signal.SIGTERM, 143, "terminated; the same command continues"),
    ],
)
def test_a_run_ends_and_goes_on(
    line: str, number: int, status: int, words: str, store_path: Path, tmp_path: Path
) -> None:
    study = write_toml(tmp_path)
    with started("run", study, "--store", store_path, "--workers", "2") as process:
        said = read_until(process, line)
        _, rest = interrupted(process, number)
    assert process.returncode == status, rest
    assert rest.splitlines()[-1].startswith(words)
    assert "Traceback" not in said + rest
    assert not (store_path / LOCK_KEY).exists()
    again = call("run", study, "--store", store_path, "--workers", "1")
    assert again.returncode == 0, again.stderr
    assert "taken over" not in again.stderr


# Says when the command line is about to be imported.
IMPORTING = """
import sys
import sobolev_batch.__main__ as door

class Herald:
    def find_spec(name, path=None, target=None):
        if name == "sobolev_batch.cli":
            print("here", flush=True)

sys.meta_path.insert(0, Herald)
door.main()
"""


def test_a_command_that_has_not_begun_says_so(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", IMPORTING, "run", str(write_toml(tmp_path)), "--store", str(tmp_path / "s.zarr")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "here\n"
    _, rest = interrupted(process)
    assert process.returncode == 130, rest
    assert rest.strip().startswith("interrupted")
    assert len(rest.strip().splitlines()) == 1
    assert not (tmp_path / "s.zarr").exists()


# A command that is asked to end while a finalizer runs, where Python reports what is raised and goes on.
IN_A_FINALIZER = """
import signal, sys, time
import click
import sobolev_batch.cli as line

class Finalized:
    def __del__(self):
        signal.raise_signal({number})
        time.sleep(0)

@line.cli.command("finalize")
def finalize():
    Finalized()
    click.echo("goes on", err=True)
    time.sleep(2 * {limit})

sys.argv = ["sobolev-batch", "finalize"]
line.main()
"""


@pytest.mark.parametrize(
    ("number", "status", "word"), [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")]
)
def test_a_request_within_a_finalizer_is_heard(number: int, status: int, word: str) -> None:
    script = IN_A_FINALIZER.format(number=int(number), limit=_SECONDS)
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=_SECONDS)
    lines = [line for line in found.stderr.splitlines() if line]
    assert lines[0] == "goes on"
    assert lines[1:] == [word]
    assert found.returncode == status
