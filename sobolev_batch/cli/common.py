"""The command sobolev-batch, which has all others as subcommands; the options and the output that they share.

All that commands print passes through here, so that no name reaches a terminal as a command.

The modules of commands import whatever computes inside of their functions: with it, a command would take seconds to
show its help.
"""

from __future__ import annotations

import logging
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from sobolev_batch.tables import FORMATS
from sobolev_batch.visible import visible, visible_lines

if TYPE_CHECKING:
    from sobolev_batch.batch.cluster.execution import Progress
    from sobolev_batch.store.location import Location

# Exit statuses; `end_process` has those after SIGINT and SIGTERM.
EXIT_OTHER, EXIT_INPUT, EXIT_SOME_FAILED = 1, 2, 3
# Of `compare --below`, beside 0 for files that are the same; like diff, which has 1 for files that differ.
EXIT_DIFFERENT, EXIT_UNDECIDED = 1, 4
PATH = click.Path(path_type=Path)
# Loggers of the drivers of object storage.
_DRIVERS = ("aiobotocore", "botocore", "s3fs", "gcsfs", "google", "urllib3", "azure")

_CLEAR_LINE = "\r\x1b[K"
# Time after which a silent command says that it goes on, and that between such lines without a terminal.
_PATIENCE_SECONDS, _SECONDS_BETWEEN_LINES = 2.0, 30.0
_is_answered = threading.Event()
_reporter: threading.Thread | None = None

Command = TypeVar("Command", bound=Callable[..., Any])


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="sobolev-batch")
@click.option("--debug", is_flag=True, help="Show tracebacks and every log message.")
@click.pass_context
def cli(context: click.Context, debug: bool) -> None:
    """Sobolev distances of negative order between surface meshes.

    A study file names families of meshes and a reference. `run` stores the Fourier transform of every
    mesh and prints its distance from the reference.

    The exit status is 0 if all is done, 2 if the input is wrong, 3 if some meshes failed or are missing, 1 after
    another error, 130 after Ctrl-C and 143 after SIGTERM. `compare --below` has its own.
    """
    context.obj = debug
    logging.basicConfig(
        level=logging.DEBUG if debug else logging.WARNING,
        format="%(kind)s %(name)s: %(message)s" if debug else "%(kind)s: %(message)s",
        stream=sys.stderr,
    )
    for handler in logging.root.handlers:
        handler.addFilter(_with_kind)
    if debug:
        # At debug level they log requests with their signatures and session tokens.
        for driver in _DRIVERS:
            logging.getLogger(driver).setLevel(logging.INFO)
    else:
        # Not by the level of its logger, which the cluster sets itself when it is imported.
        for handler in logging.root.handlers:
            handler.addFilter(_is_shown)


def _with_kind(record: logging.LogRecord) -> bool:
    """Add the level of a message as commands print it."""
    record.kind = record.levelname.lower()
    return True


def _is_shown(record: logging.LogRecord) -> bool:
    """Return whether a message is for users: those of the cluster at its start and end would only hide the table."""
    return record.levelno >= logging.ERROR or not record.name.startswith("distributed")


def _numbers(value: Any) -> tuple[float, ...]:
    """Return one number, or several with commas between them."""
    try:
        # A default was converted already.
        return value if isinstance(value, tuple) else tuple(float(part) for part in str(value).split(","))
    except ValueError as error:
        raise click.BadParameter(f"{value!r} is neither a number nor a list of numbers such as -4,-6") from error


def orders_option(text: str, default: str) -> Callable[[Command], Command]:
    """Return the option --order of a command, which takes several orders: each once, as they are given."""

    def flattened(context: click.Context, param: click.Parameter, lists: tuple[tuple[float, ...], ...]) -> Any:
        return tuple(dict.fromkeys(number for numbers in lists for number in numbers))

    return click.option(
        *("--order", "orders"),
        type=_numbers,
        multiple=True,
        callback=flattened,
        metavar="ORDERS",
        help=f"{text} Give several as --order -4,-6, or repeat the option. [default: {default}]",
    )


def meshes_option(text: str, default: str) -> Callable[[Command], Command]:
    """Return the option --mesh of a command, which takes labels of meshes."""
    return click.option(
        *("--mesh", "meshes"),
        multiple=True,
        metavar="MESH",
        help=f"{text} A pattern such as 'scans/*' stands for several. The option may be repeated. [default: {default}]",
    )


def location(value: Any) -> Location:
    """Return the location of a store that an option names."""
    from sobolev_batch.store.location import Location

    return Location.parse(value)


def memory_size(value: Any) -> int:
    """Return the bytes of a size such as 4GB."""
    from sobolev_batch.parameters import byte_count

    return byte_count(value)


store_argument = click.argument("store", type=location, metavar="STORE")
store_option = click.option(
    "--store", type=location, metavar="PATH|URL", help="Keep the results in this store. [default: storage/NAME.zarr]"
)
format_option = click.option(
    *("--format", "style"),
    type=click.Choice(FORMATS),
    default="text",
    show_default=True,
    help="Print text, markdown or latex for people, csv or json for programs.",
)
json_option = click.option(
    *("--format", "style"),
    type=click.Choice(["text", "json"]),
    default="text",
    show_default=True,
    help="Print text for people, or one JSON document for programs.",
)
study_argument = click.argument("study", type=PATH)
best_effort_option = click.option(
    "--best-effort",
    is_flag=True,
    help="Take the nearest attainable accuracy where the requested one is out of reach, and mark it.",
)
allow_commands_option = click.option(
    "--allow-commands", is_flag=True, help="Let the commands of STUDY run, which make its meshes: you trust its file."
)
trust_option = click.option(
    "--trust-network",
    is_flag=True,
    help="Use a scheduler that is neither encrypted (tls://) nor on loopback. Everyone who reaches its ports or "
    "those of its workers can then run programs on these machines and read the meshes.",
)
folder_option = click.option(
    "--folder",
    type=PATH,
    default=".",
    help="Rebuild the meshes of the study with its relative paths starting here. [default: current folder]",
)
up_option = click.option(
    "--up",
    type=click.Choice(["x", "y", "z"]),
    help="Draw the meshes with this axis pointing up. [default: y or z, what they seem to rest on]",
)


def output_option(text: str, default: str) -> Callable[[Command], Command]:
    """Return the option --output of a command that writes files."""
    return click.option("--output", type=PATH, default=default, show_default=True, help=text)


def below_option(text: str, *, required: bool = False) -> Callable[[Command], Command]:
    """Return the option --below of a command: a fraction of the norm of the reference, such as 0.01 or 1%."""

    def fraction_of_norm(value: str) -> float:
        from sobolev_batch.parameters import fraction

        return fraction(value)

    return click.option("--below", type=fraction_of_norm, metavar="FRACTION", required=required, help=text)


@contextmanager
def patience(command: str) -> Iterator[None]:
    """Report on standard error, from two seconds on and until something is printed, that a command goes on."""
    global _reporter
    began, is_terminal = time.monotonic(), sys.stderr.isatty()

    def report() -> None:
        wait, shown = _PATIENCE_SECONDS, False
        while not _is_answered.wait(wait):
            text = f"{command}: {time.monotonic() - began:.0f} s so far"
            click.echo(f"{_CLEAR_LINE}{text}" if is_terminal else text, nl=not is_terminal, err=True)
            wait, shown = 1.0 if is_terminal else _SECONDS_BETWEEN_LINES, True
        if shown and is_terminal:
            click.echo(_CLEAR_LINE, nl=False, err=True)

    _is_answered.clear()
    _reporter = threading.Thread(target=report, name="sobolev-batch-patience", daemon=True)
    _reporter.start()
    try:
        yield
    finally:
        _answer()


def _answer() -> None:
    """End the report of `patience`, whose line would be in the way."""
    _is_answered.set()
    if _reporter is not None:
        _reporter.join()


def echo(line: object = "", *, err: bool = False) -> None:
    """Print one line, on standard error if asked."""
    _answer()
    click.echo(visible(str(line)), err=err)


def echo_lines(text: object, *, err: bool = False) -> None:
    """Print a text of several lines, whose names are visible already."""
    _answer()
    click.echo(visible_lines(str(text)), err=err)


def echo_json(result: Any, **more: Any) -> None:
    """Print a result and what follows from it as one JSON document; docs/commands.md lists the keys."""
    from sobolev_batch.tables.text import json_text

    echo_lines(json_text((result if isinstance(result, dict) else vars(result)) | more))


def overwrite(line: str = "") -> None:
    """Replace the last line of the terminal; a longer one would wrap, and stay."""
    click.echo(_CLEAR_LINE + visible(line)[: shutil.get_terminal_size().columns - 1], nl=False)


def progress_bar(length: int, label: str, *, show_count: bool = True) -> Any:
    """Return a bar on standard error."""
    return click.progressbar(length=length, label=visible(label), file=sys.stderr, show_pos=show_count)


def show_usage_error(error: click.ClickException) -> None:
    """Print what is wrong with a command, as click words it."""
    text = StringIO()
    error.show(text)
    echo_lines(text.getvalue().removesuffix("\n").replace(error.message, visible(error.message)), err=True)


def replace_line(text: str, before: str) -> str:
    """Show a text in the place of the one before on a terminal, elsewhere on a new line; return the text."""
    if sys.stdout.isatty():
        if text or before:
            overwrite(text)
    elif text not in ("", before):
        echo(text)
    return text


@contextmanager
def progress_reports() -> Iterator[Callable[[Progress], None]]:
    """Give a function that shows progress on standard error: a bar on a terminal, elsewhere a line for each step."""
    with ExitStack() as bars:
        bar: Any = None

        def show(progress: Progress) -> None:
            nonlocal bar
            part = f"{progress.part}: " if progress.part else ""
            if progress.stage == "cluster":
                echo(progress, err=True)
            elif not sys.stderr.isatty():
                if progress.record is not None or progress.done == progress.total:
                    echo(progress, err=True)
            elif progress.done == 0:
                bars.close()
                stage = {"fields": "transforms", "reduction": "tables    ", "proximity": "proximity "}[progress.stage]
                bar = bars.enter_context(progress_bar(progress.total, part + stage))
            else:
                bar.update(1)
            if progress.done == progress.total:
                bars.close()

        yield show
