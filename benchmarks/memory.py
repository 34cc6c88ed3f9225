"""Peak memory of one transform, in a process that does nothing else."""

from __future__ import annotations

import re
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import sobolev_batch as sb
from benchmarks.table import Row, as_bytes
from benchmarks.timing import Effort
from benchmarks.transforms import XI_MAX, our_transform


def peaks(effort: Effort) -> Iterator[Row]:
    """Item 8: a mesh of five million triangles, and a lattice of 36 million samples."""
    sizes = ((6, 32), (3, 64)) if effort.quick else ((9, 64), (5, 416))
    for level, intervals in sizes:
        with TemporaryDirectory() as name:
            folder = Path(name)
            # Made here and not where memory is measured: making it takes more than transforming it.
            mesh = sb.shapes.icosphere(level)
            count = len(mesh.triangles)
            np.save(folder / "vertices.npy", mesh.vertices)
            np.save(folder / "triangles.npy", mesh.triangles)
            del mesh
            command = [sys.executable, "-m", "benchmarks.memory", name, str(intervals), str(effort.threads)]
            peak = int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        yield Row("8", f"peak memory: {count:,} triangles, M = {intervals}, with the mesh", as_bytes(peak))


def _peak_bytes(folder: Path, intervals: int, threads: int) -> int:
    """What loading and transforming a mesh adds to the peak of this process."""
    before = highest_bytes()
    mesh = sb.Mesh(np.load(folder / "vertices.npy"), np.load(folder / "triangles.npy"))
    our_transform(mesh, sb.Lattice(XI_MAX, intervals), threads)
    return highest_bytes() - before


def highest_bytes() -> int:
    """The peak of this process's resident memory."""
    # On Linux getrusage starts from the peak of the parent process; the kernel's own mark does not.
    status = Path("/proc/self/status")
    marks = re.findall(r"^VmHWM:\s+(\d+) kB", status.read_text(encoding="ascii"), re.M) if status.exists() else []
    if marks:
        return int(marks[0]) * 1024
    # Counted in bytes on macOS and in kilobytes elsewhere.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


if __name__ == "__main__":
    print(_peak_bytes(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])))
