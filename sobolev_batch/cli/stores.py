"""Commands that read a store: status, verify, release, table, plot, report."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import click

from sobolev_batch.batch.location import Location
from sobolev_batch.batch.release import release
from sobolev_batch.batch.verification import verify
from sobolev_batch.cli.group import EXIT_OTHER, EXIT_SOME_FAILED, cli
from sobolev_batch.results.matrix import format_matrix
from sobolev_batch.results.opening import fields_read, open_store
from sobolev_batch.results.status import Status
from sobolev_batch.results.tables import FORMATS, Format, format_table

_FOLLOW_SECONDS = 5.0


@cli.command("status")
@click.argument("store", type=Location.of, metavar="STORE")
@click.option("--follow", is_flag=True, help="Show it again and again until the run has ended.")
@click.pass_context
def status_command(context: click.Context, store: Location, follow: bool) -> None:
    """Show how far STORE is, and what failed and why."""
    status = Status.of(store)
    while follow and status.going_on:
        click.echo("\n".join(status.lines()) + "\n")
        time.sleep(_FOLLOW_SECONDS)
        status = Status.of(store)
    click.echo("\n".join(status.lines()))
    if status.failed:
        context.exit(EXIT_SOME_FAILED)
    if status.lost or (status.run is not None and status.run.state == "failed"):
        context.exit(EXIT_OTHER)


@cli.command("verify")
@click.argument("store", type=Location.of, metavar="STORE")
@click.pass_context
def verify_command(context: click.Context, store: Location) -> None:
    """Read everything in STORE back, against its checksums and completion records.

    What is damaged is named, and withdrawn where STORE can be written: `run` then computes it again.
    Exit status 1 if anything is damaged.
    """
    with click.progressbar(label="fields", file=sys.stderr, show_pos=True, length=0) as bar:

        def show(done: int, total: int) -> None:
            bar.length = total
            bar.update(1)

        found = verify(store, show)
    click.echo(f"{store}: {found.complete} of {found.total} surfaces complete, their fields read back")
    for name, what in [
        *found.fields.items(),
        *found.comparisons.items(),
        *((f"table {name}", what) for name, what in found.tables.items()),
    ]:
        click.echo(f"{name}: {what}")
    if found.is_sound:
        click.echo("nothing is damaged")
        return
    remedy = "run the study again to repair it" if found.withdrawn else "it cannot be written here, and stays as it is"
    surfaces = len({*found.fields, *found.comparisons})
    click.echo(f"{surfaces} surfaces and {len(found.tables)} arrays of tables are damaged; {remedy}")
    context.exit(EXIT_OTHER)


@cli.command("release")
@click.argument("store", type=Location.of, metavar="STORE")
@click.option("--force", is_flag=True, help="Even if its run gave a sign of life a moment ago.")
def release_command(store: Location, force: bool) -> None:
    """Release STORE from the claim of a run that was killed together with its machine."""
    claim = release(store, force=force)
    if claim is None:
        click.echo(f"{store}: no run has claimed it")
    else:
        click.echo(f"{store}: released from {claim.driver}, which had claimed it since {claim.since}")


@cli.command("table")
@click.argument("store", type=Location.of)
@click.option("--format", "style", type=click.Choice(FORMATS), default="text", show_default=True)
@click.option("--order", "orders", type=float, multiple=True, help="Only this order; may be repeated.")
@click.option("--matrix", is_flag=True, help="The distance of every mesh to every other instead.")
def table_command(store: Location, style: Format, orders: tuple[float, ...], matrix: bool) -> None:
    """Print the convergence tables of STORE, or its distance matrices."""
    form = format_matrix if matrix else format_table
    click.echo(form(open_store(store), style, orders or None))


@cli.command("plot")
@click.argument("store", type=Location.of)
@click.option(
    "--output", type=click.Path(path_type=Path), default=".", show_default=True, help="Folder of the pictures."
)
def plot_command(store: Location, output: Path) -> None:
    """Draw the convergence and the transforms of STORE."""
    # Imported here: it takes as long as everything that the other commands do at their start.
    from sobolev_batch.results.plots import plot_store

    with fields_read(store):
        paths = plot_store(open_store(store), output)
    for path in paths:
        click.echo(path)


@cli.command("report")
@click.argument("store", type=Location.of)
@click.option("--output", type=click.Path(path_type=Path), default="report.html", show_default=True, help="The page.")
@click.option(
    *("--folder", "folder"),
    type=click.Path(path_type=Path),
    default=".",
    help="Where relative paths in the study start: its meshes are shown if they are there. [default: here]",
)
@click.option("--witness", "witnesses", multiple=True, metavar="MESH", help="Show this mesh; may be repeated.")
def report_command(store: Location, output: Path, folder: Path, witnesses: tuple[str, ...]) -> None:
    """Write everything about STORE into one HTML page that needs nothing besides itself."""
    # Imported here, as for plots.
    from sobolev_batch.results.report import write_report

    click.echo(write_report(store, output, folder=folder, witnesses=witnesses))
