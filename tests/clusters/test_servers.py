"""The recipes on a real SLURM, and stores in a real object storage, where this machine has them: make test-servers."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import yaml

import sobolev_batch as sb
from tests.support.object_storage import taken_for_s3
from tests.support.processes import wait_until
from tests.support.recipes import FOLDER, RESULT, environment, run_recipe, write_study
from tests.support.servers import rclone, slurm
from tests.support.stores import assert_same_results
from tests.support.studies import small_table

pytestmark = [pytest.mark.all, pytest.mark.process]
LOOPBACK = next(name for name, found in psutil.net_if_addrs().items() if found[0].address == "127.0.0.1")


@pytest.fixture(scope="module")
def cluster() -> Iterator[dict[str, str]]:
    with slurm() as variables:
        yield variables


def test_a_study_on_jobs_of_slurm(cluster: dict[str, str], tmp_path: Path) -> None:
    write_study(tmp_path)
    settings = yaml.safe_load((FOLDER / "jobqueue.yaml").read_text())
    change = {"cores": 2, "processes": 2, "memory": "2GiB", "local-directory": str(tmp_path), "interface": LOOPBACK}
    settings["jobqueue"]["slurm"].update(change)
    (tmp_path / "jobqueue.yaml").write_text(yaml.safe_dump(settings))
    words = [FOLDER / "jobqueue.py", "study.toml", "--system", "slurm", "--jobs", "2", "--store", "results.zarr"]
    variables = {**cluster, "DASK_CONFIG": str(tmp_path / "jobqueue.yaml")}
    completed = run_recipe(tmp_path, sys.executable, *words, **variables)
    assert completed.returncode == 0, completed.stderr
    assert re.search(RESULT, completed.stdout)
    assert not list(tmp_path.glob(".sobolev-batch*"))
    require_local_numbers(tmp_path)
    wait_until(lambda: not queue(cluster))


def test_a_study_in_one_allocation_of_slurm(cluster: dict[str, str], tmp_path: Path) -> None:
    write_study(tmp_path)
    options = ["--wait", "--nodes=1", "--ntasks-per-node=2", "--mem-per-cpu=1G", "--output=job.log"]
    words = ["sbatch", *options, FOLDER / "slurm.sbatch", "study.toml", "--store", "results.zarr"]
    completed = run_recipe(tmp_path, *words, **cluster, INTERFACE=LOOPBACK, RECIPES=str(FOLDER))
    log = (tmp_path / "job.log").read_text()
    assert completed.returncode == 0, log
    assert re.search(RESULT, log)
    assert not list(tmp_path.glob(".sobolev-batch*"))
    require_local_numbers(tmp_path)


def test_a_cancelled_job_unlocks_its_store_and_the_next_one_goes_on(cluster: dict[str, str], tmp_path: Path) -> None:
    write_study(tmp_path)
    options = ["--parsable", "--nodes=1", "--ntasks-per-node=1", "--mem-per-cpu=1G", "--output=%j.log"]
    words = ["sbatch", *options, FOLDER / "slurm.sbatch", "study.toml", "--store", "results.zarr"]
    variables = {**cluster, "INTERFACE": LOOPBACK, "RECIPES": str(FOLDER)}
    job = run_recipe(tmp_path, *words, **variables).stdout.strip()
    wait_until(lambda: (tmp_path / "results.zarr/claim.json").exists() or not queue(cluster))
    # As at the end of the walltime: the signal goes to the script.
    subprocess.run(["scancel", "--batch", "--signal=TERM", job], env=environment(tmp_path, **cluster), check=True)
    wait_until(lambda: not queue(cluster))
    assert not (tmp_path / "results.zarr/claim.json").exists(), (tmp_path / f"{job}.log").read_text()
    completed = run_recipe(tmp_path, *words[:1], "--wait", *words[1:], **variables)
    assert completed.returncode == 0, completed.stderr
    require_local_numbers(tmp_path)


def queue(cluster: dict[str, str]) -> str:
    asked = ["squeue", "--noheader"]
    return subprocess.run(
        asked, env=environment(Path.home(), **cluster), capture_output=True, text=True, check=True
    ).stdout


def require_local_numbers(folder: Path) -> None:
    """Check that the store of a cluster is that of a run on this machine."""
    sb.run(folder / "study.toml", folder / "local.zarr", workers=1)
    assert_same_results(folder / "results.zarr", folder / "local.zarr")


def test_a_study_in_object_storage(tmp_path: Path) -> None:
    study, url = sb.Study.from_table(small_table()), "s3://studies/results.zarr"
    (tmp_path / "served/studies").mkdir(parents=True)
    with rclone(tmp_path / "served") as variables, taken_for_s3(variables):
        first = sb.run(study, url, workers=2)
        assert len(first.computed) == 5
        assert sb.run(study, url).reused == first.computed
        assert sb.verify(url).is_sound
        assert sb.table(url)["distance"].notna().all()
        assert sb.unlock(url) is None
    sb.run(study, tmp_path / "local.zarr", workers=2)
    assert_same_results(tmp_path / "served/studies/results.zarr", tmp_path / "local.zarr")
