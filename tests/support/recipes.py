"""The recipes of workflows/clusters/, and the commands of docs/clusters.md."""

from __future__ import annotations

import os
import re
import shlex
import sys
from pathlib import Path
from subprocess import CompletedProcess

from tests.support.commands import TOML, finished
from tests.support.repository import ROOT

FOLDER = ROOT / "workflows" / "clusters"
CERTIFICATES = FOLDER / "make-certificates"

# One mesh is a file beside the study: workers are started in another folder.
FAMILY = '[[family]]\nname = "file"\nsource = "files"\npaths = ["tetrahedron.off"]\n'
TETRAHEDRON = "OFF\n4 4 0\n1 1 1\n1 -1 -1\n-1 1 -1\n-1 -1 1\n3 0 1 2\n3 0 3 1\n3 0 2 3\n3 1 3 2\n"
RESULT = r"(?m)^Of 5 meshes, ico/3 is nearest"  # what it prints first


def write_study(folder: Path) -> None:
    (folder / "study.toml").write_text(TOML.replace("-10.0, ", "") + FAMILY)
    (folder / "tetrahedron.off").write_text(TETRAHEDRON)


def documented(beginning: str = "") -> list[list[str]]:
    """Return the commands of docs/clusters.md with a given beginning, as lists of words."""
    text = (ROOT / "docs" / "clusters.md").read_text(encoding="utf-8")
    lines = "".join(re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)).splitlines()
    return [shlex.split(line, comments=True) for line in lines if line.startswith(beginning)]


def environment(home: Path, **variables: str) -> dict[str, str]:
    """Return an environment with this checkout, its recipes, the commands beside this interpreter and a home."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("DASK_", "SLURM_"))}
    path = os.pathsep.join([str(home / "bin"), str(Path(sys.executable).parent), os.environ["PATH"]])
    own = {"PYTHONPATH": f"{ROOT}{os.pathsep}{FOLDER}", "HOME": str(home), "PATH": path, "TMPDIR": str(home)}
    return {**kept, **own, **variables}


def run_recipe(folder: Path, *words: object, **variables: str) -> CompletedProcess[str]:
    return finished(*words, cwd=folder, env=environment(folder, **variables))


def add_command(home: Path, name: str, script: str) -> None:
    (home / "bin").mkdir(exist_ok=True)
    (home / "bin" / name).write_text(f"#!/bin/bash\n{script}")
    (home / "bin" / name).chmod(0o755)
