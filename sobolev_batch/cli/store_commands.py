"""Commands that read a store, besides its tables: status, verify, unlock, plot, witness, report."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sobolev_batch.cli.common import (
    EXIT_OTHER,
    EXIT_SOME_FAILED,
    PATH,
    cli,
    echo,
    echo_json,
    echo_lines,
    folder_option,
    json_option,
    meshes_option,
    orders_option,
    output_option,
    progress_bar,
    replace_line,
    store_argument,
    up_option,
)
from sobolev_batch.errors import InputError, SobolevBatchError, StoreError, from_extra

if TYPE_CHECKING:
    from sobolev_batch.extras.figures.style import PictureFormat
    from sobolev_batch.extras.figures.views import Axis, Colors
    from sobolev_batch.store.location import Location
    from sobolev_batch.tables.export import ExportFormat

_FOLLOW_SECONDS = 2.0


def _require_folder(path: Path) -> None:
    """Refuse a folder that files cannot be written into, before they are made. It need not exist yet."""
    nearest = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        raise StoreError(f"{path}: no files can be written there: {nearest} is no folder that can be written")


@cli.command("status")
@store_argument
@click.option("--follow", is_flag=True, help="Show the progress on one line until the run has ended.")
@json_option
@click.pass_context
def status_command(context: click.Context, store: Location, follow: bool, style: str) -> None:
    """Show the progress of STORE's study, and what failed and why.

    The time left is estimated from the surfaces that were finished last.

    The exit status is 1 if the run failed or shows no sign of life, and 3 if some surfaces failed or are missing.
    """
    from sobolev_batch.batch.status import status

    current = status(store)
    shown = ""
    while follow and current.going_on:
        shown = "" if style == "json" else replace_line(current.progress, shown)
        time.sleep(_FOLLOW_SECONDS)
        current = status(store)
        if current.run_store and not current.going_on:
            # Between two objects of a collection, no run goes on for a moment.
            time.sleep(_FOLLOW_SECONDS)
            current = status(store)
    replace_line("", shown)
    if style == "json":
        names = ("waiting", "going_on", "lost", "is_incomplete", "seconds_left")
        echo_json(current, **{name: getattr(current, name) for name in names})
    else:
        echo_lines(current)
    if current.lost or (current.run is not None and current.run.state == "failed"):
        context.exit(EXIT_OTHER)
    if current.failed or current.not_compared or current.is_incomplete:
        context.exit(EXIT_SOME_FAILED)


@cli.command("verify")
@store_argument
@json_option
@click.pass_context
def verify_command(context: click.Context, store: Location, style: str) -> None:
    """Check all data of STORE against its checksums.

    All objects of a collection are checked. Damaged data are listed and, if STORE can be written, removed; `run`
    computes them again. The exit status is 1 if anything is damaged.
    """
    from sobolev_batch.batch.verify import verify

    with progress_bar(0, "fields") as bar:

        def show(done: int, total: int) -> None:
            if done == 1:
                # The next object of a collection adds its own.
                bar.length = (bar.length or 0) + total
            bar.update(1)

        result = verify(store, show)
    if style == "json":
        echo_json(result, is_sound=result.is_sound)
    else:
        echo_lines(result)
    context.exit(0 if result.is_sound else EXIT_OTHER)


@cli.command("unlock")
@store_argument
@click.option("--force", is_flag=True, help="Unlock it even if its run was active a moment ago.")
def unlock_command(store: Location, force: bool) -> None:
    """Remove the lock that a killed run left on STORE."""
    from sobolev_batch.store.heartbeat import unlock

    lock = unlock(store, force=force)
    if lock is None:
        echo(f"{store}: not locked by any run")
    else:
        echo(f"{store}: unlocked; {lock.driver} had locked it since {lock.since}")


@cli.command("prune")
@store_argument
@click.option("--yes", is_flag=True, help="Remove it. Otherwise only count its bytes.")
def prune_command(store: Location, yes: bool) -> None:
    """Remove what STORE keeps and no record needs.

    These are fields of meshes that are no longer in the study, leftovers of killed runs, and tables that are not
    listed. Meshes that commands made are kept: other stores may use them.
    """
    from sobolev_batch.batch.prune import prune
    from sobolev_batch.parameters import format_bytes
    from sobolev_batch.store.collection_store import CollectionStore

    collection = CollectionStore.read(store)
    total = 0
    for name, place in ({"": store} if collection is None else collection.existing_stores).items():
        for kind, size in prune(place, is_dry=not yes).items():
            total += size
            if size:
                echo(f"{name + ': ' * bool(name)}{kind}: {format_bytes(size)}")
    remark = "removed" if yes else "can be removed: give --yes"
    echo(f"{format_bytes(total)} {remark}" if total else "nothing to remove")


@cli.command("export")
@store_argument
@click.argument("output", type=PATH)
@click.option(
    *("--to", "style"),
    type=click.Choice(["parquet", "netcdf", "csv"]),
    required=True,
    help="Write a long table, or with netcdf the groups of tables. The first two need the extra export.",
)
@orders_option("Write the table of this order, for parquet and csv.", "the study's")
def export_command(store: Location, output: Path, style: ExportFormat, orders: tuple[float, ...]) -> None:
    """Write the tables of STORE to the file OUTPUT, with their coordinates."""
    from sobolev_batch.tables.export import export

    if orders and style == "netcdf":
        raise click.UsageError("--order is for parquet and csv; netcdf has the orders of the study")
    export(store, output, style, orders or None)
    echo(output)


@cli.command("plot")
@store_argument
@output_option("Write the pictures into this folder.", ".")
@click.option(
    *("--format", "formats"),
    type=click.Choice(["png", "svg", "pdf"]),
    multiple=True,
    default=["png"],
    show_default=True,
    help="Write this format; may be repeated.",
)
@click.option(
    "--size",
    metavar="WIDTHxHEIGHT",
    help="Make each panel this large, in cm, mm or in, such as 8.4x6cm. Panels of several orders are stacked.",
)
@orders_option("Draw only this order.", "all of the store")
@click.option(
    *("--family", "families"), multiple=True, metavar="NAME|GLOB", help="Draw only this family; may be repeated."
)
@click.option(
    "--x",
    help="Draw convergence over this: edge_length, triangles, vertices, seconds, or a number among the metadata of the "
    "meshes. [default: edge_length, triangles for a league]",
)
@meshes_option("Draw this mesh with its witness function.", "a few")
@folder_option
@up_option
@click.option(
    "--colors",
    type=click.Choice(["own", "common"]),
    default="own",
    show_default=True,
    help="Give each mesh its own scale of colours, or all a common one.",
)
@click.pass_context
def plot_command(
    context: click.Context,
    store: Location,
    output: Path,
    formats: tuple[PictureFormat, ...],
    size: str | None,
    orders: tuple[float, ...],
    families: tuple[str, ...],
    x: str | None,
    meshes: tuple[str, ...],
    folder: Path,
    up: Axis | None,
    colors: Colors,
) -> None:
    """Draw the results of STORE as pictures.

    They show convergence, distances and spectra, and some of the meshes. Those of a collection show its
    league.

    Meshes are coloured by their witness functions, which show where they differ from the reference. They are rebuilt
    from the study. Pictures need the extra "plot". By default a few are chosen by their distances.
    """
    from sobolev_batch.extras.leagues.league import league
    from sobolev_batch.store.collection_store import CollectionStore
    from sobolev_batch.tables.open import EDGE_LENGTH, fields_read

    with from_extra("plot", "a plot needs"):
        from sobolev_batch.extras.figures.drawing import COST_LEAGUE, LEAGUE, write_plots
        from sobolev_batch.extras.figures.selection import Selection
        from sobolev_batch.extras.figures.style import drawing, parse_size, write_figures
        from sobolev_batch.extras.figures.views import write_witness_plots

    panel = None if size is None else parse_size(size)
    _require_folder(output)
    if CollectionStore.read(store) is not None:
        if meshes:
            raise click.UsageError("--mesh draws meshes of one object: name its store, such as STORE/OBJECT")
        chosen, figures = orders or None, {}
        with drawing(panel):
            # Where no cost is known, there is no league by cost.
            with suppress(InputError):
                by_cost = league(store, chosen, by="cost", methods=families or None)
                figures["league-by-cost"] = COST_LEAGUE.figure(by_cost, size=panel)
            try:
                figures["league"] = LEAGUE.figure(league(store, chosen, x=x, methods=families or None), size=panel)
            except InputError as error:
                if x or not figures:
                    raise
                echo(f"league: {error}", err=True)
        for path in write_figures(figures, output, formats, panel):
            echo(path)
        return
    with fields_read(store):
        selection = Selection.from_store(store, orders or None, families or None, x or EDGE_LENGTH)
        # First, since a label may be wrong.
        witness_paths, missing = write_witness_plots(selection, output, folder, meshes, up, colors, formats, panel)
        paths, omissions = write_plots(selection, output, formats, panel)
    for path in (*paths, *witness_paths):
        echo(path)
    for name, notes in omissions.items():
        echo(f"{name}: {'; '.join(notes)}", err=True)
    if missing:
        for label, reason in missing.items():
            echo(f"{label}: not drawn with its witness function: {reason}", err=True)
        if meshes:
            context.exit(EXIT_SOME_FAILED)


@cli.command("witness")
@store_argument
@meshes_option("Write this mesh.", "all")
@orders_option("Write witness functions of this order, which may be any below -1/2.", "the study's")
@click.option(
    *("--format", "style"),
    type=click.Choice(["ply", "vtp"]),
    default="ply",
    show_default=True,
    help="Write ply for MeshLab and similar programs, or vtp for ParaView.",
)
@click.option("--distances", is_flag=True, help="Also write the distance of each vertex from the reference.")
@output_option("Write the files into this folder.", ".")
@folder_option
@click.pass_context
def witness_command(
    context: click.Context,
    store: Location,
    meshes: tuple[str, ...],
    orders: tuple[float, ...],
    style: str,
    distances: bool,
    output: Path,
    folder: Path,
) -> None:
    """Write the meshes of STORE with their witness functions.

    The witness function shows where a mesh differs from the reference. Each mesh gets one file, in its own unit of
    length. The study makes the meshes again; a mesh is skipped and named if that fails, or if it is not the one that
    was computed.
    """
    from sobolev_batch.extras.figures.remade import exported

    made, labels, chosen = exported(store, meshes, orders or None, folder)
    _require_folder(output)
    output.mkdir(parents=True, exist_ok=True)
    is_complete = True
    for label in labels:
        try:
            mesh, values = made.with_witness(label, chosen)
        except SobolevBatchError as error:
            echo(f"{label}: {error}", err=True)
            is_complete = False
            continue
        path = output / f"{made.stem(label)}.{style}"
        made.write(path, label, mesh, values, chosen, distances=distances)
        echo(path)
    if not is_complete:
        context.exit(EXIT_SOME_FAILED)


@cli.command("report")
@store_argument
@output_option("Write the page to this file.", "report.html")
@folder_option
@up_option
@meshes_option("Show this mesh with its witness function.", "a few")
def report_command(store: Location, output: Path, folder: Path, up: Axis | None, meshes: tuple[str, ...]) -> None:
    """Write the results of STORE as one HTML page.

    The page needs no other files and makes no requests. What it leaves out is listed. The page of a collection has its
    league; each object has a store, and a report, of its own.
    """
    from sobolev_batch.extras.report.build import make_report, write_page

    page, omissions = make_report(store, folder=folder, witnesses=meshes, up=up)
    write_page(output, page)
    echo(output)
    for omission in omissions:
        echo(f"left out: {omission}", err=True)
