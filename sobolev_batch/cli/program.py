"""The command sobolev-batch, which has all others as sub-commands, also those that are registered by name.

The modules of commands import whatever computes inside of their functions: with it, a command would take seconds to
show its help.
"""

import logging
import traceback
from importlib.metadata import EntryPoint
from typing import Any

import click

from sobolev_batch.cli.interruption import SECONDS_TO_END, Deadline
from sobolev_batch.cli.output import EchoHandler, echo, echo_lines, patience
from sobolev_batch.errors import InputError, SobolevBatchError, SpaceError, one_line
from sobolev_batch.plugins import COMMANDS, extra, is_extra, registered

# Exit statuses; `end_process` has those after SIGINT and SIGTERM.
EXIT_OTHER, EXIT_INPUT, EXIT_SOME_FAILED, EXIT_NO_SPACE = 1, 2, 3, 5
# Key of the context's `meta` with the status of errors other than wrong input, where a command has one of its own.
ERROR_STATUS = "sobolev_batch.error_status"

# A lock of a store is given up once the storage has answered.
_SECONDS_WITH_LOCK = 30.0
# Loggers of the drivers of object storage.
_DRIVERS = ("aiobotocore", "botocore", "s3fs", "gcsfs", "google", "urllib3", "azure")


class Command(click.Command):
    """A command, with what its process is to know before it begins.

    Attributes:
        shows_progress: True if it says by itself that it goes on.
        locks: True if it locks a store, and needs time to give the lock up.
        remark: End of the last line of a process that was asked to end.
    """

    def __init__(
        self, *arguments: Any, shows_progress: bool = False, locks: bool = False, remark: str = "", **settings: Any
    ) -> None:
        super().__init__(*arguments, **settings)
        self.shows_progress, self.locks, self.remark = shows_progress, locks, remark

    def prepare(self, context: click.Context) -> None:
        """Tell the process what is known of the command, and report that it goes on where it does not itself."""
        context.obj.expect(self.remark, _SECONDS_WITH_LOCK if self.locks else SECONDS_TO_END)
        if not self.shows_progress:
            context.with_resource(patience(str(self.name)))


class NamedCommands(click.Group):
    """Commands of this package, of its extras and of other packages, each of which is loaded when it is asked for.

    The latter come from the entry point group ``sobolev_batch.commands``. A command of a group has the name of the
    group as its first word, such as "table league".
    """

    command_class = Command
    prefix = ""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands."""
        return sorted({*self.commands, *self._registered()})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command; None if there is none of this name, InputError if it is one of extras that are lacking."""
        if cmd_name in self.commands:
            return self.commands[cmd_name]
        name = f"{self.prefix}{cmd_name}"
        if is_extra(COMMANDS, name):
            return extra(COMMANDS, name, f"the command {name!r}")  # type: ignore[no-any-return]
        point = self._registered().get(cmd_name)
        return None if point is None else point.load()

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands; to load those of other packages for their help could take long, or fail."""
        names = self.list_commands(ctx)
        foreign = {name: point.dist for name, point in self._registered().items() if point.dist is not None}
        room = formatter.width - 6 - max(map(len, names))
        rows = []
        for name in names:
            command = None if name in foreign else self.get_command(ctx, name)
            text = f"See the package {foreign[name].name}." if command is None else command.get_short_help_str(room)
            rows.append((name, text))
        with formatter.section("Commands"):
            formatter.write_dl(rows)

    def _registered(self) -> dict[str, EntryPoint]:
        own = (point for point in reversed(registered(COMMANDS)) if point.name.startswith(self.prefix))
        points = {point.name.removeprefix(self.prefix): point for point in own}
        # Names of several words are those of commands of groups.
        return {name: point for name, point in points.items() if " " not in name}


class _Program(NamedCommands):
    """The command line as a whole, which ends each error of a command with a line and an exit status."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except (click.ClickException, click.exceptions.Exit, click.Abort, BrokenPipeError):
            raise
        except Exception as error:
            status = EXIT_NO_SPACE if isinstance(error, SpaceError) else ctx.meta.get(ERROR_STATUS, EXIT_OTHER)
            if ctx.params["debug"]:
                echo_lines(traceback.format_exc().removesuffix("\n"), err=True)
                ctx.exit(status)
            is_ours = isinstance(error, SobolevBatchError)
            message = str(error) if is_ours else f"{type(error).__name__}: {one_line(error)} (--debug shows where)"
            echo(f"error: {message}", err=True)
            ctx.exit(EXIT_INPUT if isinstance(error, InputError) and status != EXIT_NO_SPACE else status)


@click.group(cls=_Program, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="sobolev-batch")
@click.option("--debug", is_flag=True, help="Show tracebacks and every log message.")
@click.pass_context
def cli(context: click.Context, debug: bool) -> None:
    """Sobolev distances of negative order between surface meshes.

    A study file names families of meshes and a reference. `run` stores the Fourier transform of every
    mesh and prints which are nearest to the reference.

    The exit status is 0 if all is done, 2 if the input is wrong, 3 if some meshes failed or are missing, 5 if a disk
    is full, 1 after another error or a check that failed, 130 after Ctrl-C and 143 after SIGTERM. `compare
    --within` has its own.
    """
    _set_up_logging(debug)
    command = cli.get_command(context, str(context.invoked_subcommand))
    # Only a process of its own has a deadline.
    if isinstance(context.obj, Deadline) and command is not None:
        (command if isinstance(command, Command) else Command(command.name)).prepare(context)


def _set_up_logging(debug: bool) -> None:
    logging.basicConfig(
        level=logging.DEBUG if debug else logging.WARNING,
        format="%(kind)s %(name)s: %(message)s" if debug else "%(kind)s: %(message)s",
        handlers=[EchoHandler()],
    )
    for handler in logging.root.handlers:
        # Not by the level of its logger, which the cluster sets itself when it is imported.
        handler.addFilter(lambda record: _is_shown(record, debug=debug))
    if debug:
        # At debug level they log requests with their signatures and session tokens.
        for driver in _DRIVERS:
            logging.getLogger(driver).setLevel(logging.INFO)


def _is_shown(record: logging.LogRecord, *, debug: bool) -> bool:
    """Add the level of a message as commands print it, and return whether it is shown.

    Those of the cluster at its start and end would only hide the table.
    """
    record.kind = record.levelname.lower()
    if debug or not record.name.startswith("distributed"):
        return True
    # They show Dask's own code, and the error that follows says what happened.
    record.exc_info = record.exc_text = None
    return record.levelno >= logging.ERROR and bool(record.getMessage())
