"""Commands that take a study: run, submit, plan."""

from __future__ import annotations

import shlex
from contextlib import nullcontext
from pathlib import Path

import click

from sobolev_batch.batch.cluster.clients import remote_client
from sobolev_batch.batch.run import run
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.study.study import Study
from sobolev_batch.batch.submit import submit
from sobolev_batch.cli.group import EXIT_SOME_FAILED, cli
from sobolev_batch.cli.options import memory_of, store_option, study_argument, trust_option
from sobolev_batch.cli.reporter import Reporter
from sobolev_batch.parameters import byte_count
from sobolev_batch.results.open import open_store
from sobolev_batch.results.plan import DEFAULT_FOLDER, default_store, plan
from sobolev_batch.results.tables.convergence import format_table


@cli.command("run")
@study_argument
@store_option
@click.option("--scheduler", metavar="ADDRESS", help="Dask scheduler, such as tls://host:8786.")
@trust_option
@click.option("--workers", type=click.IntRange(min=1), help="Processes on this machine. [default: one per core]")
@click.option(
    "--memory", type=byte_count, metavar="SIZE", help="Memory per process, such as 4GB. [default: equal parts]"
)
@click.option("--worker-memory", type=byte_count, hidden=True)
@click.pass_context
def run_command(
    context: click.Context,
    study: Path,
    store: Location | None,
    scheduler: str | None,
    trust_network: bool,
    workers: int | None,
    memory: int | None,
    worker_memory: int | None,
) -> None:
    """Compute what is missing of STUDY and print its tables."""
    memory = memory_of(memory, "--worker-memory", worker_memory)
    if scheduler and (workers or memory):
        raise click.UsageError(
            "--workers and --memory are for a cluster on this machine; the workers of a scheduler have their own"
        )
    parsed = Study.from_toml(study)
    location = store or _made_default_store(parsed)
    with Reporter() as reporter:
        if scheduler:
            with remote_client(scheduler, trust_network) as client:
                summary = run(parsed, location, client, on_progress=reporter)
        else:
            summary = run(
                parsed,
                location,
                workers=workers,
                memory=None if memory is None else f"{memory}B",
                on_progress=reporter,
            )
    click.echo(format_table(open_store(location)))
    click.echo(
        f"\n{len(summary.computed)} computed, {len(summary.reused)} reused, {len(summary.failed)} failed; "
        f"store: {summary.store}"
    )
    for label, reason in summary.not_compared.items():
        click.echo(f"{label}: {reason}", err=True)
    if summary.failed or summary.not_compared:
        context.exit(EXIT_SOME_FAILED)


@cli.command("submit")
@study_argument
@click.option("--scheduler", metavar="ADDRESS", required=True, help="Dask scheduler, such as tls://host:8786.")
@trust_option
@store_option
def submit_command(study: Path, scheduler: str, trust_network: bool, store: Location | None) -> None:
    """Hand STUDY over to a cluster and return.

    The cluster computes it without this process.
    """
    parsed = Study.from_toml(study)
    with remote_client(scheduler, trust_network) as client:
        submission = submit(parsed, store or _made_default_store(parsed), client)
    click.echo(f"{submission.missing} of {submission.surfaces} surfaces to be computed by the cluster at {scheduler}")
    click.echo(f"follow it by: sobolev-batch status --follow {shlex.quote(submission.store)}")


@cli.command("plan")
@study_argument
@store_option
@click.option("--scheduler", metavar="ADDRESS", help="Plan for its workers. [default: processes on this machine]")
@trust_option
def plan_command(study: Path, store: Location | None, scheduler: str | None, trust_network: bool) -> None:
    """Show what running STUDY would do.

    Nothing is computed. The plan has the lattice and the reasons for it, the tasks and their memory, the bytes to be
    stored, and the number of surfaces that the store has already.
    """
    parsed = Study.from_toml(study)
    with remote_client(scheduler, trust_network) if scheduler else nullcontext() as client:
        click.echo(plan(parsed, store, client=client))


def _made_default_store(study: Study) -> Location:
    """Return the default store of a study, whose folder is made; folders that users name are not."""
    location = default_store(study)
    with location.access("written"):
        DEFAULT_FOLDER.mkdir(exist_ok=True)
    return location
