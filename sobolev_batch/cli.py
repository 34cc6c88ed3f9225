"""The command line: sobolev-batch."""

from __future__ import annotations

import logging
import shlex
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

import click

from sobolev_batch.batch.cluster import available_cores, remote_client
from sobolev_batch.batch.crew import Crew
from sobolev_batch.batch.equipment import enlist
from sobolev_batch.batch.layout import lay_out_rows
from sobolev_batch.batch.location import Location
from sobolev_batch.batch.plan import Plan, make_plan
from sobolev_batch.batch.progress import Progress
from sobolev_batch.batch.release import release
from sobolev_batch.batch.run import Summary, run
from sobolev_batch.batch.store import Store, stored_choice
from sobolev_batch.batch.study import Study
from sobolev_batch.batch.submission import submit
from sobolev_batch.batch.verification import verify
from sobolev_batch.errors import InputError, SobolevBatchError
from sobolev_batch.results.matrix import format_matrix
from sobolev_batch.results.opening import fields_read, open_store
from sobolev_batch.results.status import Status
from sobolev_batch.results.tables import FORMATS, Format, format_table
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.norms import distance
from sobolev_batch.surfaces.readers import read_mesh
from sobolev_batch.surfaces.similarity import Similarity

EXIT_OTHER, EXIT_INPUT, EXIT_SOME_FAILED, EXIT_INTERRUPTED, EXIT_TERMINATED = 1, 2, 3, 130, 143
_DEFAULT_FOLDER = Path("storage")
_FOLLOW_SECONDS = 5.0
# Of object storage, by the names of their loggers.
_DRIVERS = ("aiobotocore", "botocore", "s3fs", "gcsfs", "google", "urllib3", "azure")


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="sobolev-batch")
@click.option("--debug", is_flag=True, help="Show tracebacks and every log message.")
@click.pass_context
def cli(context: click.Context, debug: bool) -> None:
    """Sobolev distances of negative order between surface meshes.

    A study file names families of meshes and a reference; `run` stores the Fourier field of every
    mesh and prints how far each is from the reference.

    Exit status: 0 all done, 2 the input is wrong, 3 some meshes failed, 1 anything else.
    """
    context.obj = debug
    logging.basicConfig(
        level=logging.DEBUG if debug else logging.WARNING,
        format="%(levelname)s %(name)s: %(message)s",
        stream=sys.stderr,
    )
    if debug:
        # Below that they log what they send, with its signature and a session's token.
        for driver in _DRIVERS:
            logging.getLogger(driver).setLevel(logging.INFO)
    else:
        # The cluster's own messages at shutdown are of no use to someone who reads a table.
        logging.getLogger("distributed").setLevel(logging.ERROR)


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
    with _Reporter() as reporter:
        if scheduler:
            with remote_client(scheduler, trust_network) as client:
                summary = run(parsed, place, client, on_progress=reporter)
        else:
            summary = run(parsed, place, workers=workers, memory=worker_memory, on_progress=reporter)
    click.echo(format_table(open_store(place)))
    click.echo(_totals(summary))
    if summary.failed:
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
            crew = enlist(client, parsed.libraries)
    else:
        crew = Crew.of_this_machine(available_cores())
    for name, value in _plan_lines(plan, place, crew):
        click.echo(f"{name + ':':<14} {value}")


@cli.command("status")
@click.argument("store", type=Location.of, metavar="STORE")
@click.option("--follow", is_flag=True, help="Show it again and again until the run has ended.")
@click.pass_context
def status_command(context: click.Context, store: Location, follow: bool) -> None:
    """Show how far STORE is, and what failed and why."""
    status = Status.of(store)
    while follow and status.going_on:
        click.echo("\n".join(status.lines()) + "\n")
        time.sleep(_FOLLOW_SECONDS)
        status = Status.of(store)
    click.echo("\n".join(status.lines()))
    if status.failed:
        context.exit(EXIT_SOME_FAILED)
    if status.lost or (status.run is not None and status.run.state == "failed"):
        context.exit(EXIT_OTHER)


@cli.command("verify")
@click.argument("store", type=Location.of, metavar="STORE")
@click.pass_context
def verify_command(context: click.Context, store: Location) -> None:
    """Read everything in STORE back, against its checksums and completion records.

    What is damaged is named, and withdrawn where STORE can be written: `run` then computes it again.
    Exit status 1 if anything is damaged.
    """
    with click.progressbar(label="fields", file=sys.stderr, show_pos=True, length=0) as bar:

        def show(done: int, total: int) -> None:
            bar.length = total
            bar.update(1)

        found = verify(store, show)
    click.echo(f"{store}: {found.complete} of {found.total} surfaces complete, their fields read back")
    for name, what in [*found.fields.items(), *((f"table {name}", what) for name, what in found.tables.items())]:
        click.echo(f"{name}: {what}")
    if found.is_sound:
        click.echo("nothing is damaged")
        return
    remedy = "run the study again to repair it" if found.withdrawn else "it cannot be written here, and stays as it is"
    click.echo(f"{len(found.fields)} surfaces and {len(found.tables)} arrays of tables are damaged; {remedy}")
    context.exit(EXIT_OTHER)


@cli.command("release")
@click.argument("store", type=Location.of, metavar="STORE")
@click.option("--force", is_flag=True, help="Even if its run gave a sign of life a moment ago.")
def release_command(store: Location, force: bool) -> None:
    """Release STORE from the claim of a run that was killed together with its machine."""
    claim = release(store, force=force)
    if claim is None:
        click.echo(f"{store}: no run has claimed it")
    else:
        click.echo(f"{store}: released from {claim.driver}, which had claimed it since {claim.since}")


@cli.command("table")
@click.argument("store", type=Location.of)
@click.option("--format", "style", type=click.Choice(FORMATS), default="text", show_default=True)
@click.option("--order", "orders", type=float, multiple=True, help="Only this order; may be repeated.")
@click.option("--matrix", is_flag=True, help="The distance of every mesh to every other instead.")
def table_command(store: Location, style: Format, orders: tuple[float, ...], matrix: bool) -> None:
    """Print the convergence tables of STORE, or its distance matrices."""
    form = format_matrix if matrix else format_table
    click.echo(form(open_store(store), style, orders or None))


@cli.command("plot")
@click.argument("store", type=Location.of)
@click.option(
    "--output", type=click.Path(path_type=Path), default=".", show_default=True, help="Folder of the pictures."
)
def plot_command(store: Location, output: Path) -> None:
    """Draw the convergence and the transforms of STORE."""
    # Imported here: it takes as long as everything that the other commands do at their start.
    from sobolev_batch.results.plots import plot_store

    with fields_read(store):
        paths = plot_store(open_store(store), output)
    for path in paths:
        click.echo(path)


@cli.command("report")
@click.argument("store", type=Location.of)
@click.option("--output", type=click.Path(path_type=Path), default="report.html", show_default=True, help="The page.")
@click.option(
    *("--folder", "folder"),
    type=click.Path(path_type=Path),
    default=".",
    help="Where relative paths in the study start: its meshes are shown if they are there. [default: here]",
)
@click.option("--witness", "witnesses", multiple=True, metavar="MESH", help="Show this mesh; may be repeated.")
def report_command(store: Location, output: Path, folder: Path, witnesses: tuple[str, ...]) -> None:
    """Write everything about STORE into one HTML page that needs nothing besides itself."""
    # Imported here, as for plots.
    from sobolev_batch.results.report import write_report

    click.echo(write_report(store, output, folder=folder, witnesses=witnesses))


@cli.command("compare")
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path))
@click.option("--order", "orders", type=float, multiple=True, help="Sobolev order; may be repeated. [default: -2]")
@click.option("--rtol", type=float, help="Largest error relative to the distance; instead of a lattice.")
@click.option("--memory-gb", type=float, help="What a transform may take with --rtol. [default: 2]")
@click.option("--xi-max", type=float, help="Highest frequency per axis. [default: 5]")
@click.option("--M", "intervals", type=int, help="Lattice intervals per axis. [default: 64]")
@click.option("--no-scaling", is_flag=True, help="Keep the files' own unit instead of fitting B into the unit sphere.")
def compare_command(
    a: Path,
    b: Path,
    orders: tuple[float, ...],
    rtol: float | None,
    memory_gb: float | None,
    xi_max: float | None,
    intervals: int | None,
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
    found = distance(*pair, tuple(dict.fromkeys(orders)) or (-2.0,), lattice=lattice, rtol=rtol, memory=memory)
    click.echo(f"scale {similarity.scale:.9g}, origin {' '.join(f'{x:.9g}' for x in similarity.origin)}")
    if rtol is not None:
        click.echo(f"xi_max {found.attrs['xi_max']:.4g}, M {found.attrs['M']}, {found.attrs['dtype']}")
    for order in found["order"].values:
        here = found.sel(order=order)
        parts = ", ".join(f"{name} {here[name].item():.0e}" for name in ("truncation", "aliasing", "discretisation"))
        short = "" if rtol is None or here["within"].item() else f", more than rtol {rtol:g}"
        click.echo(f"order {order:g}: {here['distance'].item():.9e} ± {here['error'].item():.0e} ({parts}){short}")


def main() -> None:
    """Run the command line; the process ends with its exit status."""
    debug = "--debug" in sys.argv
    # What ends a job at its time limit: it leaves the time to give up the claim on a store.
    signal.signal(signal.SIGTERM, _terminate)
    try:
        status = cli.main(standalone_mode=False)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, click.Abort):
        _ignore_signals()
        click.echo("interrupted; the same command goes on from what is stored", err=True)
        sys.exit(EXIT_INTERRUPTED)
    except _Terminated:
        _ignore_signals()
        click.echo("terminated; the same command goes on from what is stored", err=True)
        sys.exit(EXIT_TERMINATED)
    except Exception as error:
        if debug:
            raise
        known = isinstance(error, SobolevBatchError)
        what = str(error) if known else f"{type(error).__name__}: {error} (--debug shows where)"
        click.echo(f"error: {what}", err=True)
        sys.exit(EXIT_INPUT if isinstance(error, InputError) else EXIT_OTHER)
    sys.exit(status or 0)


def _ignore_signals() -> None:
    """What asks a process to end that is ending must not change how it ends."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


class _Terminated(SystemExit):
    """Somebody has asked the process to end."""


def _terminate(number: int, frame: FrameType | None) -> None:
    raise _Terminated


class _Reporter:
    """Progress for people: a bar on a terminal, a plain line per step elsewhere; on standard error."""

    def __init__(self) -> None:
        self._bar: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def __call__(self, progress: Progress) -> None:
        if progress.stage == "cluster":
            click.echo(f"dashboard: {progress.label}", err=True)
        elif sys.stderr.isatty():
            self._draw(progress)
        elif progress.record is not None:
            outcome = progress.record.reason or f"{progress.record.seconds:.2f} s"
            click.echo(
                f"[{progress.done}/{progress.total}] {progress.label}: {progress.record.status}, {outcome}", err=True
            )
        elif progress.stage == "reduction" and progress.done == progress.total:
            click.echo("tables reduced", err=True)

    def _draw(self, progress: Progress) -> None:
        if progress.done == 0:
            self._close()
            label = {"fields": "transforms", "reduction": "tables    "}[progress.stage]
            self._bar = click.progressbar(length=progress.total, label=label, file=sys.stderr, show_pos=True)
            self._bar.__enter__()
        else:
            self._bar.update(1)
        if progress.done == progress.total:
            self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.__exit__(None, None, None)
            self._bar = None


def _default_place(study: Study) -> Location:
    """Where the results of a study go unless somebody says otherwise; the folder is made here, others are not."""
    location = Location.of(_DEFAULT_FOLDER / f"{study.name}.zarr")
    with location.access("written"):
        _DEFAULT_FOLDER.mkdir(exist_ok=True)
    return location


def _plan_lines(plan: Plan, place: Location, crew: Crew) -> Iterator[tuple[str, str]]:
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
        allowed = f"{_size(study.accuracy.memory)} for a transform, M <= {study.accuracy.largest_intervals}"
        yield "accuracy", f"rtol {study.accuracy.rtol:g} of every distance to {plan.reference}; {allowed}"
        for reason in plan.choice.reasons:
            yield "chosen", reason
        yield "transform", f"{transform.precision}, eps and quadrature for each surface from its distance"
    else:
        yield (
            "transform",
            f"eps {transform.accuracy:g}, {transform.precision}, quadrature {transform.quadrature.method}",
        )
    yield "backend", study.backend
    yield from _task_lines(plan, crew)
    yield "storage", f"{_size(plan.field_bytes)} per surface, {_size(plan.field_bytes * len(plan.rows))} in all"
    there = _stored_keys(place)
    done = sum(there.get(row.label) == row.key != "" for row in plan.rows)
    yield "store", f"{place}, {done} of {len(plan.rows)} already there"


def _task_lines(plan: Plan, crew: Crew) -> Iterator[tuple[str, str]]:
    gpus = sum(member.backend == "gpu" for member in crew.members)
    yield (
        "workers",
        f"{len(crew.members)}, with {crew.threads} threads and {gpus} GPUs together; for tasks, "
        f"{_size(crew.share_bytes)} or more of memory a thread",
    )
    layouts, refused = lay_out_rows(plan, plan.rows, crew.with_backend(plan.study.backend))
    tasks = sum(layout.task_count for layout in layouts.values())
    yield "tasks", f"{tasks} for {len(layouts)} surfaces; chunks of the lattice: {len(plan.blocks)}"
    for label, layout in layouts.items():
        if layout.parts > 1:
            yield "cut", f"{label} into {layout.parts} parts"
    if layouts:
        largest = max(layouts, key=lambda label: layouts[label].largest_bytes)
        yield "memory", f"up to {_size(layouts[largest].largest_bytes)} in a task, of {largest}"
    for label, reason in refused.items():
        yield "refused", f"{label}: {reason}"


def _stored_keys(place: Location) -> dict[str, str]:
    store = Store(place)
    if not store.is_there() or store.is_unfinished:
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
