"""Distances at low orders, whose tails are measured, against closed forms and the heat traces of rectangles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from sobolev_batch import Mesh, distance, norm
from sobolev_batch.errors import AccuracyError, InputError
from sobolev_batch.geometry.subdivision import subdivided
from sobolev_batch.norms.accuracy import frequencies, problem
from sobolev_batch.norms.tail.remainder import Remainder, remainder
from sobolev_batch.shapes import Sphere, icosphere
from sobolev_batch.study.plan import make_plan
from sobolev_batch.study.study import Study
from tests.support.rectangles import Rectangles

Pair = tuple[Rectangles, Rectangles]


BOX = Rectangles.box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
MOVED_BOX = BOX, BOX.moved(0.01, 0.03, 0.02)
PAIRS: dict[str, Callable[[], Pair]] = {
    "moved box": lambda: MOVED_BOX,
    "box slid along its faces": lambda: (BOX, BOX.moved(0.25, 0.0, 0.0)),
    "fins": lambda: (Rectangles.fins(12), Rectangles.fins(12).moved(0, 0, 1 / 24)),
    "perforated": lambda: (Rectangles.perforated(3), Rectangles.perforated(3).moved(1 / 6, 0, 0)),
    # Plates at a pitch of 1/20 show no period below a frequency of 20.
    "plates": lambda: (Rectangles.tapered(40, 1 / 20, 0.2), Rectangles.tapered(40, 1 / 20, 0.2, 0.5)),
    "fine plates": lambda: (Rectangles.tapered(35, 1 / 35, 0.3), Rectangles.tapered(35, 1 / 35, 0.3, 0.5)),
    # They agree up to three times the frequency at which a lattice meets an accuracy at order -8.
    "few plates": lambda: (Rectangles.tapered(8, 0.35, 0.3, -0.25), Rectangles.tapered(8, 0.35, 0.3, 0.25)),
    "fine fins": lambda: (Rectangles.fins(30), Rectangles.fins(30).moved(0, 0, 1 / 60)),
    "strips": lambda: (Rectangles.strips(25, 0.0, 0.9, 0.5), Rectangles.strips(25, 0.5, 0.9, 0.5)),
    "layers": lambda: (Rectangles.sheets(3, 1e-3, 0.0), Rectangles.sheets(1, 1e-3, 5e-3)),
}
CASES = [
    *(
        (name, *order_and_rtol)
        for name in ("moved box", "box slid along its faces", "fins", "perforated")
        for order_and_rtol in ((-0.7, 1e-1), (-1.0, 3e-2), (-2.0, 1e-2), (-3.0, 1e-3))
    ),
    ("plates", -4.0, 1e-1),
    ("fine plates", -5.0, 1e-1),
    ("few plates", -8.0, 1e-1),
    ("fine fins", -2.0, 1e-2),
    ("fine fins", -2.5, 1e-3),
    ("strips", -1.0, 1e-1),
    ("strips", -0.75, 1e-1),
    ("layers", -0.75, 3e-2),
]


@lru_cache
def pair_and_truths(name: str) -> tuple[Mesh, Mesh, dict[float, float]]:
    """The heat trace takes longest, and serves all orders."""
    orders = [order for other, order, _ in CASES if other == name]
    first, second = PAIRS[name]()
    return first.mesh(), second.mesh(), dict(zip(orders, first.distance(second, orders).tolist(), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "order", "rtol"), CASES)
def test_flat_faces_that_repeat_against_their_heat_trace(name: str, order: float, rtol: float) -> None:
    first, second, truths = pair_and_truths(name)
    exact, dataset = truths[order], distance(first, second, order, rtol=rtol)
    assert dataset["within"].item()
    assert abs(dataset["distance"].item() - exact) <= dataset["error"].item() <= rtol * dataset["distance"].item()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_thin_surfaces_that_nearly_cancel(seed: int) -> None:
    orders, turn = (-1.0, -2.0, -4.0), np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    rods = [Rectangles.box((-0.5, y, 0.0), (0.5, y + 1e-3, 1e-3)) for y in (0.0, 2e-3)]
    truth = rods[0].distance(rods[1], orders)
    one, other = (Mesh(rod.mesh().vertices @ turn.T, rod.mesh().triangles) for rod in rods)
    found = distance(one, other, orders, rtol=0.1, seed=seed)
    assert found["within"].all()
    assert (np.abs(found["distance"].values - truth) <= found["error"].values).all()


@pytest.mark.slow
def test_a_seed_makes_results_reproducible_and_another_one_changes_them() -> None:
    pair = icosphere(1), icosphere(2)
    first, again, other = (distance(*pair, -1.0, rtol=0.003, seed=seed) for seed in (1, 1, 2))
    # Sums of several threads round differently, here in single precision.
    assert first["distance"].item() == pytest.approx(again["distance"].item(), rel=1e-5)
    assert first["distance"].item() != other["distance"].item()
    assert abs(first["distance"] - other["distance"]) <= first["error"] + other["error"]
    assert first["error_part"].sel(part="statistical") > 0
    assert first["error"].item() == pytest.approx(first["error_part"].sum().item(), rel=1e-14)


@pytest.mark.parametrize("seed", [-1, 1.5, "a", True, None])
def test_a_seed_is_a_whole_number(seed: Any) -> None:
    with pytest.raises(InputError, match="seed must be a whole number from 0 on"):
        distance(icosphere(1), icosphere(2), -1.0, rtol=0.05, seed=seed)


@pytest.mark.all
def test_the_unit_of_length_may_be_tiny_beside_the_surfaces() -> None:
    scale, ball, smaller = 1e9, icosphere(1), icosphere(1).moved(0.9, (0.0, 0.0, 0.0))
    pair = (ball.moved(scale, (0.0, 0.0, 0.0)), smaller.moved(scale, (0.0, 0.0, 0.0)))
    found = distance(*pair, -1.0, rtol=3e-2)
    assert found["within"].item()
    # Far beyond a wavelength of one unit the measures have nothing in common: the energy is at its limit everywhere.
    squares = 2 * (pair[0].area + pair[1].area) * np.pi / 2
    assert found["distance"].item() == pytest.approx(np.sqrt(squares), rel=0.05)


@pytest.mark.slow
def test_very_negative_orders_beside_low_ones_have_no_tail() -> None:
    found = distance(icosphere(1), icosphere(2), [-0.6, -4.0, -100.0], rtol=5e-2)
    assert found["within"].all()
    exact = distance(icosphere(1), icosphere(2), -100.0, rtol=1e-4)
    assert found["distance"].values[2] == pytest.approx(exact["distance"].item(), rel=1e-3)


@pytest.mark.slow
def test_a_remainder_that_inner_ones_contradict_is_no_accuracy(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = MOVED_BOX
    cutoffs: list[float] = []

    def misjudged(surfaces: Any, signs: Any, cutoff: float, *others: Any, **options: Any) -> Remainder:
        """Return half of what lies beyond all but the first cutoff, without any error."""
        cutoffs.append(cutoff)
        beyond = remainder(surfaces, signs, cutoff, *others, **options)
        (energy,) = beyond.energies
        energy, error = (energy, 0.1 * energy) if cutoff == cutoffs[0] else (energy / 2, 0.0)
        # No more points are drawn.
        return replace(beyond, energies=(energy,), errors=(error,), points=10**9)

    monkeypatch.setattr(problem, "remainder", misjudged)
    with pytest.raises(AccuracyError, match="out of reach"):
        distance(a.mesh(), b.mesh(), -1.0, rtol=0.01)


@pytest.mark.slow
def test_points_that_see_less_than_is_there_already_are_no_accuracy(monkeypatch: pytest.MonkeyPatch) -> None:
    def blind(*given: Any, **options: Any) -> Remainder:
        """Return nothing, from many points that still leave much out."""
        beyond = remainder(*given, **options)
        return replace(beyond, energies=(0.0,), errors=(0.0,), points=10**8, covering=10**9, hidden=0.0)

    monkeypatch.setattr(problem, "remainder", blind)
    with pytest.raises(AccuracyError, match="out of reach"):
        distance(MOVED_BOX[0].mesh(), MOVED_BOX[1].mesh(), -1.0, rtol=0.1)


def test_no_more_points_are_drawn_than_a_part_that_they_may_miss_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def hiding(surfaces: Any, signs: Any, cutoff: float, orders: Any, points: int | None, **options: Any) -> Remainder:
        """Return an error that falls with the number of points; at first there are few."""
        asked.append(points or 20)
        beyond = remainder(surfaces, signs, cutoff, orders, **options)
        errors = (20 * beyond.energies[0] / asked[-1],)
        return replace(beyond, errors=errors, points=asked[-1], pairs=asked[-1], covering=10**6, hidden=1.0)

    monkeypatch.setattr(problem, "remainder", hiding)
    found = distance(MOVED_BOX[0].mesh(), MOVED_BOX[1].mesh(), -1.0, rtol=0.02)
    assert found["within"]
    # Far fewer would not do.
    assert found["error_part"].sel(part="truncation") > 0.05 * 0.02 * found["distance"]


@pytest.mark.parametrize("is_chance", [True, False])
def test_other_points_confirm_a_disagreement_or_show_that_it_was_chance(
    monkeypatch: pytest.MonkeyPatch, is_chance: bool
) -> None:
    a, b = MOVED_BOX
    seeds, first = [], dict[float, Remainder]()

    def shifted(surfaces: Any, signs: Any, cutoff: float, *others: Any, **options: Any) -> Remainder:
        """Return 1.5 times a large error too much beyond the first cutoff: by chance, from the first points only."""
        beyond = remainder(surfaces, signs, cutoff, *others, **options)
        if cutoff != next(iter(first), cutoff):
            return beyond
        seeds.append(options.get("seed", others[-1]))
        usual = first.setdefault(cutoff, beyond)
        error = 10 * usual.errors[0]
        energy = usual.energies[0] if is_chance and len(seeds) > 1 else usual.energies[0] + 1.5 * error
        return replace(beyond, energies=(energy,), errors=(error * np.sqrt(usual.points / beyond.points),))

    monkeypatch.setattr(problem, "remainder", shifted)
    if is_chance:
        found, exact = distance(a.mesh(), b.mesh(), -1.0, rtol=0.02), a.distance(b, [-1.0]).item()
        assert abs(found["distance"].item() - exact) <= found["error"].item() <= 0.02 * exact
    else:
        with pytest.raises(AccuracyError, match="out of reach"):
            distance(a.mesh(), b.mesh(), -1.0, rtol=0.02)
    assert len(seeds) == len(set(seeds)) == 2


def test_pilots_look_beyond_their_octaves_only_where_these_may_be_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_at: list[float] = []

    def counted(surfaces: Any, signs: Any, cutoff: float, *others: Any, **options: Any) -> Remainder:
        looked_at.append(cutoff)
        return remainder(surfaces, signs, cutoff, *others, **options)

    monkeypatch.setattr(problem, "remainder", counted)
    study: dict[str, Any] = {
        "study": {"name": "spheres"},
        "accuracy": {"rtol": 0.02},
        "norm": {"orders": [-1.0]},
        "reference": {"source": "icosphere", "levels": [3]},
        "family": [{"name": "levels", "source": "icosphere", "levels": [2]}],
    }
    chosen = make_plan(Study.from_table(study)).choice.tail
    assert chosen is not None
    assert looked_at[-1] == chosen.highest_frequency
    assert len(looked_at) <= len(chosen.octaves) / 2


# An octave on flat faces takes many draws, each over all triangles: more points beyond the lattice are cheaper.
def test_finely_cut_flat_faces_need_no_octaves_for_their_norm() -> None:
    plate = Rectangles.box([-50.0, -30.0, 0.0], [50.0, 30.0, 5.0]).mesh()
    for _ in range(5):
        plate = subdivided(plate)
    found = norm(plate, -2.0, rtol=1e-2)
    assert found["within"]


@pytest.mark.parametrize("radius", [10.0, 100.0])
def test_a_ball_of_many_units_does_not_meet_its_images(radius: float) -> None:
    # The step at the end of a small lattice has a tail in space: images of opposite sides were in the norm.
    orders, ball = (-0.75, -1.0, -2.0, -4.0, -10.0), Sphere(radius)
    exact, found = norm(ball, orders), norm(ball, orders, rtol=1e-3)
    assert found["within"].all()
    assert (np.abs(found["norm"] - exact["norm"]) <= found["error"]).all()


def test_images_that_a_step_lets_in_are_an_error() -> None:
    # So little memory leaves no lattice on which they are far enough.
    exact, found = norm(Sphere(100.0), -2.0), norm(Sphere(100.0), -2.0, rtol=1e-2, memory="305MB")
    assert found.attrs["M"] < 64
    assert abs(found["norm"] - exact["norm"]) <= found["error"]


def test_what_lies_beyond_the_octaves_of_a_distance_is_estimated_once(monkeypatch: pytest.MonkeyPatch) -> None:
    estimated: list[tuple[int, float]] = []

    def counted(surfaces: Any, signs: Any, cutoff: float, *others: Any, **settings: Any) -> Remainder:
        estimated.append((len(surfaces), cutoff))
        return remainder(surfaces, signs, cutoff, *others, **settings)

    for module in (problem, frequencies):
        monkeypatch.setattr(module, "remainder", counted)
    found = distance(icosphere(1), Sphere(), -1.5, rtol=1e-2)
    of_pair = [cutoff for count, cutoff in estimated if count == 2]
    assert max(of_pair) == found.attrs["highest_frequency"]
    assert len(of_pair) == len({*of_pair})
