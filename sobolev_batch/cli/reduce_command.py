"""The command reduce: the fewest triangles of each mesh within a tolerance."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sobolev_batch.cli.options import PATH, format_option
from sobolev_batch.cli.output import echo, echo_lines
from sobolev_batch.cli.program import EXIT_SOME_FAILED, cli
from sobolev_batch.norms import DEFAULT_ORDER

if TYPE_CHECKING:
    from sobolev_batch.batch.reduce import Reduction
    from sobolev_batch.tables import Format


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
@click.option("--order", type=float, help=f"Measure this fraction at an order below -1/2. [default: {DEFAULT_ORDER:g}]")
@click.option("--unit", metavar="NAME", help="Name the unit of length of the files, such as mm.")
@click.option(
    *("--with", "method"),
    default="decimate",
    show_default=True,
    metavar="METHOD",
    help="Take 'mmgs_O3 -in {input} -out {output} -hausd {hausd}' or another command, or the source remesh.",
)
@click.option(
    "--search",
    callback=_range,
    metavar="NAME=LOW:HIGH",
    help="Search a parameter between two values; whole numbers try those alone. [default: triangles]",
)
@click.option("--output", required=True, metavar="FOLDER|URL", help="Write meshes and records of trials there.")
@click.option("--workers", type=click.IntRange(min=1), metavar="N", help="Start N processes. [default: one per core]")
@click.option(
    "--scheduler", metavar="ADDRESS", help="Take the workers of this Dask scheduler, such as tls://host:8786."
)
@click.option("--trust-network", is_flag=True, help="Use a scheduler that others may reach; see run.")
@format_option
@click.pass_context
def reduce_command(
    context: click.Context,
    /,
    files: tuple[Path, ...],
    style: Format,
    scheduler: str | None,
    trust_network: bool,
    **settings: Any,
) -> None:
    """Find the fewest triangles of each mesh within a tolerance.

    Each mesh is made with more or fewer triangles and compared with its file, until the coarsest one within the
    tolerance is known. Bounds decide. The same command goes on where it was ended. A command in METHOD runs here, or
    on the workers.

    The exit status is 3 if nothing within the tolerance was found for some.
    """
    from sobolev_batch.batch.cluster.clients import remote_client
    from sobolev_batch.batch.reduce import format_reductions, reduce

    if scheduler and settings["workers"]:
        raise click.UsageError("--workers is for processes on this machine; a scheduler has its own")

    def tell(one: Reduction) -> None:
        if len(files) > 1:
            echo(one, err=True)

    with remote_client(scheduler, trust_network) if scheduler else nullcontext() as client:
        found = reduce(files, client=client, on_progress=tell, **settings)
    echo_lines(format_reductions(found, style, settings["unit"]))
    if any(one.reason for one in found.values()):
        context.exit(EXIT_SOME_FAILED)
