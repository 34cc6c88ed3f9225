"""Distances of all pairs in tiles: the same as in one, computed once each, and again where they are lost."""

from __future__ import annotations

import shutil
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from distributed import Client

from sobolev_batch import Study, matrix, open_store, run, table, verify
from sobolev_batch.errors import DamageError
from sobolev_batch.geometry.formats.writing import write_mesh
from sobolev_batch.store.layout import Store
from sobolev_batch.tables import pairs
from sobolev_batch.tables.evaluator import Evaluator
from tests.support.rectangles import Rectangles
from tests.support.studies import small_table

Tile = tuple[tuple[int, ...], tuple[int, ...]]


def balls(count: int, **changes: Any) -> Study:
    family = [{"name": f"ball-{k}", "source": "sphere", "radius": 0.5 + 0.1 * k} for k in range(count)]
    return Study.from_table(small_table(family=family, **changes))


@pytest.fixture(autouse=True)
def _two_meshes_a_side(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pairs, "_FEWEST", 2)
    monkeypatch.setattr(pairs, "_MOST", 2)


@pytest.fixture
def tiles(monkeypatch: pytest.MonkeyPatch) -> list[Tile]:
    """Return the rows and others of each tile that is computed from now on."""
    computed: list[Tile] = []
    measured = Evaluator.pairs

    def recording(evaluator: Evaluator, rows: list[int], others: list[int]) -> Any:
        computed.append((tuple(rows), tuple(others)))
        return measured(evaluator, rows, others)

    monkeypatch.setattr(Evaluator, "pairs", recording)
    return computed


def test_tiles_have_the_numbers_of_a_single_one(
    store_path: Path, finished_store: Path, threads: Client, tiles: list[Tile]
) -> None:
    run(Study.from_table(small_table()), store_path, threads)
    assert len(tiles) == 6
    # Errors are differences of roots, in which digits cancel.
    stores = store_path, finished_store
    pd.testing.assert_frame_equal(*(matrix(store, -3.0) for store in stores), rtol=1e-12)
    pd.testing.assert_frame_equal(*(matrix(store, -3.0, "error") for store in stores), rtol=1e-6)
    assert verify(store_path).is_sound
    distances = xr.open_datatree(store_path, engine="zarr")["distances"].to_dataset()
    assert distances["distance"].encoding["chunks"] == (2, 2, 2)
    to_reference = table(store_path).pivot(index="mesh", columns="order", values="distance")
    stored = distances["distance"].sel(mesh=to_reference.index, other="reference", order=to_reference.columns)
    assert np.array_equal(stored.values, to_reference.to_numpy())


def test_images_of_ends_are_in_the_errors_of_studies(store_path: Path, threads: Client, tmp_path: Path) -> None:
    # Two squares at both ends, moved along the line through them: their images are nearest at the whole period.
    surfaces = [Rectangles.sheets(2, 2.2, -1.1 + 0.03 * k) for k in range(3)]
    for k, surface in enumerate(surfaces):
        write_mesh(surface.mesh(), tmp_path / f"{k}.ply")
    family = [{"name": "moved", "source": "files", "paths": ["[12].ply"]}]
    reference, lattice = {"source": "files", "paths": ["0.ply"]}, {"xi_max": 8.0, "M": 48}
    orders, unscaled = [-3.0, -4.0], {"mode": "none"}
    changes = {"family": family, "reference": reference, "lattice": lattice, "scaling": unscaled}
    run(Study.from_table(small_table(norm={"orders": orders}, **changes), folder=tmp_path), store_path, threads)
    for order in (*orders, -5.0):
        distances, errors = (matrix(store_path, order, name).to_numpy() for name in ("distance", "error"))
        labels = matrix(store_path, order).index.tolist()
        places = [0 if label == "reference" else int(label[-1]) for label in labels]
        for i, j in combinations(range(3), 2):
            truth = surfaces[places[i]].distance(surfaces[places[j]], [order])[0]
            assert 1 < errors[i, j] / abs(distances[i, j] - truth) < 8, (order, labels[i], labels[j])


def test_a_period_shorter_than_a_unit_is_in_the_errors_of_pairs(
    store_path: Path, threads: Client, tmp_path: Path
) -> None:
    # The sum holds next to nothing of the difference of two that are far from the reference, so it bounds no image.
    half = np.array([0.1, 0.08, 0.06])
    box = Rectangles.box(-half, half)
    surfaces = [Rectangles.box(-half / 2, half), box, box.moved(0.01, 0, 0)]
    for k, surface in enumerate(surfaces):
        write_mesh(surface.mesh(), tmp_path / f"{k}.ply")
    family = [{"name": "moved", "source": "files", "paths": ["[12].ply"]}]
    reference, lattice = {"source": "files", "paths": ["0.ply"]}, {"xi_max": 6.0, "M": 4}
    changes = {"family": family, "reference": reference, "lattice": lattice, "scaling": {"mode": "none"}}
    run(Study.from_table(small_table(norm={"orders": [-4.0, -12.0]}, **changes), folder=tmp_path), store_path, threads)
    for order in (-4.0, -12.0):
        distances, errors = (matrix(store_path, order, name).to_numpy() for name in ("distance", "error"))
        i, j = (k for k, label in enumerate(matrix(store_path, order).index) if label != "reference")
        assert abs(distances[i, j] - surfaces[1].distance(surfaces[2], [order])[0]) < errors[i, j]


def test_beyond_octaves_edits_of_one_part_differ_by_no_more_than_both_do_from_it(
    store_path: Path, threads: Client, tmp_path: Path
) -> None:
    part = Rectangles.box((-0.5, -0.4, -0.3), (0.5, 0.4, 0.3))
    plates = (Rectangles.box((x, -0.1, 0.3), (x + 0.1, 0.1, 0.31)) for x in (-0.3, 0.1))
    surfaces = [part, *map(part.joined, plates)]
    for k, surface in enumerate(surfaces):
        write_mesh(surface.mesh(), tmp_path / f"{k}.ply")
    family = [{"name": "edited", "source": "files", "paths": ["[12].ply"]}]
    reference, lattice = {"source": "files", "paths": ["0.ply"]}, {"xi_max": 5.0, "M": 32, "octaves": 2}
    changes = {"family": family, "reference": reference, "lattice": lattice, "scaling": {"mode": "none"}}
    run(Study.from_table(small_table(norm={"orders": [-1.0]}, **changes), folder=tmp_path), store_path, threads)
    value, error = (matrix(store_path, -1.0, name).loc["edited/1", "edited/2"] for name in ("distance", "error"))
    truth = surfaces[1].distance(surfaces[2], [-1.0]).item()
    assert abs(value - truth) < error < 0.5 * truth


def test_new_meshes_cost_new_tiles(store_path: Path, threads: Client, tiles: list[Tile]) -> None:
    run(balls(3), store_path, threads)
    assert sorted(tiles) == [((0, 1), (0, 1)), ((0, 1), (2, 3)), ((2, 3), (2, 3))]
    tiles.clear()
    run(balls(4), store_path, threads)
    assert sorted(tiles) == [((0, 1), (4,)), ((2, 3), (4,)), ((4,), (4,))]
    tiles.clear()
    run(balls(4), store_path, threads)
    assert not tiles
    assert matrix(store_path, -3.0).shape == (5, 5)


def test_an_interrupted_run_goes_on_with_the_tiles_that_are_missing(
    store_path: Path, threads: Client, tiles: list[Tile], monkeypatch: pytest.MonkeyPatch
) -> None:
    key_of_tile = pairs.Pairs.key_of_tile

    def interrupted(self: pairs.Pairs, tile: tuple[int, int]) -> str:
        # The third tile is written by then, but for its key.
        if len(tiles) == 3:
            raise KeyError("interrupted")
        return key_of_tile(self, tile)

    with monkeypatch.context() as patch:
        patch.setattr(pairs.Pairs, "key_of_tile", interrupted)
        with pytest.raises(KeyError, match="interrupted"):
            run(balls(3), store_path, threads)
    assert "distances" not in open_store(store_path).children
    (_, _, last) = tiles
    tiles.clear()
    run(balls(3), store_path, threads)
    assert tiles == [last]
    assert matrix(store_path, -3.0).notna().all(axis=None)


@pytest.mark.slow
@pytest.mark.parametrize("is_lost", [True, False])
def test_a_lost_or_altered_tile_is_told_and_made_again(
    is_lost: bool, store_path: Path, threads: Client, tiles: list[Tile]
) -> None:
    run(balls(3), store_path, threads)
    before = matrix(store_path, -3.0)
    chunk = store_path / "distances/error/c/1/0/0"
    content = bytearray(chunk.read_bytes())
    content[8] ^= 1
    chunk.write_bytes(content)
    if is_lost:
        chunk.unlink()
    with pytest.raises(DamageError, match="distances/error"):
        matrix(store_path, -3.0, values="error")
    assert not verify(store_path).is_sound
    tiles.clear()
    run(balls(3), store_path, threads)
    assert tiles == [((0, 1), (2, 3))]
    assert verify(store_path).is_sound
    assert matrix(store_path, -3.0).equals(before)


@pytest.mark.slow
def test_a_study_may_turn_to_its_reference_alone_and_back(store_path: Path, threads: Client) -> None:
    run(balls(3), store_path, threads)
    before = matrix(store_path, -3.0)
    run(balls(3, compare=None), store_path, threads)
    assert matrix(store_path, -3.0).columns.tolist() == ["reference"]
    assert not list(store_path.glob("distances/distance/c/1/1"))
    assert verify(store_path).is_sound
    run(balls(3), store_path, threads)
    assert matrix(store_path, -3.0).equals(before)


def test_a_mesh_that_failed_has_no_numbers_in_any_tile(store_path: Path, threads: Client) -> None:
    study = small_table()
    study["family"].append({"name": "lost", "source": "files", "paths": ["nowhere.ply"]})
    run(Study.from_table(study), store_path, threads)
    found = matrix(store_path, -3.0)
    assert found.loc["lost/nowhere"].isna().all()
    assert found.drop(index="lost/nowhere", columns="lost/nowhere").notna().all(axis=None)


@pytest.mark.slow
def test_chunks_of_an_earlier_state_are_told_and_made_again(store_path: Path, threads: Client) -> None:
    earlier = store_path.with_name("earlier.zarr")
    study = balls(3, reference={"source": "sphere", "radius": 0.9})
    run(balls(3), earlier, threads)
    run(study, store_path, threads)
    sound = matrix(store_path, -3.0)
    for group in ("spectra", "distances"):
        for name in Store.open(earlier).keyed_arrays():
            if name.startswith(group):
                shutil.copytree(earlier / name, store_path / name, dirs_exist_ok=True)
        assert any(group in name for name in verify(store_path).tables)
        assert run(study, store_path, threads).computed == ()
        assert verify(store_path).is_sound
    assert matrix(store_path, -3.0).equals(sound)
