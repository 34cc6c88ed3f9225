"""A mesh in batches gives the field that it gives as a whole."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from distributed import Client

from sobolev_batch import Lattice, Mesh, MeshError, StoreError, Study, icosphere
from sobolev_batch.batch.cluster.execution import Cluster
from sobolev_batch.batch.cluster.workers import WorkerInfo, Workers
from sobolev_batch.batch.fields.graph import field_task
from sobolev_batch.batch.fields.large_mesh import BlockSum, SplitMesh, add_sums, split_mesh, transform_batch
from sobolev_batch.batch.fields.sizing import TaskSizes
from sobolev_batch.batch.fields.tasks import FieldSettings, Job
from sobolev_batch.batch.store.create import prepare_store
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.study.plan import Plan, Row, make_plan
from sobolev_batch.spectral.errors.quality import Quality
from sobolev_batch.spectral.lattice import Block
from sobolev_batch.spectral.shells import SobolevWeights
from sobolev_batch.surfaces.sources.registry import Fingerprint, Member
from tests.support.studies import small_table


class Ball(Member):
    """Of two scales, so that batches get different rules, and with a run of triangles without area."""

    def load(self) -> Mesh:
        fine, coarse = icosphere(4), icosphere(1)
        flat = np.tile([[0, 0, 1]], (3000, 1))
        triangles = [fine.triangles, flat, coarse.triangles + len(fine.vertices)]
        return Mesh(np.concatenate([0.5 * fine.vertices, coarse.vertices]), np.concatenate(triangles))

    def fingerprint(self) -> Fingerprint:
        return {}


class Torn(Ball):
    def load(self) -> Mesh:
        raise MeshError("torn.ply: no triangles")


class Outside(Ball):
    def load(self) -> Mesh:
        return Mesh(100 * icosphere(1).vertices, icosphere(1).triangles)


@pytest.fixture
def plan() -> Plan:
    return make_plan(Study.from_table(small_table()))


def job_of(plan: Plan, store_path: Path, member: Member, row: int = 0) -> Job:
    store = prepare_store(store_path, plan)
    return Job(store, row, Row("a/0", "a", member, "", "key"), FieldSettings.of(plan))


def computed(client: Client, job: Job, batches: int, blocks: tuple[Block, ...]) -> Record:
    sizes = TaskSizes(batches, tuple((block,) for block in blocks), 1e9, 1e9, 1e9)
    workers = Workers((WorkerInfo("tcp://a", 1, 2e9, "cpu", ""),))
    ((_, record),) = Cluster(client, workers).run([field_task(job, sizes)])
    assert isinstance(record, Record)
    return record


@pytest.mark.parametrize("batches", [3, *(pytest.param(count, marks=pytest.mark.all) for count in (2, 7))])
def test_octaves_of_batches_add_up_to_those_of_the_whole(client: Client, store_path: Path, batches: int) -> None:
    lattice = {"xi_max": 3.0, "M": 16, "octaves": 2}
    plan = make_plan(Study.from_table(small_table(lattice=lattice, norm={"orders": [-1.5, -2.0]})))
    whole = computed(client, job_of(plan, store_path, Ball("ball", 0)), 1, plan.blocks)
    job = job_of(plan, store_path, Ball("ball", 0), row=1)
    record = computed(client, job, batches, plan.blocks)
    assert record.status == "complete", record.reason
    expected, found = job.store.read_octaves([0, 1], [one.checksums[-1] for one in (whole, record)])
    assert np.abs(found - expected).max() < 2e-8 * whole.facts.area
    qualities = [Quality.from_json(one.quality) for one in (whole, record)]
    for quality in qualities:
        assert quality.tail is not None
        assert quality.tail.own_limit[0] == pytest.approx(2 * whole.facts.area)
    assert (qualities[1].error_norms(SobolevWeights(plan.lattice, (-1.5,), 3.0)) < 1e-6 * whole.facts.area).all()


@pytest.mark.parametrize("batches", [2, 3, 7])
def test_batches_add_up_to_the_whole(client: Client, plan: Plan, store_path: Path, batches: int) -> None:
    whole = computed(client, job_of(plan, store_path, Ball("ball", 0)), 1, plan.blocks)
    job = job_of(plan, store_path, Ball("ball", 0), row=1)
    record = computed(client, job, batches, plan.blocks)
    assert record.status == "complete", record.reason
    place = plan.lattice.place(plan.lattice.half)
    expected, found = job.store.read_fields([0, 1], place)
    assert np.abs(found - expected).max() < 2e-9 * whole.facts.area
    assert replace(record.facts, points=0) == replace(whole.facts, points=0)
    assert record.facts.points > 0
    assert record.backend == "finufft"


def test_blocks_of_batches_are_those_of_the_whole(client: Client, plan: Plan, store_path: Path) -> None:
    blocks = plan.lattice.split(1000)
    assert len(blocks) == 3
    plan = replace(plan, blocks=blocks)
    job = job_of(plan, store_path, Ball("ball", 0))
    record = computed(client, job, 3, blocks)
    assert record.status == "complete", record.reason
    whole = job_of(plan, store_path, Ball("ball", 0), row=1)
    reference = computed(client, whole, 1, (plan.lattice.half,))
    expected, found = job.store.read_fields([1, 0], plan.lattice.place(plan.lattice.half))
    assert np.abs(found - expected).max() < 2e-9 * reference.facts.area
    assert record.quality.count(",") == reference.quality.count(",")  # as many draws


@pytest.mark.parametrize(("member", "reason"), [(Torn, "torn.ply: no triangles"), (Outside, r"reaches to \|coord")])
def test_a_mesh_that_cannot_be_split_fails_alone(
    client: Client, plan: Plan, store_path: Path, member: type[Ball], reason: str
) -> None:
    record = computed(client, job_of(plan, store_path, member("torn", 0)), 3, plan.blocks)
    assert record.status == "failed"
    assert re.search(reason, record.reason)


def test_a_batch_that_is_gone_is_no_failure_of_its_mesh(plan: Plan, store_path: Path) -> None:
    job = job_of(plan, store_path, Ball("ball", 0))
    split = split_mesh(job, 3)
    assert split.batches == {0, 1, 2}
    job.store.scratch.discard(0)
    with pytest.raises(StoreError, match="batch 1 of the triangles of row 0 cannot be read"):
        transform_batch(job, split, 1, plan.blocks[0])


def test_errors_survive_the_sum() -> None:
    total = add_sums(BlockSum(np.ones(2, dtype=np.complex128)), BlockSum(error="gone"))
    assert (total.error, add_sums(BlockSum(error="first"), total).error) == ("gone", "first")


def test_a_split_that_failed_is_not_transformed(plan: Plan, store_path: Path) -> None:
    job = job_of(plan, store_path, Ball("ball", 0))
    assert transform_batch(job, SplitMesh(error="no"), 0, Lattice(1.0, 4).half).values is None
