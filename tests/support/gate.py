"""Loaded into a worker before it starts: whoever loads a mesh file beside which there is a gate waits at it.

A gate is a named pipe with the file's stem: it opens when somebody writes to it.
"""

from __future__ import annotations

from pathlib import Path

from sobolev_batch.batch.fields import tasks
from sobolev_batch.batch.fields.tasks import Job
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.files import FileMember

# Dask may load this twice.
_LOAD = vars(tasks).setdefault("_load_surface_without_gate", tasks.load_surface)


def gate_of(path: Path) -> Path:
    """Where the gate of a mesh file is."""
    return path.with_suffix(".gate")


def wait_and_load(job: Job) -> Surface:
    """The surface of a job, once its gate is open."""
    if isinstance(job.member, FileMember) and gate_of(job.member.path).exists():
        gate_of(job.member.path).read_bytes()
    surface: Surface = _LOAD(job)
    return surface


vars(tasks)["load_surface"] = wait_and_load
