"""Commands that read a store, besides its tables: status, verify, unlock, prune."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import click

from sobolev_batch.cli.options import json_option, store_argument
from sobolev_batch.cli.output import echo, echo_result, lengthen, progress_bar, replace_line
from sobolev_batch.cli.program import EXIT_OTHER, EXIT_SOME_FAILED, cli

if TYPE_CHECKING:
    from sobolev_batch.store.location import Location

_FOLLOW_SECONDS = 2.0


@cli.command("status", shows_progress=True)
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
    replace_line("", shown)
    names = ("waiting", "going_on", "lost", "is_incomplete", "seconds_left")
    echo_result(style, current, vars(current) | {name: getattr(current, name) for name in names})
    if current.lost or (current.run is not None and current.run.state == "failed"):
        context.exit(EXIT_OTHER)
    if current.failed or current.not_compared or current.is_incomplete:
        context.exit(EXIT_SOME_FAILED)


@cli.command("verify", shows_progress=True, locks=True)
@store_argument
@json_option
@click.pass_context
def verify_command(context: click.Context, store: Location, style: str) -> None:
    """Check all data of STORE against its checksums.

    All its objects are checked. Damaged data are listed and, if STORE can be written, removed; `run`
    computes them again. The exit status is 1 if anything is damaged.
    """
    from sobolev_batch.batch.verify import verify

    with progress_bar(0, "fields") as bar:

        def show(done: int, total: int) -> None:
            if done == 1:
                lengthen(bar, total)
            bar.update(1)

        result = verify(store, show)
    echo_result(style, result, vars(result) | {"is_sound": result.is_sound})
    context.exit(0 if result.is_sound else EXIT_OTHER)


@cli.command("unlock", locks=True)
@store_argument
@click.option("--force", is_flag=True, help="Unlock it even if its run was active a moment ago.")
def unlock_command(store: Location, force: bool) -> None:
    """Remove the lock that a killed run left on STORE."""
    from sobolev_batch.store.latest_run import unlock

    lock = unlock(store, force=force)
    if lock is None:
        echo(f"{store}: not locked by any run")
    else:
        echo(f"{store}: unlocked; {lock.driver} had locked it since {lock.since}")


@cli.command("prune", locks=True)
@store_argument
@click.option("--yes", is_flag=True, help="Remove it. Otherwise only count its bytes.")
def prune_command(store: Location, yes: bool) -> None:
    """Remove what STORE keeps and no record needs.

    These are fields of meshes and objects that are no longer in the study, leftovers of killed runs, and tables that
    are not listed. Meshes that commands made are kept: other stores may use them.
    """
    from sobolev_batch.batch.prune import prune, prune_lost_objects
    from sobolev_batch.parameters import format_bytes
    from sobolev_batch.store.objects import stores_below

    total = prune_lost_objects(store, is_dry=not yes)
    if total:
        echo(f"objects that are no longer in the study: {format_bytes(total)}")
    for name, place in stores_below(store).items():
        for kind, size in prune(place, is_dry=not yes).items():
            total += size
            if size:
                echo(f"{name + ': ' * bool(name)}{kind}: {format_bytes(size)}")
    remark = "removed" if yes else "can be removed: give --yes"
    echo(f"{format_bytes(total)} {remark}" if total else "nothing to remove")
