"""The command sobolev-batch itself, which its subcommands join."""

from __future__ import annotations

import logging
import sys

import click

# Of a command that has begun; EXIT_INTERRUPTED and EXIT_TERMINATED as shells expect them.
EXIT_OTHER, EXIT_INPUT, EXIT_SOME_FAILED, EXIT_INTERRUPTED, EXIT_TERMINATED = 1, 2, 3, 130, 143
# Of object storage, by the names of their loggers.
_DRIVERS = ("aiobotocore", "botocore", "s3fs", "gcsfs", "google", "urllib3", "azure")


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="sobolev-batch")
@click.option("--debug", is_flag=True, help="Show tracebacks and every log message.")
@click.pass_context
def cli(context: click.Context, debug: bool) -> None:
    """Sobolev distances of negative order between surface meshes.

    A study file names families of meshes and a reference; `run` stores the Fourier field of every
    mesh and prints how far each is from the reference.

    Exit status: 0 all done, 2 the input is wrong, 3 some meshes failed, 1 anything else.
    """
    context.obj = debug
    logging.basicConfig(
        level=logging.DEBUG if debug else logging.WARNING,
        format="%(levelname)s %(name)s: %(message)s",
        stream=sys.stderr,
    )
    if debug:
        # Below that they log what they send, with its signature and a session's token.
        for driver in _DRIVERS:
            logging.getLogger(driver).setLevel(logging.INFO)
    else:
        # The cluster's own messages at shutdown are of no use to someone who reads a table.
        logging.getLogger("distributed").setLevel(logging.ERROR)
