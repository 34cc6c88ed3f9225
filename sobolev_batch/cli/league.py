"""The command on the store of a collection: league."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from sobolev_batch.cli.group import cli
from sobolev_batch.cli.options import format_option, location, orders_option, store_argument
from sobolev_batch.cli.output import echo_lines
from sobolev_batch.results.tables.formatting import Format

if TYPE_CHECKING:
    from sobolev_batch.batch.storage.location import Location


@cli.command("league")
@store_argument
@format_option
@orders_option("Compare at this order.", "all of the stores")
@click.option("--x", default="triangles", show_default=True, help="Compare methods at equal values of this size.")
@click.option("--method", "methods", multiple=True, help="Compare this method; may be repeated. [default: all]")
@click.option("--against", type=location, metavar="STORE", help="Compare with this earlier study instead.")
def league_command(
    store: Location,
    style: Format,
    orders: tuple[float, ...],
    x: str,
    methods: tuple[str, ...],
    against: Location | None,
) -> None:
    """Rank the methods of a collection's STORE over its objects.

    With --against, compare each method with itself in an earlier study instead.
    """
    from sobolev_batch.results.league.league import compare_studies, league
    from sobolev_batch.results.league.text import format_changes, format_league

    if against is not None:
        echo_lines(format_changes(compare_studies(store, against, orders or None), style))
    else:
        echo_lines(format_league(league(store, orders or None, x=x, methods=methods or None), style))
