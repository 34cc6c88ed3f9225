"""Ctrl-C and its like: the command ends, says how to continue, and continues."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from sobolev_batch.batch.storage.lock import LOCK_KEY
from tests.support.commands import call, read_until, started, write_toml

pytestmark = pytest.mark.process

# Alone it takes two; a machine may have much else to do.
_SECONDS = 240
_POLL_SECONDS = 0.01


def interrupted(process: subprocess.Popen[str], number: int = signal.SIGINT) -> tuple[str, str]:
    """Interrupt a command as a terminal does, every process of it at once; what it still says."""
    os.killpg(process.pid, number)
    return process.communicate(timeout=_SECONDS)


@pytest.mark.parametrize(
    ("line", "number", "status", "words"),
    [
        ("[2/5]", signal.SIGINT, 130, "interrupted; the same command continues"),
        *(
            pytest.param(line, number, 128 + number, f"{word}; the same command continues", marks=pytest.mark.all)
            for line, number, word in [
                ("dashboard:", signal.SIGINT, "interrupted"),
                ("[5/5]", signal.SIGINT, "interrupted"),
                ("[2/5]", signal.SIGTERM, "terminated"),
            ]
        ),
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


SEMAPHORE_LEFT = """
import multiprocessing, signal
from sobolev_batch.cli.interruption import Deadline, end_process, raise_when_asked

if __name__ == "__main__":
    raise_when_asked(Deadline("", 30.0))
    lock = multiprocessing.get_context("spawn").Lock()
    end_process(signal.SIGINT, "")
"""


def test_the_last_word_is_that_of_the_command() -> None:
    # Of a local cluster, semaphores may be left.
    done = subprocess.run([sys.executable, "-c", SEMAPHORE_LEFT], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


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


# A command within a function of C, which does not return to Python while a transform goes on.
COMPUTING = """
import ctypes, sys
import click
import sobolev_batch.cli as line

@click.command("compute")
def compute():
    block = ctypes.CDLL(None).pthread_mutex_lock
    mutex = ctypes.create_string_buffer(256)
    block(mutex)
    click.echo("computes", err=True)
    block(mutex)  # held already

line.cli.add_command(compute, sys.argv[1])
line.main()
"""


@pytest.mark.parametrize("command", ["compare", "table"])
@pytest.mark.parametrize(
    ("number", "status", "word"), [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")]
)
def test_a_command_ends_while_a_library_computes(command: str, number: int, status: int, word: str) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", COMPUTING, command], stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert read_until(process, "computes")
    while psutil.Process(process.pid).status() != psutil.STATUS_SLEEPING:
        time.sleep(_POLL_SECONDS)
    _, rest = interrupted(process, number)
    assert (process.returncode, rest) == (status, f"{word}\n")


# Work that keeps what it has is asked again for each part that takes long, and is not killed.
KEEPING = """
import signal, sys, time
import click
import sobolev_batch.cli as line
from sobolev_batch.cli.interruption import Deadline

@click.command("keep")
def keep():
    parts = []
    with Deadline.with_results(lambda: True):
        for part in range(3):
            try:
                click.echo("works", err=True)
                while True:
                    time.sleep({limit})
            except KeyboardInterrupt:
                parts.append(part)
    time.sleep(0.01)
    click.echo(f"written: {{parts}}")

line.cli.add_command(keep, "keep")
sys.argv = ["sobolev-batch", "keep"]
line.main()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_work_that_keeps_what_it_has_is_asked_again_and_not_killed(number: int) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", KEEPING.format(limit=_SECONDS)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert read_until(process, "works")
    process.send_signal(number)
    output, rest = process.communicate(timeout=_SECONDS)
    assert (process.returncode, output) == (0, "written: [0, 1, 2]\n"), rest


@pytest.mark.all
def test_a_status_that_is_followed_ends_without_a_traceback(store_path: Path, tmp_path: Path) -> None:
    with started("run", write_toml(tmp_path), "--store", store_path, "--workers", "1") as process:
        read_until(process, "[1/5]")
        process.send_signal(signal.SIGSTOP)
        with started("status", store_path, "--follow") as follower:
            assert follower.stdout is not None
            line = follower.stdout.readline()
            assert re.match(r"[1-5] of 5 done, 0 failed", line), line
            output, rest = interrupted(follower, signal.SIGTERM)
            assert (follower.returncode, rest) == (143, "terminated\n"), output
