"""Batches and sub-blocks that fit into memory."""

from __future__ import annotations

from dataclasses import replace
from math import prod

import numpy as np
import pytest

from sobolev_batch.spectral.backends import CPU_COSTS, GPU_COSTS, Costs, NufftSpec, Workload
from sobolev_batch.spectral.lattice import Block
from sobolev_batch.spectral.transform.transform import fastest_spec, sub_shapes


@pytest.mark.parametrize("shape", [(65, 65, 33), (129, 129, 65), (17, 90, 3), (5, 4, 2)])
@pytest.mark.parametrize("sigma", [1.25, 1.5, 2.0])
@pytest.mark.parametrize("costs", [CPU_COSTS, GPU_COSTS], ids=["cpu", "gpu"])
def test_smaller_sub_blocks_never_take_more(shape: tuple[int, int, int], sigma: float, costs: Costs) -> None:
    workload = Workload(1e6, 1e6)
    specs = [NufftSpec(sub_shape, 1e-6, oversampling=sigma) for sub_shape in sub_shapes(shape, sigma)]
    projected = [costs.projected_bytes(spec, workload) for spec in specs]
    assert projected == sorted(projected, reverse=True)


@pytest.mark.parametrize("allowed_bytes", [2.2e7, 4e7, 8e7, 1.2e8])
def test_it_is_the_fastest_of_all_that_fit(allowed_bytes: float) -> None:
    whole, workload, costs = NufftSpec((129, 129, 65), 1e-6), Workload(3e5, 6e5, 100_000), CPU_COSTS
    found = fastest_spec(whole, workload, costs, allowed_bytes)
    assert costs.projected_bytes(found, workload) <= allowed_bytes
    others = [
        replace(whole, shape=shape, oversampling=sigma, batch=whole.batch >> halvings)
        for sigma in costs.oversamplings(whole)
        for shape in sub_shapes(whole.shape, sigma)
        for halvings in range(10)
    ]
    fitting = [other for other in others if costs.projected_bytes(other, workload) <= allowed_bytes]
    fastest = min(costs.projected_nanoseconds(other, whole.shape, workload) for other in fitting)
    assert found != whole
    assert costs.projected_nanoseconds(found, whole.shape, workload) <= 1.05 * fastest


def test_sub_blocks_cover_the_block_once() -> None:
    block = Block((-3, 1, 2), (5, 4, 4))
    covered = np.zeros(block.shape, dtype=int)
    for sub_block, (x, y, z) in block.tiles((2, 3, 3)):
        assert prod(sub_block.shape) == 18
        assert sub_block.start == (block.start[0] + x.start, block.start[1] + y.start, block.start[2] + z.start)
        covered[x, y, z] += 1
    assert (covered == 1).all()
