"""Run a study on workers that are jobs of SLURM or PBS.

    export DASK_CONFIG=$HOME/jobqueue.yaml
    python jobqueue.py STUDY --system slurm --jobs 4 [further options of `sobolev-batch run`, such as --store STORE]

The scheduler is part of this process, on the node where you start it. See docs/clusters.md.
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
import dask
from dask_jobqueue import JobQueueCluster, PBSCluster, SLURMCluster
from dask_jobqueue.local import LocalCluster
from distributed import Adaptive, Client, Security
from distributed.core import Status

from sobolev_batch import Study
from sobolev_batch.cli import cli
from sobolev_batch.errors import SobolevBatchError

# dask_jobqueue ends the process on Ctrl-C with the exit status of success.
signal.signal(signal.SIGINT, signal.default_int_handler)

CLUSTERS: dict[str, type[JobQueueCluster]] = {"slurm": SLURMCluster, "pbs": PBSCluster, "local": LocalCluster}
INTERVAL_SECONDS = 30.0  # between two checks of the jobs


class ReplacingAdaptive(Adaptive):  # type: ignore[misc]  # distributed has no types
    """Policy that requests a new job once the workers of one have left.

    dask-jobqueue alone does so only for jobs with one worker, and it takes a refused job for a waiting one.
    """

    last_refusal = ""

    async def target(self) -> int:
        """Return the number of workers to have, after forgetting jobs whose workers have left."""
        cluster = self.cluster
        forget_refused(cluster)
        for name, job in list(cluster.workers.items()):
            names = {f"{name}{suffix}" for suffix in cluster.worker_spec.get(name, {}).get("group", [""])}
            if names & cluster.observed:
                job.had_workers = True
            elif getattr(job, "had_workers", False):
                del cluster.workers[name]
                await job.close()
        wanted: int = await super().target()
        return wanted

    async def adapt(self) -> None:
        """Adapt the number of jobs; report each refusal of the batch system once."""
        try:
            await super().adapt()
        except RuntimeError as error:
            if str(error) != self.last_refusal:
                click.echo(f"no new job: {str(error).strip()}", err=True)
            self.last_refusal = str(error)


def forget_refused(cluster: JobQueueCluster) -> None:
    """Drop the jobs that the batch system refused: the cluster counts them otherwise."""
    for name, job in list(cluster.workers.items()):
        if job.job_id is None:
            job.status = Status.failed
            del cluster.workers[name]


def setting(system: str, name: str) -> Any:
    """Return a setting of Dask's configuration for a batch system."""
    return dask.config.get(f"jobqueue.{system}.{name}", None)


def check_settings(system: str, printing: bool) -> None:
    """Refuse a configuration that cannot request jobs, or whose scheduler everybody could reach."""
    for name in ("cores", "memory", "processes"):
        if setting(system, name) is None:
            raise click.ClickException(
                f"jobqueue.{system}.{name} is not set: copy jobqueue.yaml, fill it in, and export DASK_CONFIG=its path"
            )
    command = CLUSTERS[system].job_cls.submit_command
    if command is not None and not printing and shutil.which(command) is None:
        raise click.ClickException(f"{command} is not on the PATH: start this on a node from which jobs are submitted")
    if setting(system, "interface") is None and not {"host", "interface"} & set(setting(system, "scheduler-options")):
        raise click.ClickException(
            f"jobqueue.{system}.interface is not set, and the scheduler would listen on all networks: "
            "name the one that the nodes share, such as ib0"
        )


def security_of(folder: Path) -> Security:
    """Return the security settings for a folder made by make-certificates."""
    files = {
        f"tls_{role}_{part}": f"{folder}/{name}.pem"
        for role in ("scheduler", "worker", "client")
        for part, name in (("cert", "certificate"), ("key", "key"))
    }
    return Security(require_encryption=True, tls_ca_file=f"{folder}/ca.pem", **files)


def job_script(system: str) -> str:
    """Return the script of one job, with placeholders for values that are known only on submission."""
    security = security_of(Path("CERTIFICATES"))
    job = CLUSTERS[system].job_cls("tls://SCHEDULER:PORT", name="WORKER", protocol="tls://", security=security)
    return str(job.job_script())


@contextmanager
def jobs_of(system: str, jobs: int, adaptive: bool = False) -> Iterator[JobQueueCluster]:
    """Yield a cluster whose workers are jobs, cancelled at the end; encrypted, since other users share its network.

    Args:
        system: Key of CLUSTERS.
        jobs: Number of jobs; those that end are replaced.
        adaptive: Permission to run fewer jobs while there is little work.
    """
    options = {"dashboard_address": "127.0.0.1:0", **setting(system, "scheduler-options")}
    # Certificates for this run alone, in a folder that all nodes see and nobody else can read: below the current
    # folder, unless the configuration names another.
    parent = setting(system, "shared-temp-directory") or Path.cwd()
    with TemporaryDirectory(prefix=".sobolev-batch-", dir=parent) as work:
        folder = Path(work, "certificates")
        subprocess.run([Path(__file__).with_name("make-certificates"), folder], check=True, stdout=subprocess.DEVNULL)
        cluster = CLUSTERS[system](
            # Given here too: from the configuration alone dask-jobqueue does not learn the names of the workers.
            processes=setting(system, "processes"),
            security=security_of(folder),
            scheduler_options=options,
        )

        async def submit() -> None:
            try:
                await cluster
            finally:
                forget_refused(cluster)

        least = 1 if adaptive else jobs
        with closing(cluster):
            for _ in range(least):
                # scale() would submit in the background and hide the refusals of the batch system.
                cluster.worker_spec.update(cluster.new_worker_spec())
                cluster.sync(submit)
            cluster.adapt(
                Adaptive=ReplacingAdaptive,
                minimum_jobs=least,
                maximum_jobs=jobs,
                interval=INTERVAL_SECONDS,
                wait_count=4,  # checks in a row that find a job idle before it is cancelled
            )
            yield cluster


def run_on(cluster: JobQueueCluster, arguments: Sequence[str]) -> int:
    """Do `sobolev-batch run` on a cluster, and return its exit status."""
    security = cluster.security
    files = {"ca-file": security.tls_ca_file, "client.cert": security.tls_client_cert}
    files["client.key"] = security.tls_client_key
    with dask.config.set({f"distributed.comm.tls.{name}": path for name, path in files.items()}):
        command = ["run", *arguments, "--scheduler", cluster.scheduler_address]
        return int(cli.main(command, prog_name="sobolev-batch", standalone_mode=False) or 0)


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("study", type=click.Path(path_type=Path))
@click.argument("options", nargs=-1, type=click.UNPROCESSED)
@click.option("--system", type=click.Choice(list(CLUSTERS)), required=True)
@click.option("--jobs", type=click.IntRange(min=1), default=1, show_default=True, help="Number of jobs at a time.")
@click.option("--adaptive", is_flag=True, help="Run fewer jobs while there is little work.")
@click.option("--print-script", is_flag=True, help="Show the script of a job and end.")
def main(study: Path, options: tuple[str, ...], system: str, jobs: int, adaptive: bool, print_script: bool) -> None:
    """Run STUDY on jobs of a batch system.

    OPTIONS are those of `sobolev-batch run`, such as --store STORE or --allow-commands, whose exit status this has.
    """
    check_settings(system, print_script)
    if print_script:
        click.echo(job_script(system))
        return
    try:
        Study.from_toml(study)  # before any job is submitted
        with jobs_of(system, jobs, adaptive) as cluster, Client(cluster) as client:
            click.echo("jobs are submitted; the study begins when the first one runs", err=True)
            client.wait_for_workers(1)
            status = run_on(cluster, [str(study), *options])
    except (SobolevBatchError, RuntimeError) as error:  # the batch system and Dask raise the latter
        raise click.ClickException(str(error).strip()) from error
    sys.exit(status)


if __name__ == "__main__":
    for number in (signal.SIGTERM, signal.SIGHUP):  # these cancel the jobs too
        signal.signal(number, lambda number, frame: sys.exit(128 + number))
    main()
