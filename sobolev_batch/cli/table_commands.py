"""The command table, with a sub-command for each kind of table of a store."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from sobolev_batch.cli.common import (
    Command,
    below_option,
    cli,
    echo_lines,
    format_option,
    location,
    orders_option,
    store_argument,
)

if TYPE_CHECKING:
    import xarray as xr

    from sobolev_batch.store.location import Location
    from sobolev_batch.tables import Format

_DEFAULT = "convergence"


class _Tables(click.Group):
    """Sub-commands; a first word that is none of them is the STORE of the default one."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        is_default = bool(args) and args[0] not in (*self.commands, *self.get_help_option_names(ctx))
        return super().parse_args(ctx, [_DEFAULT, *args] if is_default else args)


@cli.group("table", cls=_Tables, no_args_is_help=False, subcommand_metavar="[KIND] STORE")
def table_command() -> None:
    """Print a table of STORE, by default that of convergence.

    Orders that the study lacks are computed from what the store holds. The table says what they rest on.
    """


def _table_options(command: Command) -> Command:
    """Add what all tables take."""
    order = orders_option("Print the table of this order, which may be any below -1/2.", "the study's")
    return store_argument(format_option(order(command)))


def _tree_of_one(store: Location) -> xr.DataTree:
    """Open the store of one object."""
    from sobolev_batch.store.collection_store import CollectionStore
    from sobolev_batch.tables.open import open_store

    collection = CollectionStore.read(store)
    if collection is not None:
        raise click.UsageError(f"name the store of one object, such as {store}/{collection.objects[0]}")
    return open_store(store)


@table_command.command(_DEFAULT)
@_table_options
@click.option(
    "--x",
    default="edge_length",
    show_default=True,
    help="Observe rates in edge_length, triangles, vertices, seconds, or a number among the metadata of the meshes.",
)
def convergence_command(store: Location, style: Format, orders: tuple[float, ...], x: str) -> None:
    """Print distances to the reference, with rates.

    A collection has the tables of all its objects.
    """
    from sobolev_batch.tables.convergence import format_table

    echo_lines(format_table(store, style, orders or None, x=x))


@table_command.command("matrix")
@_table_options
def matrix_command(store: Location, style: Format, orders: tuple[float, ...]) -> None:
    """Print distances of all pairs of meshes."""
    from sobolev_batch.tables.matrix import format_matrix

    echo_lines(format_matrix(_tree_of_one(store), style, orders or None))


@table_command.command("verdict")
@_table_options
def verdict_command(store: Location, style: Format, orders: tuple[float, ...]) -> None:
    """Print the nearest mesh at each size, and the smallest below 5 % and 1 %."""
    from sobolev_batch.tables.conclusion import format_verdict

    echo_lines(format_verdict(_tree_of_one(store), style, orders or None))


@table_command.command("time")
@_table_options
@click.option(
    "--truth",
    metavar="FAMILY",
    help="Measure from this family, which is the true surface. [default: the reference]",
)
@click.option(
    "--factor",
    type=click.FloatRange(min=1.0, min_open=True),
    default=2.0,
    show_default=True,
    help="Report when the distance has grown by this factor.",
)
def time_command(store: Location, style: Format, orders: tuple[float, ...], truth: str | None, factor: float) -> None:
    """Print distances of moving meshes over time."""
    from sobolev_batch.extras.leagues.evolution import format_evolution

    echo_lines(format_evolution(_tree_of_one(store), style, orders or None, truth=truth, factor=factor))


@table_command.command("smallest")
@_table_options
@below_option("Take what is below FRACTION, such as 1%, of the norm of the reference.", required=True)
def smallest_command(store: Location, style: Format, orders: tuple[float, ...], below: float) -> None:
    """Print the smallest mesh below a bound."""
    from sobolev_batch.tables.convergence import format_smallest

    echo_lines(format_smallest(_tree_of_one(store), style, orders or None, below=below))


@table_command.command("league")
@_table_options
@click.option(
    "--by",
    type=click.Choice(["size", "cost"]),
    default="size",
    show_default=True,
    help="Compare at equal sizes, or list the meshes that no other beats in distance and cost.",
)
@click.option("--x", help="Take this size or cost of a mesh. [default: triangles by size, make_seconds by cost]")
@click.option("--family", "families", multiple=True, help="Compare this method; may be repeated. [default: all]")
@click.option("--against", type=location, metavar="STORE", help="Compare with this earlier study instead.")
def league_command(
    store: Location,
    style: Format,
    orders: tuple[float, ...],
    by: str,
    x: str | None,
    families: tuple[str, ...],
    against: Location | None,
) -> None:
    """Rank methods over the objects of STORE.

    With --by cost, STORE may also be that of one object. With --against, compare each method with itself in an earlier
    study instead.
    """
    from sobolev_batch.extras.leagues.costs import format_cost_leagues
    from sobolev_batch.extras.leagues.league import compare_studies, format_changes, format_league, league

    if against is not None:
        echo_lines(format_changes(compare_studies(store, against, orders or None), style))
    elif by == "cost":
        echo_lines(format_cost_leagues(league(store, orders or None, by="cost", x=x, methods=families or None), style))
    else:
        echo_lines(format_league(league(store, orders or None, x=x, methods=families or None), style))
