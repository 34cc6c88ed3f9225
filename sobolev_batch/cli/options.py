"""Options that several commands have."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from sobolev_batch.batch.storage.location import Location

Command = TypeVar("Command", bound=Callable[..., Any])

store_argument = click.argument("store", type=Location.of, metavar="STORE")
store_option = click.option(
    "--store", type=Location.of, metavar="PATH|URL", help="Store of the results. [default: storage/NAME.zarr]"
)
study_argument = click.argument("study", type=click.Path(path_type=Path))
order_option = click.option("--order", "orders", type=float, multiple=True, help="Only this order; may be repeated.")
trust_option = click.option(
    "--trust-network",
    is_flag=True,
    help="Use a scheduler that is neither encrypted (tls://) nor on loopback. Everyone who reaches its ports or "
    "those of its workers can then run programs on these machines and read the meshes.",
)
folder_option = click.option(
    "--folder",
    type=click.Path(path_type=Path),
    default=".",
    help="Base folder of the study's relative paths, to rebuild its meshes. [default: current folder]",
)
up_option = click.option(
    "--up",
    type=click.Choice(["x", "y", "z"]),
    default="z",
    show_default=True,
    help="Axis of the meshes that points up.",
)


def output_option(text: str, default: str) -> Callable[[Command], Command]:
    """Return the option --output of a command that writes files."""
    return click.option("--output", type=click.Path(path_type=Path), default=default, show_default=True, help=text)


def memory_of(memory: int | None, old: str, old_memory: int | None) -> int | None:
    """Return the memory that --memory gives, or the name that it had before, which works for one more release."""
    if old_memory is None:
        return memory
    if memory is not None:
        raise click.UsageError(f"{old} is the old name of --memory; give --memory alone")
    click.echo(f"{old} is now called --memory and takes sizes such as 4GB; {old} will be removed", err=True)
    return old_memory
