"""Loaded into a worker before it starts: whoever loads a mesh file beside which there is a gate waits at it.

A gate is a named pipe with the file's stem: it opens when somebody writes to it.
"""

from __future__ import annotations

from pathlib import Path

from sobolev_batch.batch.field_tasks import Job
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.sources.files import FileMember

# Dask may load this twice.
if not hasattr(Job, "load_without_gate"):
    setattr(Job, "load_without_gate", Job.load)  # noqa: B010


def gate_of(path: Path) -> Path:
    return path.with_suffix(".gate")


def wait_and_load(job: Job) -> Surface:
    """Load the surface of a job, once its gate is open."""
    member = job.planned.member
    if isinstance(member, FileMember) and gate_of(member.path).exists():
        gate_of(member.path).read_bytes()
    surface: Surface = job.load_without_gate()  # type: ignore[attr-defined]
    return surface


Job.load = wait_and_load  # type: ignore[method-assign, assignment]
