"""Studies whose fields have octaves beside them: right numbers, stored, resumed, verified, in parts."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from distributed import Client
from numpy.typing import NDArray
from scipy.special import erfc

import sobolev_batch as sb
from sobolev_batch.batch.store.store import Store
from sobolev_batch.spectral.exact import sphere_inner_product
from tests.support.stores import delete, flip, put_back, truncate
from tests.support.studies import small_table, variable

Reals = NDArray[np.float64]

ORDERS = (-0.8, -1.5, -2.0)
BALL = sb.Sphere(0.9)
LEVELS = [1, 2]


def asking(rtol: float = 5e-2, **changes: Any) -> dict[str, Any]:
    """A study of two icospheres and a ball, which has a closed form."""
    families = [
        {"name": "ico", "source": "icosphere", "levels": LEVELS},
        {"name": "ball", "source": "sphere", "radius": BALL.radius},
    ]
    norm = {"orders": list(ORDERS)}
    return small_table(accuracy={"rtol": rtol}, lattice=None, norm=norm, family=families, **changes)


@pytest.fixture(scope="module")
def octave_store(client: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("octaves") / "store.zarr"
    sb.run(sb.Study.from_table(asking()), path, client)
    return path


@pytest.fixture
def store(octave_store: Path, store_path: Path) -> Path:
    shutil.copytree(octave_store, store_path)
    return store_path


def test_distances_are_as_accurate_as_asked_and_their_errors_hold(octave_store: Path) -> None:
    convergence = sb.open_store(octave_store)["convergence"].to_dataset().drop_sel(mesh="reference")
    assert convergence["within"].all()
    ball = convergence.sel(mesh="ball/sphere")
    exact = sb.distance(sb.Sphere(), BALL, ORDERS)["distance"].values
    assert (np.abs(ball["distance"].values - exact) <= ball["error"].values).all()
    for level in LEVELS:
        other = sb.distance(sb.icosphere(level), sb.Sphere(), ORDERS, rtol=2e-2, seed=7)
        here = convergence.sel(mesh=f"ico/{level}")
        gap = np.abs(here["distance"].values - other["distance"].values)
        assert (gap <= here["error"].values + other["error"].values).all()
        assert (here["statistical"] > 0).all()
    parts = sum(convergence[name] for name in ("truncation", "aliasing", "discretisation", "statistical"))
    assert np.array_equal(parts, convergence["error"])


def test_norms_pairs_and_parts_agree_with_closed_forms(octave_store: Path) -> None:
    tree = sb.open_store(octave_store)
    for label, sphere in (("reference", sb.Sphere()), ("ball/sphere", BALL)):
        found = tree["norms"].to_dataset().sel(mesh=label)
        exact = sb.norm(sphere, ORDERS)["norm"].values
        assert (np.abs(found["norm"].values - exact) <= found["error"].values).all()
        assert (found["error"].values < 0.05 * exact).all()
    pair = tree["distances"].to_dataset().sel(mesh="ball/sphere", other="ico/2")
    swapped = tree["distances"].to_dataset().sel(mesh="ico/2", other="ball/sphere")
    alone = sb.distance(sb.icosphere(2), BALL, ORDERS, rtol=2e-2, seed=3)
    assert (np.abs(pair["distance"] - alone["distance"].values) <= pair["error"] + alone["error"].values).all()
    for name in ("distance", "error", "statistical"):
        assert np.array_equal(pair[name], swapped[name])
    # The ball is shrunk: <a - b, b> / ||b|| by the closed forms of spheres.
    exact_norm = sb.norm(sb.Sphere(), ORDERS)["norm"].values
    products = np.array([sphere_inner_product(BALL, sb.Sphere(), order) for order in ORDERS])
    area = np.abs(products - exact_norm**2) / exact_norm
    found = tree["convergence"].to_dataset().sel(mesh="ball/sphere")
    assert found["area_part"].values == pytest.approx(area, rel=0.05)
    assert (found["area_part"] ** 2 + found["shape_part"] ** 2).values == pytest.approx(found["distance"].values ** 2)


def step_down(fractions: Reals) -> Reals:
    """The step between octaves by |ξ| over its end, written down once more."""
    return np.asarray(0.5 * erfc(3 * (fractions - 0.75) / 0.25))


def test_plain_xarray_integrates_over_all_frequencies(octave_store: Path) -> None:
    tree = xr.open_datatree(octave_store, engine="zarr")
    octaves = tree["octaves"].to_dataset()
    axes = [octaves[name].values for name in ("xi_x", "xi_y", "xi_z")]
    lengths = 1 + sum(axis**2 for axis in axes)
    of_reference = np.abs(octaves["octaves"].sel(mesh="reference").values) ** 2
    field = variable(tree, "fourier", "fourier").sel(mesh="reference")
    x, y, z = (field[name].values for name in ("xi_x", "xi_y", "xi_z"))
    square = (x**2)[:, None, None] + (y**2)[:, None] + z**2
    step = step_down(np.sqrt(square) / tree.attrs["study"]["octaves"]["cutoff"])
    inner = (x[1] - x[0]) ** 3 * np.where(z > 0, 2.0, 1.0) * step * np.abs(field.values) ** 2
    for order in (-0.8, -1.0, -2.0):
        tail = (octaves["weight"].values * lengths**order * of_reference).sum()
        inside = (inner * (1 + square) ** order).sum()
        exact = sb.norm(sb.Sphere(), order)["norm"].item() ** 2
        # At -0.8 some hundredths lie beyond the last octave.
        assert inside + tail == pytest.approx(exact, rel={-0.8: 5e-2, -1.0: 5e-3, -2.0: 1e-3}[order])
        assert tail > (0.1 * exact if order >= -1 else 0)
    assert octaves.sizes["mesh"] == 4
    assert set(np.unique(octaves["octave"])) == set(range(1, len(tree.attrs["study"]["octaves"]["octaves"]) + 1))
    assert octaves["xi_x"].attrs["units"] == "cycles per unit length"


def test_a_run_reuses_octaves_and_a_new_mesh_gets_the_same_frequencies(store: Path, client: Client) -> None:
    before = sb.open_store(store)["octaves"].to_dataset().load()
    plan = sb.plan(sb.Study.from_table(asking()), store)
    assert (plan.octaves, len(plan.stored)) == (before["octave"].values.max(), 4)
    assert f"{before.sizes['sample']:,} samples" in str(plan)
    summary = sb.run(sb.Study.from_table(asking()), store, client)
    assert summary.computed == ()
    more = asking()
    more["family"][0]["levels"] = [0, *LEVELS]
    summary = sb.run(sb.Study.from_table(more), store, client)
    assert summary.computed == ("ico/0",)
    after = sb.open_store(store)["octaves"].to_dataset().load()
    assert np.array_equal(after.xi_x, before.xi_x)
    assert np.array_equal(after.octaves.sel(mesh=before.mesh), before.octaves)
    found = variable(sb.open_store(store), "convergence", "distance").sel(mesh="ico/0").values
    other = sb.distance(sb.icosphere(0), sb.Sphere(), ORDERS, rtol=2e-2)
    assert found == pytest.approx(other["distance"].values, rel=0.05)


def swap_octaves(chunk: Path) -> None:
    """Another mesh's values in octaves: their own checksum is right."""
    shutil.copy(chunk.parents[1] / "0/0", chunk)


def test_damaged_octaves_frequencies_and_labels_are_named_and_made_again(
    store: Path, octave_store: Path, client: Client
) -> None:
    row = Store.open(store).labels().index("ico/2")
    for damage in (truncate, flip, delete, swap_octaves):
        with put_back(store):
            damage(store / f"octaves/octaves/c/{row}/0")
            assert set(sb.verify(store).fields) == {"ico/2"}, damage
    swap_octaves(store / f"octaves/octaves/c/{row}/0")
    for name in ("weight", "mesh"):
        flip(next((store / f"octaves/{name}/c").rglob("[0-9]")))
    assert set(sb.verify(store).tables) == {"octaves/weight", "octaves/mesh"}
    assert sb.run(sb.Study.from_table(asking()), store, client).computed == ("ico/2",)
    assert sb.verify(store).is_sound
    after, before = (sb.open_store(path) for path in (store, octave_store))
    found, expected = (variable(tree, "convergence", "distance").values for tree in (after, before))
    assert found == pytest.approx(expected, rel=1e-9, nan_ok=True)
    for name in ("weight", "mesh"):
        assert np.array_equal(variable(after, "octaves", name), variable(before, "octaves", name))
    # Another order asks for new tables: the reduction finds damage too.
    flip(store / f"octaves/octaves/c/{row}/0")
    more = asking()
    more["norm"]["orders"] = [*ORDERS, -2.5]
    assert "ico/2" in sb.run(sb.Study.from_table(more), store, client).computed
    assert sb.verify(store).is_sound


def test_octaves_at_other_frequencies_are_not_mixed(store: Path, client: Client) -> None:
    stored = Store.open(store)
    stored.write("octaves/xi_x", ..., np.asarray(stored.read("octaves/xi_x", ...)) + 1.0)
    stored.consolidate()
    with pytest.raises(sb.StoreError, match="sampled at other frequencies"):
        sb.run(sb.Study.from_table(asking()), store, client)


def with_lattice(octaves: int) -> dict[str, Any]:
    lattice = {"xi_max": 4.0, "M": 32, "octaves": octaves}
    return small_table(lattice=lattice, norm={"orders": [-1.5, -2.0]})


@pytest.mark.all
def test_octaves_beyond_a_given_lattice_lower_its_errors(client: Client, tmp_path: Path) -> None:
    datasets = {}
    for octaves in (0, 4):
        sb.run(sb.Study.from_table(with_lattice(octaves)), tmp_path / f"{octaves}.zarr", client)
        datasets[octaves] = sb.open_store(tmp_path / f"{octaves}.zarr")["convergence"].to_dataset()
    assert "octaves" not in sb.open_store(tmp_path / "0.zarr")
    for level in (1, 2, 3):
        exact = sb.distance(sb.icosphere(level), sb.Sphere(), [-1.5, -2.0], rtol=5e-3)
        errors = []
        for dataset in datasets.values():
            here = dataset.sel(mesh=f"ico/{level}")
            gap = np.abs(here["distance"].values - exact["distance"].values)
            assert (gap <= here["error"].values + exact["error"].values).all()
            errors.append(here["error"].values / here["distance"].values)
        assert (errors[1] < errors[0] / 5).all()
    with pytest.raises(sb.StoreError, match=r"octaves: 4, not none"):
        sb.run(sb.Study.from_table(with_lattice(0)), tmp_path / "4.zarr", client)


def test_equal_meshes_have_the_distance_zero(client: Client, store_path: Path) -> None:
    families = [{"name": name, "source": "icosphere", "levels": [1]} for name in ("ico", "copy")]
    sb.run(sb.Study.from_table({**with_lattice(2), "family": families}), store_path, client)
    pair = sb.open_store(store_path)["distances"].to_dataset().sel(mesh="ico/1", other="copy/1")
    assert (pair["distance"] == 0).all()
    assert (pair["error"] < 1e-6).all()


def test_fields_in_blocks_and_octaves_in_a_task_of_their_own_are_the_same(client: Client, tmp_path: Path) -> None:
    # Small chunks: several blocks, and a task for the octaves of each mesh.
    table = {**with_lattice(2), "family": [{"name": "ico", "source": "icosphere", "levels": [2]}]}
    study = sb.Study.from_table(table)
    sb.run(study, tmp_path / "whole.zarr", client)
    sb.run(replace(study, largest_chunk_bytes=1 << 17), tmp_path / "blocks.zarr", client)
    whole, blocks = (sb.open_store(tmp_path / name) for name in ("whole.zarr", "blocks.zarr"))
    assert len(list((tmp_path / "blocks.zarr/fourier/fourier/c/0").rglob("0"))) > 1
    assert np.array_equal(variable(whole, "octaves", "octaves"), variable(blocks, "octaves", "octaves"))
    found, expected = (variable(tree, "fourier", "fourier").values for tree in (blocks, whole))
    assert np.allclose(found, expected, rtol=0, atol=1e-8)
    for group, name in (("convergence", "distance"), ("norms", "norm"), ("distances", "distance")):
        found, expected = (variable(tree, group, name).values for tree in (blocks, whole))
        assert found == pytest.approx(expected, rel=1e-8, nan_ok=True)
    assert sb.verify(tmp_path / "blocks.zarr").is_sound


def test_an_open_store_gives_any_order_from_its_octaves(octave_store: Path) -> None:
    tree = sb.open_store(octave_store)
    found = tree.sobolev.distance("ball/sphere", "reference", [-1.0, -1.5])
    exact = sb.distance(sb.Sphere(), BALL, [-1.0, -1.5])["distance"].values
    assert (np.abs(found["distance"].values - exact) <= found["error"].values).all()
    assert (found["error"].values < 0.1 * exact).all()
    stored = tree["convergence"].to_dataset().sel(mesh="ball/sphere", order=-1.5)
    for name in ("distance", "error", "area_part"):
        assert found[name].sel(order=-1.5).item() == pytest.approx(stored[name].item(), rel=1e-9)
    pair = tree["distances"].to_dataset().sel(mesh="ico/1", other="ico/2", order=-2.0)
    single = tree.sobolev.distance("ico/1", "ico/2", -2.0)
    assert single["distance"].dims == ()
    assert single["distance"].item() == pytest.approx(pair["distance"].item(), rel=1e-6)
    norms = tree.sobolev.norm("ball/sphere", -0.9)
    assert abs(norms["norm"].item() - sb.norm(BALL, -0.9)["norm"].item()) <= norms["error"].item()
    with pytest.raises(sb.InputError, match="no mesh 'ico/9' with a field"):
        tree.sobolev.norm("ico/9", -2.0)


def test_the_spectrum_of_an_open_store_ends_at_the_areas(octave_store: Path) -> None:
    tree = sb.open_store(octave_store)
    bands = tree.sobolev.spectrum("ball/sphere", None, [-1.0, -2.0])
    # A sphere's energy is 2 area sin²(2πr), half of that twice on average.
    assert bands.attrs["energy_limit"] == pytest.approx(2 * BALL.area, rel=1e-3)
    outer = bands["energy"].values[-3:]
    assert outer == pytest.approx(2 * BALL.area, rel=0.15)
    exact = sb.norm(BALL, -2.0)["norm"].item() ** 2
    assert bands["squared"].sel(order=-2.0).sum().item() == pytest.approx(exact, rel=1e-3)
    assert bands["share"].sum("band").values == pytest.approx(1)
    assert (bands["lower"].values[1:] == bands["upper"].values[:-1]).all()
    pair = tree.sobolev.spectrum("ico/1", "reference", -2.0)
    assert pair["squared"].sum().item() == pytest.approx(
        tree.sobolev.distance("ico/1", "reference", -2.0)["distance"].item() ** 2, rel=0.02
    )
