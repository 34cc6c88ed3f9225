"""A program that makes a mesh of another one: it runs in a folder of its own, within limits, and leaves nothing."""

import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import psutil

from sobolev_batch.errors import InputError, MeshError, StudyError, one_line
from sobolev_batch.geometry.formats.readers import read_mesh
from sobolev_batch.geometry.formats.writing import write_mesh
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.parameters import format_bytes

INPUT, OUTPUT = "input", "output"
_NOTHING_KNOWN = float("nan")
# Time and bytes after which a command that prints a version is ended.
_VERSION_SECONDS, _LONGEST_VERSION = 60.0, 1_000_000
PLACEHOLDER = re.compile(r"\{(\w+)\}")
# Characters of what a program said last, in the reason of its failure.
_LONGEST_TAIL = 300
# Seconds between looks at a program that runs: at first, and at most.
_FIRST_PAUSE, _LONGEST_PAUSE = 0.005, 0.1
# Those of real time have none.
_NAMES_OF_SIGNALS = {one.value: one.name for one in signal.Signals}
# Variable of a program's environment with its folder. On Linux it shows which processes left the program's session.
_MARK = "SOBOLEV_BATCH_FOLDER"
# It is told the number of a process, if one starts. When the writer ends, however it does, it kills the session of the
# process and those that left it, and removes the folder.
_GUARD = f"""
exec 2> /dev/null
if read -r number; then
    read -r _
    kill -s KILL -- "-$number"
    for place in $(grep -lFzx -e "{_MARK}=$1" /proc/[0-9]*/environ); do
        place=${{place%/environ}}
        kill -s KILL "${{place#/proc/}}"
    done
fi
rm -rf -- "$1"
"""


@dataclass(frozen=True)
class Cost:
    """Time, memory and exit status of making a mesh; NaN where they are not known.

    Attributes:
        make_seconds: Time from the start to the end.
        make_peak_bytes: Largest memory of the process.
        exit_status: Exit status of the program; negative if a signal ended it.
    """

    make_seconds: float = _NOTHING_KNOWN
    make_cpu_seconds: float = _NOTHING_KNOWN
    make_peak_bytes: float = _NOTHING_KNOWN
    exit_status: float = _NOTHING_KNOWN


class CannotStartError(MeshError):
    """A program cannot be started, or not be given its input, whatever its parameters."""


# What making a mesh took, and the mesh, or why there is none.
Made = tuple[Cost, Mesh | str]


def environment() -> dict[str, str]:
    """Return the environment of programs: ``python`` is the one that runs this, with its libraries."""
    own = str(Path(sys.executable).parent)
    return {**os.environ, "PATH": os.pathsep.join(filter(None, (own, os.environ.get("PATH"))))}


def printed(words: Sequence[str]) -> str:
    """Return what a program prints, such as its version; StudyError where it fails, or prints without an end."""
    try:
        with tempfile.TemporaryFile() as said:
            process = subprocess.Popen(  # noqa: S603 -- the user permitted it
                words, env=environment(), stdin=subprocess.DEVNULL, stdout=said, stderr=subprocess.STDOUT
            )
            problem, *_ = _awaited(process, lambda: _size(said), _VERSION_SECONDS, _LONGEST_VERSION)
            said.seek(0)
            text = said.read(_LONGEST_VERSION).decode(errors="replace").strip()
    except (OSError, ValueError) as error:
        problem = _cannot_start(words[0], error)
    else:
        if process.returncode and not problem:
            problem = f"it ended with exit status {process.returncode}"
    if problem:
        raise StudyError(f"version: {shlex.join(words)}: {problem}")
    return text


def run_command(mesh: Mesh, words: list[str], suffixes: tuple[str, str], timeout: float, largest_output: int) -> Made:
    """Run a program on files {input} and {output}, and return its mesh, or why it failed and what it said last.

    It ends with this process at the latest. CannotStartError where it does not start.
    """
    with ExitStack() as stack:
        try:
            scratch = tempfile.TemporaryDirectory(prefix="sobolev-batch-", ignore_cleanup_errors=True)
            folder = Path(stack.enter_context(scratch))
            # Without names, so that the program can neither remove nor replace them.
            out, err = (stack.enter_context(tempfile.TemporaryFile()) for _ in range(2))
            # In a session of its own, so that what kills this process does not kill it too.
            watching = ["sh", "-c", _GUARD, "sh", str(folder)]
            guard = subprocess.Popen(watching, stdin=subprocess.PIPE, bufsize=0, start_new_session=True)  # noqa: S603
            stack.enter_context(guard)
        except OSError as error:
            problem = f"it has no scratch folder: {one_line(error)}; set TMPDIR to one that can be written"
            raise CannotStartError(problem) from error
        files = {name: folder / f"{name}{suffix}" for name, suffix in zip((INPUT, OUTPUT), suffixes, strict=True)}
        try:
            write_mesh(mesh, files[INPUT])
        except InputError as error:
            raise CannotStartError(f"its input cannot be written: {error}") from error
        filled = [PLACEHOLDER.sub(lambda found: str(files.get(found[1], found[0])), word) for word in words]
        started, marked = time.perf_counter(), environment() | {_MARK: str(folder)}
        try:
            process = subprocess.Popen(  # noqa: S603 -- the user permitted it
                filled, cwd=folder, env=marked, stdin=subprocess.DEVNULL, stdout=out, stderr=err, start_new_session=True
            )
        except (OSError, ValueError) as error:
            problem = f"{words[0]} cannot be started on this machine: {_cannot_start(words[0], error)}"
            raise CannotStartError(problem) from error
        if guard.stdin is not None:
            guard.stdin.write(b"%d\n" % process.pid)

        def written() -> int:
            return _bytes_below(folder) + _size(out) + _size(err)

        problem, cpu_seconds, peak_bytes = _awaited(process, written, timeout, largest_output)
        status = process.returncode
        cost = Cost(time.perf_counter() - started, cpu_seconds, peak_bytes, status)
        if not problem and status:
            name = _NAMES_OF_SIGNALS.get(-status, f"signal {-status}")
            problem = f"was ended by {name}" if status < 0 else f"ended with exit status {status}"
            problem = f"{words[0]} {problem}"
        if not problem and not os.path.isfile(files[OUTPUT]):
            problem = f"{words[0]} wrote no mesh (output{suffixes[1]})"
        if not problem:
            try:
                return cost, read_mesh(files[OUTPUT])
            except InputError as error:
                problem = f"{words[0]} wrote what cannot be used: {str(error).removeprefix(f'{files[OUTPUT]}: ')}"
        return cost, ": ".join(filter(None, (problem, _tail(err, out))))


def _cannot_start(word: str, error: Exception) -> str:
    is_absent = isinstance(error, FileNotFoundError) and error.filename == word
    return f"{word} is not installed, or not on the PATH" if is_absent else one_line(error)


def _awaited(
    process: subprocess.Popen[bytes], written: Callable[[], int], timeout: float, largest_output: int
) -> tuple[str, float, float]:
    """Wait for a program, and return why it was ended before its time, its processor time and its largest memory."""
    problem, pause, deadline, peak_bytes = "", _FIRST_PAUSE, time.monotonic() + timeout, float("nan")
    while True:
        # Nothing in subprocess tells the time of a single process. Its peak of memory would count that of this one.
        found, status, usage = os.wait4(process.pid, 0 if problem else os.WNOHANG)
        if found:
            process.returncode = os.waitstatus_to_exitcode(status)
            return problem, usage.ru_utime + usage.ru_stime, peak_bytes
        peak_bytes = float(np.fmax(peak_bytes, _resident_bytes(process.pid)))
        if time.monotonic() > deadline:
            problem = f"it was ended after {timeout:g} s, its timeout"
        elif (count := written()) > largest_output:
            problem = f"it was ended after it had written {format_bytes(count)}"
        if problem:
            # What else is in its session ends with the guard.
            os.kill(process.pid, signal.SIGKILL)
        time.sleep(pause)
        pause = min(2 * pause, _LONGEST_PAUSE)


def _resident_bytes(pid: int) -> float:
    """Return the memory of a process and of those that it started; NaN once it has ended."""
    with suppress(psutil.Error):
        process = psutil.Process(pid)
        return float(sum(one.memory_info().rss for one in (process, *process.children(recursive=True))))
    return float("nan")


def _bytes_below(folder: Path) -> int:
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):
                total += os.lstat(os.path.join(place, name)).st_size
    return total


def _size(file: IO[bytes]) -> int:
    return os.fstat(file.fileno()).st_size


def _tail(*files: IO[bytes]) -> str:
    """Return the end of the first file that says something, on one line."""
    for file in files:
        file.seek(max(0, _size(file) - 4 * _LONGEST_TAIL))
        if text := " ".join(file.read(4 * _LONGEST_TAIL).decode(errors="replace").split()):
            return text if len(text) <= _LONGEST_TAIL else f"... {text[-_LONGEST_TAIL:]}"
    return ""
