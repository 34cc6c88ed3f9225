"""What it takes to tell whether two surfaces are the same."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.util import find_spec

import numpy as np

import sobolev_batch as sb
from benchmarks.table import Row, as_seconds, at_most
from benchmarks.timing import Effort, take_turns

_MOST_SECONDS = 0.5

Pair = tuple[sb.Mesh, sb.Mesh]


def verdicts(effort: Effort) -> Iterator[Row]:
    """Item 13: verdicts on pairs of some 100,000 triangles each, beside Hausdorff and Chamfer distances."""
    around, across = (32, 16) if effort.quick else (316, 158)
    mesh = sb.shapes.Torus(1.0, 0.4).mesh(around, across)
    coarse = sb.shapes.Torus(1.0, 0.4).mesh(around // 2, across // 2)
    pairs = {
        "vertices and triangles in another order": (_permuted(mesh), mesh, "same"),
        "vertices elsewhere": (sb.shapes.Torus(1.0, 0.4).mesh(around + 2, across - 1), mesh, "same"),
        "each triangle cut in four, each in three and more": (_cut(coarse, _in_four), _cut(coarse, _in_three), "same"),
        "a hundredth of the triangles lost": (_without(_permuted(mesh), len(mesh.triangles) // 100), mesh, "different"),
        "vertices elsewhere and moved by 0.01": (
            sb.Mesh(sb.shapes.Torus(1.0, 0.4).mesh(around + 2, across - 1).vertices + 0.01 * np.eye(3)[0],
                    sb.shapes.Torus(1.0, 0.4).mesh(around + 2, across - 1).triangles),
            mesh,
            "different",
        ),
    }  # fmt: skip
    for what, (first, second, expected) in pairs.items():
        yield _row(what, (first, second), expected, effort)


def _row(what: str, pair: Pair, expected: str, effort: Effort) -> Row:
    def prepare() -> Pair:
        # New arrays: nothing that a mesh keeps may be left from the turn before.
        first, second = (sb.Mesh(np.array(mesh.vertices), np.array(mesh.triangles)) for mesh in pair)
        return first, second

    outcomes: list[str] = []
    contestants: list[Callable[[Pair], object]] = [
        lambda given: outcomes.append(
            sb.testing.same_surface(*given, tolerance=1e-2 if effort.quick else 1e-3, order=-4.0).outcome
        )
    ]
    if find_spec("vtkmodules"):
        contestants.append(lambda given: sb.proximity(*given))
    seconds = take_turns(contestants, prepare, effort.repeats)
    text = f"{len(pair[0].triangles):,} against {len(pair[1].triangles):,} triangles, {what}"
    found = ", ".join(sorted(set(outcomes)))
    remark = found if found == expected else f"{found} INSTEAD OF {expected}"
    return Row(
        "13",
        f"{text}: {remark}, seconds",
        as_seconds(seconds[0]),
        as_seconds(seconds[1]) if len(seconds) > 1 else "",
        seconds[0],
        None if effort.quick else at_most(_MOST_SECONDS),
    )


def _permuted(mesh: sb.Mesh) -> sb.Mesh:
    rng = np.random.default_rng(0)
    order = rng.permutation(len(mesh.vertices))
    return sb.Mesh(mesh.vertices[order], rng.permutation(np.argsort(order)[mesh.triangles]))


def _without(mesh: sb.Mesh, count: int) -> sb.Mesh:
    """Return a mesh without some triangles around its first one."""
    centroids = mesh.vertices[mesh.triangles].mean(axis=1)
    kept = np.argsort(np.linalg.norm(centroids - centroids[0], axis=1))[count:]
    return sb.Mesh(mesh.vertices, mesh.triangles[kept])


Corners = np.ndarray[tuple[int, ...], np.dtype[np.float64]]


def _in_four(corners: Corners) -> Corners:
    a, b, c = np.moveaxis(corners, 1, 0)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return np.concatenate([np.stack(part, axis=1) for part in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])


def _in_three(corners: Corners) -> Corners:
    a, b, c = np.moveaxis(corners, 1, 0)
    middle = (a + b + c) / 3
    return np.concatenate([np.stack(part, axis=1) for part in ((a, b, middle), (b, c, middle), (c, a, middle))])


def _cut(mesh: sb.Mesh, cut: Callable[[Corners], Corners]) -> sb.Mesh:
    """Return the same surface in more triangles, with a vertex for each corner of each."""
    corners = cut(mesh.vertices[mesh.triangles])
    return sb.Mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
