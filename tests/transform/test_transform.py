"""Fields against the exact triangle transform and closed forms; their settings, and those that an error permits."""

from __future__ import annotations

import pickle
import shlex
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sobolev_batch import Lattice, Mesh, fourier_transform, norm
from sobolev_batch.arrays import ComplexDtype
from sobolev_batch.errors import InputError, LatticeError
from sobolev_batch.norms.fields import compute_field, field_for
from sobolev_batch.shapes import Sphere, icosphere
from sobolev_batch.transform.exact import exact_transform
from sobolev_batch.transform.fourier import (
    ErrorTarget,
    Execution,
    TransformSettings,
    cheapest_dtype,
    choose_settings,
    projected_bytes,
    transform_block,
)
from sobolev_batch.transform.lattice import Block, SobolevWeights
from tests.support.shapes import CENTRED_BOX as BOX


def soup(rng: np.random.Generator) -> Mesh:
    centers = rng.uniform(-0.8, 0.8, size=(60, 1, 3))
    corners = centers + 10.0 ** rng.uniform(-4, -0.7, size=(60, 1, 1)) * rng.normal(size=(60, 3, 3))
    # Half of them are slivers.
    corners[:30, 2] = corners[:30, 0] + 1e-4 * rng.normal(size=(30, 3))
    return Mesh(corners.reshape(-1, 3), np.arange(180).reshape(-1, 3))


def moved_box(rng: np.random.Generator) -> Mesh:
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return Mesh(BOX.vertices @ rotation.T + rng.uniform(-0.3, 0.3, size=3), BOX.triangles)


def bumpy(rng: np.random.Generator) -> Mesh:
    sphere = icosphere(4)
    radii = 0.7 + 0.2 * np.sin(sphere.vertices @ rng.normal(scale=4, size=3))
    return Mesh(sphere.vertices * radii[:, None], sphere.triangles)


@pytest.mark.slow
@pytest.mark.parametrize("make", [soup, moved_box, bumpy])
@pytest.mark.parametrize("eps", [1e-4, 1e-6, 1e-8, 1e-10, 1e-12])
def test_agrees_with_the_exact_transform_to_a_small_multiple_of_eps(make, eps: float) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(17)
    mesh, lattice = make(rng), Lattice(5.0, 64)
    field = fourier_transform(mesh, lattice, eps)
    chosen = [rng.integers(0, count, 60) for count in lattice.shape]
    frequencies = np.stack([axis[k] for axis, k in zip(lattice.axes, chosen, strict=True)], axis=1)
    errors = np.abs(field.values[tuple(chosen)] - exact_transform(mesh, frequencies))
    assert errors.max() < 5 * eps * mesh.area


def test_single_precision_reaches_its_own_accuracy() -> None:
    lattice, mesh = Lattice(5.0, 64), bumpy(np.random.default_rng(2))
    single = fourier_transform(mesh, lattice, dtype="complex64")
    double = fourier_transform(mesh, lattice, 1e-12)
    assert single.dtype == np.complex64
    assert np.abs(single.values - double.values).max() < 1e-5 * mesh.area


@pytest.mark.slow
def test_every_block_of_the_lattice_equals_the_same_part_of_the_whole() -> None:
    lattice, mesh = Lattice(4.0, 20), icosphere(2)
    settings = TransformSettings(1e-12)
    whole = transform_block(mesh, lattice, lattice.half, settings).values
    for block in (*lattice.half.split(600), Block((-3, 4, 2), (5, 2, 4)), Block((10, -10, 0), (1, 1, 1))):
        part = transform_block(mesh, lattice, block, settings).values
        assert np.abs(part - whole[block.place_in(lattice.half)]).max() < 1e-11 * mesh.area


@pytest.mark.slow
@pytest.mark.parametrize("memory", [2.5e7, 1.2e7, 9.9e6])
@pytest.mark.parametrize("dtype", ["complex128", "complex64"])
def test_little_memory_changes_the_values_by_a_small_multiple_of_eps(memory: float, dtype: ComplexDtype) -> None:
    lattice, mesh = Lattice(5.0, 64), bumpy(np.random.default_rng(5))
    settings = TransformSettings(1e-9 if dtype == "complex128" else 1e-6, dtype)
    whole = transform_block(mesh, lattice, lattice.half, settings)
    ample = projected_bytes(lattice.half, settings, triangles=len(mesh.triangles))
    assert ample > 3 * memory
    divided, same = (
        transform_block(mesh, lattice, lattice.half, settings, Execution(allowed_bytes=allowed_bytes))
        for allowed_bytes in (memory, ample)
    )
    assert np.array_equal(whole.values, same.values)
    # Batches of triangles share no nodes with each other.
    assert whole.points <= divided.points < 1.01 * whole.points
    assert divided.values.dtype == dtype
    assert not np.array_equal(divided.values, whole.values)
    assert np.abs(divided.values - whole.values).max() < 5 * settings.eps * mesh.area


@pytest.mark.slow
def test_states_the_smallest_memory() -> None:
    lattice, mesh = Lattice(5.0, 32), icosphere(2)
    with pytest.raises(InputError, match=r"^1 MB .* 33 x 33 x 17 samples: give at least [\d.]+ MB") as caught:
        transform_block(mesh, lattice, lattice.half, TransformSettings(), Execution(allowed_bytes=1e6))
    least = float(str(caught.value).split("at least ")[1].split(" MB")[0]) * 1e6
    transform_block(mesh, lattice, lattice.half, TransformSettings(), Execution(allowed_bytes=least))
    with pytest.raises(InputError, match="give at least"):
        transform_block(mesh, lattice, lattice.half, TransformSettings(), Execution(allowed_bytes=least - 1.1e5))


@pytest.mark.process
@pytest.mark.all
@pytest.mark.parametrize(("intervals", "memory"), [(128, None), (128, 6e7), (256, 3e8)])
def test_takes_no_more_memory_than_it_says(intervals: int, memory: float | None) -> None:
    # What a transform adds to the peak of a fresh process, what that was estimated as, and its result, in bytes.
    code = f"""
import resource, sys
import sobolev_batch as sb
from sobolev_batch.transform.fourier import Execution, TransformSettings
from sobolev_batch.transform.fourier import projected_bytes, transform_block

mesh, lattice, settings = sb.shapes.icosphere(5), sb.Lattice(5.0, {intervals}), TransformSettings()
mesh.areas, mesh.centroid_radii, mesh.extent
settings.kind_for(mesh, lattice).lowest_degree
unit = 1 if sys.platform == "darwin" else 1024
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
values = transform_block(mesh, lattice, lattice.half, settings, Execution(allowed_bytes={memory})).values
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
said = projected_bytes(lattice.half, settings, triangles=len(mesh.triangles))
said = int(min(said, values.nbytes + ({memory} or said)))
print(after - before, said, values.nbytes)
"""
    # A shell in between: on Linux a process starts from the peak of the one that forked it.
    command = ["sh", "-c", f"{shlex.quote(sys.executable)} -c {shlex.quote(code)}"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    taken, said, result = map(int, done.stdout.split())
    assert taken < said
    if memory is not None:
        assert said <= memory + result
        assert taken > 0.3 * said  # an estimate far too high would divide what fits


def test_refuses_meshes_that_would_fold() -> None:
    lattice = Lattice(5.0, 16)  # half period 0.8
    with pytest.raises(LatticeError, match=r"\|coordinate\| = 1, .* < 1/\(2h\) = 0.8; take M >= 22"):
        fourier_transform(icosphere(1), lattice)
    with pytest.raises(LatticeError, match=r"\|coordinate\| = 1e\+30, .*; take a smaller xi_max, or scale down"):
        fourier_transform(Mesh(1e30 * icosphere(1).vertices, icosphere(1).triangles), lattice)
    with pytest.raises(LatticeError, match=r"the surface reaches to \|coordinate\| = 1, "):
        fourier_transform(Sphere(), lattice)
    fourier_transform(icosphere(1), Lattice(5.0, 22))


LATTICE = Lattice(3.0, 32)

# One corner drawn out: triangles of very different sizes in one mesh.
DRAWN = icosphere(3).vertices.copy()
DRAWN[0] *= 1.9
MESHES = {
    "box": BOX,
    "icosphere": icosphere(4),
    "drawn": Mesh(0.6 * DRAWN, icosphere(3).triangles),
}


@pytest.mark.slow
@pytest.mark.parametrize("order", [-2.0, -5.0, -10.0])
@pytest.mark.parametrize("name", MESHES)
def test_chosen_fields_keep_their_goal_and_are_not_wasteful(name: str, order: float) -> None:
    mesh = MESHES[name]
    exact = fourier_transform(mesh, LATTICE, 1e-13)
    scale = norm(exact, order)["norm"].item()
    points = []
    for relative in (1e-2, 1e-4, 1e-6, 1e-8):
        target = ErrorTarget((order,), (relative * scale,))
        settings = choose_settings(mesh, LATTICE, target, TransformSettings())
        transformed = transform_block(mesh, LATTICE, LATTICE.half, settings)
        error = norm(exact.copy(data=transformed.values - exact.values), order)["norm"].item()
        # The forecast is no bound: the probe says what came of it, and whoever needs it tightens.
        assert error < 4 * target.norms[0]
        points.append(transformed.points)
    assert points == sorted(points)
    careful = transform_block(mesh, LATTICE, LATTICE.half, TransformSettings(1e-8)).points
    assert points[-1] <= careful


@pytest.mark.parametrize("name", MESHES)
def test_probed_fields_keep_their_goal(name: str) -> None:
    mesh, orders = MESHES[name], (-2.0, -8.0)
    exact = fourier_transform(mesh, LATTICE, 1e-13)
    target = ErrorTarget(orders, tuple((1e-5 * norm(exact, orders)["norm"].values).tolist()))
    field = field_for(mesh, LATTICE, target, TransformSettings())
    errors = norm(exact.copy(data=field.values - exact.values), orders)["norm"].values
    assert (errors <= target.norms).all()
    assert (field.quality.probe.norms(SobolevWeights(LATTICE, orders)) <= target.norms).all()


def test_single_precision_is_for_goals_above_its_rounding() -> None:
    area = Sphere().area
    assert cheapest_dtype([Sphere()], LATTICE, ErrorTarget((-2.0,), (1e-4 * area,))) == "complex64"
    assert cheapest_dtype([Sphere()], LATTICE, ErrorTarget((-2.0,), (1e-8 * area,))) == "complex128"
    assert cheapest_dtype([Sphere(), Sphere(100.0)], LATTICE, ErrorTarget((-2.0,), (1e-4 * area,))) == "complex128"


@pytest.mark.parametrize("settings", [TransformSettings(dtype="complex64"), TransformSettings(stored="complex64")])
@pytest.mark.parametrize("surface", [Sphere(), icosphere(2)])
def test_rounding_to_single_precision_is_an_error_like_any_other(
    surface: Sphere | Mesh, settings: TransformSettings
) -> None:
    field = compute_field(surface, LATTICE, replace(settings, eps=1e-6), [-2.0])
    assert field.values.dtype == np.complex64
    exact = fourier_transform(surface, LATTICE, 1e-13)
    true = norm(exact.copy(data=field.values - exact.values), -2.0)["norm"].item()
    assert 0 < true < 2 * field.quality.probe.norms(SobolevWeights(LATTICE, (-2.0,)))[0] < 1e-5 * surface.area


def test_settings_keep_precision_and_quadrature() -> None:
    given = TransformSettings(dtype="complex64")
    chosen = choose_settings(BOX, LATTICE, ErrorTarget((-2.0,), (1e-9,)), given)
    assert replace(chosen, eps=given.eps, tolerance=given.tolerance) == given
    assert chosen.eps == 2e-7


@pytest.mark.parametrize(("dtype", "eps"), [("complex128", 1e-9), ("complex64", 1e-6)])
def test_eps_follows_from_the_dtype(dtype: ComplexDtype, eps: float) -> None:
    settings = TransformSettings(dtype=dtype)
    assert settings.eps == eps
    assert pickle.loads(pickle.dumps(settings)) == settings
    settings = TransformSettings(1e-5, tolerance=1e-3)
    assert replace(settings, eps=1e-7) == TransformSettings(1e-7, tolerance=1e-3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        *(({"eps": eps}, "eps must lie between") for eps in (1e-15, 0.5, np.nan)),
        ({"eps": 1e-9, "dtype": "complex64"}, "eps must lie between"),
        ({"dtype": "float64"}, "dtype must be"),
        *(({"quadrature": method}, "quadrature must be") for method in ("gauss9", 0, 51, True, 2.5, None)),
    ],
)
def test_refuses_what_is_out_of_reach(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        TransformSettings(**settings)
