"""One allocation of SLURM: the script, with an srun that starts its tasks on this machine."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import psutil
import pytest

from tests.support.recipes import FOLDER, TABLE, add_command, documented, environment, write_study

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
    completed = subprocess.run(
        ["bash", FOLDER / Path(script).name, study, "--store", "results.zarr"],
        env=environment(
            tmp_path,
            INTERFACE=next(
                name for name, addresses in psutil.net_if_addrs().items() if addresses[0].address == "127.0.0.1"
            ),
            RECIPES=str(FOLDER),
            SLURM_SUBMIT_DIR=str(tmp_path),
            SLURM_NTASKS="1",
            SLURM_MEM_PER_CPU="2048",
        ),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
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
