"""Random pairs with point clouds: how often the reported error covers the true one.

    python -m tests.coverage.clouds --pairs 100 --seed 5

The truth is a sum of Matérn kernels over all pairs of points, with closed potentials of spheres and faces.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import click
import numpy as np
from numpy.typing import NDArray

from sobolev_batch import AccuracyError, Lattice, Mesh, PointCloud, Sphere, distance
from sobolev_batch.surfaces.shapes.surface import Surface
from tests.coverage.draws import direction, placed, random_box, random_sphere, rotation
from tests.coverage.matern import Sides, double_sum, graded_points, mesh_potentials, sphere_potential
from tests.support.shapes import TETRAHEDRON_TRIANGLES, TETRAHEDRON_VERTICES

Reals = NDArray[np.float64]
Maker = Callable[[np.random.Generator], tuple[PointCloud, Surface]]

ORDERS = (-1.6, -2.0, -2.5, -3.0, -4.0, -6.0, -10.0)
_LEAST_RTOL, _LARGEST_RTOL = 1e-4, 1e-1
# Slower ones for surfaces, whose octaves are sampled.
_LEAST_RTOL_OF_SURFACES = 3e-3
# Rounding of double sums, relative to the squared norms.
_ROUNDING = 1e-14


@dataclass(frozen=True)
class CloudCase:
    """A distance: as it was reported, and as it is."""

    kind: str
    order: float
    setting: str
    reported: float
    error: float
    true: float
    uncertainty: float

    @property
    def is_covered(self) -> bool:
        """True where the error covers the true one."""
        return abs(self.reported - self.true) <= self.error + self.uncertainty


def _cloud(rng: np.random.Generator, points: Reals, *, unequal: bool = False) -> PointCloud:
    weights = 10.0 ** rng.uniform(-6, 0, len(points)) if unequal else rng.uniform(0.5, 1.5, len(points))
    return PointCloud(points, weights * rng.uniform(0.5, 2) / weights.sum())


def _random_points(rng: np.random.Generator) -> Reals:
    return rng.uniform(-0.5, 0.5, (int(rng.integers(2, 400)), 3)) * rng.uniform(0.2, 1.2, 3)


def _sampled(rng: np.random.Generator, surface: Mesh | Sphere, count: int) -> Reals:
    if isinstance(surface, Sphere):
        points = rng.normal(size=(count, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        return np.asarray(np.asarray(surface.center) + surface.radius * points)
    chosen = rng.choice(len(surface.triangles), count, p=surface.areas / surface.area)
    shares = rng.dirichlet(np.ones(3), count)
    return np.asarray(np.einsum("ni,nij->nj", shares, surface.vertices[surface.triangles[chosen]]))


def _grid(rng: np.random.Generator) -> Reals:
    axis = np.linspace(-0.5, 0.5, int(rng.integers(3, 9)))
    return np.asarray(np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3) @ rotation(rng).T)


def _line(rng: np.random.Generator) -> Reals:
    return np.linspace(-0.8, 0.8, int(rng.integers(2, 300)))[:, None] * direction(rng)


def _moved(rng: np.random.Generator, points: Reals) -> tuple[PointCloud, PointCloud]:
    cloud = PointCloud.uniform(points, 1.0)
    return cloud, PointCloud(cloud.points + 10.0 ** rng.uniform(-5, -1) * direction(rng), cloud.weights)


def _duplicates(rng: np.random.Generator) -> tuple[PointCloud, PointCloud]:
    points = _random_points(rng)
    repeated = points[rng.integers(len(points), size=3 * len(points))]
    return _cloud(rng, repeated), _cloud(rng, np.concatenate([points[: len(points) // 2 + 1], _random_points(rng)]))


def _close_pairs(rng: np.random.Generator) -> tuple[PointCloud, PointCloud]:
    points = _random_points(rng)[:50]
    steps = 10.0 ** rng.uniform(-9, -2, (len(points), 1)) * np.stack([direction(rng) for _ in points])
    return _cloud(rng, np.concatenate([points, points + steps])), _cloud(rng, _random_points(rng))


def _of_sphere(rng: np.random.Generator) -> tuple[PointCloud, Surface]:
    sphere, count = random_sphere(rng), int(rng.integers(1, 1000))
    noise = 10.0 ** rng.uniform(-4, -1) if rng.random() < 0.5 else 0.0
    points = _sampled(rng, sphere, count)
    return PointCloud.uniform(points + noise * rng.normal(size=points.shape), sphere.area), sphere


def _of_box(rng: np.random.Generator) -> tuple[PointCloud, Surface]:
    box = random_box(rng)
    points = _sampled(rng, box, int(rng.integers(1, 600))) if rng.random() < 0.7 else box.vertices
    return PointCloud.uniform(points, box.area), box


def _of_tetrahedron(rng: np.random.Generator) -> tuple[PointCloud, Surface]:
    mesh = placed(Mesh(TETRAHEDRON_VERTICES @ rotation(rng).T, TETRAHEDRON_TRIANGLES), random_sphere(rng))
    return _cloud(rng, mesh.vertices if rng.random() < 0.3 else _random_points(rng)), mesh


KINDS: dict[str, Maker] = {
    "random": lambda rng: (_cloud(rng, _random_points(rng)), _cloud(rng, _random_points(rng))),
    "unequal weights": lambda rng: (_cloud(rng, _random_points(rng), unequal=True), _cloud(rng, _random_points(rng))),
    "single points": lambda rng: (_cloud(rng, _random_points(rng)[:1]), _cloud(rng, _random_points(rng)[:1])),
    "duplicates": _duplicates,
    "close pairs": _close_pairs,
    "grid, moved": lambda rng: _moved(rng, _grid(rng)),
    "line, moved": lambda rng: _moved(rng, _line(rng)),
    "grid, line": lambda rng: (_cloud(rng, _grid(rng)), _cloud(rng, _line(rng))),
    "sphere": _of_sphere,
    "box": _of_box,
    "tetrahedron": _of_tetrahedron,
}


def true_distance(cloud: PointCloud, other: Surface, order: float) -> tuple[float, float]:
    """Return the distance and its uncertainty, by sums in real space."""
    power = -order
    if isinstance(other, PointCloud):
        points, weights = np.concatenate([cloud.points, other.points]), np.concatenate([cloud.weights, -other.weights])
        # Equal points must cancel to the last digit.
        points, members = np.unique(points, axis=0, return_inverse=True)
        weights = np.bincount(members.ravel(), weights=weights).astype(np.float64)
        square, slack = double_sum(points, weights, [power])[0], 0.0
    else:
        square = double_sum(cloud.points, cloud.weights, [power])[0]
        if isinstance(other, Sphere):
            pole = np.add(other.center, [[0.0, 0.0, other.radius]])
            square += other.area * sphere_potential(other, pole, power).item()
            square -= 2 * float(sphere_potential(other, cloud.points, power) @ cloud.weights)
            slack = 0.0
        else:
            assert isinstance(other, Mesh)
            sides = Sides.of(other)
            own = [weights @ mesh_potentials(sides, points, [power])[0] for points, weights in _rules(other)]
            square += own[1] - 2 * float(mesh_potentials(sides, cloud.points, [power])[0] @ cloud.weights)
            slack = abs(own[1] - own[0]) + 1e-7 * own[1]
    slack += _ROUNDING * float(double_sum(cloud.points, cloud.weights, [power])[0])
    value = float(np.sqrt(max(square, 0.0)))
    return value, float(max(np.sqrt(max(square, 0.0) + slack) - value, value - np.sqrt(max(square - slack, 0.0))))


def _rules(mesh: Mesh) -> list[tuple[Reals, Reals]]:
    return [graded_points(mesh, count) for count in (7, 9)]


def cases(seed: int, pairs: int) -> Iterator[CloudCase]:
    """Yield the cases of random pairs, two for each; the same seed gives the same ones."""
    for index in range(pairs):
        rng = np.random.default_rng([seed, index])
        kind = tuple(KINDS)[index % len(KINDS)]
        cloud, other = KINDS[kind](rng)
        for order in rng.choice(ORDERS, 2, replace=False).tolist():
            found = _reported(rng, cloud, other, order)
            if found is not None:
                yield CloudCase(kind, order, *found, *true_distance(cloud, other, order))


def _reported(
    rng: np.random.Generator, cloud: PointCloud, other: Surface, order: float
) -> tuple[str, float, float] | None:
    """Return a setting with the distance and error that it leads to; None where it is refused."""
    if rng.random() < 0.3:
        lattice = Lattice(float(rng.uniform(3, 8)), 2 * int(rng.integers(30, 44)))
        # Away from the images by half a period.
        scale = 0.25 * lattice.half_period / max(cloud.extent.reach, other.extent.reach, 0.25 * lattice.half_period)
        if scale < 1:
            return None
        found, setting = distance(cloud, other, order, lattice=lattice), f"xi_max {lattice.xi_max:.3g} M {lattice.M}"
    else:
        least = _LEAST_RTOL if isinstance(other, PointCloud) else _LEAST_RTOL_OF_SURFACES
        rtol = float(np.exp(rng.uniform(*np.log([least, _LARGEST_RTOL]))))
        try:
            found, setting = distance(cloud, other, order, rtol=rtol), f"rtol {rtol:.1e}"
        except AccuracyError:
            return None
    return setting, found["distance"].item(), found["error"].item()


@click.command()
@click.option("--pairs", default=100)
@click.option("--seed", default=5)
def main(pairs: int, seed: int) -> None:
    """Print each case, those that are not covered with a mark, and a summary."""
    ratios = []
    for case in cases(seed, pairs):
        ratios.append(abs(case.reported - case.true) / max(case.error, 1e-300))
        mark = "" if case.is_covered else "  NOT COVERED"
        click.echo(f"{case.kind:16} {case.order:5} {case.setting:18} {case.true:.5e} {ratios[-1]:8.4f}{mark}")
    covered = sum(ratio <= 1 for ratio in ratios)
    click.echo(f"{covered} of {len(ratios)} covered; true over reported error: median {np.median(ratios):.3g}")


if __name__ == "__main__":
    main()
