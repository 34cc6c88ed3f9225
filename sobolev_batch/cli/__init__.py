"""The command line: sobolev-batch.

In: words. Out: text for people, JSON for programs, exit statuses.
"""

import signal
import sys

import click

# Importing these modules adds their commands to the group.
from sobolev_batch.cli import mesh_commands, store_commands, study_commands, table_commands  # noqa: F401
from sobolev_batch.cli.interruption import Deadline
from sobolev_batch.cli.output import show_usage_error
from sobolev_batch.cli.program import cli
from sobolev_batch.visible import make_messages_visible

__all__ = ["cli", "main"]


def main() -> None:
    """Run the command line; the process ends with its exit status."""
    # A job at its time limit is also asked to end, and has time to give up its lock of a store.
    deadline = Deadline()
    deadline.start()
    make_messages_visible()
    try:
        status = cli.main(standalone_mode=False, obj=deadline)
    except click.ClickException as error:
        show_usage_error(error)
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, click.Abort):
        # Some work takes SIGTERM for an interrupt.
        deadline.end(deadline.request or signal.SIGINT)
    except SystemExit as request:
        if request.code != 128 + signal.SIGTERM:
            raise
        deadline.end(signal.SIGTERM)
    sys.exit(status or 0)
