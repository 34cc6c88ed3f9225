"""Tasks of one row: batches of points, blocks of the lattice, and records that are there already."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sobolev_batch import Study
from sobolev_batch.batch.fields.tasks import (
    Job,
    compute_mesh,
    compute_parts,
    finish_mesh,
)
from sobolev_batch.batch.store.create import prepare_store
from sobolev_batch.batch.study.plan import Plan, make_plan
from tests.support.studies import small_table

FINE = small_table(family=[{"name": "ico", "source": "icosphere", "levels": [0, 5]}])


def job_of(plan: Plan, store_path: Path, label: str = "ico/5", allowed_bytes: float | None = None) -> Job:
    row = next(row for row in plan.rows if row.label == label)
    return Job.for_row(plan, row, prepare_store(store_path, plan), 0, allowed_bytes)


def test_a_mesh_is_one_task_whatever_the_memory_allows(store_path: Path) -> None:
    plan = make_plan(Study.from_table(FINE))
    whole = compute_mesh(job_of(plan, store_path), plan.blocks)
    # So little that points are added up in batches.
    job = replace(job_of(plan, store_path, allowed_bytes=1.25e7), index=1)
    record = compute_mesh(job, plan.blocks)
    assert record.status == "complete", record.reason
    assert record.facts == whole.facts
    expected, values = job.store.read_fields([0, 1], plan.lattice.place(plan.lattice.half))
    assert np.abs(values - expected).max() < 2e-9 * whole.facts.area


def test_a_task_whose_record_is_there_writes_nothing(store_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lattice = {"xi_max": 3.0, "M": 16, "octaves": 1}
    study = Study.from_table(small_table(lattice=lattice, norm={"orders": [-2.0]}))
    plan = make_plan(replace(study, largest_chunk_bytes=16_000))
    blocks = plan.blocks
    job = job_of(plan, store_path, "ico/1")
    parts = [*(compute_parts(job, [block]) for block in blocks), compute_parts(job, octaves=True)]
    record = finish_mesh(job, parts)
    assert (record.status, len(record.checksums)) == ("complete", len(blocks) + 1)

    def refuse(*arguments: Any) -> None:
        raise AssertionError("it is written again")

    for name in ("write_field", "write_record"):
        monkeypatch.setattr(type(job.store), name, refuse)
    again = [*(compute_parts(job, [block]) for block in blocks), compute_parts(job, octaves=True)]
    # Those whose worker was lost are done again; the results of others may be there still.
    for mixture in (parts, again, [*parts[:2], *again[2:]]):
        assert finish_mesh(job, mixture) == record
    assert compute_mesh(job, blocks) == record
