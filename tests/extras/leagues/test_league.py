"""Leagues over tables that are put together by hand, whose answers are known."""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import sobolev_batch as sb
from sobolev_batch.extras.leagues import statistics
from sobolev_batch.extras.leagues.costs import CostLeague, cost_leagues_of, format_cost_leagues
from sobolev_batch.extras.leagues.league import League, format_league, leagues_of
from sobolev_batch.extras.leagues.statistics import filled, interval, sign_flip_test, within_objects
from tests.support.studies import method_rows

SIZES = (100, 400, 1600)


def ranked(tables: Mapping[str, pd.DataFrame], **arguments: Any) -> League:
    """Return the league of some tables."""
    (made,) = leagues_of(tables, list(tables), **arguments)
    return made


def of_powers(factors: Mapping[str, float], scale: float, rate: float = 2.0) -> pd.DataFrame:
    """Return the table of methods whose distances are factors of the same power of the edge length."""
    return method_rows(
        {name: {n: factor * scale * n ** (-rate / 2) for n in SIZES} for name, factor in factors.items()}
    )


def test_factors_between_methods_are_found_whatever_the_objects() -> None:
    rng = np.random.default_rng(3)
    tables = {
        f"object{i}": of_powers({"a": 1.0, "b": 1.5 * np.exp(0.01 * rng.standard_normal())}, scale)
        for i, scale in enumerate((1.0, 10.0, 0.1, 3.0, 0.02, 7.0))
    }
    made = ranked(tables)
    assert made.table["method"].tolist() == ["a", "b"]
    assert made.table[["rank", "last_rank"]].to_numpy().tolist() == [[1, 1], [2, 2]]
    np.testing.assert_allclose(made.table["rate"], 2.0)
    (pair,) = made.pairs.to_dict("records")
    assert pair["ratio"] == pytest.approx(1 / 1.5, rel=0.02)
    assert pair["low"] < 1 / 1.5 < pair["high"]
    # Of 2^6 changes of sign, two are as extreme.
    assert pair["p"] == pytest.approx(2 / 64)
    assert pair["nearer"] == "a"


def test_what_methods_lack_takes_no_matrix_of_all_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, objects, methods = np.random.default_rng(5), 60, 4
    values = np.where(rng.random((objects, methods)) < 0.4, np.nan, rng.standard_normal((objects, methods)))
    values[:, 0] = np.where(np.isnan(values).all(axis=1), 0.0, values[:, 0])
    rows, columns = np.indices(values.shape).reshape(2, -1)
    design, known = np.hstack([np.eye(objects)[rows], np.eye(methods)[columns]]), np.isfinite(values).ravel()
    effects = np.linalg.lstsq(design[known], values.ravel()[known])[0]
    solve, shapes = np.linalg.lstsq, list[tuple[int, ...]]()

    def noted(matrix: Any, side: Any) -> Any:
        shapes.append(matrix.shape)
        return solve(matrix, side)

    monkeypatch.setattr(np.linalg, "lstsq", noted)
    found = filled(values)
    np.testing.assert_allclose(found.ravel()[~known], (design @ effects)[~known], rtol=1e-10)
    assert shapes == [(methods, methods)]


def test_signs_are_drawn_in_parts_that_memory_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    differences, errors = np.random.default_rng(9).standard_normal(40) + 0.3, np.zeros(40)
    whole = sign_flip_test(differences, errors)
    monkeypatch.setattr(statistics, "_MOST_SIGNS", 40 * 300)
    assert sign_flip_test(differences, errors) == whole
    assert 0 < whole < 0.1


def test_a_number_is_not_compared_at_equal_values_of_itself() -> None:
    tables = {name: of_powers({"a": 1.0, "b": 2.0}, 1.0) for name in ("x", "y", "z")}
    with pytest.raises(sb.errors.InputError, match="the same triangles at equal triangles; choose another x"):
        ranked(tables, y="triangles")


def test_methods_are_compared_at_equal_sizes() -> None:
    first = {n: 1.0 / n for n in SIZES}
    # The same curve, sampled elsewhere: with fewer triangles each, at which a mean of distances would be larger.
    second = {n: 1.0 / n for n in (50, 150, 500, 2000)}
    tables = {name: method_rows({"a": first, "b": second}) for name in ("x", "y", "z")}
    made = ranked(tables)
    assert made.pairs["ratio"].item() == pytest.approx(1.0)
    # The middle of the common range, 100 to 1600, on a logarithmic axis.
    np.testing.assert_allclose(made.table["relative"], 1 / 400)


def test_the_plot_has_the_means_of_the_table_whatever_the_sizes_of_the_meshes() -> None:
    # The k-th meshes of the objects differ in size: a mean of these would put b below a.
    plain = method_rows({"a": {n: 1.0 / n for n in (100, 400, 1600)}, "b": {n: 2.0 / n for n in (400, 1600, 6400)}})
    made = ranked({"x": plain, "y": method_rows({"a": {n: 3.0 / n for n in SIZES}, "b": {n: 6.0 / n for n in SIZES}})})
    lines = {line.get_label(): line for line in sb.plot.league(made).lines}
    for method, relative in made.table.set_index("method")["relative"].items():
        places, values = np.asarray(lines[str(method)].get_xydata()).T
        assert np.exp(np.log(values).mean()) == pytest.approx(relative, rel=1e-12)
        assert (np.diff(places) > 0).all()


def test_errors_of_distances_hide_a_difference() -> None:
    distances = {"a": dict.fromkeys(SIZES, 1.0), "b": dict.fromkeys(SIZES, 1.1)}
    sharp, blurred = (ranked({f"{i}": method_rows(distances, error) for i in range(8)}) for error in (1e-3, 0.1))
    assert sharp.pairs["nearer"].item() == "a"
    assert sharp.table["last_rank"].tolist() == [1, 2]
    assert blurred.pairs["nearer"].item() == ""
    assert blurred.pairs["p"].item() == 1.0
    assert blurred.table["last_rank"].tolist() == [2, 2]


def test_a_distance_below_its_error_bounds_nothing() -> None:
    tables = {f"{i}": method_rows({"a": {100: 1e-3}, "b": {100: 1.0}}, error=2.0) for i in range(6)}
    made = ranked(tables)
    assert np.isinf(made.table["high"]).all()
    assert made.table["last_rank"].tolist() == [2, 2]
    assert "?" in format_league([made])


POWERS = of_powers({"a": 1, "b": 2}, 1.0)


@pytest.mark.parametrize(
    ("distances", "reason"),
    [
        ({"a": {n: 1.0 / n for n in SIZES}}, "no distance of b"),
        ({"a": {1000: 1.0, 8000: 1e-3}}, "no distance of b"),
        ({"a": dict.fromkeys(SIZES, 3e-8), "b": {n: 1.0 / n for n in SIZES}}, "a reproduced it, up to rounding"),
        ({"a": dict.fromkeys(SIZES, 0.0), "b": {n: 1.0 / n for n in SIZES}}, "a reproduced it, up to rounding"),
        ({"a": {1000: 1.0}, "b": {2000: 2.0}}, "no common range of sizes: b begins at 2,000, a ends at 1,000"),
    ],
)
def test_objects_that_cannot_be_compared_are_left_out_and_named(
    distances: Mapping[str, Mapping[int, float]], reason: str
) -> None:
    tables = {"x": POWERS, "y": method_rows(distances, error=0.03), "z": POWERS}
    (made,) = leagues_of(tables, [*tables, "later"])
    assert made.objects == ("x", "z")
    assert made.left_out == {"later": "it has no tables; the command status tells why", "y": reason}
    assert f"y is left out: {reason}." in format_league([made])
    assert made.pairs["ratio"].item() == pytest.approx(0.5)
    np.testing.assert_allclose(made.table["rate"], 2.0)


def test_a_method_that_an_object_lacks_drops_no_object_for_the_others() -> None:
    rng = np.random.default_rng(8)
    factors, scales = {"a": 1.0, "b": 1.5, "c": 3.0}, rng.uniform(0.01, 10, 8)
    tables = {f"{i}": of_powers(factors, scale) for i, scale in enumerate(scales)}
    whole = ranked(tables)
    # One lacks c. Another has it at sizes that it shares with no other method, and a third has a at those.
    tables["0"] = of_powers({"a": 1.0, "b": 1.5}, scales[0])
    for name, method in (("1", "c"), ("2", "a")):
        is_far = tables[name]["family"] == method
        tables[name].loc[is_far, "triangles"] *= 1000
        tables[name].loc[is_far, "relative"] /= 1000
    made = ranked(tables)
    assert made.objects == whole.objects
    assert list(made.left_out) == ["0/c", "1/c", "2/a"]
    assert made.left_out["0/c"] == "no distance of c"
    assert made.table.set_index("method")["objects"].to_dict() == {"a": 7, "b": 8, "c": 6}
    pairs = made.pairs.set_index(["method", "other"])
    assert pairs["objects"].to_dict() == {("a", "b"): 7, ("a", "c"): 5, ("b", "c"): 6}
    np.testing.assert_allclose(pairs["ratio"], [1 / 1.5, 1 / 3, 1.5 / 3])
    # As all ratios are the same, those that are not known are known from the others.
    for name in ("relative", "low", "high"):
        np.testing.assert_allclose(made.table[name], whole.table[name], rtol=1e-9)
    apart = {"x": of_powers({"a": 1, "b": 2}, 1.0), "y": of_powers({"c": 1, "d": 2}, 1.0)}
    # Objects that no run has come to yet, perhaps because it left them out, tell nothing of the others.
    refusal = r"no objects can serve to compare the methods a, b, c, d \(x/c: no distance of c; x/d: .*; y/a: "
    with pytest.raises(sb.errors.InputError, match=refusal):
        leagues_of(apart, ["later", *apart])


def test_methods_are_compared_by_any_number() -> None:
    def with_lengths(scale: float) -> pd.DataFrame:
        rows = pd.concat(of_powers({"a": 1, "b": 2}, 1.0).assign(order=order) for order in (-2.0, -4.0))
        lengths = scale * np.where(rows["family"] == "a", 3.0, 1.0) * rows["triangles"] ** -0.5
        return rows.assign(
            hausdorff=lengths, hausdorff_upper=1.01 * lengths, rms=lengths / 9, bias=-lengths, fscore=0.5
        )

    tables = {f"{i}": with_lengths(scale) for i, scale in enumerate((1.0, 20.0, 0.3, 7.0, 0.6, 4.0))}
    for y, error in (("hausdorff", 0.01), ("rms", 0.0), ("bias", 0.0)):
        made = ranked(tables, y=y)
        assert made.table["method"].tolist() == ["b", "a"]
        (pair,) = made.pairs.to_dict("records")
        assert (pair["ratio"], pair["nearer"]) == (pytest.approx(3.0), "b")
        assert np.log(pair["high"] / pair["low"]) == pytest.approx(4 * error, rel=0.02, abs=1e-9)
        text = format_league([made])
        assert f"League by {y}, over 6 objects" in text
        assert f"b has 3 times less {y} than a" in text
        assert f"Numbers ({y} in unit length of the files) are" in " ".join(text.split())
        assert sb.plot.league(made).get_ylabel() != sb.plot.league(ranked(tables, y="hausdorff_upper")).get_ylabel()
    for y in ("fscore", "colour", "mesh", "order"):
        with pytest.raises(sb.errors.InputError, match=f"less is better is named '{y}'; known are .*hausdorff, "):
            ranked(tables, y=y)


def test_the_picture_has_order_and_interval_of_the_table_and_every_mesh() -> None:
    tables = {f"{i}": of_powers({"a": 1.5 + 0.1 * i, "b": 1.0}, scale) for i, scale in enumerate((1.0, 5.0, 0.2))}
    made = ranked(tables)
    axes = sb.plot.league(made)
    dots = np.concatenate([np.asarray(line.get_xydata()) for line in axes.lines if line.get_marker() == "."])
    meshes = pd.concat(tables.values())[["triangles", "relative"]].to_numpy()
    np.testing.assert_allclose(np.sort(dots, axis=0), np.sort(meshes, axis=0))
    # Methods that keep their ratio to each other at all sizes have intervals as wide as those of the table.
    bands = [np.asarray(one.get_paths()[0].vertices) for one in axes.collections if one.get_alpha()]
    ends = [band[band[:, 0] == band[:, 0].max(), 1] for band in bands]
    np.testing.assert_allclose([end.max() / end.min() for end in ends], made.table["high"] / made.table["low"])
    assert axes.get_legend_handles_labels()[1] == made.table["method"].tolist()


def test_methods_that_no_object_connects_with_most_are_left_out_and_named() -> None:
    tables = {name: of_powers({"a": 1, "b": 2, "far": 3}, 1.0) for name in "xy"}
    for frame in tables.values():
        frame.loc[frame["family"] == "far", "triangles"] *= 1000
    tables["z"] = of_powers({"c": 1, "far": 2}, 1.0)
    made = ranked({**tables, "w": of_powers({"a": 1, "d": 2}, 1.0)})
    assert (made.methods, made.objects) == (("a", "b", "d"), ("x", "y", "w"))
    assert [*made.left_out][:2] == ["method far", "method c"]
    assert "method far is left out: no object connects it with the methods that are compared." in format_league([made])


def test_methods_may_be_chosen_and_must_be_known() -> None:
    one = of_powers({"a": 1}, 1.0)
    alone = ranked({"x": POWERS, "y": one}, methods="a")
    assert alone.objects == ("x", "y")
    # Without another method, nothing is said of ranks and pairs.
    assert ["pairs" in str(made) for made in (alone, ranked({"x": POWERS}))] == [False, True]
    with pytest.raises(
        sb.errors.InputError, match=r"compare the methods a, b \(y: no distance of b; w: no distance of a\)"
    ):
        ranked({"y": one, "w": of_powers({"b": 1}, 1.0)})
    with pytest.raises(sb.errors.InputError, match="no method is named 'c'; known are a, b"):
        ranked({"x": POWERS}, methods=["c"])


def test_meshes_of_nearly_one_size_are_compared_and_have_no_rate() -> None:
    near = method_rows({"a": {1000: 1.0}, "b": {1100: 2.0}})
    made = ranked({"x": near, "z": near})
    assert made.pairs["ratio"].item() == pytest.approx(0.5)
    assert made.table["rate"].isna().all()
    steep = method_rows({"a": {1000: 1.0, 1001: 0.5}, "b": {1000: 1.0, 1001: 0.5}})
    np.testing.assert_allclose(ranked({"x": POWERS, "steep": steep}).table["rate"], 2.0)


def test_large_numbers_are_whole_ones_and_factors_are_told_from_1() -> None:
    rows = POWERS.assign(tool=np.where(POWERS["family"] == "a", 1e6, 1.0004e6) / POWERS["triangles"])
    text = format_league([ranked({f"{i}": rows.assign(tool=2.0**i * rows["tool"]) for i in range(6)}, y="tool")])
    assert "a has 1.0004 times less tool than b" in text
    assert not re.search(r"\de\+\d", text)
    assert re.search(r"^a +1 +\d{2},\d{3} ", text, re.M)


def test_objects_are_named_with_the_orders_that_leave_them_out() -> None:
    exact = method_rows({"a": dict.fromkeys(SIZES, 1e-8), "b": {n: 1.0 / n for n in SIZES}})
    every, some = ranked({"x": POWERS, "box": POWERS}), ranked({"x": POWERS, "box": exact})
    assert "box is left out at order -2: a reproduced it" in format_league([every, some])
    assert "box is left out: a reproduced it" in format_league([some, some])


def test_pairs_of_the_nearest_method_are_told_first() -> None:
    rows = of_powers({"a": 4, "b": 2, "c": 1}, 1.0)
    told = re.findall(
        r"^(.) is (.) times nearer than (.)", format_league([ranked(dict.fromkeys("123456789", rows))]), re.M
    )
    assert told == [("c", "4", "a"), ("c", "2", "b"), ("b", "2", "a")]


def test_few_objects_are_said_to_be_too_few() -> None:
    one, five, six = (ranked({f"{i}": POWERS for i in range(count)}) for count in (1, 5, 6))
    assert "The test cannot tell 2 methods from chance with 5 objects; take 6 or more." in format_league([five])
    assert "a is 2 times nearer than b" in format_league([six])
    assert one.table[["low", "high"]].isna().all(axis=None)
    assert one.table[["rank", "last_rank"]].to_numpy().tolist() == [[1, 2], [1, 2]]
    assert one.pairs["nearer"].item() == ""


def test_nothing_is_extrapolated_from_two_meshes_of_about_one_size() -> None:
    close = method_rows({"a": {1000: 0.0100, 1001: 0.0102}, "b": {1150: 0.0100}})
    made = ranked(dict.fromkeys("stuvwxyz", close))
    assert made.table.set_index("method").loc["a", "relative"] == pytest.approx(0.0102)


def test_meshes_of_one_size_all_count() -> None:
    tables = method_rows({"a": {1000: 0.01}, "b": {1000: 0.015}})
    more = [tables[tables["family"] == "a"].assign(relative=0.03)] * 2
    made = ranked(dict.fromkeys("stuvwxyz", pd.concat([tables, *more], ignore_index=True)))
    assert made.table["method"].tolist() == ["b", "a"]
    assert made.table["relative"].iloc[1] == pytest.approx((0.01 * 0.03 * 0.03) ** (1 / 3))


def test_intervals_are_those_of_student() -> None:
    values = np.random.default_rng(1).normal(2.0, 0.3, 12)
    known = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    made = interval(values, np.full(12, 0.05))
    assert made == pytest.approx([values.mean(), known.low - 0.05, known.high + 0.05])


def test_the_permutation_test_is_that_of_another_library() -> None:
    differences = np.random.default_rng(2).normal(0.4, 1.0, 10)
    known = stats.permutation_test(
        (differences,), np.sum, permutation_type="samples", n_resamples=10_000, alternative="two-sided"
    )
    assert sign_flip_test(differences, np.zeros(10)) == pytest.approx(known.pvalue)


def test_errors_make_p_the_largest_that_they_allow() -> None:
    rng = np.random.default_rng(4)
    differences, errors = rng.normal(1.0, 0.5, 6), np.full(6, 0.1)
    bound = sign_flip_test(differences, errors)
    for signs in product((-1.0, 0.0, 1.0), repeat=6):
        assert sign_flip_test(differences + np.array(signs) * errors, np.zeros(6)) <= bound


def test_many_objects_are_tried_at_random_and_p_is_never_zero() -> None:
    p = sign_flip_test(np.ones(40), np.zeros(40))
    assert 0 < p < 1e-3


def test_what_objects_differ_by_does_not_widen_intervals() -> None:
    rng = np.random.default_rng(5)
    noise = 0.1 * rng.standard_normal((2000, 3))
    spread = within_objects(noise + 10 * rng.standard_normal((2000, 1)))
    np.testing.assert_allclose(spread, 0.1, rtol=0.05)


def priced(distances: Mapping[str, Mapping[int, float]], errors: float = 0.0, label: str = "{:g}") -> pd.DataFrame:
    """Return the table of an object from the distances of methods by the seconds that they took."""
    rows = method_rows(distances, errors).rename(columns={"triangles": "make_seconds"})
    return rows.assign(mesh=[f"{row.family}/{label.format(row.make_seconds)}" for row in rows.itertuples()])


def by_cost(tables: Mapping[str, pd.DataFrame], x: str = "make_seconds") -> CostLeague:
    methods = list(dict.fromkeys(name for frame in tables.values() for name in frame["family"]))
    (made,) = cost_leagues_of(tables, [*tables, "later"], methods, x)
    return made


# No times in common: the slow method is worth its time at its end alone.
QUICK, SLOW = {1: 0.4, 2: 0.2, 3: 0.3}, {10: 0.25, 20: 0.1}


def test_the_front_of_an_object_is_what_no_mesh_beats_in_both() -> None:
    made = by_cost({"cow": priced({"quick": QUICK, "slow": SLOW})})
    assert made.meshes.loc[made.meshes["front"], "mesh"].tolist() == ["quick/1", "quick/2", "slow/20"]
    assert not made.meshes["undecided"].any()
    assert made.table["best"].tolist() == ["1, 2", "20"]
    assert made.left_out == {"later": "it has no tables; the command status tells why"}


def test_no_object_costs_a_look_at_the_meshes_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    tables = {f"cow {number}": priced({"quick": QUICK}) for number in range(20)}
    iterate, looked = pd.Series.__iter__, list[object]()

    def noted(column: Any) -> Any:
        looked.append(column.name)
        return iterate(column)

    monkeypatch.setattr(pd.Series, "__iter__", noted)
    assert len(by_cost(tables).objects) == 20
    assert looked.count("object") < 5


@pytest.mark.parametrize("seed", range(5))
def test_fronts_are_those_of_all_pairs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Small integers, so that many costs and distances are equal.
    costs, distances = rng.integers(1, 8, 40).astype(float), rng.integers(1, 8, 40).astype(float)
    errors = rng.choice([0.0, 0.3, 1.2], 40)
    frame = method_rows({"a": dict(enumerate(distances, 1))}).assign(make_seconds=costs, relative_error=errors)

    def unbeaten(own: np.ndarray, others: np.ndarray) -> list[bool]:
        return [
            not any(
                (costs[j] <= costs[i] and others[j] < own[i]) or (costs[j] < costs[i] and others[j] <= own[i])
                for j in range(40)
                if j != i
            )
            for i in range(40)
        ]

    meshes = by_cost({"cow": frame}).meshes
    assert meshes["front"].tolist() == unbeaten(distances, distances)
    worst, best = (unbeaten(distances + sign * errors, distances - sign * errors) for sign in (1, -1))
    assert meshes["undecided"].tolist() == [low != high for low, high in zip(worst, best, strict=True)]


def test_objects_count_the_fronts_of_a_method_and_its_members() -> None:
    bell = priced({"quick": {1: 0.4, 3: 0.3}, "slow": {20: 0.05, 10: 0.06}, "unpriced": {1: 0.01}})
    tables = {
        "cow": priced({"quick": QUICK, "slow": SLOW}),
        "egg": priced({"quick": QUICK, "slow": {10: 0.15, 20: 0.16}}),
        "bell": bell.assign(make_seconds=bell["make_seconds"].where(bell["family"] != "unpriced")),
    }
    made = by_cost(tables)
    assert made.table[["method", "front", "objects"]].to_numpy().tolist() == [["quick", 3, 3], ["slow", 3, 3]]
    assert made.table["best"].tolist() == ["1 (3), 2 (2), 3 (1)", "20 (2), 10 (2)"]
    # The bell lacks a member, and a time of another method.
    assert made.means["member"].tolist() == ["1", "3", "10", "20"]
    assert made.means.set_index("member").loc["20", "relative"] == pytest.approx((0.1 * 0.16 * 0.05) ** (1 / 3))
    assert made.means["fronts"].tolist() == [3, 1, 2, 2]
    assert made.left_out["unpriced"] == "no mesh has a distance and make_seconds"
    text = format_cost_leagues([made])
    assert "bell: quick/1, quick/3, slow/10, slow/20" in text
    assert "unpriced is left out" in text
    assert "20,000" in format_cost_leagues([by_cost({"cow": priced({"slow": {20_000: 0.1}})})])
    assert format_cost_leagues([made], "csv").startswith("order,object,method,member,mesh,make_seconds,relative")


def test_the_errors_of_means_hold_all_that_those_of_the_objects_allow() -> None:
    errors, rng = {"cow": 0.3, "egg": 0.01, "bell": 0.9}, np.random.default_rng(1)
    tables = {name: priced({"quick": {1: 0.4}}).assign(relative_error=0.4 * error) for name, error in errors.items()}
    made = by_cost(tables).means.iloc[0]
    shares = 1 + np.array([*errors.values()]) * np.vstack([rng.uniform(-1, 1, (50, 3)), *product((-1, 1), repeat=3)])
    gaps = abs(0.4 * shares.prod(axis=1) ** (1 / 3) - made["relative"])
    assert gaps.max() <= made["relative_error"] * (1 + 1e-12) <= 0.4
    unknown = {**tables, "egg": tables["egg"].assign(relative_error=np.nan)}
    assert np.isnan(by_cost(unknown).means.iloc[0]["relative_error"])


def test_an_object_that_is_reproduced_has_no_part_in_means_by_cost() -> None:
    tables = {name: priced({"quick": {1: 0.03}, "slow": {2: 0.01}}) for name in ("cow", "egg")}
    cube = {"cube": priced({"quick": {1: 0.02}, "slow": {2: 1e-9}}).assign(relative_error=1e-5)}
    made = by_cost({**tables, **cube})
    assert made.means["relative"].to_numpy() == pytest.approx([0.03, 0.01])
    assert made.means["fronts"].tolist() == [3, 3]
    assert by_cost(cube).means["member"].tolist() == ["1", "2"]


def test_names_that_hold_the_object_are_members_of_all_objects() -> None:
    tables = {name: priced({"quick": QUICK}, label=name + "_{:g}") for name in ("cow", "egg")}
    assert by_cost(tables).means["member"].tolist() == ["{object}_1", "{object}_2", "{object}_3"]
    shared = {name: priced({"quick": QUICK}, label="1{:g}") for name in ("1", "2")}
    assert by_cost(shared).means["member"].tolist() == ["11", "12", "13"]


@pytest.mark.parametrize(
    ("x", "message"),
    [
        ("edge_length", "edge_length falls where meshes get finer, so it is no cost; take triangles"),
        ("colour", "no size of meshes is named 'colour'; known are edge_length, triangles, make_seconds"),
        ("make_seconds", "no mesh has both a distance and make_seconds; name another cost, such as triangles"),
    ],
)
def test_a_cost_that_nothing_has_is_refused(x: str, message: str) -> None:
    with pytest.raises(sb.errors.InputError, match=message):
        by_cost({"cow": POWERS.assign(make_seconds=np.nan)}, x)


def test_the_plot_by_cost_has_all_members_and_their_front() -> None:
    tables = {"cow": priced({"quick": QUICK, "slow": SLOW}), "egg": priced({"quick": QUICK, "slow": {20: 0.1}})}
    axes = sb.plot.league(by_cost(tables))
    lines = {str(line.get_label()): np.asarray(line.get_xydata()) for line in axes.lines}
    np.testing.assert_allclose(lines["quick"], [[1, 0.4], [2, 0.2], [3, 0.3]])
    np.testing.assert_allclose(lines["front"], [[1, 0.4], [2, 0.2], [20, 0.1]])
    assert [text.get_text() for text in axes.texts] == ["1", "2", "20"]
    assert axes.get_title().endswith("not drawn: 1 member that not all objects have")
    assert axes.get_xlabel() == "time of making the mesh in seconds"


def test_a_place_without_a_store_is_not_taken_for_one_of_one_object(tmp_path: Path) -> None:
    with pytest.raises(sb.errors.StoreError, match=r"none\.zarr: it does not exist"):
        sb.league(tmp_path / "none.zarr")
