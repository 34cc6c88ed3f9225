"""Random solids made of boxes, with edits of a part of them: all else of their surfaces coincides.

Coordinates are multiples of a power of two, and rotations have rational entries, so that flat faces stay exactly in
their planes. Flat faces of both solids are cut into different triangles. Truths are those of the differences alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from sobolev_batch import Mesh
from sobolev_batch.arrays import Reals
from tests.coverage.kinds import direction, sphere_at
from tests.coverage.truth import Pair
from tests.support.rectangles import Rectangles

# Coordinates are multiples of this times the denominator of the rotation: up to 2²² they are exact, as are their sums.
_STEP = 2.0**-30
# Bounds of the whole numbers of a rotation's quaternion.
_QUATERNION = 4
# Of surfaces farther apart than so many units, the inner product is below any digit.
_FAR = 10.0
_CORNERS: Reals = np.array([(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)])


@dataclass(frozen=True)
class Block:
    """An axis-parallel box that is added to a solid, or taken from it."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    added: bool = True

    @classmethod
    def of(cls, low: Iterable[float], high: Iterable[float], *, added: bool = True) -> Block:
        (x, y, z), (u, v, w) = low, high
        return cls((float(x), float(y), float(z)), (float(u), float(v), float(w)), added)


@dataclass(frozen=True)
class Turn:
    """A rotation `whole / denominator`, of whole numbers; multiples of `step` stay multiples of a power of two."""

    whole: NDArray[np.int64]
    denominator: int

    @classmethod
    def random(cls, rng: np.random.Generator) -> Turn:
        """Return the rotation of a random quaternion of whole numbers, or none, as of a CAD program."""
        a, b, c, d = (
            rng.integers(-_QUATERNION, _QUATERNION + 1, size=4).tolist() if rng.random() < 0.7 else (1, 0, 0, 0)
        )
        a += int(not any((a, b, c, d)))
        whole = np.array(
            [
                [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
                [2 * (b * c + a * d), a * a - b * b + c * c - d * d, 2 * (c * d - a * b)],
                [2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d],
            ]
        )
        return cls(whole, a * a + b * b + c * c + d * d)

    @property
    def step(self) -> float:
        return self.denominator * _STEP

    def snapped(self, values: Reals) -> Reals:
        return np.asarray(self.step * np.round(values / self.step))

    def block(self, block: Block) -> Block:
        low, high = (self.snapped(np.array(corner)) for corner in (block.low, block.high))
        return Block.of(low, high, added=block.added)

    def apply(self, mesh: Mesh) -> Mesh:
        return Mesh((mesh.vertices / self.denominator) @ self.whole.T, mesh.triangles)


def boundary(blocks: Sequence[Block], others: Sequence[Block] = ()) -> Rectangles:
    """Return the surface of a solid, cut along its sides, and where the sides of other blocks would cut it."""
    corners = np.array([(block.low, block.high) for block in (*blocks, *others)])
    edges = [np.unique(corners[..., axis]) for axis in range(3)]
    middles = np.stack(np.meshgrid(*((edge[1:] + edge[:-1]) / 2 for edge in edges), indexing="ij"), axis=-1)
    filled = np.zeros(middles.shape[:-1], dtype=bool)
    for block in blocks:
        filled[np.all((middles > block.low) & (middles < block.high), axis=-1)] = block.added
    return Rectangles.cells(edges, filled)


def difference(a: Rectangles, b: Rectangles) -> tuple[Rectangles, Rectangles]:
    """Return two surfaces without the rectangles that both have, whose areas cancel."""
    rows = [np.concatenate([each.low, each.high], axis=1).tolist() for each in (a, b)]
    shared = set(map(tuple, rows[0])) & set(map(tuple, rows[1]))
    kept = [np.array([tuple(row) not in shared for row in each]) for each in rows]
    first, second = (Rectangles(each.low[keep], each.high[keep]) for each, keep in zip((a, b), kept, strict=True))
    return first, second


def cut_at_random(rng: np.random.Generator, rectangles: Rectangles, most: int, turn: Turn) -> Mesh:
    """Return rectangles in triangles between their corners and up to so many random points within each."""
    vertices: list[Reals] = []
    triangles: list[NDArray[np.int64]] = []
    first = 0
    for low, high in zip(rectangles.low, rectangles.high, strict=True):
        across = np.flatnonzero(high > low)
        places = np.concatenate([rng.permutation(_CORNERS), rng.uniform(0.05, 0.95, size=(rng.integers(most + 1), 2))])
        points = np.tile(low, (len(places), 1))
        points[:, across] = turn.snapped(low[across] + places * (high - low)[across])
        vertices.append(points)
        triangles.append(first + Delaunay(places).simplices.astype(np.int64))
        first += len(points)
    different, names = np.unique(np.concatenate(vertices), axis=0, return_inverse=True)
    return Mesh(different, names.ravel()[np.concatenate(triangles)])


def edited(rng: np.random.Generator) -> Pair:
    """Return a box or a plate with steps, and the same with a boss, a pocket, a hole or a rib, in other triangles."""
    turn, most = Turn.random(rng), int(rng.integers(0, 5))
    blocks = _steps(rng) if rng.random() < 0.5 else [Block.of((0, 0, 0), rng.uniform(0.3, 1.2, size=3))]
    blocks = [turn.block(block) for block in blocks]
    edit = turn.block(random_edit(rng, blocks[int(rng.integers(len(blocks)))]))
    a, b = boundary(blocks), boundary([*blocks, edit])
    first, second = (turn.apply(cut_at_random(rng, surface, most, turn)) for surface in (a, b))
    return Pair(first, second, difference(boundary(blocks, [edit]), b))


def random_edit(rng: np.random.Generator, block: Block) -> Block:
    """Return a boss, a pocket, a hole or a rib on the top of a block."""
    low, high = np.array(block.low), np.array(block.high)
    across, choice = (high - low)[:2], rng.random()
    sizes = across.min() * 10.0 ** rng.uniform(-2.3, -0.4) * rng.uniform(0.5, 1.5, size=2)
    if choice > 0.7:
        sizes[1] = across[1] * rng.uniform(0.3, 0.9)
    start = low[:2] + (across - sizes) * rng.uniform(0.05, 0.95, size=2)
    end, height = start + sizes, sizes[0] * rng.uniform(0.3, 2.0)
    if 0.3 < choice < 0.7:
        depth = min(height, 0.8 * (high - low)[2]) if choice < 0.5 else (high - low)[2]
        return Block.of((*start, high[2] - depth), (*end, high[2]), added=False)
    return Block.of((*start, high[2]), (*end, high[2] + height))


def close_and_thin(rng: np.random.Generator) -> Pair:
    """Return two rods or plates at a gap as small as they are thin."""
    turn, thin = Turn.random(rng), 10.0 ** rng.uniform(-4, -1.7)
    gap, across = thin * 10.0 ** rng.uniform(-1, 0.5), thin if rng.random() < 0.5 else rng.uniform(0.1, 0.8)
    length = rng.uniform(0.3, 1.0)
    a, b = (boundary([turn.block(Block.of((0, 0, z), (length, across, z + thin)))]) for z in (0.0, thin + gap))
    first, second = (turn.apply(cut_at_random(rng, each, most, turn)) for each, most in ((a, 0), (b, 6)))
    return Pair(first, second, (a, b))


def array(rng: np.random.Generator) -> Pair:
    """Return small boxes or plates at a pitch in all directions, and the same moved, or only some of them."""
    turn, count = Turn.random(rng), int(rng.integers(2, 7))
    pitch = rng.uniform(0.5, 1.2) / count
    sides = pitch * rng.uniform(0.1, 0.6) * np.array([1.0, 1.0, 1.0 if rng.random() < 0.5 else 0.1])
    corners = pitch * np.array(list(product(range(count), repeat=3)))
    moved = rng.random() < 0.6
    others = corners + pitch * rng.uniform(0.05, 0.4) * direction(rng) if moved else _some(rng, corners)
    a, b = (boundary([turn.block(Block.of(low, low + sides)) for low in lows]) for lows in (corners, others))
    first, second = (turn.apply(cut_at_random(rng, surface, 0, turn)) for surface in (a, b))
    return Pair(first, second, difference(a, b))


def far_apart(rng: np.random.Generator) -> Pair:
    """Return two spheres or boxes, equal ones or others, some units to a million units apart."""
    apart = 10.0 ** rng.uniform(0.5, 6) * direction(rng)
    if rng.random() < 0.4:
        radii = rng.uniform(0.05, 0.6, size=2)
        return Pair(sphere_at(radii[0], np.zeros(3)), sphere_at(radii[1], apart))
    turn, sides = Turn.random(rng), rng.uniform(0.05, 0.8, size=(2, 3))
    others = sides[int(rng.random() < 0.5)]
    a, b = (boundary([turn.block(Block.of((0, 0, 0), each))]) for each in (sides[0], others))
    first, second = (turn.apply(cut_at_random(rng, each, 2, turn)) for each in (a, b))
    shift = _STEP * np.round(apart / _STEP)
    stand_in = shift * min(1.0, _FAR / math.hypot(*shift)) @ turn.whole / turn.denominator
    return Pair(first, Mesh(second.vertices + shift, second.triangles), (a, b.moved(*stand_in)))


def _steps(rng: np.random.Generator) -> list[Block]:
    """Return a plate with steps of different heights on it, side by side."""
    count, width = int(rng.integers(2, 6)), float(rng.uniform(0.2, 0.8))
    sides, heights = np.linspace(0, 1, count + 1), rng.uniform(0.05, 0.4, size=count)
    return [Block.of((a, 0, 0), (b, width, h)) for a, b, h in zip(sides[:-1], sides[1:], heights, strict=True)]


def _some(rng: np.random.Generator, corners: Reals) -> Reals:
    kept = rng.random(len(corners)) < rng.uniform(0.3, 0.9)
    kept[rng.permutation(len(corners))[:2]] = True, False
    return corners[kept]


SOLIDS: dict[str, Callable[[np.random.Generator], Pair]] = {
    "edited and remeshed": edited,
    "close and thin": close_and_thin,
    "array": array,
    "far apart": far_apart,
}
