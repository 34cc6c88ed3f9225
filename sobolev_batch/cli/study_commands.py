"""Commands that take a study file: run, submit, plan; and its schema."""

from __future__ import annotations

import json
import shlex
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sobolev_batch.cli.options import (
    PATH,
    client_of,
    json_option,
    location,
    memory_size,
    scheduler_options,
    workers_option,
)
from sobolev_batch.cli.output import echo, echo_lines, echo_result, progress_reports, show_step
from sobolev_batch.cli.program import EXIT_SOME_FAILED, cli
from sobolev_batch.errors import InputError
from sobolev_batch.plugins import COMMANDS, extra
from sobolev_batch.shown import reasons, together
from sobolev_batch.visible import visible

if TYPE_CHECKING:
    from sobolev_batch.store.location import Location

_MOST_OBJECTS = 10


_study_argument = click.argument("study", type=PATH)
_store_option = click.option(
    "--store", type=location, metavar="PATH|URL", help="Keep the results in this store. [default: storage/NAME.zarr]"
)
_allow_commands_option = click.option(
    "--allow-commands", is_flag=True, help="Let the commands of STUDY run, which make its meshes: you trust its file."
)
_only_option = click.option(
    "--only",
    multiple=True,
    metavar="PART",
    help="Compute this part with the reference: OBJECT, FAMILY, FAMILY/MEMBER, or the latter two after OBJECT/; "
    "patterns such as 'mmg/0.0*' work. The option may be repeated.",
)


@cli.command("run", shows_progress=True, locks=True, remark="; the same command continues from the store")
@_study_argument
@_store_option
@scheduler_options()
@workers_option
@click.option(
    *("--worker-memory", "memory"),
    type=memory_size,
    metavar="SIZE",
    help="Limit the memory of each process, such as 4GB. [default: equal parts]",
)
@_allow_commands_option
@_only_option
@click.option("--tables", is_flag=True, help="Also print the distance of each mesh, as table does.")
@click.pass_context
def run_command(
    context: click.Context,
    /,
    study: Path,
    store: Location | None,
    scheduler: str | None,
    trust_network: bool,
    tables: bool,
    **settings: Any,
) -> None:
    """Compute what is missing of STUDY and print the verdict.

    Ctrl-C and SIGTERM end it. The same command continues from the store. For several objects it
    prints their league, and the objects, the worst first; an object that cannot be carried out stops no other.

    The exit status is 3 if a mesh failed, or if a distance is less accurate than the study requires.
    """
    from sobolev_batch.batch.run import run
    from sobolev_batch.reduction.searched import SearchedSource
    from sobolev_batch.study.study import as_study
    from sobolev_batch.tables.conclusion import format_objects, format_verdict
    from sobolev_batch.tables.convergence import format_table

    parsed, of_processes = as_study(study), (settings["workers"], settings["memory"])
    with progress_reports() as show, client_of(scheduler, trust_network, *of_processes) as client:
        summary = run(parsed, store, client, on_progress=show, **settings)
    if "" in parsed.objects:
        echo_lines(format_verdict(summary.store))
    else:
        try:
            league = extra(COMMANDS, "table league", "the command 'table league'")
            families = [family for one in parsed.objects.values() for family in one.families]
            # Families within tolerances were made to find their fewest triangles.
            is_searched = all(isinstance(family.source, SearchedSource) for family in families)
            sizes = {"columns": ("triangles",), "x": "target_tolerance"} if is_searched else {}
            context.invoke(league, store=location(summary.store), orders=None, **sizes)
        except InputError as problem:
            echo(f"no league: {problem}")
        with suppress(InputError):  # As the league says, no object has tables.
            objects = format_objects(summary.store, most=_MOST_OBJECTS)
            echo()
            echo_lines(objects)
    if tables:
        echo()
        echo_lines(format_table(summary.store))
    echo()
    echo(str(summary).partition("\n")[0])
    if not tables:
        echo_lines(f"all distances: sobolev-batch table {visible(shlex.quote(summary.store))}", "shell")
    # The verdict on an object has what failed, and objects that cannot be carried out were refused at once.
    failed = {label: reason for label, reason in summary.failed.items() if not {"", label} & parsed.objects.keys()}
    for _, line in reasons("", together(failed | dict(summary.not_compared))):
        echo(line, err=True)
    what = "its distance has an error of {:.2g} %, more than the rtol of the study"
    for _, line in reasons("", {label: what.format(100 * error) for label, error in summary.imprecise.items()}):
        echo(line, err=True)
    is_short = bool(summary.imprecise) and not (parsed.accuracy is not None and parsed.accuracy.best_effort)
    if summary.failed or summary.not_compared or is_short:
        context.exit(EXIT_SOME_FAILED)


@cli.command("submit", locks=True)
@_study_argument
@scheduler_options(required=True)
@_store_option
@_allow_commands_option
@_only_option
@click.pass_context
def submit_command(
    context: click.Context, /, study: Path, scheduler: str, trust_network: bool, store: Location | None, **settings: Any
) -> None:
    """Hand STUDY over to a cluster and return.

    The cluster computes it without this process.
    """
    from sobolev_batch.batch.cluster.clients import remote_client
    from sobolev_batch.batch.submit import submit

    with remote_client(scheduler, trust_network) as client:
        submission = submit(study, store, client, **settings)

    echo(f"{submission.missing} of {submission.surfaces} surfaces to be computed by the cluster at {scheduler}")
    for name, reason in submission.refused.items():
        echo(f"{name}: {reason}", err=True)
    echo_lines(f"follow it by: sobolev-batch status --follow {visible(shlex.quote(submission.store))}", "shell")
    if submission.refused:
        context.exit(EXIT_SOME_FAILED)


@cli.command("plan")
@_study_argument
@_store_option
@scheduler_options()
@_allow_commands_option
@json_option
@click.pass_context
def plan_command(
    context: click.Context,
    study: Path,
    store: Location | None,
    scheduler: str | None,
    trust_network: bool,
    allow_commands: bool,
    style: str,
) -> None:
    """Show what running STUDY would do.

    No field is computed, but a lattice for an [accuracy] is chosen, for which a few meshes are made and compared. The
    plan has the time, the tasks and their memory, the bytes to be stored, the number of surfaces that the store has
    already, and the lattice with the reasons for it.
    """
    from sobolev_batch.batch.dry_run import plan

    with client_of(scheduler, trust_network) as client:
        made = plan(study, store, client, allow_commands=allow_commands, on_progress=show_step)
    echo_result(style, made, made.to_table())
    if made.refused:
        context.exit(EXIT_SOME_FAILED)


@cli.command("schema")
def schema_command() -> None:
    """Print the JSON schema of study files. Editors complete and check them by it."""
    from sobolev_batch.study.json_schema import study_schema

    echo_lines(json.dumps(study_schema(), indent=2), "json")
