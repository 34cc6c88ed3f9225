"""Tiles of rows: that they measure what pair by pair would give."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sobolev_batch import Study, distance, fourier_transform
from sobolev_batch.shapes import Sphere
from sobolev_batch.store.create import prepare_store
from sobolev_batch.store.field_arrays import Fields
from sobolev_batch.study.plan import make_plan
from sobolev_batch.tables.evaluator import Evaluator
from sobolev_batch.transform.lattice import SobolevWeights, shell_sums
from tests.support.studies import SMALL_LATTICE, small_table

ROWS = 11
REFERENCE = 4
TWINS = 2, 9


@pytest.fixture
def fields() -> NDArray[np.complex128]:
    rng = np.random.default_rng(0)
    shape = ROWS, *SMALL_LATTICE.shape
    fields = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    # So near to each other that their distance cannot come from products with the others.
    fields[TWINS[1]] = fields[TWINS[0]] * (1 + 1e-7)
    return fields


@pytest.fixture
def evaluator(store_path: Path, fields: NDArray[np.complex128]) -> Evaluator:
    """Of fields in several chunks, of which a task holds five: three rows, one other, and one that is read."""
    family = {"name": "ico", "source": "icosphere", "levels": list(range(ROWS - 1))}
    study = replace(Study.from_table(small_table(family=[family])), largest_chunk_bytes=16_000)
    plan = make_plan(study)
    assert len(plan.blocks) > 2
    store = prepare_store(store_path, plan)
    checksums: dict[int, tuple[int, ...]] = dict.fromkeys(range(ROWS), ())
    for block in plan.blocks:
        place = block.place_in(plan.lattice.half)
        for row, field in enumerate(fields):
            checksums[row] += (Fields(store).write(row, place, field[place]),)
    return Evaluator(
        store=store,
        lattice=plan.lattice,
        blocks=plan.blocks,
        orders=study.orders,
        reference=REFERENCE,
        areas=np.ones(ROWS),
        errors=np.zeros((2, ROWS)),
        beyond=np.zeros((2, ROWS)),
        images=np.zeros((2, ROWS)),
        widths=np.ones(13),
        checksums=checksums,
        tile_bytes=5 * 16 * plan.blocks[0].size,
    )


def norms_of(values: NDArray[np.complex128], evaluator: Evaluator) -> NDArray[np.float64]:
    """The norms (orders, ...) of fields (..., shape of the lattice), straight from their sums over shells."""
    lattice = evaluator.lattice
    sums = shell_sums(values.reshape(-1, *lattice.shape), None, lattice, lattice.half)
    norms = np.sqrt(SobolevWeights(lattice, evaluator.orders).per_shell @ sums.T)
    return norms.reshape(-1, *values.shape[:-3])


def test_pairs_are_measured_as_each_of_them_is(evaluator: Evaluator, fields: NDArray[np.complex128]) -> None:
    rows, others = list(range(0, ROWS, 2)), list(range(1, ROWS, 2))
    for side, opposite in ((range(ROWS), range(ROWS)), (rows, others)):
        found = evaluator.pairs(list(side), list(opposite)).values
        expected = norms_of(fields[list(side)][:, None] - fields[list(opposite)], evaluator)
        assert found == pytest.approx(expected, rel=1e-10)
    found = evaluator.pairs(list(range(ROWS)), list(range(ROWS))).values
    assert np.array_equal(found, np.swapaxes(found, 1, 2))
    assert (np.diagonal(found, axis1=1, axis2=2) == 0).all()


@pytest.mark.parametrize(("rows", "others"), [([0, 1], [3, 4, 9]), ([2], [9]), ([5], [6, 7, 8])])
@pytest.mark.parametrize("fitting", [5, 3])
def test_tiles_whose_others_are_all_other_rows(
    evaluator: Evaluator, fields: NDArray[np.complex128], rows: list[int], others: list[int], fitting: int
) -> None:
    evaluator = replace(evaluator, tile_bytes=fitting * 16 * evaluator.blocks[0].size)
    expected = norms_of(fields[rows][:, None] - fields[others], evaluator)
    assert evaluator.tile(rows, others).values == pytest.approx(expected, rel=1e-10)


def test_norms_are_those_of_the_fields(evaluator: Evaluator, fields: NDArray[np.complex128]) -> None:
    rows = [1, 3, REFERENCE]
    compared = evaluator.norms(rows)
    norms, to_reference = compared.norms, compared.distances
    parts = compared.reference.area_and_shape(to_reference)
    areas, shapes = parts["area_part"], parts["shape_part"]
    for found, values in (norms, fields), (to_reference, fields - fields[REFERENCE]):
        assert found.values == pytest.approx(norms_of(values[rows], evaluator), rel=1e-13)
    # The parts of each distance are those of the library, whatever the chunks.
    for row, area, shape in zip([1, 3], areas.T, shapes.T, strict=False):
        known = fourier_transform(Sphere(0.1), evaluator.lattice)
        alone = distance(known.copy(data=fields[row]), known.copy(data=fields[REFERENCE]), evaluator.orders)
        whole, share = alone["distance"].values, alone["area_share"].values
        assert area == pytest.approx(whole * share**0.5, rel=1e-10)
        assert shape == pytest.approx(whole * (1 - share) ** 0.5, rel=1e-12)
    assert (areas**2 + shapes**2)[:, :2] == pytest.approx(to_reference.values[:, :2] ** 2, rel=1e-12)
    assert (areas[:, 2] == 0).all()
    assert (shapes[:, 2] == 0).all()


def test_without_a_reference_there_are_norms_alone(evaluator: Evaluator) -> None:
    compared = replace(evaluator, reference=None).norms([1, 3])
    assert compared.norms.values == pytest.approx(evaluator.norms([1, 3]).norms.values, rel=1e-14)
    assert (compared.beyond[0] == 0).all()
    parts = compared.reference.area_and_shape(compared.distances).values()
    for found in (*compared.distances.stacked, *parts, compared.beyond[1]):
        assert found.shape == compared.norms.values.shape
        assert np.isnan(found).all()
