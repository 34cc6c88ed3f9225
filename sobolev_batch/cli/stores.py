"""Commands that read a store: status, verify, release, table, plot, witness, report."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.release import release
from sobolev_batch.batch.verify import verify
from sobolev_batch.cli.group import EXIT_OTHER, EXIT_SOME_FAILED, cli
from sobolev_batch.cli.options import folder_option, order_option, output_option, store_argument, up_option
from sobolev_batch.errors import SobolevBatchError, StoreError
from sobolev_batch.results.open import fields_read, open_store
from sobolev_batch.results.status import status
from sobolev_batch.results.tables.convergence import format_table
from sobolev_batch.results.tables.evolution import REMESHING_FACTOR, format_evolution
from sobolev_batch.results.tables.matrix import format_matrix
from sobolev_batch.results.tables.text import FORMATS, Format

if TYPE_CHECKING:
    from sobolev_batch.results.meshes.views import Axis

_FOLLOW_SECONDS = 5.0


@cli.command("status")
@store_argument
@click.option("--follow", is_flag=True, help="Repeat until the run has ended.")
@click.pass_context
def status_command(context: click.Context, store: Location, follow: bool) -> None:
    """Show the progress of STORE's study, and what failed and why."""
    current = status(store)
    while follow and current.going_on:
        click.echo(f"{current}\n")
        time.sleep(_FOLLOW_SECONDS)
        current = status(store)
    click.echo(current)
    if current.failed or current.not_compared:
        context.exit(EXIT_SOME_FAILED)
    if current.lost or (current.run is not None and current.run.state == "failed"):
        context.exit(EXIT_OTHER)


@cli.command("verify")
@store_argument
@click.pass_context
def verify_command(context: click.Context, store: Location) -> None:
    """Check all data of STORE against its checksums.

    Damaged data are named. If STORE can be written, they are also removed, and `run` computes them again.
    The exit status is 1 if anything is damaged.
    """
    with click.progressbar(label="fields", file=sys.stderr, show_pos=True, length=0) as bar:

        def show(done: int, total: int) -> None:
            bar.length = total
            bar.update(1)

        result = verify(store, show)
    click.echo(f"{store}: {result.complete} of {result.total} surfaces complete, their fields read back")
    tables = {f"table {name}": damage for name, damage in result.tables.items()}
    for name, damage in (*result.fields.items(), *result.comparisons.items(), *tables.items()):
        click.echo(f"{name}: {damage}")
    if result.is_sound:
        click.echo("nothing is damaged")
        return
    remedy = (
        "run the study again to repair it"
        if result.withdrawn
        else "the store cannot be written from here, so nothing was withdrawn"
    )
    surfaces = len({*result.fields, *result.comparisons})
    click.echo(f"{surfaces} surfaces and {len(result.tables)} arrays of tables are damaged; {remedy}")
    context.exit(EXIT_OTHER)


@cli.command("release")
@store_argument
@click.option("--force", is_flag=True, help="Release it even if its run was active a moment ago.")
def release_command(store: Location, force: bool) -> None:
    """Remove the lock that a killed run left on STORE."""
    lock = release(store, force=force)
    if lock is None:
        click.echo(f"{store}: not locked by any run")
    else:
        click.echo(f"{store}: released from {lock.driver}, which had locked it since {lock.since}")


@cli.command("table")
@store_argument
@click.option("--format", "style", type=click.Choice(FORMATS), default="text", show_default=True)
@order_option
@click.option("--matrix", is_flag=True, help="Print the distances of every mesh to every other instead.")
@click.option("--over-time", is_flag=True, help="Print the distances of meshes that move, over time, instead.")
@click.option("--truth", metavar="FAMILY", help="True surface of --over-time if it moves. [default: the reference]")
@click.option(
    "--factor",
    type=click.FloatRange(min=1.0, min_open=True),
    help=f"Growth of the distance at which a new mesh pays, for --over-time. [default: {REMESHING_FACTOR:g}]",
)
def table_command(
    store: Location,
    style: Format,
    orders: tuple[float, ...],
    matrix: bool,
    over_time: bool,
    truth: str | None,
    factor: float | None,
) -> None:
    """Print the tables or distance matrices of STORE."""
    if matrix and over_time:
        raise click.UsageError("--matrix and --over-time are two tables: ask for one of them")
    for name, is_given in (("--truth", truth is not None), ("--factor", factor is not None)):
        if is_given and not over_time:
            raise click.UsageError(f"{name} belongs to --over-time")
    tree, chosen = open_store(store), orders or None
    if over_time:
        click.echo(format_evolution(tree, style, chosen, truth=truth, factor=factor or REMESHING_FACTOR))
    else:
        form = format_matrix if matrix else format_table
        click.echo(form(tree, style, chosen))


@cli.command("plot")
@store_argument
@output_option("Folder of the pictures.", ".")
@click.option("--witness", "witnesses", multiple=True, metavar="MESH", help="Mesh to draw; may be repeated.")
@folder_option
@up_option
@click.pass_context
def plot_command(
    context: click.Context, store: Location, output: Path, witnesses: tuple[str, ...], folder: Path, up: Axis
) -> None:
    """Draw the results of STORE as pictures.

    They show convergence, transforms, distances and spectra, and some of the meshes.

    Meshes are coloured by their witness functions, which show where they differ from the reference. They are rebuilt
    from the study; drawing needs the extra "vtk". By default a few are chosen by their distances.
    """
    # Imported here, since it takes as long as the start of all other commands.
    from sobolev_batch.results.figures.plots import write_plots
    from sobolev_batch.results.figures.witness_plots import write_witness_plots

    with fields_read(store):
        tree = open_store(store)
        # First, since a label may be wrong.
        witness_paths, missing = write_witness_plots(tree, output, folder, witnesses, up)
        paths = write_plots(tree, output)
    for path in (*paths, *witness_paths):
        click.echo(path)
    if missing:
        labels_by_reason: dict[str, list[str]] = {}
        for label, reason in missing.items():
            labels_by_reason.setdefault(reason, []).append(label)
        parts = "; ".join(f"{', '.join(labels)}: {reason}" for reason, labels in labels_by_reason.items())
        click.echo(f"not drawn with their witness functions: {parts}", err=True)
        if witnesses:
            context.exit(EXIT_SOME_FAILED)


@cli.command("witness")
@store_argument
@click.option("--mesh", "meshes", multiple=True, metavar="MESH", help="Only this mesh; may be repeated.")
@click.option(
    *("--order", "orders"), type=float, multiple=True, help="Any below -1/2; may be repeated. [default: the study's]"
)
@click.option(
    *("--format", "style"),
    type=click.Choice(["ply", "vtp"]),
    default="ply",
    show_default=True,
    help="ply for MeshLab and similar programs, vtp for ParaView.",
)
@output_option("Folder of the files.", ".")
@folder_option
@click.pass_context
def witness_command(
    context: click.Context,
    store: Location,
    meshes: tuple[str, ...],
    orders: tuple[float, ...],
    style: str,
    output: Path,
    folder: Path,
) -> None:
    """Write the meshes of STORE with their witness functions.

    The witness function shows where a mesh differs from the reference. Each mesh gets one file, in its own unit of
    length. The study makes the meshes again; a mesh is skipped and named if that fails, or if it is not the one that
    was computed.
    """
    # Imported here, as for plots.
    from sobolev_batch.results.meshes.export import Exporter

    exporter = Exporter.of(store, orders or None, folder)
    labels = exporter.labels(meshes)
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"{output}: no files can be written there: {error.strerror or error}") from error
    is_complete = True
    for label in labels:
        try:
            field = exporter.field(label)
        except SobolevBatchError as error:
            click.echo(f"{label}: {error}", err=True)
            is_complete = False
            continue
        path = output / f"{exporter.stem(label)}.{style}"
        field.write(path)
        click.echo(path)
    if not is_complete:
        context.exit(EXIT_SOME_FAILED)


@cli.command("report")
@store_argument
@output_option("File of the page.", "report.html")
@folder_option
@up_option
@click.option("--witness", "witnesses", multiple=True, metavar="MESH", help="Mesh to show; may be repeated.")
def report_command(store: Location, output: Path, folder: Path, up: Axis, witnesses: tuple[str, ...]) -> None:
    """Write the results of STORE as one HTML page.

    The page needs no other files and makes no requests.
    """
    # Imported here, as for plots.
    from sobolev_batch.results.report.build import report

    click.echo(report(store, output, folder=folder, witnesses=witnesses, up=up))
