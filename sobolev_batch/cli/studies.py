"""Commands that take a study: run, submit, plan."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path

import click

from sobolev_batch.batch.cluster.clients import available_cores, remote_client
from sobolev_batch.batch.cluster.worker_plugin import prepare_workers
from sobolev_batch.batch.cluster.workers import Workers
from sobolev_batch.batch.fields.sizing import size_rows
from sobolev_batch.batch.run import Summary, run
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.store import Store, stored_choice
from sobolev_batch.batch.study.plan import Plan, make_plan
from sobolev_batch.batch.study.study import Study
from sobolev_batch.batch.submit import submit
from sobolev_batch.cli.group import EXIT_SOME_FAILED, cli
from sobolev_batch.cli.reporter import Reporter
from sobolev_batch.results.open import open_store
from sobolev_batch.results.tables.convergence import format_table

_DEFAULT_FOLDER = Path("storage")

_trust_option = click.option(
    "--trust-network",
    is_flag=True,
    help="Use a scheduler that is neither encrypted (tls://) nor on loopback: everybody who reaches its ports or "
    "those of its workers can run programs on these machines and read the meshes.",
)


@cli.command("run")
@click.argument("study", type=click.Path(path_type=Path))
@click.option("--store", type=Location.of, metavar="PATH|URL", help="Where results go. [default: storage/NAME.zarr]")
@click.option("--scheduler", metavar="ADDRESS", help="A Dask scheduler, such as tls://host:8786.")
@_trust_option
@click.option("--workers", type=click.IntRange(min=1), help="Processes on this machine. [default: one per core]")
@click.option("--worker-memory", metavar="SIZE", help="Of each of them, such as 4GB. [default: an equal part]")
@click.pass_context
def run_command(
    context: click.Context,
    study: Path,
    store: Location | None,
    scheduler: str | None,
    trust_network: bool,
    workers: int | None,
    worker_memory: str | None,
) -> None:
    """Compute what is missing of STUDY, reduce it, print the tables."""
    if scheduler and (workers or worker_memory):
        raise click.UsageError(
            "--workers and --worker-memory are for a cluster on this machine; one with a scheduler has its own"
        )
    parsed = Study.from_toml(study)
    place = store or _default_place(parsed)
    with Reporter() as reporter:
        if scheduler:
            with remote_client(scheduler, trust_network) as client:
                summary = run(parsed, place, client, on_progress=reporter)
        else:
            summary = run(parsed, place, workers=workers, memory=worker_memory, on_progress=reporter)
    click.echo(format_table(open_store(place)))
    click.echo(_totals(summary))
    for label, reason in summary.not_compared.items():
        click.echo(f"{label}: {reason}", err=True)
    if summary.failed or summary.not_compared:
        context.exit(EXIT_SOME_FAILED)


@cli.command("submit")
@click.argument("study", type=click.Path(path_type=Path))
@click.option("--scheduler", metavar="ADDRESS", required=True, help="A Dask scheduler, such as tls://host:8786.")
@_trust_option
@click.option("--store", type=Location.of, metavar="PATH|URL", help="Where results go. [default: storage/NAME.zarr]")
def submit_command(study: Path, scheduler: str, trust_network: bool, store: Location | None) -> None:
    """Hand STUDY over to a cluster and return; it goes on without this process."""
    parsed = Study.from_toml(study)
    with remote_client(scheduler, trust_network) as client:
        submission = submit(parsed, store or _default_place(parsed), client)
    click.echo(f"{submission.missing} of {submission.surfaces} surfaces to be computed by the cluster at {scheduler}")
    click.echo(f"follow it by: sobolev-batch status --follow {shlex.quote(submission.store)}")


@cli.command("plan")
@click.argument("study", type=click.Path(path_type=Path))
@click.option(
    "--store", type=Location.of, metavar="PATH|URL", help="Where results would go. [default: storage/NAME.zarr]"
)
@click.option("--scheduler", metavar="ADDRESS", help="Plan for its workers. [default: for processes on this machine]")
@_trust_option
def plan_command(study: Path, store: Location | None, scheduler: str | None, trust_network: bool) -> None:
    """Show what running STUDY would do: tasks, lattice, bytes, memory, what is already there."""
    parsed = Study.from_toml(study)
    place = store or Location.of(_DEFAULT_FOLDER / f"{parsed.name}.zarr")
    plan = make_plan(parsed, stored_choice(place))
    if scheduler:
        with remote_client(scheduler, trust_network) as client:
            crew = prepare_workers(client, parsed.libraries)
    else:
        crew = Workers.of_this_machine(available_cores())
    for name, value in _plan_lines(plan, place, crew):
        click.echo(f"{name + ':':<14} {value}")


def _default_place(study: Study) -> Location:
    """Where the results of a study go unless somebody says otherwise; the folder is made here, others are not."""
    location = Location.of(_DEFAULT_FOLDER / f"{study.name}.zarr")
    with location.access("written"):
        _DEFAULT_FOLDER.mkdir(exist_ok=True)
    return location


def _plan_lines(plan: Plan, place: Location, crew: Workers) -> Iterator[tuple[str, str]]:
    study, lattice, transform = plan.study, plan.lattice, plan.transform
    origin = " ".join(f"{x:.9g}" for x in plan.similarity.origin)
    yield "study", study.title
    yield "surfaces", f"{len(plan.rows)} in {len(study.families)} families, reference {plan.reference}"
    yield (
        "similarity",
        f"scale {plan.similarity.scale:.9g}, origin {origin}",
    )
    yield (
        "lattice",
        f"xi_max {lattice.xi_max:g}, M {lattice.M}, spacing {lattice.spacing:g}, half period {lattice.half_period:g}",
    )
    yield "orders", ", ".join(f"{order:g}" for order in study.orders)
    if study.accuracy is not None:
        allowed = f"{_size(study.accuracy.allowed_bytes)} for a transform, M <= {study.accuracy.largest_intervals}"
        yield "accuracy", f"rtol {study.accuracy.rtol:g} of every distance to {plan.reference}; {allowed}"
        for reason in plan.choice.reasons:
            yield "chosen", reason
        yield "transform", f"{transform.dtype}, eps and quadrature for each surface from its distance"
    else:
        yield (
            "transform",
            f"eps {transform.eps:g}, {transform.dtype}, quadrature {transform.quadrature.method}",
        )
    yield "backend", study.backend
    if study.witness:
        yield "witness", f"of order {', '.join(f'{order:g}' for order in study.witness)}, at the vertices of every mesh"
    if study.proximity is not None:
        yield "proximity", f"Hausdorff and Chamfer distances, from {study.proximity:,} points on each mesh"
    yield from _task_lines(plan, crew)
    yield "storage", f"{_size(plan.field_bytes)} per surface, {_size(plan.field_bytes * len(plan.rows))} in all"
    there = _stored_keys(place)
    done = sum(there.get(row.label) == row.key != "" for row in plan.rows)
    yield "store", f"{place}, {done} of {len(plan.rows)} already there"


def _task_lines(plan: Plan, crew: Workers) -> Iterator[tuple[str, str]]:
    gpus = sum(member.backend == "gpu" for member in crew.members)
    yield (
        "workers",
        f"{len(crew.members)}, with {crew.threads} threads and {gpus} GPUs together; for tasks, "
        f"{_size(crew.allowed_bytes_per_task)} or more of memory a thread",
    )
    layouts, refused = size_rows(plan, plan.rows, crew.with_backend(plan.study.backend))
    tasks = sum(layout.task_count for layout in layouts.values())
    yield "tasks", f"{tasks} for {len(layouts)} surfaces; chunks of the lattice: {len(plan.blocks)}"
    for label, layout in layouts.items():
        if layout.batches > 1:
            yield "split", f"{label} into {layout.batches} batches of triangles"
    if layouts:
        largest = max(layouts, key=lambda label: layouts[label].projected_bytes)
        yield "memory", f"up to {_size(layouts[largest].projected_bytes)} in a task, of {largest}"
    for label, reason in refused.items():
        yield "refused", f"{label}: {reason}"


def _stored_keys(place: Location) -> dict[str, str]:
    store = Store(place)
    if not store.exists() or store.is_unfinished:
        return {}
    store.attributes()
    return {
        label: record.key
        for label, record in zip(store.labels(), store.records(), strict=True)
        if record is not None and record.status == "complete"
    }


def _size(count: float) -> str:
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"


def _totals(summary: Summary) -> str:
    return (
        f"\n{len(summary.computed)} computed, {len(summary.reused)} reused, {len(summary.failed)} failed; "
        f"store: {summary.store}"
    )
