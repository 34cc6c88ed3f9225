"""Commands of the extras: init, fit, plot, witness, report, export, table time, table league.

As all modules of commands, this one imports whatever computes inside of its functions.
"""

from __future__ import annotations

import math
import os
import sys
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import click

from sobolev_batch.cli.interruption import Deadline
from sobolev_batch.cli.options import PATH, ChosenOrders, location, orders_option, output_option, store_argument
from sobolev_batch.cli.output import echo, echo_lines, progress_bar
from sobolev_batch.cli.program import EXIT_SOME_FAILED, Command
from sobolev_batch.cli.table_commands import table_options
from sobolev_batch.errors import InputError, SobolevBatchError, StoreError, from_extra, require_writable, write_file
from sobolev_batch.extras.fitting import DEFAULT_SMOOTHING, DEFAULT_STEPS
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.shown import reasons, together

if TYPE_CHECKING:
    from sobolev_batch.extras.export import ExportFormat
    from sobolev_batch.extras.figures.style import PictureFormat
    from sobolev_batch.extras.figures.views import Axis, Colors
    from sobolev_batch.extras.fitting.fit import FitProgress, FitQuality
    from sobolev_batch.store.location import Location
    from sobolev_batch.tables import Format

_folder_option = click.option(
    "--folder",
    type=PATH,
    default=".",
    help="Rebuild the meshes of the study with its relative paths starting here. [default: current folder]",
)
_up_option = click.option(
    "--up",
    type=click.Choice(["x", "y", "z"]),
    help="Draw the meshes with this axis pointing up. [default: y or z, what they seem to rest on]",
)
_meshes_option = partial(click.option, *("--mesh", "meshes"), multiple=True, metavar="MESH")
_meshes_help = "{} A pattern such as 'scans/*' stands for several. The option may be repeated. [default: {}]".format


@click.command("init", cls=Command, short_help="Write a study file for a folder of meshes.")
@click.argument("folder", type=PATH, default=".")
@output_option(help="Write the study to this file, which must not exist.", default="study.toml")
def init_command(folder: Path, output: Path) -> None:
    """Write a study file for the meshes in FOLDER.

    The study runs as it is. The reference is the mesh that is called original, reference, target or ground truth, or
    else the one with the most triangles. Folders are families, and so are meshes whose names differ in the number at
    the end. Several references are several objects. Without FOLDER, the current one is taken.
    """
    from sobolev_batch.extras.draft import init_study

    echo_lines(init_study(folder, output))


@click.command(
    "fit", cls=Command, shows_progress=True, short_help="Move the vertices of START to bring it nearer to TARGET."
)
@click.argument("start", type=PATH)
@click.argument("target", type=PATH)
@output_option(help="Write the mesh to this file, .ply, .obj, .off or .stl.", required=True)
@click.option("--order", type=float, default=DEFAULT_ORDER, show_default=True, help="Lower the distance of this order.")
@click.option("--steps", type=int, default=DEFAULT_STEPS, metavar="N", show_default=True, help="Take N steps at most.")
@click.option(
    "--smoothing",
    type=float,
    default=DEFAULT_SMOOTHING,
    show_default=True,
    help="Smooth the steps: more keeps triangles better, less lowers the distance more. A far START takes at least 4.",
)
@click.option(
    *("--refine-to", "triangles"),
    type=int,
    metavar="N",
    help="Also split the edges that lower the distance most, until there are N triangles.",
)
@click.option("--keep-boundary", is_flag=True, help="Leave vertices of open boundaries where they are.")
@click.option("--no-scaling", is_flag=True, help="Keep the files' unit. Otherwise TARGET is scaled to the unit sphere.")
def fit_command(
    start: Path, target: Path, output: Path, triangles: int | None, no_scaling: bool, **settings: Any
) -> None:
    """Move the vertices of START to bring it nearer to TARGET, and write the mesh.

    Both are mesh files in the same unit. The triangles stay as they are, unless you refine them. Ctrl-C ends with the
    best mesh so far, and so does SIGTERM.
    """
    import numpy as np

    from sobolev_batch.extras.fitting.fit import fit, refine
    from sobolev_batch.extras.fitting.objective import require_comparable
    from sobolev_batch.geometry.formats.readers import read_mesh
    from sobolev_batch.geometry.formats.writing import require_writable, write_mesh
    from sobolev_batch.geometry.mesh import Mesh
    from sobolev_batch.geometry.surface import Similarity

    require_writable(output)
    own, goal = read_mesh(start), read_mesh(target)
    if output.exists() and output.samefile(target):
        raise InputError(f"{output}: this is the target, which would be lost; name another file")
    # Refused in the files' own unit.
    require_comparable(own, goal)
    similarity = Similarity() if no_scaling else Similarity.to_unit_ball(goal)
    method = fit if triangles is None else partial(refine, triangles=triangles)
    has_begun = Event()
    bar = progress_bar(1, "steps", show_count=False) if sys.stderr.isatty() else None

    def show(progress: FitProgress) -> None:
        has_begun.set()
        if bar is not None:
            bar.length = progress.steps
            # Earlier rounds may have needed fewer steps than they had.
            bar.update(progress.step - bar.pos)

    with bar or nullcontext(), Deadline.with_results(has_begun.is_set):
        fitted = method(similarity.apply(own), similarity.apply(goal), **settings, on_progress=show)
    vertices = np.asarray(fitted.mesh.vertices) / similarity.scale + np.asarray(similarity.origin)
    write_mesh(Mesh(vertices, fitted.mesh.triangles), output)
    echo(f"{len(fitted.mesh.triangles):,} triangles; {fitted.steps} steps; {fitted.end}")
    echo(f"before: {_text(fitted.before, similarity.scale)}")
    echo(f"after:  {_text(fitted.after, similarity.scale)}")
    for remark in (*fitted.remarks, *read_mesh(output).notes):
        echo(f"note: {remark}")


def _text(quality: FitQuality, scale: float) -> str:
    """Return the numbers on one line, lengths in the files' unit."""
    from sobolev_batch.tables.text import percent, with_error

    if not math.isfinite(quality.distance):
        return "not measured"
    text = f"differs by {percent(quality.relative, quality.relative_error)}, "
    text += f"distance {with_error(quality.distance, quality.error)}"
    if math.isfinite(quality.hausdorff):
        text += f", Hausdorff ≥ {quality.hausdorff / scale:.3g}, Chamfer {quality.chamfer / scale:.3g}"
    return f"{text}, smallest angle {quality.smallest_angle:.3g} degrees"


@click.command("plot", cls=Command)
@store_argument
@output_option(help="Write the pictures into this folder.", default=".")
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
@_meshes_option(help=_meshes_help("Draw this mesh with its witness function.", "a few"))
@_folder_option
@_up_option
@click.option(
    "--colors",
    type=click.Choice(["own", "common"]),
    default="own",
    show_default=True,
    help="Give each mesh its own scale of colours, or all a common one.",
)
def plot_command(
    store: Location,
    output: Path,
    formats: tuple[PictureFormat, ...],
    size: str | None,
    orders: ChosenOrders,
    families: tuple[str, ...],
    x: str | None,
    meshes: tuple[str, ...],
    folder: Path,
    up: Axis | None,
    colors: Colors,
) -> int:
    """Draw the results of STORE as pictures.

    They show convergence, distances and spectra, and some of the meshes. Those of several objects show their league.

    Meshes are coloured by their witness functions, which show where they differ from the reference. They are rebuilt
    from the study, by default a few, chosen by their distances. Pictures need the extra "plot".
    """
    from sobolev_batch.extras.leagues.league import league
    from sobolev_batch.extras.leagues.statistics import EDGE_LENGTH
    from sobolev_batch.store.objects import Objects

    with from_extra("plot", "a plot needs"):
        from sobolev_batch.extras.figures.drawing import COST_LEAGUE, LEAGUE, write_plots
        from sobolev_batch.extras.figures.selection import Selection
        from sobolev_batch.extras.figures.style import drawing, parse_size, write_figures
        from sobolev_batch.extras.figures.views import write_witness_plots

    panel, chosen = None if size is None else parse_size(size), families or None
    _require_folder(output)
    if Objects.read(store) is None:
        selection = Selection.from_store(store, orders, chosen, x or EDGE_LENGTH)
        # First, since a label may be wrong.
        witness_paths, missing = write_witness_plots(selection, output, folder, meshes, up, colors, formats, panel)
        paths, omissions = write_plots(selection, output, formats, panel)
        for path in (*paths, *witness_paths):
            echo(path)
        for name, notes in omissions.items():
            echo(f"{name}: {'; '.join(notes)}", err=True)
        for labels, reason in together(missing).items():
            echo(f"{labels}: not drawn with its witness function: {reason}", err=True)
        return EXIT_SOME_FAILED if missing and meshes else 0
    if meshes:
        raise click.UsageError("--mesh draws meshes of one object: name its store, such as STORE/OBJECT")
    figures = {}
    with drawing(panel):
        with suppress(InputError):
            figures["league-by-cost"] = COST_LEAGUE.figure(league(store, orders, by="cost", methods=chosen), size=panel)
        try:
            figures["league"] = LEAGUE.figure(league(store, orders, x=x, methods=chosen), size=panel)
        except InputError as error:
            if x or not figures:
                raise
            echo(f"league: {error}", err=True)
    for path in write_figures(figures, output, formats, panel):
        echo(path)
    return 0


def _require_folder(path: Path) -> None:
    """Refuse a folder that files cannot be written into, before they are made. It need not exist yet."""
    nearest = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        raise StoreError(f"{path}: no files can be written there: {nearest} is no folder that can be written")


@click.command("witness", cls=Command)
@store_argument
@_meshes_option(help=_meshes_help("Write this mesh.", "all"))
@orders_option("Write witness functions of this order, which may be any below -1/2.", "the study's")
@click.option(
    *("--format", "style"),
    type=click.Choice(["ply", "vtp"]),
    default="ply",
    show_default=True,
    help="Write ply for MeshLab and similar programs, or vtp for ParaView.",
)
@click.option("--distances", is_flag=True, help="Also write the distance of each vertex from the reference.")
@output_option(help="Write the files into this folder.", default=".")
@_folder_option
def witness_command(
    store: Location,
    meshes: tuple[str, ...],
    orders: ChosenOrders,
    style: str,
    distances: bool,
    output: Path,
    folder: Path,
) -> int:
    """Write the meshes of STORE with their witness functions.

    The witness function shows where a mesh differs from the reference. Each mesh gets one file, in its own unit of
    length. The study makes the meshes again; a mesh is skipped and named if that fails, or if it is not the one that
    was computed.
    """
    from sobolev_batch.extras.figures.remade import exported, stem_of, write_vertex_witness

    made, labels, chosen = exported(store, meshes, orders, folder)
    _require_folder(output)
    output.mkdir(parents=True, exist_ok=True)
    reference, missing = made.reference if distances else None, dict[str, str]()
    for label in labels:
        try:
            found = made.with_witness(label, chosen, reference)
        except SobolevBatchError as error:
            missing[label] = str(error)
            continue
        path = output / f"{stem_of(made.tree, label)}.{style}"
        write_vertex_witness(path, found)
        echo(path)
    for _, line in reasons("", together(missing)):
        echo(line, err=True)
    return EXIT_SOME_FAILED if missing else 0


@click.command("report", cls=Command)
@store_argument
@output_option(help="Write the page to this file.", default="report.html")
@_folder_option
@_up_option
@_meshes_option(help=_meshes_help("Show this mesh with its witness function.", "a few"))
def report_command(store: Location, output: Path, folder: Path, up: Axis | None, meshes: tuple[str, ...]) -> None:
    """Write the results of STORE as one HTML page.

    The page needs no other files and makes no requests. What it leaves out is listed. The page of several objects
    has their league; STORE/OBJECT is the store of each, which has a page of its own. Pages need the extra "report".
    """
    from sobolev_batch.extras.report.build import make_report

    require_writable(output, "the report")
    page, omissions = make_report(store, folder=folder, witnesses=meshes, up=up)
    write_file(output, page.encode(), "the report")
    echo(output)
    for omission in omissions:
        echo(f"left out: {omission}", err=True)


@click.command("export", cls=Command)
@store_argument
@output_option(help="Write the tables to this file.", required=True)
@click.option(
    *("--format", "style"),
    type=click.Choice(["parquet", "netcdf", "csv"]),
    help="Write a long table, or with netcdf the groups of tables. The first two need the extra export. "
    "[default: by the ending of the file: .parquet, .nc, .csv]",
)
@orders_option("Write the table of this order, for parquet and csv.", "the study's")
def export_command(store: Location, output: Path, style: ExportFormat | None, orders: ChosenOrders) -> None:
    """Write the tables of STORE to a file. Coordinates go with them."""
    from sobolev_batch.extras.export import BY_ENDING, export

    style = style or BY_ENDING.get(output.suffix.lower())
    if style is None:
        raise click.UsageError(f"no format has the ending {output.suffix!r}; give --format parquet, netcdf or csv")
    if orders and style == "netcdf":
        raise click.UsageError("--order is for parquet and csv; netcdf has the orders of the study")
    export(store, output, style, orders)
    echo(output)


@click.command("time")
@table_options
@click.option(
    "--factor",
    type=click.FloatRange(min=1.0, min_open=True),
    default=2.0,
    show_default=True,
    help="Report when the distance has grown by this factor.",
)
def time_command(store: Location, style: Format, orders: ChosenOrders, factor: float) -> None:
    """Print distances of moving meshes over time."""
    from sobolev_batch.extras.leagues.evolution import format_evolution

    echo_lines(format_evolution(store, style, orders, factor=factor), style)


@click.command("league")
@table_options
@click.option(
    "--by",
    type=click.Choice(["size", "cost"]),
    default="size",
    show_default=True,
    help="Compare at equal sizes, or list the meshes that no other beats in distance and cost.",
)
@click.option("--x", help="Take this size or cost of a mesh. [default: triangles by size, make_seconds by cost]")
@click.option(
    "--y",
    "columns",
    multiple=True,
    default=["relative"],
    show_default=True,
    help="Compare this column of the table, of which less is better; may be repeated.",
)
@click.option("--family", "families", multiple=True, help="Compare this method; may be repeated. [default: all]")
@click.option(
    "--against",
    type=location,
    metavar="STORE",
    help="Compare with this earlier study instead; families within tolerances need --y triangles.",
)
@click.option(
    "--most", type=click.FloatRange(min=1.0), metavar="RATIO", help="Fail if a mean ratio to that study is above it."
)
def league_command(
    store: Location,
    style: Format,
    orders: ChosenOrders,
    by: str,
    x: str | None,
    columns: tuple[str, ...],
    families: tuple[str, ...],
    against: Location | None,
    most: float | None,
) -> int:
    """Rank methods over the objects of STORE.

    With --by cost, STORE may also be that of one object. With --against, compare each method with itself in an earlier
    study instead. The exit status is then 1 if any method is farther by the test (or has more of another column than
    the distance), if its mean ratio is above --most, or if a mesh of the earlier study is missing.
    """
    from sobolev_batch.extras.leagues.changes import compare_studies, format_changes
    from sobolev_batch.extras.leagues.costs import format_cost_leagues
    from sobolev_batch.extras.leagues.league import format_league, league

    is_worse = False
    if against is None and most is not None:
        raise click.UsageError("--most is a ratio to an earlier study: name it with --against")
    if against is not None and (x or by == "cost"):
        raise click.UsageError("--against compares meshes of the same names: leave out --by and --x")
    if against is not None:
        changes = compare_studies(store, against, orders, y=columns, methods=families or None)
        larger = changes[changes["ratio"] > (math.inf if most is None else most)]
        for row in larger.to_dict("records"):
            echo(f"{row['method']}: {row['y']} grew {row['ratio']:.3g} times in the mean, above {most:g}", err=True)
        is_worse = bool(changes.attrs["lost"]) or (changes["verdict"] == "farther").any() or len(larger) > 0
        text = format_changes(changes, style)
    elif by == "cost":
        text = format_cost_leagues(league(store, orders, by="cost", x=x, methods=families or None), style)
    else:
        by_size = [league(store, orders, x=x, y=y, methods=families or None) for y in columns]
        text = format_league([one for leagues in by_size for one in leagues], style)
    echo_lines(text, style)
    return int(is_worse)
