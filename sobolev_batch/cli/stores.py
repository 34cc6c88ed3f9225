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
from sobolev_batch.errors import SobolevBatchError, StoreError
from sobolev_batch.results.open import fields_read, open_store
from sobolev_batch.results.status import Status
from sobolev_batch.results.tables.convergence import FORMATS, Format, format_table
from sobolev_batch.results.tables.matrix import format_matrix

if TYPE_CHECKING:
    from sobolev_batch.results.meshes.views import Axis

_FOLLOW_SECONDS = 5.0

_study_folder = click.option(
    *("--folder", "folder"),
    type=click.Path(path_type=Path),
    default=".",
    help="Where relative paths in the study start, by which meshes are made again. [default: here]",
)
_up = click.option(
    "--up",
    type=click.Choice(["x", "y", "z"]),
    default="z",
    show_default=True,
    help="The meshes' axis that points up.",
)


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
    if status.failed or status.not_compared:
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
    lock = release(store, force=force)
    if lock is None:
        click.echo(f"{store}: no run has claimed it")
    else:
        click.echo(f"{store}: released from {lock.driver}, which had claimed it since {lock.since}")


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
@click.option("--witness", "witnesses", multiple=True, metavar="MESH", help="Draw this mesh; may be repeated.")
@_study_folder
@_up
@click.pass_context
def plot_command(
    context: click.Context, store: Location, output: Path, witnesses: tuple[str, ...], folder: Path, up: Axis
) -> None:
    """Draw the convergence and the transforms of STORE, and where meshes differ from the reference.

    Meshes are made again by the study and drawn with the extra "vtk"; by default a few that are chosen by their
    distances, if that can be done.
    """
    # Imported here: it takes as long as everything that the other commands do at their start.
    from sobolev_batch.results.figures.plots import plot_store, plot_witnesses

    with fields_read(store):
        tree = open_store(store)
        # First, since a label may be wrong.
        seen, absent = plot_witnesses(tree, output, folder, witnesses, up)
        paths = plot_store(tree, output)
    for path in (*paths, *seen):
        click.echo(path)
    if absent:
        why: dict[str, list[str]] = {}
        for label, reason in absent.items():
            why.setdefault(reason, []).append(label)
        parts = "; ".join(f"{', '.join(labels)}: {reason}" for reason, labels in why.items())
        click.echo(f"not drawn with their witness functions: {parts}", err=True)
    if witnesses and absent:
        context.exit(EXIT_SOME_FAILED)


@cli.command("witness")
@click.argument("store", type=Location.of)
@click.option("--mesh", "labels", multiple=True, metavar="LABEL", help="Only this mesh; may be repeated.")
@click.option(
    *("--order", "orders"), type=float, multiple=True, help="Any below -1/2; may be repeated. [default: the study's]"
)
@click.option(
    *("--format", "style"),
    type=click.Choice(["ply", "vtp"]),
    default="ply",
    show_default=True,
    help="For MeshLab and its like, or for ParaView.",
)
@click.option("--output", type=click.Path(path_type=Path), default=".", show_default=True, help="Folder of the files.")
@_study_folder
@click.pass_context
def witness_command(
    context: click.Context,
    store: Location,
    labels: tuple[str, ...],
    orders: tuple[float, ...],
    style: str,
    output: Path,
    folder: Path,
) -> None:
    """Write the meshes of STORE, each with its witness function: where it differs from the reference.

    One file per mesh, in its own unit of length. Meshes are made again by the study; those that cannot be, or
    are no longer the ones that were computed, are named.
    """
    # Imported here, as for plots.
    from sobolev_batch.results.meshes.export import Exporter

    exporter = Exporter.of(store, orders or None, folder)
    chosen = exporter.labels(labels)
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"{output}: no files can be written there: {error.strerror or error}") from error
    missing = False
    for label in chosen:
        try:
            field = exporter.field(label)
        except SobolevBatchError as error:
            click.echo(f"{label}: {error}", err=True)
            missing = True
            continue
        path = output / f"{exporter.stem(label)}.{style}"
        field.write(path)
        click.echo(path)
    if missing:
        context.exit(EXIT_SOME_FAILED)


@cli.command("report")
@click.argument("store", type=Location.of)
@click.option("--output", type=click.Path(path_type=Path), default="report.html", show_default=True, help="The page.")
@_study_folder
@_up
@click.option("--witness", "witnesses", multiple=True, metavar="MESH", help="Show this mesh; may be repeated.")
def report_command(store: Location, output: Path, folder: Path, up: Axis, witnesses: tuple[str, ...]) -> None:
    """Write everything about STORE into one HTML page that needs nothing besides itself."""
    # Imported here, as for plots.
    from sobolev_batch.results.report.build import write_report

    click.echo(write_report(store, output, folder=folder, witnesses=witnesses, up=up))
