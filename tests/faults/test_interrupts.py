"""Ctrl-C and its like: the command ends, says how to continue, and continues."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from sobolev_batch.cli.interruption import end_process
from sobolev_batch.store.lock import LOCK_KEY
from tests.support.commands import call, finished, read_until, started, write_toml
from tests.support.processes import PATIENCE_SECONDS, wait_until

WORDS: dict[int, str] = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


@pytest.mark.parametrize(
    ("line", "number"),
    [
        ("[2/5]", signal.SIGINT),
        pytest.param("dashboard:", signal.SIGINT, marks=pytest.mark.all),
        pytest.param("[5/5]", signal.SIGINT, marks=pytest.mark.all),
        pytest.param("[2/5]", signal.SIGTERM, marks=pytest.mark.all),
    ],
)
def test_a_run_ends_and_goes_on(line: str, number: int, store_path: Path, tmp_path: Path) -> None:
    study = write_toml(tmp_path)
    with started("run", study, "--store", store_path, "--workers", "2") as process:
        before = read_until(process, line)
        _, rest = interrupted(process, number)
    assert process.returncode == 128 + number, rest
    assert rest.splitlines()[-1].startswith(f"{WORDS[number]}; the same command continues")
    assert "Traceback" not in before + rest
    assert not (store_path / LOCK_KEY).exists()
    again = call("run", study, "--store", store_path, "--workers", "1")
    assert again.returncode == 0, again.stderr
    assert "taken over" not in again.stderr


def interrupted(process: subprocess.Popen[str], number: int = signal.SIGINT) -> tuple[str, str]:
    """Interrupt a command as a terminal does, every process of it at once; what it still prints."""
    os.killpg(process.pid, number)
    return process.communicate(timeout=PATIENCE_SECONDS)


SEMAPHORE_LEFT = """
import multiprocessing, signal
from sobolev_batch.cli.interruption import Deadline, end_process

if __name__ == "__main__":
    Deadline().start()
    lock = multiprocessing.get_context("spawn").Lock()
    end_process(signal.SIGINT, "")
"""


@pytest.mark.all
def test_the_last_word_is_that_of_the_command() -> None:
    # Of a local cluster, semaphores may be left.
    done = finished(sys.executable, "-c", SEMAPHORE_LEFT)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


def test_the_last_word_takes_the_place_of_what_a_terminal_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[bytes] = []
    monkeypatch.setattr(os, "isatty", lambda number: True)
    monkeypatch.setattr(os, "write", lambda number, text: said.append(text))
    monkeypatch.setattr(os, "_exit", sys.exit)
    with pytest.raises(SystemExit):
        end_process(signal.SIGINT, "; go on")
    assert said == [b"\r\x1b[Kinterrupted; go on\n"]


# Says when the command line is about to be imported.
IMPORTING = """
import sys
import sobolev_batch.__main__ as door

class Herald:
    def find_spec(name, path=None, target=None):
        if name == "sobolev_batch.cli":
            print("here", file=sys.stderr, flush=True)

sys.meta_path.insert(0, Herald)
sys.argv[1:] = ["plan", "study.toml"]
door.main()
"""
WORKING = """
import ctypes, sys
import click
import sobolev_batch.cli as line
from sobolev_batch.cli.interruption import Deadline

@line.cli.command()
def computing():
    # A function of C, which does not return to Python while a transform goes on.
    block = ctypes.CDLL(None).pthread_mutex_lock
    mutex = ctypes.create_string_buffer(256)
    block(mutex)
    click.echo("here", err=True)
    block(mutex)  # held already

@line.cli.command()
def keeping():
    # Work that keeps what it has is asked again for each part that takes long, and is not killed.
    parts = []
    with Deadline.with_results(lambda: True):
        for part in range(3):
            try:
                click.echo("here", err=True)
                while True:
                    line.signal.pause()
            except KeyboardInterrupt:
                parts.append(part)
    click.echo(f"written: {parts}")

class Heavy:
    def __del__(self):
        click.echo("here", err=True)
        line.signal.pause()

@line.cli.command()
def forgetting():
    # A finalizer, where Python ignores every exception.
    heavy = Heavy()
    del heavy
    line.signal.pause()

sys.argv[1:] = ["%s"]
line.main()
"""
COMPUTING, KEEPING, FORGETTING = (WORKING % command for command in ("computing", "keeping", "forgetting"))


@pytest.mark.parametrize(
    ("number", "script"),
    [
        (signal.SIGINT, FORGETTING),
        pytest.param(signal.SIGTERM, FORGETTING, marks=pytest.mark.all),
        *(
            pytest.param(number, script, marks=pytest.mark.all)
            for number in WORDS
            for script in (IMPORTING, COMPUTING, KEEPING)
        ),
    ],
)
def test_a_command_ends_while_it_starts_and_computes_and_with_what_it_has(script: str, number: int) -> None:
    with started(script=script) as process:
        assert read_until(process, "here")
        if script == COMPUTING:
            wait_until(lambda: psutil.Process(process.pid).status() == psutil.STATUS_SLEEPING)
        output, rest = interrupted(process, number)
    if script == KEEPING:
        assert (process.returncode, output) == (0, "written: [0, 1, 2]\n"), rest
    else:
        word = "interrupted before anything began" if script == IMPORTING else WORDS[number]
        # The command line goes on to a new line where a Ctrl-C is raised as an exception.
        begin = "\n" if script == FORGETTING and number == signal.SIGINT else ""
        assert (process.returncode, rest) == (128 + number, f"{begin}{word}\n")
