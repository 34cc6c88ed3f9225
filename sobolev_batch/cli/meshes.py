"""The command that takes two mesh files: compare."""

from __future__ import annotations

from pathlib import Path

import click

from sobolev_batch.cli.group import cli
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.metrics.norms import distance
from sobolev_batch.surfaces.formats.readers import read_mesh
from sobolev_batch.surfaces.proximity import proximity
from sobolev_batch.surfaces.shapes.similarity import Similarity


@cli.command("compare")
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path))
@click.option("--order", "orders", type=float, multiple=True, help="Sobolev order; may be repeated. [default: -2]")
@click.option("--rtol", type=float, help="Largest error relative to the distance; instead of a lattice.")
@click.option("--memory-gb", type=float, help="What a transform may take with --rtol. [default: 2]")
@click.option("--xi-max", type=float, help="Highest frequency per axis. [default: 5]")
@click.option("--M", "intervals", type=int, help="Lattice intervals per axis. [default: 64]")
@click.option("--proximity", "nearness", is_flag=True, help="Hausdorff and Chamfer distances too.")
@click.option("--no-scaling", is_flag=True, help="Keep the files' own unit instead of fitting B into the unit sphere.")
def compare_command(
    a: Path,
    b: Path,
    orders: tuple[float, ...],
    rtol: float | None,
    memory_gb: float | None,
    xi_max: float | None,
    intervals: int | None,
    nearness: bool,
    no_scaling: bool,
) -> None:
    """Print the distance of the mesh files A and B, B being the reference."""
    if rtol is not None and (xi_max is not None or intervals is not None):
        raise click.UsageError("--rtol chooses the lattice; leave out --xi-max and --M")
    lattice = None if rtol is not None else Lattice(xi_max or 5.0, intervals or 64)
    first, second = read_mesh(a), read_mesh(b)
    similarity = Similarity() if no_scaling else Similarity.to_unit_ball(second)
    pair = similarity.apply(first), similarity.apply(second)
    memory = None if memory_gb is None else 1e9 * memory_gb
    near = proximity(*pair) if nearness else None
    found = distance(*pair, tuple(dict.fromkeys(orders)) or (-2.0,), lattice=lattice, rtol=rtol, memory=memory)
    click.echo(f"scale {similarity.scale:.9g}, origin {' '.join(f'{x:.9g}' for x in similarity.origin)}")
    if rtol is not None:
        click.echo(f"xi_max {found.attrs['xi_max']:.4g}, M {found.attrs['M']}, {found.attrs['dtype']}")
    for order in found["order"].values:
        here = found.sel(order=order)
        parts = ", ".join(f"{name} {here[name].item():.0e}" for name in ("truncation", "aliasing", "discretisation"))
        short = "" if rtol is None or here["within"].item() else f", more than rtol {rtol:g}"
        click.echo(f"order {order:g}: {here['distance'].item():.9e} ± {here['error'].item():.0e} ({parts}){short}")
    if near is not None:
        click.echo(
            f"Hausdorff at least {near.hausdorff:.2e}, Chamfer {near.chamfer:.4e} ± {near.chamfer_error:.0e} (s.e.)"
        )
