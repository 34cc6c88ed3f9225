"""The command table, with a sub-command for each kind of table of a store."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from sobolev_batch.cli.options import Callback, ChosenOrders, format_option, orders_option, store_argument
from sobolev_batch.cli.output import echo_lines
from sobolev_batch.cli.program import NamedCommands, cli

if TYPE_CHECKING:
    from sobolev_batch.store.location import Location
    from sobolev_batch.tables import Format

_DEFAULT = "convergence"


class _Tables(NamedCommands):
    """Sub-commands; a first word that is none of them is the STORE of the default one."""

    prefix = "table "

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        is_named = not args or args[0] in self.get_help_option_names(ctx) or self.get_command(ctx, args[0]) is not None
        return super().parse_args(ctx, args if is_named else [_DEFAULT, *args])


def table_options(command: Callback) -> Callback:
    """Add what all tables take to a command: the store, the format as its style, and orders; None for the study's."""
    order = orders_option("Print the table of this order, which may be any below -1/2.", "the study's")
    return store_argument(format_option(order(command)))


@cli.group("table", cls=_Tables, no_args_is_help=False, subcommand_metavar="[KIND] STORE")
def table_command() -> None:
    """Print a table of STORE, by default that of convergence.

    Orders that the study lacks are computed from what the store holds. The table says what they rest on.
    """


@table_command.command(_DEFAULT)
@table_options
def convergence_command(store: Location, style: Format, orders: ChosenOrders) -> None:
    """Print distances to the reference, with rates.

    The rows of several objects follow each other.
    """
    from sobolev_batch.tables.convergence import format_table

    echo_lines(format_table(store, style, orders), style)


@table_command.command("matrix")
@table_options
def matrix_command(store: Location, style: Format, orders: ChosenOrders) -> None:
    """Print distances of all pairs of meshes."""
    from sobolev_batch.tables.matrix import format_matrix

    echo_lines(format_matrix(store, style, orders), style)


@table_command.command("verdict")
@table_options
def verdict_command(store: Location, style: Format, orders: ChosenOrders) -> None:
    """Print the nearest mesh at each size. Also print the smallest below 5 % and 1 %.

    More than three objects have a line each, the worst first; for one of them, name STORE/OBJECT.
    """
    from sobolev_batch.tables.conclusion import format_verdict

    echo_lines(format_verdict(store, style, orders), style)


@table_command.command("objects")
@table_options
def objects_command(store: Location, style: Format, orders: ChosenOrders) -> None:
    """Print the nearest mesh of each object. The worst objects come first."""
    from sobolev_batch.tables.conclusion import format_objects

    echo_lines(format_objects(store, style, orders), style)


@table_command.command("smallest")
@table_options
@click.option(
    "--below",
    metavar="FRACTION",
    required=True,
    help="Take what is below FRACTION, such as 0.01 or 1%, of the norm of the reference.",
)
def smallest_command(store: Location, style: Format, orders: ChosenOrders, below: str) -> None:
    """Print the smallest mesh below a bound.

    For a bound on lengths, such as 0.1 mm, see `sobolev-batch reduce --within`.
    """
    from sobolev_batch.tables.smallest import format_smallest

    echo_lines(format_smallest(store, style, orders, below=below), style)
