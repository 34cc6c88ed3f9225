"""Studies whose fields have octaves beside them: right numbers, stored, resumed, verified, in parts."""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import combinations, permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.store.layout import Store, stored_choice
from sobolev_batch.study.plan import make_plan
from sobolev_batch.transform.spheres import sphere_inner_product
from tests.support.rectangles import Rectangles
from tests.support.stores import delete, flip, put_back, truncate
from tests.support.studies import small_table, variable

ORDERS = (-0.8, -1.5, -2.0)
BALL = sb.shapes.Sphere(0.9)
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
    return Path(shutil.copytree(octave_store, store_path))


def test_distances_are_as_accurate_as_asked_and_their_errors_hold(octave_store: Path) -> None:
    convergence = sb.open_store(octave_store)["convergence"].to_dataset().drop_sel(mesh="reference")
    assert convergence["within"].all()
    ball = convergence.sel(mesh="ball/sphere")
    exact = sb.distance(sb.shapes.Sphere(), BALL, ORDERS)["distance"].values
    assert (np.abs(ball["distance"].values - exact) <= ball["error"].values).all()
    for level in LEVELS:
        other = sb.distance(sb.shapes.icosphere(level), sb.shapes.Sphere(), ORDERS, rtol=2e-2, seed=7)
        here = convergence.sel(mesh=f"ico/{level}")
        gap = np.abs(here["distance"].values - other["distance"].values)
        assert (gap <= here["error"].values + other["error"].values).all()
        assert (here["error_part"].sel(part="statistical") > 0).all()
    assert np.array_equal(convergence["error_part"].sum("part"), convergence["error"])


def test_norms_pairs_and_parts_agree_with_closed_forms(octave_store: Path) -> None:
    tree = sb.open_store(octave_store)
    norms, pairs = tree["norms"].to_dataset(), tree["distances"].to_dataset()
    for label, sphere in (("reference", sb.shapes.Sphere()), ("ball/sphere", BALL)):
        found, exact = norms.sel(mesh=label), sb.norm(sphere, ORDERS)["norm"].values
        assert (np.abs(found["norm"].values - exact) <= found["error"].values).all()
        assert (found["error"].values < 0.05 * exact).all()
    pair, swapped = (pairs.sel(mesh=a, other=b) for a, b in permutations(("ball/sphere", "ico/2")))
    alone = sb.distance(sb.shapes.icosphere(2), BALL, ORDERS, rtol=2e-2, seed=3)
    assert (np.abs(pair["distance"] - alone["distance"].values) <= pair["error"] + alone["error"].values).all()
    for name in ("distance", "error", "error_part"):
        assert np.array_equal(pair[name], swapped[name])
    # The ball is shrunk: <a - b, b> / ||b|| by the closed forms of spheres.
    exact_norm = sb.norm(sb.shapes.Sphere(), ORDERS)["norm"].values
    products = np.array([sphere_inner_product(BALL, sb.shapes.Sphere(), order) for order in ORDERS])
    parts = tree["convergence"].to_dataset().sel(mesh="ball/sphere")
    assert parts["area_part"].values == pytest.approx(np.abs(products - exact_norm**2) / exact_norm, rel=0.05)
    areas = np.abs(products - exact_norm**2) / exact_norm
    shapes = np.sqrt(sb.distance(BALL, sb.shapes.Sphere(), ORDERS)["distance"].values ** 2 - areas**2)
    for name, truth in (("area_part", areas), ("shape_part", shapes)):
        assert (np.abs(parts[name].values - truth) <= parts[f"{name}_error"].values).all()
    assert (parts["area_part_error"].values < 0.1 * areas).all()
    assert (parts["area_part"] ** 2 + parts["shape_part"] ** 2).values == pytest.approx(parts["distance"].values ** 2)


def test_a_run_reuses_octaves_and_a_new_mesh_gets_the_same_frequencies(store: Path, client: Client) -> None:
    before = sb.open_store(store)["octaves"].to_dataset().load()
    assert before.xi_x.attrs["units"] == "cycles per unit length"
    plan = sb.plan(sb.Study.from_table(asking()), store)
    assert (plan.object.octaves, len(plan.object.stored)) == (before["octave"].values.max(), 4)
    assert f"{before.sizes['sample']:,} samples" in str(plan)
    assert sb.run(sb.Study.from_table(asking()), store, client).computed == ()
    more = asking()
    more["family"][0]["levels"] = [0, *LEVELS]
    assert sb.run(sb.Study.from_table(more), store, client).computed == ("ico/0",)
    after = sb.open_store(store)["octaves"].to_dataset().load()
    assert np.array_equal(after.xi_x, before.xi_x)
    assert np.array_equal(after.octaves.sel(mesh=before.mesh), before.octaves)
    found = variable(sb.open_store(store), "convergence", "distance").sel(mesh="ico/0").values
    other = sb.distance(sb.shapes.icosphere(0), sb.shapes.Sphere(), ORDERS, rtol=2e-2)
    assert found == pytest.approx(other["distance"].values, rel=0.05)


def swap(chunk: Path) -> None:
    """Another mesh's values in octaves: their own checksum is right."""
    shutil.copy(chunk.parents[1] / "0/0", chunk)


def test_damaged_octaves_frequencies_and_labels_are_named_and_made_again(
    store: Path, octave_store: Path, client: Client
) -> None:
    chunk = store / f"octaves/octaves/c/{Store.open(store).labels().index('ico/2')}/0"
    for damage in (truncate, flip, delete, swap):
        with put_back(store):
            damage(chunk)
            assert set(sb.verify(store).fields) == {"ico/2"}, damage
    swap(chunk)
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
    flip(chunk)
    more = asking()
    more["norm"]["orders"] = [*ORDERS, -2.5]
    assert "ico/2" in sb.run(sb.Study.from_table(more), store, client).computed
    assert sb.verify(store).is_sound


def test_octaves_at_other_frequencies_are_not_mixed(store: Path, client: Client) -> None:
    stored = Store.open(store)
    for name in ("octaves/xi_x", "octaves/xi_y", "octaves/xi_z"):
        stored.write(name, [0], np.asarray(stored.read(name)) + 1.0)
    stored.consolidate()
    with pytest.raises(sb.errors.StoreError, match="sampled at other frequencies"):
        sb.run(sb.Study.from_table(asking()), store, client)


# Octaves beyond a lattice that is given.
BEYOND = small_table(lattice={"xi_max": 4.0, "M": 32, "octaves": 2}, norm={"orders": [-1.5, -2.0]})


def test_octaves_of_another_reference_are_sampled_anew(threads: Client, tmp_path: Path) -> None:
    """Their frequencies lie around its normals; other objects keep their fields."""
    lattice, path = {"xi_max": 2.5, "M": 16, "octaves": 1}, tmp_path / "store.zarr"
    names = ("a", "b")
    objects = [{"name": name, "reference": {"source": "files", "paths": [f"{name}.off"]}} for name in names]
    table = small_table(lattice=lattice, object=objects, compare=None, family=[{"name": "ball", "source": "sphere"}])
    for heights, computed in (((1.0, 1.0), names), ((1.0, 1.2), ("b",)), ((1.0, 1.2), ())):
        for name, height in zip(names, heights, strict=True):
            trimesh.creation.box((1.0, 1.0, height)).export(tmp_path / f"{name}.off")
        found = sb.run(sb.Study.from_table(table, folder=tmp_path), path, threads).computed
        assert found == tuple(f"{name}/{label}" for name in computed for label in ("ball/sphere", "reference"))
    assert sb.verify(path).is_sound
    before = (path / "zarr.json").read_bytes()
    with pytest.raises(sb.errors.StoreError, match="another study, with octaves: 1, not 2"):
        sb.run(sb.Study.from_table({**table, "lattice": {**lattice, "octaves": 2}}, folder=tmp_path), path, threads)
    assert (path / "zarr.json").read_bytes() == before


def test_equal_meshes_have_the_distance_zero(client: Client, store_path: Path) -> None:
    families = [{"name": name, "source": "icosphere", "levels": [1]} for name in ("ico", "copy")]
    sb.run(sb.Study.from_table({**BEYOND, "family": families}), store_path, client)
    pair = sb.open_store(store_path)["distances"].to_dataset().sel(mesh="ico/1", other="copy/1")
    assert (pair["distance"] == 0).all()
    assert (pair["error"] < 1e-6).all()


def test_a_reference_by_formula_is_certain_to_be_itself(octave_store: Path) -> None:
    itself = sb.open_store(octave_store)["convergence"].to_dataset().sel(mesh="reference")
    assert (itself["distance"] == 0).all()
    assert (itself["error"] == 0).all()
    assert itself["within"].all()


@pytest.mark.parametrize(("count", "other"), [(5, 7), (6, 6)])
def test_numbers_to_a_loose_accuracy_hold_for_faces_that_repeat_beyond_the_lattice(
    threads: Client, tmp_path: Path, count: int, other: int
) -> None:
    width = 0.6 if count < other else 0.8
    parts = {
        "reference": Rectangles.fins(count, width),
        "fins/moved": Rectangles.fins(other, width).moved(0, 0, 0.3 / other),
        "fins/dense": Rectangles.fins(17, width),
    }
    for label, part in parts.items():
        sb.write_mesh(part.mesh(), tmp_path / f"{Path(label).name}.ply")
    table = small_table(
        accuracy={"rtol": 0.1},
        lattice=None,
        norm={"orders": [-1.5]},
        scaling={"mode": "none"},
        reference={"source": "files", "paths": ["reference.ply"]},
        family=[{"name": "fins", "source": "files", "paths": ["moved.ply", "dense.ply"]}],
    )
    sb.run(sb.Study.from_table(table, folder=tmp_path), tmp_path / "store.zarr", threads)
    tree = sb.open_store(tmp_path / "store.zarr")
    assert variable(tree, "convergence", "within").all()
    norms, pairs = (tree[group].to_dataset().squeeze("order") for group in ("norms", "distances"))
    nothing = Rectangles(np.zeros((0, 3)), np.zeros((0, 3)))
    for label, part in parts.items():
        found = norms.sel(mesh=label)
        assert abs(found["norm"].item() - part.distance(nothing, [-1.5]).item()) <= found["error"].item()
    for (one, first), (two, second) in combinations(parts.items(), 2):
        found = pairs.sel(mesh=one, other=two)
        assert abs(found["distance"].item() - first.distance(second, [-1.5]).item()) <= found["error"].item()


def test_what_pilots_choose_is_enough_for_them(threads: Client, store_path: Path) -> None:
    family = [{"name": "ico", "source": "icosphere", "levels": [1, 2, 3]}]
    study = sb.Study.from_table(asking(0.1) | {"norm": {"orders": [-2.0]}, "family": family})
    planned = make_plan(study).choice
    sb.run(study, store_path, threads)
    stored = stored_choice(store_path)
    assert stored is not None
    assert stored.lattice == planned.lattice
    assert variable(sb.open_store(store_path), "convergence", "within").all()


def test_fields_in_blocks_and_octaves_in_a_task_of_their_own_are_the_same(client: Client, tmp_path: Path) -> None:
    # Small chunks: several blocks, and a task for the octaves of each mesh.
    table = {**BEYOND, "family": [{"name": "ico", "source": "icosphere", "levels": [2]}]}
    study = sb.Study.from_table(table)
    whole_path, blocks_path = (tmp_path / f"{name}.zarr" for name in ("whole", "blocks"))
    sb.run(study, whole_path, client)
    sb.run(replace(study, largest_chunk_bytes=1 << 17), blocks_path, client)
    assert len(list((blocks_path / "fourier/fourier/c/0").rglob("0"))) > 1
    for group, name, rtol, atol in (
        ("octaves", "octaves", 0.0, 0.0),
        ("fourier", "fourier", 0.0, 1e-8),
        ("convergence", "distance", 1e-8, 0.0),
        ("norms", "norm", 1e-8, 0.0),
        ("distances", "distance", 1e-8, 0.0),
    ):
        found, expected = (variable(sb.open_store(path), group, name).values for path in (blocks_path, whole_path))
        np.testing.assert_allclose(found, expected, rtol, atol)
    assert sb.verify(blocks_path).is_sound


def test_an_open_store_gives_any_order_from_its_octaves(octave_store: Path) -> None:
    tree = sb.open_store(octave_store)
    found = tree.sobolev.distance([-1.0, -1.5], "ball/sphere", "reference")
    exact = sb.distance(sb.shapes.Sphere(), BALL, [-1.0, -1.5])["distance"].values
    assert (np.abs(found["distance"].values - exact) <= found["error"].values).all()
    assert (found["error"].values < 0.1 * exact).all()
    stored = tree["convergence"].to_dataset().sel(mesh="ball/sphere", order=-1.5)
    for name in ("distance", "error", "area_part"):
        assert found[name].sel(order=-1.5).item() == pytest.approx(stored[name].item(), rel=1e-9)
    pair = variable(tree, "distances", "distance").sel(mesh="ico/1", other="ico/2", order=-2.0)
    single = tree.sobolev.distance(-2.0, "ico/1", "ico/2")["distance"]
    assert (single.dims, single.item()) == ((), pytest.approx(pair.item(), rel=1e-6))
    norms = tree.sobolev.norm(-0.9, "ball/sphere")
    assert abs(norms["norm"].item() - sb.norm(BALL, -0.9)["norm"].item()) <= norms["error"].item()
    with pytest.raises(sb.errors.InputError, match="no mesh 'ico/9' with a field"):
        tree.sobolev.norm(-2.0, "ico/9")


def test_the_spectrum_of_an_open_store_ends_at_the_areas(octave_store: Path) -> None:
    tree = sb.open_store(octave_store)
    bands = tree.sobolev.spectrum([-1.0, -2.0], "ball/sphere")
    # A sphere's energy is 2 area sin²(2πr), half of that twice on average.
    assert bands.attrs["energy_limit"] == pytest.approx(2 * BALL.area, rel=1e-3)
    outer = bands["energy"].values[-3:]
    assert outer == pytest.approx(2 * BALL.area, rel=0.15)
    exact = sb.norm(BALL, -2.0)["norm"].item() ** 2
    assert bands["squared"].sel(order=-2.0).sum().item() == pytest.approx(exact, rel=1e-3)
    assert bands["share"].sum("band").values == pytest.approx(1)
    assert (bands["lower"].values[1:] == bands["upper"].values[:-1]).all()
    pair, distance = (ask(-2.0, "ico/1", "reference") for ask in (tree.sobolev.spectrum, tree.sobolev.distance))
    assert pair["squared"].sum().item() == pytest.approx(distance["distance"].item() ** 2, rel=0.02)


@pytest.mark.slow
def test_pairs_that_were_not_compared_have_errors_that_hold(threads: Client, store_path: Path) -> None:
    levels = (1, 2, 3)
    table = small_table(
        lattice={"xi_max": 4.0, "M": 32, "octaves": 2},
        norm={"orders": [-1.0, -2.0]},
        family=[{"name": "ico", "source": "icosphere", "levels": list(levels)}],
    )
    sb.run(sb.Study.from_table(table), store_path, threads)
    pairs = sb.open_store(store_path)["distances"].to_dataset()
    for one, other in combinations(levels, 2):
        found = pairs.sel(mesh=f"ico/{one}", other=f"ico/{other}")
        true = sb.distance(sb.shapes.icosphere(one), sb.shapes.icosphere(other), [-1.0, -2.0], rtol=1e-2)
        gaps = np.abs(found["distance"].values - true["distance"].values)
        assert (gaps <= found["error"].values + true["error"].values).all()
        assert (found["error_part"].sel(part="truncation").values > 0).all()


@pytest.mark.slow
def test_layers_may_be_less_far_apart_beyond_the_octaves(threads: Client, tmp_path: Path) -> None:
    """At the last frequencies the energy of what differs is above its limit, and next it falls below it."""
    orders, base = [-0.65, -1.0, -1.5], Rectangles.sheets(1, 0.0, -0.7)
    parts = {f"{name}_{height:g}": Rectangles.sheets(1, 0.0, height) for name in "ab" for height in (0.0, 0.1, 0.215)}
    parts = {name: part.joined(base) if name.startswith("b") else part for name, part in parts.items()}
    for name, part in {"base": base, **parts}.items():
        sb.write_mesh(part.mesh(), tmp_path / f"{name}.ply")
    table = small_table(
        lattice={"xi_max": 4.0, "M": 32, "octaves": 1},
        norm={"orders": orders},
        scaling={"mode": "none"},
        reference={"source": "files", "paths": ["base.ply"]},
        family=[{"name": "layer", "source": "files", "paths": [f"{name}.ply" for name in parts]}],
    )
    sb.run(sb.Study.from_table(table, folder=tmp_path), tmp_path / "store.zarr", threads)
    pairs = sb.open_store(tmp_path / "store.zarr")["distances"].to_dataset()
    for one, other in combinations(parts, 2):
        found = pairs.sel(mesh=f"layer/{one}", other=f"layer/{other}")
        off = np.abs(found["distance"].values - parts[one].distance(parts[other], orders))
        assert (off <= found["error"].values).all(), (one, other)
