"""Random parts of axis-parallel rectangles, as of CAD programs, whose distances are exact at every order."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from sobolev_batch import Mesh
from sobolev_batch.arrays import Reals
from sobolev_batch.shapes import Sphere
from tests.coverage.kinds import direction, rotation, small_amount
from tests.coverage.truth import Pair
from tests.support.rectangles import Rectangles


def pair_of(rng: np.random.Generator, a: Rectangles, b: Rectangles) -> Pair:
    """Return two parts as they are, or turned and moved together, which changes no distance."""
    turned = bool(rng.random() < 0.5)
    if not turned:
        return Pair(a.mesh(), b.mesh(), (a, b))
    turn, shift = rotation(rng), rng.uniform(0, 0.3) * direction(rng)
    first, second = (Mesh(mesh.vertices @ turn.T + shift, mesh.triangles) for mesh in (a.mesh(), b.mesh()))
    return Pair(first, second, (a, b), turned=True)


def moved_boxes(rng: np.random.Generator) -> Pair:
    """Return a box and the same moved, slid along its faces, or with another height."""
    sides, amount, choice = rng.uniform(0.2, 1.0, size=3), 3 * small_amount(rng), rng.random()
    box = _box(sides)
    if choice < 0.4:
        return pair_of(rng, box, box.moved(*(amount * direction(rng))))
    if choice < 0.7:
        return pair_of(rng, box, box.moved(*(amount * np.eye(3)[rng.integers(3)])))
    return pair_of(rng, box, _box(sides + amount * np.eye(3)[2]))


def little_moves(rng: np.random.Generator) -> Pair:
    """Return a thin plate, a wire or a box far smaller than the unit, and the same moved by a part of its thickness.

    Opposite faces have one distance, of which a small move takes second differences.
    """
    thin, small, choice = 10 ** rng.uniform(-2.5, -1.5), 10 ** rng.uniform(-2.5, -1.0), rng.random()
    if choice < 0.4:
        sides = np.array([1.0, 0.7, thin])
    elif choice < 0.7:
        sides = np.array([rng.uniform(1.0, 10.0), thin, thin])
    else:
        sides = small * rng.uniform(0.2, 1.0, size=3)
    move, box = float(sides.min()) * 10 ** rng.uniform(-2.5, -1.0), _box(sides)
    return pair_of(rng, box, box.moved(*(move * direction(rng))))


def perforated_plates(rng: np.random.Generator) -> Pair:
    """Return a plate with holes and the same moved by part of a pitch, with other holes, or without any."""
    count, thickness, choice = int(rng.integers(4, 13)), float(rng.uniform(0.02, 0.1)), rng.random()
    plate = Rectangles.perforated(count, thickness)
    if choice < 0.5:
        return pair_of(rng, plate, plate.moved(float(rng.uniform(0.05, 0.6)) / count))
    if choice < 0.8:
        return pair_of(rng, plate, Rectangles.perforated(int(rng.integers(4, 13)), thickness))
    return pair_of(rng, plate, _box(np.array([1.0, 1.0, thickness])))


def fins(rng: np.random.Generator) -> Pair:
    count, width = int(rng.integers(4, 31)), float(rng.uniform(0.3, 1.0))
    stack = Rectangles.fins(count, width)
    if rng.random() < 0.7:
        return pair_of(rng, stack, stack.moved(0, 0, float(rng.uniform(0.05, 0.5)) / count))
    return pair_of(rng, stack, Rectangles.fins(int(rng.integers(4, 31)), width))


def crenellations(rng: np.random.Generator) -> Pair:
    """Return a wall with battlements and the same moved along it, with others, or without any."""
    count, choice = int(rng.integers(3, 16)), rng.random()
    wall = _crenellated(count)
    if choice < 0.5:
        return pair_of(rng, wall, wall.moved(float(rng.uniform(0.05, 1.0)) / count))
    if choice < 0.8:
        return pair_of(rng, wall, _crenellated(int(rng.integers(3, 16))))
    return pair_of(rng, wall, _box(np.array([1.0, 0.2, 0.5])))


def voxel_balls(rng: np.random.Generator) -> Pair:
    count = int(rng.integers(4, 13))
    ball = _voxel_ball(count)
    if rng.random() < 0.5:
        return pair_of(rng, ball, ball.moved(*(2 * small_amount(rng) * direction(rng))))
    return pair_of(rng, ball, _voxel_ball(int(rng.integers(4, 13))))


def thin_walls(rng: np.random.Generator) -> Pair:
    """Return a hollow box against one of another thickness or a solid one, or parallel layers at two gaps."""
    sides, walls, choice = rng.uniform(0.4, 1.0, size=3), 10.0 ** rng.uniform(-3, -1, size=2), rng.random()
    if choice < 0.3:
        layer = _box(np.array([sides[0], sides[1], 0.0]))
        return pair_of(rng, *(layer.joined(layer.moved(0, 0, gap)) for gap in walls))
    other = _hollow(sides, walls[1]) if choice < 0.7 else _box(sides)
    return pair_of(rng, _hollow(sides, walls[0]), other)


def distant_parts(rng: np.random.Generator) -> Pair:
    """Return two small boxes some units apart, or the same two of which one differs."""
    first, second = (_box(rng.uniform(0.02, 0.3, size=3)) for _ in range(2))
    second = second.moved(*(rng.uniform(1, 6) * (np.eye(3)[0] if rng.random() < 0.5 else direction(rng))))
    if rng.random() < 0.5:
        return pair_of(rng, first, second)
    return pair_of(rng, first.joined(second), first.joined(second.moved(*(small_amount(rng) * direction(rng)))))


def tapered_plates(rng: np.random.Generator) -> Pair:
    count, half = int(rng.integers(8, 41)), float(rng.uniform(0.1, 0.4))
    amount = _part_of_pitch(rng)
    return pair_of(rng, *(Rectangles.tapered(count, 1 / count, half, offset) for offset in (0.0, amount)))


def strips(rng: np.random.Generator) -> Pair:
    """Return long narrow strips in a plane, and the same moved across by part of their pitch, or strips of others."""
    count, length, filled = int(rng.integers(5, 31)), float(rng.uniform(0.3, 1.0)), float(rng.uniform(0.2, 0.7))
    grid = Rectangles.strips(count, 0.0, length, filled)
    if rng.random() < 0.7:
        return pair_of(rng, grid, Rectangles.strips(count, _part_of_pitch(rng), length, filled))
    return pair_of(rng, grid, Rectangles.strips(int(rng.integers(5, 31)), 0.0, length, filled))


def layers(rng: np.random.Generator) -> Pair:
    """Return sheets at a small gap against fewer of them, or at another gap."""
    sides, gaps = rng.uniform(0.3, 1.0, size=2), 10.0 ** rng.uniform(-4, -1.3, size=2)
    counts, heights = rng.integers(1, 5, size=2), (0.0, float(gaps.min()) / 3)
    return pair_of(rng, *(Rectangles.sheets(*each, sides) for each in zip(counts, gaps, heights, strict=True)))


def woven(rng: np.random.Generator) -> Pair:
    """Return strips along x above and below strips along y, and the same moved by part of the pitch."""
    count, height = int(rng.integers(4, 13)), float(10.0 ** rng.uniform(-3, -1.3))

    def cloth(offset: float) -> Rectangles:
        lefts = (np.arange(count) + 0.25 + offset) / count - 0.5
        cuts = np.append(lefts + 0.25 / count, lefts[-1] + 1.25 / count)
        corners = []
        for i, x in enumerate(lefts):
            for j, (start, end) in enumerate(itertools.pairwise(cuts)):
                z = height * (-1) ** (i + j)
                corners += [((x, start, z), (x + 0.5 / count, end, z)), ((start, x, -z), (end, x + 0.5 / count, -z))]
        return Rectangles.from_corners(*corners)

    return pair_of(rng, cloth(0.0), cloth(_part_of_pitch(rng)))


def corrugations(rng: np.random.Generator) -> Pair:
    """Return a sheet with square folds that fade towards its ends, and the same folded the other way."""
    count, width, amplitude = int(rng.integers(5, 25)), float(rng.uniform(0.2, 0.8)), float(rng.uniform(0.005, 0.04))
    edges = np.linspace(-0.5, 0.5, 2 * count + 1)
    envelope = amplitude * np.cos(np.pi * (edges[:-1] + edges[1:]) / 2) ** 2

    def sheet(sign: float) -> Rectangles:
        levels = sign * envelope * (-1.0) ** np.arange(2 * count)
        flat = [((a, 0, z), (b, width, z)) for a, b, z in zip(edges[:-1], edges[1:], levels, strict=True)]
        pairs = zip(edges[1:-1], np.minimum(levels[:-1], levels[1:]), np.maximum(levels[:-1], levels[1:]), strict=True)
        return Rectangles.from_corners(*flat, *(((x, 0, low), (x, width, high)) for x, low, high in pairs))

    return pair_of(rng, sheet(1.0), sheet(-1.0))


def _part_of_pitch(rng: np.random.Generator) -> float:
    return 0.5 if rng.random() < 0.5 else float(rng.uniform(0.05, 0.5))


def _box(sides: Reals) -> Rectangles:
    """Return a box around the origin, or a single rectangle if one of its sides is zero."""
    box = Rectangles.box((-sides / 2).tolist(), (sides / 2).tolist())
    flat = (box.high > box.low).sum(axis=1) == 2
    kept = np.flatnonzero(flat)[: 1 if np.any(sides == 0) else 6]
    return Rectangles(box.low[kept], box.high[kept])


def _hollow(sides: Reals, wall: float) -> Rectangles:
    return _box(sides).joined(_box(sides - 2 * wall))


def _crenellated(count: int) -> Rectangles:
    edges = [np.linspace(-0.5, 0.5, 2 * count + 1), np.array([-0.1, 0.1]), np.array([-0.25, 0.1, 0.25])]
    filled = np.ones((2 * count, 1, 2), dtype=bool)
    filled[1::2, :, 1] = False
    return Rectangles.cells(edges, filled)


def _voxel_ball(count: int) -> Rectangles:
    middles = np.indices((count,) * 3) - (count - 1) / 2
    return Rectangles.cells([np.linspace(-0.5, 0.5, count + 1)] * 3, (middles**2).sum(axis=0) <= (count / 2) ** 2)


def large_norms(rng: np.random.Generator) -> Pair:
    """Return a ball, a box, a square tube or two plates, turned, of 5 to 1,000 units of length, alone."""
    scale, choice = float(np.exp(rng.uniform(*np.log([5.0, 1000.0])))), rng.random()
    if choice < 0.4:
        return Pair(Sphere(scale), Sphere(scale), alone=True)
    sides = scale * (np.ones(3) if choice < 0.5 else rng.uniform(0.2, 1.0, size=3))
    # The faces at both ends of one axis, of two, or all.
    box, count = Rectangles.box((-sides / 2).tolist(), (sides / 2).tolist()), int(rng.choice([2, 4, 6]))
    part, nothing = Rectangles(box.low[:count], box.high[:count]), Rectangles(box.low[:0], box.high[:0])
    mesh = part.mesh()
    if rng.random() < 0.7:
        mesh = Mesh(mesh.vertices @ rotation(rng).T, mesh.triangles)
    return Pair(mesh, mesh, (part, nothing), alone=True)


PARTS: dict[str, Callable[[np.random.Generator], Pair]] = {
    "moved boxes": moved_boxes,
    "perforated plates": perforated_plates,
    "fins": fins,
    "crenellations": crenellations,
    "voxel balls": voxel_balls,
    "thin walls": thin_walls,
    "distant parts": distant_parts,
    "tapered plates": tapered_plates,
    "strips": strips,
    "layers": layers,
    "woven": woven,
    "corrugations": corrugations,
    "large norms": large_norms,
    "little moves": little_moves,
}
