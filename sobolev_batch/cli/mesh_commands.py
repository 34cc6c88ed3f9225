"""Commands on mesh files: compare, with a verdict as exit status where asked, info, and reduce."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sobolev_batch.cli.options import (
    PATH,
    client_of,
    format_option,
    json_option,
    memory_size,
    orders_option,
    output_option,
    scheduler_options,
    workers_option,
)
from sobolev_batch.cli.output import echo, echo_lines, echo_result
from sobolev_batch.cli.program import ERROR_STATUS, EXIT_INPUT, EXIT_SOME_FAILED, cli
from sobolev_batch.errors import MeshError
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.plugins import FEATURES, extra
from sobolev_batch.visible import visible

if TYPE_CHECKING:
    from sobolev_batch.geometry.mesh import Mesh
    from sobolev_batch.tables import Format

# Why a mesh has no volume, by the edges that it has.
_NO_VOLUME = {
    "boundary_edges": "it is not closed",
    "nonmanifold_edges": "edges have more than two triangles",
    "inconsistent_edges": "normals flip",
}
# Exit statuses of a verdict; like diff, which has 1 for files that differ.
_STATUSES = {"same": 0, "within": 0, "different": 1, "not within": 1, "undecided": 4}


@cli.command("compare")
@click.argument("a", type=PATH)
@click.argument("b", type=PATH)
@orders_option("Print the distance of this order, which may be any below -1/2.", f"{DEFAULT_ORDER:g}")
@click.option(
    "--rtol", type=float, help="Reach this relative error at most. [default: 1e-2, or the nearest attainable]"
)
@click.option(
    "--memory", type=memory_size, metavar="SIZE", help="Limit the memory of a transform for --rtol. [default: 2GB]"
)
@click.option(
    "--best-effort",
    is_flag=True,
    help="Take the nearest attainable accuracy where the requested one is out of reach, and mark it.",
)
@click.option(
    "--xi-max",
    type=float,
    help="Sample frequencies up to this one on each axis, in place of --rtol. [default: 5 with --M]",
)
@click.option(
    "--M",
    "intervals",
    type=int,
    metavar="M",
    help="Divide each axis of the lattice into M intervals, in place of --rtol. [default: 64 with --xi-max]",
)
@click.option(
    "--proximity", is_flag=True, help="Also print distances of points: the largest deviation, mean, RMS and others."
)
@click.option(
    "--threshold", type=float, help="Take this length for the F-score of --proximity. [default: 1 % of the radius of B]"
)
@click.option("--align", is_flag=True, help="First move A rigidly to where it is nearest to B.")
@click.option(
    "--unit",
    metavar="NAME",
    help="Name the unit of length of both files, such as mm. The first line is then the largest deviation.",
)
@click.option(
    "--witness",
    type=PATH,
    metavar="PATH",
    help="Write both meshes with the witness function of the first order at their vertices, for MeshLab, into "
    "PATH-a.ply and PATH-b.ply, or draw them if PATH ends in .png, .svg or .pdf. With --proximity also distances.",
)
@click.option(
    "--report", type=PATH, metavar="PATH", help="Write one HTML page for a browser and for one sheet of paper."
)
@click.option("--no-scaling", is_flag=True, help="Keep the files' unit. Otherwise B is scaled to the unit sphere.")
@click.option(
    "--within",
    metavar="TOLERANCE",
    help="Tell by the exit status whether no point of either mesh is farther from the other one than a length, such as "
    "0.1 in the files' unit, or 0.1mm with --unit; or whether the distance is below 1% of the norm of B.",
)
@click.option("--one-way", is_flag=True, help="Of a length, count points of A alone: B may have parts that A lacks.")
@click.option("--verbose", is_flag=True, help="Also print the parts of each error, and the settings that were chosen.")
@json_option
@click.pass_context
def compare_command(context: click.Context, /, **options: Any) -> None:
    """Print how much two meshes differ.

    B is the reference. The difference is given in per cent of its norm, with an estimate of the largest error, the
    share of the squared distance that a change of area explains, and the move of B that takes it as far from itself.

    With --within, one line says instead whether they are as near everywhere as a length, or the same surface to a
    percentage. The exit status is then 0 if they are, 1 if they are not, 4 if that cannot be told, and 2 after any
    error.
    """
    if options["within"] is not None:
        # The usual status of other errors says that the files differ.
        context.meta[ERROR_STATUS] = EXIT_INPUT
    # Here, since it loads what computes.
    from sobolev_batch.cli.comparison import CompareOptions, Comparison

    chosen = CompareOptions(**options)
    write_page = extra(FEATURES, "comparison", "--report") if chosen.report is not None else None
    if (verdict := chosen.verdict()) is not None:
        line, numbers = verdict
        echo_result(chosen.style, visible(line), numbers)
        if write_page is not None:
            write_page(chosen.report, Comparison.of_files(chosen), line)
            if chosen.style == "text":
                echo(str(chosen.report))
        context.exit(_STATUSES[numbers["outcome"]])
    found = Comparison.of_files(chosen)
    echo_result(chosen.style, "\n".join(map(visible, found.lines)), found.document)
    written = [] if chosen.witness is None else [found.write_witness(chosen.witness)]
    if write_page is not None:
        write_page(chosen.report, found)
        written.append(str(chosen.report))
    for line in written if chosen.style == "text" else ():
        echo(line)


@cli.command("info")
@click.argument("files", type=PATH, nargs=-1, required=True, metavar="FILE...")
@json_option
@click.pass_context
def info_command(context: click.Context, files: tuple[Path, ...], style: str) -> None:
    """Print what mesh files hold: counts, size, and what is unusual.

    Lengths are in the unit of each file. Edges of one triangle are open, and vertices of the same place are one.
    The aspect ratio of an equilateral triangle is 1.
    """
    from sobolev_batch.geometry.formats.readers import read_mesh

    facts: list[dict[str, Any]] = []
    refused: list[MeshError] = []
    for path in files:
        try:
            facts.append(_facts(path, read_mesh(path)))
        except MeshError as error:
            refused.append(error)
    if facts:
        echo_result(style, "\n".join(visible(line) for one in facts for line in _fact_lines(one)), {"files": facts})
    for refusal in refused:
        echo(f"error: {refusal}", err=True)
    if refused:
        context.exit(EXIT_INPUT)


def _fact_lines(facts: Mapping[str, Any]) -> Iterator[str]:
    ends = list(zip("xyz", *facts["box"], strict=True))
    size = max(high - low for _, low, high in ends)
    # Far from the origin, coordinates need more digits.
    digits = 6 + math.ceil(math.log10(max(1.0, *(max(-low, high) / size for _, low, high in ends))))
    box = ", ".join(f"{axis} {low:.{digits}g} to {high:.{digits}g}" for axis, low, high in ends)
    extents = " by ".join(f"{high - low:.6g}" for _, low, high in ends)
    reasons = " and ".join(reason for key, reason in _NO_VOLUME.items() if facts[key])
    volume = f"none: {reasons}" if math.isnan(facts["volume"]) else f"{facts['volume']:.6g}"
    yield f"{facts['file']}: {facts['triangles']:,} triangles, {facts['vertices']:,} vertices"
    yield f"  area {facts['area']:.6g}, volume {volume}"
    yield f"  box {box}: {extents}"
    yield (
        f"  smallest angle {facts['smallest_angle']:.3g}° (median {facts['smallest_angle_median']:.3g}°), "
        f"aspect ratio up to {facts['aspect_ratio']:.3g} (median {facts['aspect_ratio_median']:.3g})"
    )
    yield f"  {'; '.join(facts['defects']) or 'closed, all triangles face outwards'}"
    if loops := facts["boundary_loops"]:
        yield f"  {loops:,} boundary loop{'s' * (loops != 1)}"
    if facts["components"] > 1:
        closed = "" if facts["boundary_edges"] else "closed "
        inside = f", {facts['nested']:,} inside others" if facts["nested"] else ""
        yield f"  {facts['components']:,} {closed}components{inside}"
    if 2 * facts["duplicate_triangles"] == facts["triangles"]:
        yield "  every triangle is there twice"
    yield from (f"  note: {note}" for note in facts["notes"])


def _facts(path: Path, mesh: Mesh) -> dict[str, Any]:
    """Return what is known of a mesh by itself, lengths in its own unit."""
    import numpy as np

    from sobolev_batch.geometry.parts import boundary_loops, nested_parts

    merged = mesh.merged or mesh
    angles, ratios = mesh.smallest_angles, mesh.aspect_ratios
    return {
        "file": path,
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.triangles),
        "area": mesh.area,
        "volume": mesh.volume,
        "box": [end.tolist() for end in mesh.extent.box],
        "smallest_angle": float(angles.min()),
        "smallest_angle_median": float(np.median(angles)),
        "aspect_ratio": float(ratios.max()),
        "aspect_ratio_median": float(np.median(ratios)),
        **merged.counts,
        "boundary_loops": boundary_loops(merged),
        "nested": nested_parts(merged),
        "defects": mesh.defects,
        "notes": mesh.notes,
    }


def _range(context: click.Context, param: click.Parameter, value: str | None) -> dict[str, tuple[float, float]] | None:
    """Return the parameter that is searched with its ends, from NAME=LOW:HIGH."""
    if value is None:
        return None
    name, _, ends = value.partition("=")
    try:
        low, high = ((float if set(end) & set(".eE") else int)(end) for end in ends.split(":"))
    except ValueError as error:
        raise click.BadParameter(f"{value!r} is no range such as hausd=0.001:1.0 or triangles=100:5000") from error
    return {name: (low, high)}


@cli.command("reduce", remark="; the same command goes on from its last trial")
@click.argument("files", nargs=-1, required=True, type=PATH)
@click.option(
    "--within",
    required=True,
    metavar="TOLERANCE",
    help="Keep the largest deviation within a length, such as 0.1mm, or the distance within 1% of the norm.",
)
@click.option("--order", type=float, help=f"Measure percentages at this order below -1/2. [default: {DEFAULT_ORDER:g}]")
@click.option(
    "--measure", metavar="COLUMN", help="Keep rms, mean, area or another column within TOLERANCE, or fscore above."
)
@click.option("--unit", metavar="NAME", help="Name the unit of length of the files, such as mm.")
@click.option(
    *("--with", "method"),
    default="decimate",
    show_default=True,
    metavar="METHOD",
    help="Make meshes by 'mmgs_O3 -in {input} -out {output} -hausd {hausd}' or another command, or by remesh.",
)
@click.option(
    "--search",
    callback=_range,
    metavar="NAME=LOW:HIGH",
    help="Search a parameter between two values; whole numbers try those alone. [default: triangles]",
)
@click.option("--suffix", metavar="SUFFIX", help="Give a command files of this format, such as .mesh. [default: .ply]")
@click.option("--timeout", metavar="TIME", help="End a command after this time, such as '10 min'. [default: 1 h]")
@output_option(help="Write meshes and records of trials there.", type=str, required=True, metavar="FOLDER|URL")
@workers_option
@scheduler_options()
@format_option
@click.pass_context
def reduce_command(
    context: click.Context,
    /,
    files: tuple[Path, ...],
    style: Format,
    scheduler: str | None,
    trust_network: bool,
    suffix: str | None,
    timeout: str | None,
    **settings: Any,
) -> None:
    """Find the fewest triangles of each mesh within a tolerance.

    Each mesh is made with more or fewer triangles and compared with its file, until the coarsest one within the
    tolerance is known. Bounds decide, or samples with their errors. The same command goes on where it was ended. A
    command in METHOD runs in a folder of its own, here or on the workers; {folder} in it is the current one.

    Where no smaller mesh is within the tolerance, the original is written, and a note says so. The exit status is 3 if
    nothing was found for some mesh.
    """
    from sobolev_batch.batch.reduce import format_reductions, reduce

    given = {"input": suffix, "output": suffix, "timeout": timeout}
    if own := {key: value for key, value in given.items() if value is not None}:
        settings["method"] = {"source": "command", "command": shlex.split(settings["method"]), **own}
    tell = partial(echo, err=True) if len(files) > 1 else None
    with client_of(scheduler, trust_network, settings["workers"]) as client:
        found = reduce(files, client=client, on_progress=tell, **settings)
    echo_lines(format_reductions(found, style, settings["unit"]), style)
    if any(one.reason for one in found.values()):
        context.exit(EXIT_SOME_FAILED)
