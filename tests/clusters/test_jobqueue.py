"""SLURM and PBS: scripts of jobs and of one allocation, and studies on jobs that are processes of this machine."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
import yaml

from tests.support.recipes import FOLDER, TABLE, add_command, documented, run_recipe, write_study

SETTINGS = FOLDER / "jobqueue.yaml"

# Stand-ins for the commands of SLURM: every job runs at once on this machine.
SBATCH = """
if [ -n "$REFUSE" ]; then echo "sbatch: error: Invalid account" >&2; exit 1; fi
cp "$1" "$HOME/job-$$"
setsid bash "$HOME/job-$$" > "$HOME/log-$$" 2>&1 < /dev/null &
echo "Submitted batch job $!"
"""
SCANCEL = 'kill -- "-$1"'


def jobqueue(
    home: Path, *options: str, settings: Path = SETTINGS, **variables: str
) -> subprocess.CompletedProcess[str]:
    command = documented("python workflows/clusters/jobqueue.py")[-1][1:3]
    script, study = FOLDER / Path(command[0]).name, command[1]
    return run_recipe(home, sys.executable, script, study, *options, DASK_CONFIG=str(settings), **variables)


@pytest.mark.process
@pytest.mark.parametrize(
    ("system", "directives"),
    [
        ("slurm", ["-p compute", "-A project42", "--cpus-per-task=8", "--mem=32G", "-t 04:00:00"]),
        pytest.param(
            *("pbs", ["-q compute", "-A project42", "-l select=1:ncpus=8:mem=32GB", "-l walltime=04:00:00"]),
            marks=pytest.mark.all,
        ),
    ],
)
def test_the_script_of_a_job(system: str, directives: list[str], tmp_path: Path) -> None:
    completed = jobqueue(tmp_path, "--system", system, "--print-script")
    assert completed.returncode == 0, completed.stderr
    lines = completed.stdout.splitlines()
    for directive in directives:
        assert f"#{'SBATCH' if system == 'slurm' else 'PBS'} {directive}" in lines
    (worker,) = (line for line in lines if "dask_worker" in line)
    assert worker.startswith(f"{sys.executable} -m distributed.cli.dask_worker tls://")
    for option in (
        *("--nthreads 1", "--nworkers 8", "--memory-limit 4.00GiB", "--nanny", "--interface ib0", "--tls-key "),
        *("--lifetime 225m", "--lifetime-stagger 10m", "--dashboard-address 127.0.0.1:0"),
    ):
        assert f" {option}" in worker
    assert "--lifetime-restart" not in worker


@pytest.mark.parametrize("system", ["slurm", "pbs"])
def test_lifetimes_end_before_the_walltime(system: str) -> None:
    settings = yaml.safe_load(SETTINGS.read_text())["jobqueue"][system]
    options = dict(zip(settings["worker-extra-args"][::2], settings["worker-extra-args"][1::2], strict=True))
    longest = sum(int(options[name].removesuffix("m")) for name in ("--lifetime", "--lifetime-stagger"))
    hours, minutes, _ = map(int, settings["walltime"].split(":"))
    assert longest + 3 < 60 * hours + minutes
    assert settings["cores"] == settings["processes"]


@pytest.mark.all
def test_a_study_on_local_jobs(tmp_path: Path) -> None:
    write_study(tmp_path)
    completed = jobqueue(tmp_path, "--system", "local", "--jobs", "1", "--adaptive", "--store", "results.zarr")
    assert completed.returncode == 0, completed.stderr
    assert re.search(TABLE, completed.stdout)
    assert completed.stderr.count(": complete") == 6
    assert (tmp_path / "results.zarr" / "zarr.json").exists()
    assert not list(tmp_path.glob(".sobolev-batch*"))


@pytest.fixture
def slurm(tmp_path: Path) -> Path:
    """Return a home with SLURM's commands and settings for two workers a job."""
    add_command(tmp_path, "sbatch", SBATCH)
    add_command(tmp_path, "scancel", SCANCEL)
    settings = yaml.safe_load(SETTINGS.read_text())
    change = {"cores": 2, "processes": 2, "memory": "2GiB", "local-directory": str(tmp_path), "interface": None}
    settings["jobqueue"]["slurm"].update(change)
    settings["jobqueue"]["slurm"]["scheduler-options"]["host"] = "127.0.0.1"
    settings["jobqueue"]["slurm"]["worker-extra-args"] += ["--host", "127.0.0.1"]
    (tmp_path / "jobqueue.yaml").write_text(yaml.safe_dump(settings))
    return tmp_path


REPLACED = """
import jobqueue
from distributed import Client
from tests.support.processes import wait_until

if __name__ == "__main__":
    jobqueue.INTERVAL_SECONDS = 0.2
    with jobqueue.jobs_of("slurm", 1) as cluster, Client(cluster) as client:
        client.wait_for_workers(2, timeout=200)
        first = set(client.scheduler_info(n_workers=-1)["workers"])
        assert all(worker.startswith("tls://127.0.0.1") for worker in first)
        wait_until(lambda: all(getattr(job, "had_workers", False) for job in cluster.workers.values()))
        client.retire_workers(list(first))
        client.wait_for_workers(2, timeout=200)
        assert not first & set(client.scheduler_info(n_workers=-1)["workers"])
"""


@pytest.mark.all
def test_a_job_whose_workers_have_left_is_replaced(slurm: Path) -> None:
    completed = run_recipe(slurm, sys.executable, "-c", REPLACED, DASK_CONFIG=str(slurm / "jobqueue.yaml"))
    assert completed.returncode == 0, completed.stderr
    assert len(list(slurm.glob("job-*"))) == 2
    assert not list(slurm.glob(".sobolev-batch*"))


@pytest.mark.all
def test_a_job_that_is_refused(slurm: Path) -> None:
    write_study(slurm)
    completed = jobqueue(slurm, "--system", "slurm", settings=slurm / "jobqueue.yaml", REFUSE="yes")
    assert completed.returncode == 1
    assert "sbatch: error: Invalid account" in completed.stderr
    assert "Traceback" not in completed.stderr
    assert not list(slurm.glob(".sobolev-batch*"))


@pytest.mark.all
def test_settings_that_cannot_serve(tmp_path: Path) -> None:
    completed = jobqueue(tmp_path, "--system", "slurm", settings=tmp_path / "nothing.yaml")
    assert completed.returncode == 1
    assert "jobqueue.slurm.cores is not set: copy jobqueue.yaml" in completed.stderr
    completed = jobqueue(tmp_path, "--system", "slurm", PATH=str(tmp_path))
    assert "sbatch is not on the PATH" in completed.stderr
    everywhere = tmp_path / "everywhere.yaml"
    everywhere.write_text(SETTINGS.read_text().replace("    interface: ib0", "    interface: null"))
    completed = jobqueue(tmp_path, "--system", "pbs", "--print-script", settings=everywhere)
    assert "jobqueue.pbs.interface is not set, and the scheduler would listen on all networks" in completed.stderr


# Options first, then the command, once per task.
SRUN = """
while [[ $1 == -* ]]; do shift; done
trap 'kill $(jobs -p)' TERM
for _ in $(seq "$SLURM_NTASKS"); do "$@" 2>> "$HOME/workers.log" & done
wait
wait
"""


@pytest.mark.all
def test_a_study_in_one_allocation(tmp_path: Path) -> None:
    add_command(tmp_path, "srun", SRUN)
    write_study(tmp_path)
    script, study = documented("sbatch workflows")[0][1:]
    loopback = next(name for name, found in psutil.net_if_addrs().items() if found[0].address == "127.0.0.1")
    variables = {"INTERFACE": loopback, "RECIPES": str(FOLDER), "SLURM_SUBMIT_DIR": str(tmp_path)}
    variables |= {"SLURM_NTASKS": "1", "SLURM_MEM_PER_CPU": "2048"}
    recipe = FOLDER / Path(script).name
    completed = run_recipe(tmp_path, "bash", recipe, study, "--store", "results.zarr", **variables)
    assert completed.returncode == 0, completed.stderr
    assert re.search(TABLE, completed.stdout)
    log = (tmp_path / "workers.log").read_text()
    assert len(re.findall(r"Start worker at: +tls://127\.0\.0\.1", log)) == 1
    assert log.count("Memory:                   2.00 GiB") == 1
    assert len(re.findall("End worker", log)) == 1
    assert not list(tmp_path.glob(".sobolev-batch.*"))


def test_its_directives_come_before_its_commands() -> None:
    lines = (FOLDER / "slurm.sbatch").read_text().splitlines()
    commands = [i for i, line in enumerate(lines) if line and not line.startswith("#")]
    directives = [i for i, line in enumerate(lines) if line.startswith("#SBATCH ")]
    assert max(directives) < min(commands)
    assert len(directives) == 10
