"""The command line: sobolev-batch."""

from __future__ import annotations

import sys

import click

# Importing these modules adds their commands to the group.
from sobolev_batch.cli import fitting, meshes, stores, studies  # noqa: F401
from sobolev_batch.cli.group import EXIT_INPUT, EXIT_INTERRUPTED, EXIT_OTHER, EXIT_TERMINATED, cli
from sobolev_batch.cli.interruption import Terminated, ignore_requests, raise_when_asked
from sobolev_batch.errors import InputError, SobolevBatchError

__all__ = ["cli", "main"]

# What to know about commands that were asked to end.
_REMARKS = {"run": "; the same command continues from the store"}


def main() -> None:
    """Run the command line; the process ends with its exit status."""
    debug = "--debug" in sys.argv
    command = next((argument for argument in sys.argv[1:] if not argument.startswith("-")), "")
    # A job at its time limit is asked to end, too, and has time to give up its lock of a store.
    raise_when_asked()
    try:
        status = cli.main(standalone_mode=False)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, click.Abort):
        ignore_requests()
        click.echo(f"interrupted{_REMARKS.get(command, '')}", err=True)
        sys.exit(EXIT_INTERRUPTED)
    except Terminated:
        ignore_requests()
        click.echo(f"terminated{_REMARKS.get(command, '')}", err=True)
        sys.exit(EXIT_TERMINATED)
    except Exception as error:
        if debug:
            raise
        is_ours = isinstance(error, SobolevBatchError)
        message = str(error) if is_ours else f"{type(error).__name__}: {error} (--debug shows where)"
        click.echo(f"error: {message}", err=True)
        sys.exit(EXIT_INPUT if isinstance(error, InputError) else EXIT_OTHER)
    sys.exit(status or 0)
