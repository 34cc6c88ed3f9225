"""Counts of the work behind public calls: they catch a second transform of one mesh, which no result shows.

A count is the same on each machine, where seconds are not. A change that raises a count changes the table.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import finufft
import pytest

import sobolev_batch as sb
from sobolev_batch.transform import kinds
from tests.support.studies import SMALL_LATTICE, small_table

COARSE, FINE, SPHERE = sb.shapes.icosphere(1), sb.shapes.icosphere(2), sb.shapes.Sphere()


def run_study(store: str, *levels: int) -> None:
    """Run a study of some icospheres in threads of this process, where calls are counted."""
    family = [{"name": "ico", "source": "icosphere", "levels": list(levels)}]
    sb.run(sb.Study.from_table(small_table(family=family)), f"memory://counts-{store}")


# Each call, with the most NUFFTs, points in them and terms of exact transforms that it may take, and why it takes them.
WORK: dict[str, tuple[Callable[[], object], int, int, int, str]] = {
    "distance of a mesh from itself": (
        lambda: sb.distance(FINE, FINE, -4.0, lattice=SMALL_LATTICE),
        *(0, 0, 0),
        "equal surfaces are equal by their triangles",
    ),
    "norm of a mesh": (
        lambda: sb.norm(FINE, -4.0, lattice=SMALL_LATTICE),
        *(1, 19_200, 10_240),
        "one field, probed at 32 frequencies",
    ),
    "distance of two meshes": (
        lambda: sb.distance(COARSE, FINE, -4.0, lattice=SMALL_LATTICE),
        *(2, 28_160, 12_800),
        "one field of each mesh, probed at 32 frequencies",
    ),
    "distances at three orders": (
        lambda: sb.distance(COARSE, FINE, [-2.0, -4.0, -6.0], lattice=SMALL_LATTICE),
        *(2, 28_160, 12_800),
        "all orders share the fields and their probes",
    ),
    "distance of a mesh from a sphere": (
        lambda: sb.distance(FINE, SPHERE, -4.0, lattice=SMALL_LATTICE),
        *(1, 19_200, 10_240),
        "the transform of a sphere is a formula",
    ),
    "distance to an accuracy": (
        lambda: sb.distance(COARSE, FINE, -4.0, rtol=0.05),
        *(2, 4_202, 25_600),
        "the lattice is chosen from exact values, before one coarse field of each mesh",
    ),
    "distance to a high accuracy": (
        lambda: sb.distance(sb.shapes.icosphere(4), SPHERE, -10.0, rtol=7e-4),
        *(2, 23_040, 409_600),
        "one field, and a coarse one of the frequencies beyond, probed at 32 of them each, and at 8 by its values",
    ),
    "gradient": (
        lambda: sb.fitting.gradient(COARSE, SPHERE, -4.0, lattice=SMALL_LATTICE),
        *(10, 99_680, 0),
        "a field and two sums at the nodes, at two accuracies, and four fields for the share of the target's error",
    ),
    "verdict on equal meshes": (
        lambda: sb.testing.same_surface(FINE, FINE),
        *(0, 0, 0),
        "equal surfaces are equal by their triangles",
    ),
    "verdict far from its tolerance": (
        lambda: sb.testing.same_surface(COARSE, FINE, tolerance=1e-3, order=-4.0),
        *(3, 47_340, 25_600),
        "a rough norm of the reference, and the two fields on one lattice",
    ),
    "verdict near its tolerance": (
        lambda: sb.testing.same_surface(COARSE, FINE, tolerance=0.1, order=-4.0),
        *(5, 22_144, 51_200),
        "a rough norm of the reference, and the two fields on two lattices",
    ),
    "study of one mesh": (
        partial(run_study, "one", 1),
        *(1, 8_960, 2_560),
        "its field, as for a distance; the reference is a sphere",
    ),
    "study of two meshes": (
        partial(run_study, "two", 1, 2),
        *(2, 28_160, 12_800),
        "one field of each mesh, whatever is compared with it",
    ),
    "second run of a study": (
        partial(run_study, "second", 0, 1),
        *(0, 0, 0),
        "its fields are stored, with their probes",
    ),
}


def work_of(call: Callable[[], object]) -> dict[str, int]:
    """Count NUFFTs, their points, and the terms of exact transforms: pairs of a triangle and a frequency."""
    # Appending is safe from several threads.
    events: list[tuple[str, int]] = []

    class Plan(finufft.Plan):  # type: ignore[misc]
        def setpts(self, *coordinates: Any, **targets: Any) -> Any:
            self.point_count = len(coordinates[0])
            return super().setpts(*coordinates, **targets)

        def execute(self, *arguments: Any, **settings: Any) -> Any:
            events.extend((("transforms", 1), ("points", self.point_count)))
            return super().execute(*arguments, **settings)

    def counting(values: Callable[..., Any]) -> Callable[..., Any]:
        def transform(mesh: sb.Mesh, frequencies: Any, *others: Any) -> Any:
            events.append(("exact", len(mesh.triangles) * len(frequencies)))
            return values(mesh, frequencies, *others)

        return transform

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finufft, "Plan", Plan)
        for name in ("exact_transform", "sampled_transform"):
            patch.setattr(kinds, name, counting(getattr(kinds, name)))
        call()
    return {name: sum(count for kind, count in events if kind == name) for name in ("transforms", "points", "exact")}


@pytest.mark.parametrize("name", WORK)
def test_a_call_takes_no_more_work_than_its_row(name: str) -> None:
    call, *most, reason = WORK[name]
    if name == "second run of a study":
        assert work_of(call)["transforms"] == 2
    work = work_of(call)
    assert all(count <= limit for count, limit in zip(work.values(), most, strict=True)), (work, most, reason)


def test_a_count_sees_each_transform() -> None:
    # Else all rows would hold of a count that sees nothing.
    norm = WORK["norm of a mesh"][0]
    one, two = work_of(norm), work_of(lambda: (norm(), norm()))
    assert min(one.values()) > 0
    assert two == {name: 2 * count for name, count in one.items()}
