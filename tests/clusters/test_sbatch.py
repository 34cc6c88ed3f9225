"""One allocation of SLURM: the script, with an srun that starts its tasks on this machine."""

from __future__ import annotations

import re
from pathlib import Path

import psutil
import pytest

from tests.support.recipes import FOLDER, TABLE, add_command, documented, run_recipe, write_study

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
