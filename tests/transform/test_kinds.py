"""Triangle rules, and plans: batches of weighted points, their number, what is chosen once, what neighbours share."""

from __future__ import annotations

from math import factorial
from typing import Any

import numpy as np
import pytest

from benchmarks.rule_errors import measure_largest_errors, measure_typical_errors
from sobolev_batch import Lattice, Mesh, fourier_transform
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.norms.fields import compute_field
from sobolev_batch.shapes import Torus, icosphere
from sobolev_batch.transform import kinds, quadrature
from sobolev_batch.transform.exact import exact_transform
from sobolev_batch.transform.faces import FaceArrays
from sobolev_batch.transform.fourier import Execution, TransformSettings
from sobolev_batch.transform.kinds import kind_of
from sobolev_batch.transform.quadrature import RuleUse, assign_rules
from sobolev_batch.transform.rules import (
    HIGHEST_DEGREE,
    TriangleRule,
    candidate_rules,
    gauss_rule,
    rule_ranges,
    sharing_rule,
    symmetric_rule,
    tabulated,
)
from tests.support.shapes import CENTRED_BOX as BOX


def monomial_error(rule: TriangleRule, degree: int) -> float:
    """Largest error over the barycentric monomials of a degree: their means are a! b! c! 2! / (a+b+c+2)!."""
    errors = []
    for a in range(degree + 1):
        for b in range(degree + 1 - a):
            c = degree - a - b
            found = rule.weights @ np.prod(rule.barycentric ** np.array([a, b, c]), axis=1)
            exact = 2 * factorial(a) * factorial(b) * factorial(c) / factorial(degree + 2)
            errors.append(abs(found - exact))
    return float(max(errors))


@pytest.mark.parametrize("degree", range(1, HIGHEST_DEGREE + 1))
def test_symmetric_rules_are_exact_positive_and_interior(degree: int) -> None:
    rule = symmetric_rule(degree)
    assert rule.weights.sum() == pytest.approx(1.0, abs=1e-15)
    assert (rule.weights > 0).all()
    assert (rule.barycentric > 0).all()
    assert monomial_error(rule, degree) < 3e-15


SHARED = (1, 2, 4, 5, 6)


@pytest.mark.parametrize("degree", SHARED)
def test_rules_whose_nodes_neighbours_share_are_exact_and_positive(degree: int) -> None:
    rule = sharing_rule(degree)
    assert rule.weights.sum() == pytest.approx(1.0, abs=1e-15)
    assert (rule.weights > 0).all()
    assert (rule.barycentric >= 0).all()
    assert monomial_error(rule, degree) < 1e-16 < 1e-6 < monomial_error(rule, degree + 1)
    assert rule.cost < symmetric_rule(degree).cost


def test_the_papers_rule_has_64_points_of_degree_14() -> None:
    rule = gauss_rule(8)
    assert rule.node_count == 64
    assert rule.degree == 14
    assert monomial_error(rule, 14) < 3e-16
    assert monomial_error(rule, 16) > 1e-15


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9, 1e-12])
def test_no_triangle_within_range_exceeds_the_tolerance(tolerance: float) -> None:
    rng = np.random.default_rng(11)
    rules, ranges = rule_ranges(tolerance)
    assert (np.diff(ranges) > 0).all()
    assert (np.diff([rule.cost for rule in rules]) > 0).all()
    for rule, limit in zip(rules, ranges, strict=True):
        if limit == 0:
            continue
        for _ in range(8):
            corners = rng.normal(size=(3, 3))
            corners[2] = corners[0] + rng.uniform(0.01, 1.0) * (corners[2] - corners[0])
            mesh = Mesh(corners, [[0, 1, 2]])
            frequency = rng.normal(size=3)
            frequency *= limit / (2 * np.pi * mesh.centroid_radii[0] * np.linalg.norm(frequency))
            found = mesh.area * rule.weights @ np.exp(-2j * np.pi * (rule.barycentric @ corners @ frequency))
            exact = exact_transform(mesh, frequency[None, :])[0]
            assert abs(found - exact) <= max(tolerance, 1e-14) * mesh.area


@pytest.mark.parametrize("row", [0, 2, 9, 54])
def test_the_errors_that_the_package_carries_are_those_of_its_rules(row: int) -> None:
    rule, carried = candidate_rules()[row], tabulated()
    assert carried["largest"][row] == pytest.approx(measure_largest_errors(rule), rel=1e-6, abs=1e-15)
    even, odd = measure_typical_errors(rule)
    assert carried["even"][row] == pytest.approx(even, rel=1e-6, abs=1e-15)
    assert carried["odd"][row] == pytest.approx(odd, rel=1e-6, abs=1e-15)


@pytest.mark.parametrize("method", ["auto", "gauss8", 1, 7, 50])
@pytest.mark.parametrize("capacity", [4_000, 20_000, 1 << 22])
def test_batches_hold_the_area_and_the_second_moments(method: str | int, capacity: int) -> None:
    batches = list(kind_of(BOX, 8.0, 1e-10, method).batches(capacity))
    sizes = [len(batch.weights) for batch in batches]
    assert max(sizes) <= capacity
    # They are nearly equal, up to a batch of triangles.
    assert max(sizes) < 2 * np.mean(sizes)
    # Each batch takes an FFT: there is one where that will do.
    assert len(list(kind_of(BOX, 8.0, 1e-10, method).batches(sum(sizes)))) == 1
    coordinates = np.concatenate([batch.coordinates for batch in batches], axis=1)
    weights = np.concatenate([batch.weights for batch in batches])
    assert (weights > 0).all()
    assert weights.sum() == pytest.approx(BOX.area, rel=1e-13)
    if method != 1:
        # ∫ x² over a box of sides a, b, c: two faces at ±a/2, and four that run through.
        a, b, c = 1.0, 1.2, 1.4
        assert weights @ coordinates[0] ** 2 == pytest.approx(b * c * a**2 / 2 + a**3 / 6 * (b + c), rel=1e-13)


@pytest.mark.parametrize(
    ("method", "eps", "tolerance", "most"),
    [
        ("auto", 1e-9, None, 12),
        ("auto", 1e-9, 1e-9, 15),
        ("auto", 1e-4, 1e-4, 6),
        ("auto", 1e-5, None, 1.5),
        ("auto", 1e-2, 1e-2, 1.5),
        ("auto", 1e-2, None, 0.7),
        ("gauss8", 1e-9, None, 64),
    ],
)
def test_small_triangles_get_few_points(method: str | int, eps: float, tolerance: float | None, most: float) -> None:
    fine = icosphere(6)
    batches = kind_of(fine, 8.66, eps, method, tolerance).batches(1 << 22)
    assert sum(len(batch.weights) for batch in batches) / len(fine.triangles) <= most


def random_triangles(count: int) -> Mesh:
    rng = np.random.default_rng(9)
    corners = rng.normal(size=(count, 1, 3)) + 0.05 * rng.normal(size=(count, 3, 3))
    return Mesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def grid(disorder: float) -> Mesh:
    """A square of 30 x 30 squares, each of two triangles, with its vertices moved by parts of an edge."""
    count = 30
    corners = np.stack([*np.meshgrid(*(np.arange(count + 1.0),) * 2, indexing="ij"), np.zeros((count + 1,) * 2)], 2)
    corners[:, :, :2] += disorder * np.random.default_rng(9).normal(size=(count + 1, count + 1, 2))
    first = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).ravel()
    lower, upper = (0, count + 1, count + 2), (0, count + 2, 1)
    return Mesh(corners.reshape(-1, 3) / count, np.concatenate([first[:, None] + np.array(t) for t in (lower, upper)]))


def without_partners(mesh: Mesh) -> Mesh:
    """The first half of the triangles, which all point one way."""
    return Mesh(mesh.vertices, mesh.triangles[: len(mesh.triangles) // 2])


# 3.63: the wavelength is an edge of the grid, where equal triangles add up.
@pytest.mark.parametrize("size", [0.017, 0.03, 0.3, 1.0, 1.8, 3.63])
@pytest.mark.parametrize("eps", [1e-9, 1e-5])
@pytest.mark.parametrize(
    "mesh",
    [icosphere(3), BOX, random_triangles(300), random_triangles(20), grid(0.0), grid(0.2), without_partners(grid(0.0))],
    ids=["icosphere", "box", "random", "few", "grid", "disorder", "one way"],
)
def test_a_whole_mesh_keeps_eps_with_fewer_points_than_each_of_its_triangles(
    mesh: Mesh, eps: float, size: float
) -> None:
    # Of its own: the frequencies are those of any other selection and order of tests.
    rng, highest = np.random.default_rng(9), size / (2 * np.pi * mesh.centroid_radii.max())
    directions = np.concatenate([np.eye(3), [[1, 1, 0]], rng.normal(size=(16, 3))])
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    frequencies = highest * np.concatenate([directions, rng.random((10, 1)) * directions[:10]])
    plan = kind_of(mesh, highest, eps)
    assert plan.expected_points <= kind_of(mesh, highest, eps, "auto", eps).expected_points
    (points,) = plan.batches(1 << 22)
    found = np.exp(-2j * np.pi * (frequencies @ points.coordinates)) @ points.weights
    assert np.abs(found - exact_transform(mesh, frequencies)).max() <= 1.2 * eps * mesh.area


def soup(mesh: Mesh) -> Mesh:
    """The same triangles, each with vertices of its own."""
    return Mesh(mesh.vertices[mesh.triangles].reshape(-1, 3), np.arange(3 * len(mesh.triangles)).reshape(-1, 3))


@pytest.mark.parametrize("eps", [1e-9, 1e-6, 1e-4])
def test_triangles_that_share_no_vertices_take_no_more_points_than_are_planned(eps: float) -> None:
    mesh = soup(icosphere(4))
    plan, merged = (kind_of(surface, 2.0, eps) for surface in (mesh, icosphere(4)))
    count = sum(len(batch.weights) for batch in plan.batches(1 << 20))
    assert count == plan.expected_points == plan.largest_points
    # A rule with shared nodes would take up to twice as many of them here.
    assert merged.expected_points <= count <= 2 * merged.expected_points


@pytest.mark.parametrize("surface", [BOX, icosphere(3), Torus(1.0, 0.4)], ids=["box", "icosphere", "torus"])
@pytest.mark.parametrize("method", ["auto", 7])
def test_the_size_is_known_before_the_points_are_made(surface: Surface, method: str | int) -> None:
    plan = kind_of(surface, 8.66, 1e-2, method)
    count = sum(len(batch.weights) for batch in plan.batches(1 << 20))
    assert plan.expected_points == pytest.approx(count, rel=0.05)
    assert count <= plan.largest_points


def test_an_unknown_kind_of_surface_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(InputError, match=r"must be a Mesh, a Sphere or a parametrised surface .*, found str"):
        kind_of("torus.ply")
    with pytest.raises(InputError, match=r"expected a Mesh, .*; found dict"):
        fourier_transform({}, Lattice(1.0, 4))


def test_the_rules_of_a_field_are_chosen_once(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, lattice = icosphere(4), Lattice(5.0, 32)
    calls: list[int] = []

    def counted(*arguments: Any) -> tuple[RuleUse, ...]:
        calls.append(1)
        return assign_rules(*arguments)

    monkeypatch.setattr(kinds, "assign_rules", counted)
    # Little memory: the points are counted, then made, and the probe asks for the lowest degree.
    compute_field(mesh, lattice, TransformSettings(), [-2.0], Execution(allowed_bytes=1.2e7))
    assert len(calls) == 1


def test_a_plan_holds_four_bytes_for_each_triangle() -> None:
    sphere = icosphere(5)
    mesh = Mesh(sphere.vertices * np.where(sphere.vertices[:, 2:] > 0.2, 1.0, 0.02), sphere.triangles)
    uses = assign_rules(mesh, 8.66, 1e-9)
    assert len(uses) > 2
    members = np.concatenate([use.members for use in uses])
    assert np.array_equal(np.sort(members), np.arange(len(mesh.triangles)))
    assert members.nbytes == 4 * len(mesh.triangles)


# Three triangles on one edge, one of them twice, one with a corner repeated, and a vertex of no triangle.
ODD = Mesh(
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0.5], [9, 9, 9]]),
    [[0, 1, 2], [1, 0, 3], [0, 1, 4], [4, 0, 1], [2, 2, 3]],
)


@pytest.mark.parametrize("rule", [sharing_rule(degree) for degree in SHARED], ids=SHARED)
@pytest.mark.parametrize("mesh", [BOX, ODD, icosphere(2)], ids=["box", "odd", "icosphere"])
@pytest.mark.parametrize("bits", [63, 12])
def test_each_place_gets_the_weights_of_all_its_triangles(
    rule: TriangleRule, mesh: Mesh, bits: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quadrature, "_BITS", bits)  # few bits: vertices are numbered anew
    use = RuleUse(rule, 0, np.arange(len(mesh.triangles), dtype=np.uint32))
    points = use.points(FaceArrays.of_mesh(mesh))
    # Each triangle on its own.
    places = np.einsum("qc,tci->tqi", rule.barycentric, mesh.vertices[mesh.triangles])
    waves = np.random.default_rng(0).normal(size=(3, 20))
    expected = np.einsum("tqw,q,t->w", np.exp(1j * places @ waves), rule.weights, mesh.areas)
    assert points.weights @ np.exp(1j * points.coordinates.T @ waves) == pytest.approx(expected, rel=1e-13)
    zeros = np.count_nonzero(rule.barycentric == 0, axis=1)
    shared = [places[:, zeros == count].reshape(-1, 3).round(12) for count in (1, 2)]
    merged = sum(len(np.unique(group, axis=0)) for group in shared)
    assert np.count_nonzero(points.weights) <= merged + np.count_nonzero(zeros == 0) * len(mesh.triangles)


@pytest.mark.parametrize("eps", [1e-4, 1e-9])
@pytest.mark.parametrize("aspect", [10.0, 100.0])
def test_long_triangles_take_points_by_their_area(aspect: float, eps: float) -> None:
    # Strips of two triangles each, side by side, whose errors add up; each triangle begins at another corner.
    rng, count, highest = np.random.default_rng(4), 20, 25.0
    x, ends = np.linspace(-1, 1, count + 1), np.array([-0.5, 0.5]) * aspect * 2 / count
    vertices = [[at, y, 0.1 * at] for y in ends / ends[1] for at in x]
    first = np.arange(count)
    triangles = np.concatenate(
        [[first, first + 1, first + count + 2], [first, first + count + 2, first + count + 1]], 1
    )
    turns = (rng.integers(3, size=(2 * count, 1)) + np.arange(3)) % 3
    mesh = Mesh(np.array(vertices) * [20 / aspect, 1, 1], np.take_along_axis(triangles.T, turns, axis=1))
    frequencies = rng.normal(size=(40, 3))
    frequencies *= highest / np.linalg.norm(frequencies, axis=1)[:, None]
    frequencies[:3] = highest * np.eye(3)
    plan = kind_of(mesh, highest, eps)
    assert plan.expected_points <= 6 * mesh.area * (2 * highest) ** 2 + 1000 * len(mesh.triangles)
    (points,) = plan.batches(1 << 22)
    found = np.exp(-2j * np.pi * (frequencies @ points.coordinates)) @ points.weights
    assert np.abs(found - exact_transform(mesh, frequencies)).max() <= eps * mesh.area
