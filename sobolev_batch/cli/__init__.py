"""The command line: sobolev-batch."""

from __future__ import annotations

import signal
import sys
import traceback
from contextlib import nullcontext, suppress
from typing import NoReturn

import click

# Importing these modules adds their commands to the group.
from sobolev_batch.cli import mesh_commands, store_commands, study_commands, table_commands  # noqa: F401
from sobolev_batch.cli.common import EXIT_INPUT, EXIT_OTHER, cli, echo, echo_lines, patience, show_usage_error
from sobolev_batch.cli.interruption import SECONDS_TO_END, Deadline, end_process, ignore_requests
from sobolev_batch.errors import InputError, SobolevBatchError, one_line
from sobolev_batch.visible import make_messages_visible

__all__ = ["cli", "main"]

# What to know about commands that were asked to end.
_REMARKS = {"run": "; the same command continues from the store"}
# These show their own.
_WITH_PROGRESS = ("run", "fit", "status", "verify", "")
# They give up their lock of a store, which takes until the storage has answered.
_SECONDS_WITH_LOCK = dict.fromkeys(("run", "submit", "verify", "prune", "unlock"), 30.0)


def main() -> None:
    """Run the command line; the process ends with its exit status."""
    debug = "--debug" in sys.argv
    command = next((argument for argument in sys.argv[1:] if not argument.startswith("-")), "")
    # Of a verdict, the status of other errors means that the files differ.
    is_verdict = command == "compare" and any(word.partition("=")[0] == "--below" for word in sys.argv)
    other = EXIT_INPUT if is_verdict else EXIT_OTHER
    # A job at its time limit is also asked to end, and has time to give up its lock of a store.
    deadline = Deadline(_REMARKS.get(command, ""), _SECONDS_WITH_LOCK.get(command, SECONDS_TO_END))
    deadline.start()
    make_messages_visible()
    try:
        with nullcontext() if command in _WITH_PROGRESS else patience(command):
            status = cli.main(standalone_mode=False)
    except click.ClickException as error:
        show_usage_error(error)
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, click.Abort):
        # Some work takes SIGTERM for an interrupt.
        _end(deadline.request or signal.SIGINT, command)
    except SystemExit as request:
        if request.code != 128 + signal.SIGTERM:
            raise
        _end(signal.SIGTERM, command)
    except Exception as error:
        if debug:
            echo_lines(traceback.format_exc().removesuffix("\n"), err=True)
            sys.exit(other)
        is_ours = isinstance(error, SobolevBatchError)
        message = str(error) if is_ours else f"{type(error).__name__}: {one_line(error)} (--debug shows where)"
        echo(f"error: {message}", err=True)
        sys.exit(EXIT_INPUT if isinstance(error, InputError) else other)
    sys.exit(status or 0)


def _end(request: int, command: str) -> NoReturn:
    """End a command that has cleaned up after itself."""
    ignore_requests()
    with suppress(OSError):
        sys.stdout.flush()
    # Without the end of the interpreter, which waits for threads that may still compute.
    end_process(request, _REMARKS.get(command, ""))
