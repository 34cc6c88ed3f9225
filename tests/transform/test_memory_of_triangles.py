"""What is taken for each triangle of a fine mesh while it is planned and compared, in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sobolev_batch import Mesh
from sobolev_batch.geometry.overlap import shared_triangles
from sobolev_batch.norms.tail.face_normals import FaceNormals
from sobolev_batch.shapes import Similarity, icosphere
from sobolev_batch.transform.exact import exact_transform

# 327,680 triangles, of which whole arrays stand out from what the process takes anyway.
_LEVEL = 7
_FREQUENCIES = 100.0 * np.eye(3)
_STEPS: dict[str, Callable[[Mesh], object]] = {
    "move to the unit of the study": lambda mesh: Similarity(0.5, (1.0, 0.0, 0.0)).apply(mesh),
    "box and extent": lambda mesh: (mesh.bounding_sphere, mesh.extent),
    "exact values": lambda mesh: exact_transform(mesh, _FREQUENCIES),
    "exact values by two threads": lambda mesh: exact_transform(mesh, _FREQUENCIES, threads=2),
    "directions of faces": lambda mesh: FaceNormals.from_surfaces([mesh]),
    "common triangles": lambda mesh: shared_triangles(mesh.vertices[mesh.triangles], np.zeros((1, 3, 3))),
}
# Bytes for each triangle at the peak of a step. Whole arrays of temporaries took 150 to 290.
_MOST_BYTES = 110


def main() -> None:
    """Print the bytes for each triangle that every step takes at its peak, beyond what was there before."""
    mesh = icosphere(_LEVEL)
    for name, step in _STEPS.items():
        # What is loaded once, and memory that the allocator keeps, count no more.
        step(icosphere(2))
        Path("/proc/self/clear_refs").write_text("5")
        before = _status_bytes("VmRSS")
        step(mesh)
        taken = (_status_bytes("VmHWM") - before) / len(mesh.triangles)
        sys.stdout.write(json.dumps([name, taken]) + "\n")


def _status_bytes(key: str) -> int:
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(key))
    return 1024 * int(line.split()[1])


@pytest.mark.process
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory is measured by Linux's /proc")
def test_no_step_holds_whole_arrays_of_temporaries() -> None:
    root = Path(__file__).parents[2]
    found = subprocess.run(
        [sys.executable, "-c", f"from {__name__} import main; main()"],
        capture_output=True,
        text=True,
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
    )
    assert found.returncode == 0, found.stderr
    taken = dict(json.loads(line) for line in found.stdout.splitlines())
    assert taken.keys() == _STEPS.keys()
    assert {name: bytes_each for name, bytes_each in taken.items() if bytes_each > _MOST_BYTES} == {}
