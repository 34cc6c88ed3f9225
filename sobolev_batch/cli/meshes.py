"""The command on two mesh files: compare."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sobolev_batch.cli.below import below_option, judge_files
from sobolev_batch.cli.group import cli
from sobolev_batch.cli.options import best_effort_option, memory_option, orders_option
from sobolev_batch.cli.output import echo, echo_lines
from sobolev_batch.visible import visible

if TYPE_CHECKING:
    import xarray as xr

# Of compare, which takes the nearest that can be had where nobody asks for more.
_DEFAULT_RTOL = 1e-2


@cli.command("compare")
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path))
@orders_option("Print the distance of this order, which may be any below -1/2.", "-2")
@click.option("--rtol", type=float, help="Reach this relative error at most. [default: 1e-2, or the nearest to be had]")
@memory_option("Let a transform for --rtol take so much memory. [default: 2GB]")
@best_effort_option
@click.option(
    "--xi-max",
    type=float,
    help="Sample frequencies up to this one on each axis, in place of --rtol. [default: 5 with --M]",
)
@click.option(
    "--M",
    "intervals",
    type=int,
    help="Divide each axis of the lattice into so many intervals, in place of --rtol. [default: 64 with --xi-max]",
)
@click.option(
    "--yardsticks",
    "with_yardsticks",
    is_flag=True,
    help="Print which move, noise and decimation bring B as far from itself, too. It takes several times as long.",
)
@click.option("--proximity", "with_proximity", is_flag=True, help="Print Hausdorff and Chamfer distances, too.")
@click.option(
    "--witness",
    "witness_path",
    type=click.Path(path_type=Path),
    metavar="PATH",
    help="Write both meshes with the witness function of the first order at their vertices, for MeshLab: into "
    "PATH-a.ply and PATH-b.ply.",
)
@click.option("--no-scaling", is_flag=True, help="Keep the files' unit. Otherwise B is scaled to the unit sphere.")
@below_option
@click.pass_context
def compare_command(
    context: click.Context,
    a: Path,
    b: Path,
    orders: tuple[float, ...],
    rtol: float | None,
    memory: int | None,
    best_effort: bool,
    xi_max: float | None,
    intervals: int | None,
    with_yardsticks: bool,
    with_proximity: bool,
    witness_path: Path | None,
    no_scaling: bool,
    below: float | None,
) -> None:
    """Print how much two meshes differ.

    B is the reference. The difference is given in per cent of its norm, with a bound on the error, and with the share
    of the squared distance that a change of area explains. With --below, print one line on whether both are the same
    surface. The exit status is then 0 if they are, 1 if they are not, and 4 if that cannot be told.
    """
    from sobolev_batch.spectral.lattice import Lattice
    from sobolev_batch.spectral.metrics.norms import distance
    from sobolev_batch.spectral.metrics.yardsticks import yardsticks
    from sobolev_batch.surfaces.formats.readers import read_mesh
    from sobolev_batch.surfaces.proximity import proximity
    from sobolev_batch.surfaces.shapes.similarity import Similarity, placement_doubt
    from sobolev_batch.testing.witness import require_place, write_difference

    if below is not None:
        context.exit(judge_files(context, a, b, below))
    if rtol is not None and (xi_max is not None or intervals is not None):
        raise click.UsageError("--rtol chooses the lattice; leave out --xi-max and --M")
    lattice = None
    if xi_max is not None or intervals is not None:
        lattice = Lattice(5.0 if xi_max is None else xi_max, 64 if intervals is None else intervals)
    elif rtol is None:
        rtol, best_effort = _DEFAULT_RTOL, True
    first, second = read_mesh(a), read_mesh(b)
    if witness_path is not None:
        require_place(witness_path)
    similarity = Similarity() if no_scaling else Similarity.to_unit_ball(second)
    pair = similarity.apply(first), similarity.apply(second)
    doubt = placement_doubt(*(surface.extent for surface in pair))
    if doubt is not None:
        echo(f"note: {a.name}: {doubt}", err=True)
    # Refused before a long computation where its library is not installed.
    nearness = proximity(*pair) if with_proximity else None
    orders = orders or (-2.0,)
    accuracy: dict[str, Any] = {"lattice": lattice, "rtol": rtol, "memory": memory, "best_effort": best_effort}
    results = yardsticks(*pair, orders, **accuracy) if with_yardsticks else distance(*pair, orders, **accuracy)
    _print_answers(a.name, b.name, results, first.area / second.area - 1, rtol)
    echo(f"scale {similarity.scale:.6g}, origin {' '.join(f'{x:.6g}' for x in similarity.origin)}")
    if nearness is not None:
        echo(
            f"Hausdorff at least {nearness.hausdorff:.2e}, "
            f"Chamfer {nearness.chamfer:.4e} ± {nearness.chamfer_error:.0e} (s.e.)"
        )
    if witness_path is not None:
        echo(write_difference(first, second, witness_path, orders[0], scaling=not no_scaling, subject=a.name))


def _print_answers(name: str, reference: str, results: xr.Dataset, area_change: float, rtol: float | None) -> None:
    """Print a sentence for each order, what is as far away if that was measured, and then the numbers."""
    from sobolev_batch.results.tables.formatting import answer, likeness

    by_order = [results.sel(order=order) for order in results["order"].values]
    for sentence in dict.fromkeys(answer(name, reference, result, area_change) for result in by_order):
        echo(sentence)
    # Of equal meshes there is no more to tell.
    unequal = [result for result in by_order if result["distance"] > 0]
    for result in unequal if "moved" in results else ():
        echo_lines(likeness(visible(name), visible(reference), result))
    for result in unequal:
        echo(_details(result, rtol))
    if rtol is not None and "M" in results.attrs:
        echo(_settings_text(results.attrs))


def _details(result: xr.Dataset, rtol: float | None) -> str:
    """Return the distance of one order and the parts of its error, on one line."""
    from sobolev_batch.results.tables.formatting import with_error

    names = ("truncation", "aliasing", "discretisation", *(("statistical",) if result["statistical"] > 0 else ()))
    parts = ", ".join(f"{name} {result[name].item():.0e}" for name in names)
    remark = "" if rtol is None or result["within"].item() else f", more than rtol {rtol:g}"
    distance_text = with_error(result["distance"].item(), result["error"].item())
    return f"order {result['order'].item():g}: distance {distance_text} ({parts}){remark}"


def _settings_text(attributes: Mapping[str, Any]) -> str:
    """Return what was chosen for an accuracy, on one line."""
    text = f"xi_max {attributes['xi_max']:.4g}, M {attributes['M']}, {attributes['dtype']}"
    if attributes["octaves"]:
        octaves = f"{attributes['octaves']} octave{'s' * (attributes['octaves'] != 1)}"
        text += f", {octaves} up to {attributes['highest_frequency']:.4g}, seed {attributes['seed']}"
    return text
