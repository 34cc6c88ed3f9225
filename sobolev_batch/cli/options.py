"""Arguments and options that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from sobolev_batch.tables import FORMATS

if TYPE_CHECKING:
    from distributed import Client

    from sobolev_batch.store.location import Location

PATH = click.Path(path_type=Path)
Callback = TypeVar("Callback", bound=Callable[..., Any])
ChosenOrders = tuple[float, ...] | None


def _numbers(value: Any) -> tuple[float, ...]:
    try:
        # A default was converted already.
        return value if isinstance(value, tuple) else tuple(float(part) for part in str(value).split(","))
    except ValueError as error:
        raise click.BadParameter(f"{value!r} is neither a number nor a list of numbers such as -4,-6") from error


def orders_option(text: str, default: str) -> Callable[[Callback], Callback]:
    """Return the option --order of a command, whose value is each of several orders once, or None."""

    def flattened(context: click.Context, param: click.Parameter, lists: tuple[tuple[float, ...], ...]) -> Any:
        return tuple(dict.fromkeys(number for numbers in lists for number in numbers)) or None

    return click.option(
        *("--order", "orders"),
        type=_numbers,
        multiple=True,
        callback=flattened,
        metavar="ORDERS",
        help=f"{text} Give several as --order -4,-6, or repeat the option. [default: {default}]",
    )


def location(value: Any) -> Location:
    """Return the location of a store that an option names."""
    from sobolev_batch.store.location import Location

    return Location.parse(value)


def memory_size(value: Any) -> int:
    """Return the bytes of a size such as 4GB."""
    from sobolev_batch.parameters import byte_count

    return byte_count(value)


store_argument = click.argument("store", type=location, metavar="STORE")
_in_format = partial(click.option, "--format", "style", default="text", show_default=True)
format_option = _in_format(
    type=click.Choice(FORMATS), help="Print text, markdown or latex for people, csv or json for programs."
)
json_option = _in_format(
    type=click.Choice(["text", "json"]), help="Print text for people, or one JSON document for programs."
)
output_option = partial(click.option, "-o", "--output", type=PATH, show_default=True)


def scheduler_options(*, required: bool = False) -> Callable[[Callback], Callback]:
    """Return the options of a command that may compute on a cluster, whose client is that of `client_of`."""
    scheduler = click.option(
        "--scheduler",
        metavar="ADDRESS",
        required=required,
        help="Take the workers of this Dask scheduler, such as tls://host:8786.",
    )
    trust = click.option(
        "--trust-network",
        is_flag=True,
        help="Use a scheduler that is neither encrypted (tls://) nor on loopback. Everyone who reaches its ports or "
        "those of its workers can then run programs on these machines and read the meshes.",
    )
    return lambda command: scheduler(trust(command))


def client_of(
    scheduler: str | None, trust_network: bool, *of_processes: object
) -> AbstractContextManager[Client | None]:
    """Return the client of a scheduler for a block, or none where none is named; settings of processes are for that."""
    from sobolev_batch.batch.cluster.clients import remote_client

    if scheduler and any(of_processes):
        raise click.UsageError("workers and their memory are of this machine; those of a --scheduler have their own")
    return remote_client(scheduler, trust_network) if scheduler else nullcontext()


workers_option = click.option(
    "--workers",
    type=click.IntRange(min=1),
    metavar="N",
    help="Start N processes on this machine. [default: one per core]",
)
