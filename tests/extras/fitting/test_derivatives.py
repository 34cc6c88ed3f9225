"""Derivatives of squared distances against plain sums, differences, symmetries, finer lattices; those of tensors."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray
from scipy.special import roots_jacobi, roots_legendre

import sobolev_batch as sb
from sobolev_batch.arrays import Reals
from sobolev_batch.extras.fitting.adjoint import MeshTransform
from sobolev_batch.transform import backends
from sobolev_batch.transform.fourier import TransformSettings
from sobolev_batch.transform.quadrature import assign_rules
from tests.support.fake_device import Device
from tests.support.shapes import CENTRED_BOX, tetrahedron

BALL = sb.shapes.icosphere(1)
SPHERE = sb.shapes.Sphere(0.7, (0.2, -0.1, 0.05))
# A small lattice, so that plain sums are possible, with a period of 10.
SMALL = sb.Lattice(0.5, 10)

_STEP = 1e-40
# Nodes along each side of a product rule on the triangle.
_COUNT = 12


class PlainSums:
    """Σ (1 + |ξ|²)^s |mesh^ - sphere^|² over the whole cube of frequencies of a lattice."""

    def __init__(self, sphere: sb.shapes.Sphere, lattice: sb.Lattice, orders: Sequence[float]) -> None:
        half, step = lattice.M // 2, 2 * lattice.xi_max / lattice.M
        indices = np.array(list(product(range(-half, half + 1), repeat=3)), dtype=np.float64)
        self.frequencies = step * indices
        lengths = np.linalg.norm(self.frequencies, axis=1)
        at_ends = np.sum(np.abs(indices) == half, axis=1)
        self.weights = step**3 * 0.5**at_ends * (1 + lengths**2) ** np.array(orders)[:, None]
        size = 4 * np.pi * sphere.radius**2 * np.sinc(2 * sphere.radius * lengths)
        phases = 2 * np.pi * self.frequencies @ np.array(sphere.center)
        self.sphere = size * np.cos(phases), -size * np.sin(phases)
        u, of_u = roots_legendre(_COUNT)
        v, of_v = roots_jacobi(_COUNT, 1.0, 0.0)
        self.first = ((1 + v)[:, None] / 2 * np.ones(_COUNT)).ravel()
        self.second = ((1 - v)[:, None] / 2 * (1 + u) / 2).ravel()
        self.shares = (of_v[:, None] * of_u / 4).ravel()

    def value_and_derivative(self, vertices: Reals, triangles: NDArray[np.int64]) -> tuple[Reals, Reals]:
        """Return the sum for each order and its derivative (orders, n, 3), by imaginary steps: exact to rounding."""
        parts = [self._triangle(corners) for corners in vertices[triangles]]
        cosines = sum(cosine for cosine, _ in parts) - self.sphere[0]
        sines = sum(sine for _, sine in parts) - self.sphere[1]
        found = np.zeros((len(self.weights), *vertices.shape))
        for triangle in triangles:
            for corner, axis in product(range(3), range(3)):
                moved = vertices[triangle].astype(complex)
                moved[corner, axis] += 1j * _STEP
                cosine, sine = (part.imag / _STEP for part in self._triangle(moved))
                found[:, triangle[corner], axis] += 2 * self.weights @ (cosines * cosine + sines * sine)
        return self.weights @ (cosines**2 + sines**2), found

    def _triangle(self, corners: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Real and imaginary part of a triangle's transform, as analytic functions of its corners."""
        a, b, c = corners
        normal = np.cross(b - a, c - a)
        area = np.sqrt(np.sum(normal * normal)) / 2
        nodes = a + self.first[:, None] * (b - a) + self.second[:, None] * (c - a)
        angles = 2 * np.pi * self.frequencies @ nodes.T
        return np.cos(angles) @ self.shares * area, -np.sin(angles) @ self.shares * area


def wrinkled(seed: int) -> sb.Mesh:
    ball, rng = sb.shapes.icosphere(0), np.random.default_rng(seed)
    return sb.Mesh(ball.vertices + 0.2 * rng.normal(size=ball.vertices.shape), ball.triangles)


def moved(mesh: sb.Mesh, *by: float) -> sb.Mesh:
    return sb.Mesh(mesh.vertices + np.array(by), mesh.triangles)


MESHES = {
    "ball": sb.shapes.icosphere(0),
    "wrinkled": wrinkled(1),
    "a single triangle": sb.Mesh([[0.0, 0, 0], [2.0, 0, 0], [0.0, 1.5, 0.5]], [[0, 1, 2]]),
    "slivers": sb.Mesh([[0.0, 0, 0], [1.0, 0, 0], [2.0, 1e-6, 0], [1.0, 1e-3, 1]], [[0, 1, 2], [0, 2, 3], [1, 2, 3]]),
    "three at an edge": sb.Mesh(
        [[0.0, 0, 0], [1.0, 0, 0], [0.5, 1, 0], [0.5, -1, 0], [0.5, 0, 1.0]], [[0, 1, 2], [0, 1, 3], [0, 1, 4]]
    ),
    "a triangle twice": sb.Mesh(tetrahedron().vertices, [[0, 2, 1], [0, 2, 1], [1, 2, 3]]),
    "far from the origin": moved(tetrahedron(), 2.5, -3.5, 2.0),
    "tiny beside large": sb.Mesh(
        np.concatenate([3 * tetrahedron().vertices - 1, 1e-3 * tetrahedron().vertices]),
        np.concatenate([tetrahedron().triangles, tetrahedron().triangles + 4]),
    ),
    "open, with a stray vertex": sb.Mesh(
        np.concatenate([tetrahedron().vertices, [[50.0, 0, 0]]]), [[0, 2, 1], [0, 1, 3], [1, 2, 3]]
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MESHES)
def test_it_is_the_derivative_of_plain_sums(name: str) -> None:
    mesh, orders = MESHES[name], [-0.75, -2.0, -6.0]
    vertices, sums = np.array(mesh.vertices), PlainSums(SPHERE, SMALL, orders)
    for order, square, expected in zip(orders, *sums.value_and_derivative(vertices, mesh.triangles), strict=True):
        value, found = sb.fitting.SquaredDistance.for_mesh(mesh, SPHERE, order, lattice=SMALL, eps=1e-12)(vertices)
        assert value == pytest.approx(square, rel=1e-9)
        assert np.linalg.norm(found - expected) <= 1e-9 * np.linalg.norm(expected)


@pytest.mark.parametrize("tolerance", [0.1, 1e-3, 1e-8])
def test_it_is_exact_for_the_value_whatever_the_quadrature(tolerance: float) -> None:
    mesh, lattice = sb.shapes.icosphere(2), sb.Lattice(4.0, 40)
    fine = sb.fitting.SquaredDistance.for_mesh(mesh, SPHERE, -2.0, lattice=lattice)
    transform = MeshTransform.from_mesh(mesh, lattice, TransformSettings(1e-13, tolerance=tolerance))
    squared = sb.fitting.SquaredDistance(transform, fine.target, fine.factors)
    rng = np.random.default_rng(0)
    direction, vertices, step = rng.normal(size=mesh.vertices.shape), np.array(mesh.vertices), 1e-5
    _, found = squared(vertices)
    change = (squared.value(vertices + step * direction) - squared.value(vertices - step * direction)) / (2 * step)
    assert np.sum(found * direction) == pytest.approx(change, rel=1e-6)


def test_its_points_are_those_of_a_field_whatever_the_rules() -> None:
    mesh, degrees = sb.Mesh(BALL.vertices, BALL.triangles[:-7]), set()
    waves = np.random.default_rng(3).normal(size=(3, 20))
    for tolerance in 10.0 ** -np.arange(0, 7):
        settings = TransformSettings(tolerance=float(tolerance))
        plan = settings.kind_for(mesh, SMALL)
        degrees |= {
            use.rule.degree
            for use in assign_rules(mesh, SMALL.highest_frequency, settings.eps, tolerance=settings.tolerance)
            if use.rule.shares
        }
        found, (points,) = MeshTransform.from_mesh(mesh, SMALL, settings).nodes(mesh.vertices), plan.batches(1 << 20)
        expected = points.weights @ np.exp(1j * points.coordinates.T @ waves)
        assert found.weights @ np.exp(1j * found.coordinates.T @ waves) == pytest.approx(expected, rel=1e-12)
        assert len(found.weights) == len(points.weights)
    assert degrees == {1, 2, 4, 5, 6}


def test_the_value_is_the_squared_distance_whether_vertices_are_flat_or_not() -> None:
    mesh, lattice = sb.shapes.icosphere(2), sb.Lattice(4.0, 40)
    squared = sb.fitting.SquaredDistance.for_mesh(mesh, SPHERE, -2.0, lattice=lattice)
    expected = sb.distance(mesh, SPHERE, -2.0, lattice=lattice)["distance"].item() ** 2
    (value, gradient), (flat_value, flat) = squared(mesh.vertices), squared(mesh.vertices.ravel())
    assert squared.value(mesh.vertices) == pytest.approx(expected, rel=1e-8)
    assert value == flat_value == pytest.approx(expected, rel=1e-8)
    np.testing.assert_array_equal(flat, gradient.ravel())


ORDERS = [-1.5, -2.0, -4.0]


@cache
def pair_and_gradient(name: str) -> tuple[sb.Mesh, sb.Mesh | sb.shapes.Sphere, xr.Dataset]:
    """A mesh, its target, and the derivative from a lattice that is finer and reaches farther than others."""
    pairs: dict[str, tuple[sb.Mesh, sb.Mesh | sb.shapes.Sphere]] = {
        "ball in ball": (sb.shapes.icosphere(1), sb.shapes.Sphere()),
        "moved": (sb.shapes.icosphere(1), sb.shapes.Sphere(1.0, (0.2, 0, 0))),
        "box": (CENTRED_BOX, moved(CENTRED_BOX, 0.05, 0.02, 0.01)),
    }
    mesh, target = pairs[name]
    return mesh, target, sb.fitting.gradient(mesh, target, ORDERS, lattice=sb.Lattice(8.0, 72), eps=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(("highest", "intervals", "eps"), [(2.0, 20, 1e-4), (3.0, 24, 1e-9), (5.0, 60, 1e-2)])
@pytest.mark.parametrize("name", [pytest.param("ball in ball", marks=pytest.mark.all), "moved", "box"])
def test_its_error_covers_what_a_finer_lattice_finds(name: str, highest: float, intervals: int, eps: float) -> None:
    mesh, target, finest = pair_and_gradient(name)
    lattice = sb.Lattice(highest, intervals)
    for operand in (target, sb.fourier_transform(target, lattice, eps, order=ORDERS)):
        found = sb.fitting.gradient(mesh, operand, ORDERS, lattice=lattice, eps=eps)
        off = np.sqrt(((found["gradient"] - finest["gradient"]) ** 2).sum(["vertex", "axis"]))
        assert (off <= found["error"] + finest["error"]).all()
        assert (found["error"] <= 200 * off + 1e-6 * abs(found["gradient"]).sum(["vertex", "axis"])).all()
        np.testing.assert_allclose(found["error_part"].sum("part"), found["error"])


@pytest.mark.parametrize("seed", range(4))
def test_the_measured_part_of_its_error_covers_that_of_a_coarse_eps(seed: int) -> None:
    lattice = sb.Lattice(3.0, 30)
    coarse, fine = (sb.fitting.gradient(wrinkled(seed), SPHERE, -4.0, lattice=lattice, eps=eps) for eps in (1e-2, 1e-9))
    difference = float(np.linalg.norm(coarse["gradient"] - fine["gradient"]))
    assert 0 < difference < coarse["error_part"].sel(part="discretisation").item() / 2


def test_a_lattice_of_a_few_samples_leaves_most_beyond_it_and_unknown_quality_no_error() -> None:
    found = sb.fitting.gradient(sb.shapes.icosphere(1), SPHERE, -2.0, lattice=sb.Lattice(0.1, 2))
    assert found["error"] > np.linalg.norm(found["gradient"])
    field = sb.fourier_transform(SPHERE, SMALL).drop_attrs()
    found = sb.fitting.gradient(sb.shapes.icosphere(1), field, -2.0)
    assert np.isfinite(found["gradient"]).all()
    assert np.isnan(found["error"])


def test_an_order_that_is_named_twice_counts_once() -> None:
    found = sb.fitting.gradient(sb.shapes.icosphere(1), SPHERE, [-2, -2.0], lattice=SMALL)
    assert found["gradient"].sizes["order"] == 1


def test_a_gpu_gives_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = sb.fitting.gradient(sb.shapes.icosphere(2), SPHERE, [-2.0, -4.0], lattice=SMALL)["gradient"]
    monkeypatch.setattr(backends, "gpu_backend", lambda: Device().backend())
    found = sb.fitting.gradient(sb.shapes.icosphere(2), SPHERE, [-2.0, -4.0], lattice=SMALL, backend="gpu")["gradient"]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * float(abs(expected).max()))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((sb.shapes.Sphere(), SPHERE, -2.0), "Open3D; found Sphere"),
        ((sb.shapes.icosphere(0), SPHERE, -0.5), "finite only for orders below -1/2, found -0.5"),
        ((sb.shapes.icosphere(0), "sphere", -2.0), "sphere: no mesh format"),
        ((moved(sb.shapes.icosphere(0), 9, 0, 0), SPHERE, -2.0), "to |coordinate| = 9.8"),
    ],
)
def test_wrong_arguments_are_named(arguments: tuple[sb.Mesh, sb.shapes.Sphere, float], message: str) -> None:
    for function in (sb.fitting.gradient, sb.fitting.SquaredDistance.for_mesh):
        with pytest.raises(sb.errors.SobolevBatchError, match=re.escape(message)):
            function(*arguments, lattice=SMALL)


def test_positions_are_checked() -> None:
    squared = sb.fitting.SquaredDistance.for_mesh(sb.shapes.icosphere(0), SPHERE, -2.0, lattice=SMALL)
    with pytest.raises(sb.errors.InputError, match=r"the mesh has 12 vertices: pass \(12, 3\) or 36 numbers"):
        squared(np.zeros((11, 3)))
    with pytest.raises(sb.errors.InputError, match="must be finite: found NaN or infinity"):
        squared(np.full((12, 3), np.nan))
    with pytest.raises(sb.errors.LatticeError, match="hold"):
        squared(sb.shapes.icosphere(0).vertices + 10.0)
    with pytest.raises(sb.errors.InputError, match="needs a lattice"):
        sb.fitting.gradient(sb.shapes.icosphere(0), SPHERE, -2.0)
    with pytest.raises(sb.errors.InputError, match="one order is needed, found 2"):
        sb.fitting.SquaredDistance.for_mesh(sb.shapes.icosphere(0), SPHERE, [-2.0, -3.0], lattice=SMALL)  # type: ignore[arg-type]
