"""Peak memory of a worker's task on a huge mesh, in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.all

# The mesh is cut from a square so that making it costs little beside what is measured.
TASK = """
import resource, sys
import numpy as np
import sobolev_batch as sb
from sobolev_batch.batch.study.plan import Row, make_plan
from sobolev_batch.batch.store.create import prepare_store
from sobolev_batch.batch.fields.tasks import FieldSettings, Job, compute_mesh
from sobolev_batch.surfaces.sources.registry import Member


class Sheet(Member):
    def load(self):
        side = np.linspace(-0.7, 0.7, 1583)
        x, y = np.meshgrid(side, side, indexing="ij")
        corner = (np.arange(1582)[:, None] * 1583 + np.arange(1582)).ravel()
        triangles = np.concatenate([corner[:, None] + [0, 1, 1583], corner[:, None] + [1, 1584, 1583]])
        return sb.Mesh(np.stack([x.ravel(), y.ravel(), 0.2 * (x * y).ravel()], axis=1), triangles)

    def fingerprint(self):
        return {}


table = {
    "study": {"name": "sheet"},
    "lattice": {"xi_max": 5.0, "M": 128},
    "norm": {"orders": [-10.0]},
    "reference": {"source": "sphere"},
    "family": [{"name": "a", "source": "icosphere", "levels": [0]}],
}
plan = make_plan(sb.Study.from_table(table))
store = prepare_store(sys.argv[1], plan)
job = Job(store, 0, Row("a/0", "a", Sheet("sheet", 0), "", "key"), FieldSettings.of(plan))
record = compute_mesh(job, plan.blocks)
assert record.status == "complete", record.reason
print(record.facts.triangles, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def test_five_million_triangles_stay_below_two_gigabytes(store_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", TASK, str(store_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    triangles, peak_kilobytes = map(int, done.stdout.split())
    assert triangles > 5_000_000
    assert peak_kilobytes * 1024 < 2e9
