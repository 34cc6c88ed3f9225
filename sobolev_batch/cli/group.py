"""The command sobolev-batch, which has all others as subcommands."""

from __future__ import annotations

import logging
import sys

import click

# Exit statuses; shells expect the last two after SIGINT and SIGTERM.
EXIT_OTHER, EXIT_INPUT, EXIT_SOME_FAILED, EXIT_INTERRUPTED, EXIT_TERMINATED = 1, 2, 3, 130, 143
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

    Exit status: 0 all done, 1 another error, 2 wrong input, 3 some meshes failed.
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
        # The cluster's messages at shutdown would only hide the table.
        logging.getLogger("distributed").setLevel(logging.ERROR)
