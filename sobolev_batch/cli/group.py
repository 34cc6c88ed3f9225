"""The command sobolev-batch, which has all others as subcommands."""

from __future__ import annotations

import logging
import sys

import click

# Exit statuses; `end_process` has those after SIGINT and SIGTERM.
EXIT_OTHER, EXIT_INPUT, EXIT_SOME_FAILED = 1, 2, 3
# Of `compare --below`, beside 0 for files that are the same; like diff, which has 1 for files that differ.
EXIT_DIFFERENT, EXIT_UNDECIDED = 1, 4
# Loggers of the drivers of object storage.
_DRIVERS = ("aiobotocore", "botocore", "s3fs", "gcsfs", "google", "urllib3", "azure")


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="sobolev-batch")
@click.option("--debug", is_flag=True, help="Show tracebacks and every log message.")
@click.pass_context
def cli(context: click.Context, debug: bool) -> None:
    """Sobolev distances of negative order between surface meshes.

    A study file names families of meshes and a reference. `run` stores the Fourier transform of every
    mesh and prints its distance from the reference.

    The exit status is 0 if all is done, 1 after another error, 2 if the input is wrong, 3 if some meshes failed, 130
    after Ctrl-C and 143 after SIGTERM.
    """
    context.obj = debug
    logging.basicConfig(
        level=logging.DEBUG if debug else logging.WARNING,
        format="%(levelname)s %(name)s: %(message)s",
        stream=sys.stderr,
    )
    if debug:
        # At debug level they log requests with their signatures and session tokens.
        for driver in _DRIVERS:
            logging.getLogger(driver).setLevel(logging.INFO)
    else:
        # Not by the level of its logger, which the cluster sets itself when it is imported.
        for handler in logging.root.handlers:
            handler.addFilter(_is_shown)


def _is_shown(record: logging.LogRecord) -> bool:
    """Return whether a message is for users: those of the cluster at its start and end would only hide the table."""
    return record.levelno >= logging.ERROR or not record.name.startswith("distributed")
