"""The command on two mesh files: compare."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from sobolev_batch.cli.group import cli
from sobolev_batch.cli.options import memory_of
from sobolev_batch.parameters import byte_count
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.metrics.norms import distance
from sobolev_batch.surfaces.formats.readers import read_mesh
from sobolev_batch.surfaces.proximity import proximity
from sobolev_batch.surfaces.shapes.similarity import Similarity


@cli.command("compare")
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path))
@click.option("--order", "orders", type=float, multiple=True, help="Sobolev order; may be repeated. [default: -2]")
@click.option("--rtol", type=float, help="Largest relative error; use instead of --xi-max and --M.")
@click.option("--memory", type=byte_count, metavar="SIZE", help="Memory of a transform, for --rtol. [default: 2GB]")
@click.option("--memory-gb", type=float, hidden=True)
@click.option("--xi-max", type=float, help="Highest frequency on each axis. [default: 5]")
@click.option("--M", "intervals", type=int, help="Lattice intervals on each axis. [default: 64]")
@click.option("--proximity", "with_proximity", is_flag=True, help="Also print Hausdorff and Chamfer distances.")
@click.option("--no-scaling", is_flag=True, help="Keep the files' unit; otherwise B is scaled to the unit sphere.")
def compare_command(
    a: Path,
    b: Path,
    orders: tuple[float, ...],
    rtol: float | None,
    memory: int | None,
    memory_gb: float | None,
    xi_max: float | None,
    intervals: int | None,
    with_proximity: bool,
    no_scaling: bool,
) -> None:
    """Print the Sobolev distance of two mesh files.

    B is the reference.
    """
    if rtol is not None and (xi_max is not None or intervals is not None):
        raise click.UsageError("--rtol chooses the lattice; leave out --xi-max and --M")
    memory = memory_of(memory, "--memory-gb", None if memory_gb is None else byte_count(1e9 * memory_gb))
    lattice = (
        None if rtol is not None else Lattice(5.0 if xi_max is None else xi_max, 64 if intervals is None else intervals)
    )
    first, second = read_mesh(a), read_mesh(b)
    similarity = Similarity() if no_scaling else Similarity.to_unit_ball(second)
    pair = similarity.apply(first), similarity.apply(second)
    # Refused before a long computation where its library is not installed.
    nearness = proximity(*pair) if with_proximity else None
    orders = tuple(dict.fromkeys(orders)) or (-2.0,)
    results = distance(*pair, orders, lattice=lattice, rtol=rtol, memory=memory)
    click.echo(f"scale {similarity.scale:.9g}, origin {' '.join(f'{x:.9g}' for x in similarity.origin)}")
    if rtol is not None and "M" not in results.attrs:
        click.echo("both files have the same triangles: nothing had to be computed")
    elif rtol is not None:
        click.echo(_settings_text(results.attrs))
    for order in results["order"].values:
        result = results.sel(order=order)
        names = ("truncation", "aliasing", "discretisation", *(("statistical",) if result["statistical"] > 0 else ()))
        parts = ", ".join(f"{name} {result[name].item():.0e}" for name in names)
        remark = "" if rtol is None or result["within"].item() else f", more than rtol {rtol:g}"
        click.echo(f"order {order:g}: {result['distance'].item():.9e} ± {result['error'].item():.0e} ({parts}){remark}")
    if nearness is not None:
        click.echo(
            f"Hausdorff at least {nearness.hausdorff:.2e}, "
            f"Chamfer {nearness.chamfer:.4e} ± {nearness.chamfer_error:.0e} (s.e.)"
        )


def _settings_text(attributes: Mapping[str, Any]) -> str:
    """Return what was chosen for an accuracy, on one line."""
    text = f"xi_max {attributes['xi_max']:.4g}, M {attributes['M']}, {attributes['dtype']}"
    if attributes["octaves"]:
        text += (
            f", {attributes['octaves']} octaves up to {attributes['highest_frequency']:.4g}, seed {attributes['seed']}"
        )
    return text
