"""Texts and tables of a report, from stores and tables put together by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from sobolev_batch.extras.report.content import convergence_table
from sobolev_batch.tables.conclusion import VERDICT_COLUMNS, study_verdict
from sobolev_batch.tables.convergence import table


def cells(tree: xr.DataTree, order: float) -> list[dict[str, str]]:
    """Return the texts of the rows of one order, by column."""
    made = convergence_table(tree, table(tree), ("f_1", "reference"), 100)
    # Where a narrow screen shows them.
    assert [column.name for column in made.columns[:3]] == ["mesh", "relative", "triangles"]
    (rows,) = (rows for s, _, rows in made.bodies if s == order)
    return [{**{column.name: column.text(row) for column in made.columns}, "mark": row["mark"]} for row in rows]


def test_columns_and_marks(near: xr.DataTree, tree: xr.DataTree) -> None:
    first, second, _ = cells(near, -10.0)
    assert (first["hausdorff"], first["chamfer"]) == ("0.2500 to 0.2525", "0.125 ± 0.001")
    assert second["hausdorff"] == second["chamfer"] == ""
    assert "chamfer" not in cells(tree, -10.0)[0]
    above, unresolved, _ = cells(tree, -2.5)
    assert (above["mark"], above["area_fraction"]) == ("above rtol", "36 %")
    assert (unresolved["mark"], unresolved["area_fraction"]) == ("below its error", "")


# Family, triangles and relative distance of each mesh.
Meshes = list[tuple[str, int, float]]


def frame(meshes: Meshes, error: float = 1e-3, **changes: Any) -> pd.DataFrame:
    """Return rows of a table, with errors as fractions of the distances."""
    rows = [
        {
            "order": -2.0, "mesh": f"{family}/{triangles}", "family": family, "triangles": triangles,
            "distance": 4 * relative, "error": 4 * error * relative, "relative": relative,
            "relative_error": error * relative, "resolved": error < 1, "within": True, **changes,
        }
        for family, triangles, relative in meshes
    ]  # fmt: skip
    made = pd.DataFrame(rows)
    made.attrs = {"reference": "reference"}
    return made


def verdict_on(made: pd.DataFrame, failed: dict[str, str] | None = None) -> tuple[str, dict[str, list[str]], str]:
    """Return the sentence at the first order, the texts of its rows, and what the table leaves out."""
    sentences, rows, omitted = study_verdict(made, failed or {})
    columns = [one for one in VERDICT_COLUMNS[1:] if one.name != "hausdorff" or "hausdorff" in made]
    texts = {
        row["verdict"]: [row["absent"]] if "absent" in row else [column.text(row) for column in columns] for row in rows
    }
    return sentences[0], texts, omitted


def test_the_nearest_mesh_of_each_size_and_the_smallest_below_bounds() -> None:
    meshes = [("a", 100, 0.2), ("b", 110, 0.1), ("a", 400, 0.02), ("b", 390, 0.04), ("b", 4000, 0.005)]
    sentence, rows, omitted = verdict_on(frame(meshes))
    assert sentence == (
        "b is nearest at 1 of 2 sizes, a is nearest at 1 of 2 sizes, at order −2. "
        "Of 5 meshes, b/4000 is nearest to the reference at order −2: it differs by 0.5000\xa0%\xa0±\xa00.0005\xa0%."
    )
    assert rows["100 to 110 triangles"] == [
        "b/110",
        "10.00 % ± 0.01 %",
        "110",
        "2 times nearer than a/100 of 100 triangles",
    ]
    assert rows["390 to 400 triangles"][0] == "a/400"
    assert not any("4,000" in label for label in rows)
    assert rows["below 5 %: a"][:3] == ["a/400", "2.000 % ± 0.002 %", "400"]
    assert rows["below 5 %: b"][0] == "b/390"
    assert rows["below 1 %: a"] == ["none; a/400 has 2.000 % ± 0.002 %"]
    assert rows["below 1 %: b"][0] == "b/4000"
    assert omitted == ""


def test_few_meshes_and_surfaces_without_triangles() -> None:
    sentence, rows, _ = verdict_on(frame([("a", 100, 0.2)]))
    assert sentence == "a/100 differs from the reference by 20.00\xa0%\xa0±\xa00.02\xa0% at order −2."
    assert rows["nearest of all"] == ["a/100", "20.00 % ± 0.02 %", "100", ""]
    # One family has no sizes, and what has no triangles has none.
    _, rows, _ = verdict_on(frame([("a", 100, 0.2), ("a", 105, 0.04)]))
    assert list(rows) == ["nearest of all", "below 5 %: a", "below 1 %: a"]
    _, rows, _ = verdict_on(frame([("a", 0, 0.1), ("b", 0, 0.2)]))
    assert rows == {"nearest of all": ["a/0", "10.00 % ± 0.01 %", "", "2 times nearer than b/0"]}


def test_the_largest_deviation_of_the_nearest_mesh_is_told_in_the_unit_of_the_files() -> None:
    made = frame([("a", 100, 0.2), ("a", 400, 0.04)])
    made["hausdorff"], made["hausdorff_upper"], made.attrs["unit"] = [0.5, 0.25], [0.505, 0.2525], "mm"
    sentence, rows, _ = verdict_on(made)
    assert sentence.endswith(" The largest deviation of a/400 is 0.2500\xa0to\xa00.2525\xa0mm.")
    assert rows["below 5 %: a"] == ["a/400", "4.000 % ± 0.004 %", "400", "0.2500 to 0.2525", ""]
    # It may not be known of every mesh.
    made.loc[1, ["hausdorff", "hausdorff_upper"]] = np.nan
    sentence, rows, _ = verdict_on(made)
    assert "deviation" not in sentence
    assert rows["nearest of all"][3] == ""


def test_errors_that_leave_a_place_open_are_said() -> None:
    pair = [("a", 100, 0.2), ("b", 100, 0.21)]
    sentence, rows, _ = verdict_on(frame(pair, error=0.1))
    assert sentence.endswith("and the errors leave open whether b/100 is nearer.")
    assert rows["100 triangles"][-1] == "errors leave open b/100"
    sentence, rows, _ = verdict_on(frame(pair, error=2.0))
    assert sentence == "No distance to the reference is above its error at order −2: the meshes may be equal to it."
    assert rows["nearest of all"] == ["no distance is above its error"]
    _, rows, _ = verdict_on(frame(pair, within=False))
    assert rows["above rtol"] == ["a/100, b/100"]


def test_a_mesh_that_equals_the_reference_is_nearest() -> None:
    made = frame([("a", 100, 0.0), ("b", 100, 1.03), ("b", 400, 0.7)], error=0.03)
    made.loc[0, ["error", "relative_error", "resolved"]] = 8e-10, 2e-10, False
    sentence, rows, _ = verdict_on(made)
    assert sentence.startswith(
        "a is nearest at the same size, at order −2. Of 3 meshes, a/100 is nearest to the reference"
    )
    assert "open" not in sentence
    assert rows["100 triangles"] == ["a/100", "0 % ± 2 × 10⁻⁸ %", "100", "below its error, nearer than b/100"]
    # Another one may be as near.
    made.loc[2, ["distance", "error", "resolved"]] = 0.4, 0.5, False
    sentence, rows, _ = verdict_on(made)
    assert sentence.endswith("and the errors leave open whether b/400 is nearer.")
    assert rows["nearest of all"][-1] == "errors leave open b/400"
    made.loc[1, "error"] = np.nan
    sentence, _, _ = verdict_on(made)
    assert sentence.endswith("whether one of b/400, b/100 is nearer.")


def test_the_first_sentence_compares_meshes_of_one_size() -> None:
    meshes = [("a", 100, 0.2), ("b", 100, 0.5), ("a", 400, 0.02), ("b", 400, 0.06), ("b", 4000, 0.005)]
    sentence, _, _ = verdict_on(frame(meshes))
    assert sentence.startswith("a is nearest at each of 2 sizes, 2.5 to 3 times nearer than the next, at order −2. ")
    # A mesh that is finer and nearer is better only if it is nearer by more than its triangles explain.
    assert verdict_on(frame([("a", 118, 0.2), *meshes[1:]]))[0].startswith("a is nearest at each of 2 sizes, 2.5 to 3 ")
    assert verdict_on(frame([("a", 118, 0.4), *meshes[1:]]))[0].startswith("a is nearest at 1 of 2 sizes, ")
    for more, less in (("a", "b"), ("b", "a")):
        only = [(more, 266, 0.2), (less, 230, 0.201)]
        assert verdict_on(frame(only, error=1e-6))[0].startswith(f"Of 2 meshes, {more}/266 is nearest")
    fewer = [("a", 266, 0.201), ("b", 230, 0.2)]
    assert verdict_on(frame(fewer, error=1e-6))[0].startswith("b is nearest at the same size, 1.005 times nearer than ")
    # The errors of the small ones leave open which is nearer.
    made = frame(meshes)
    made.loc[[0, 1], "error"] = 4.0
    sentence, _, _ = verdict_on(made)
    assert sentence.startswith("a is nearest at 1 of 2 sizes, at order −2. Of 5 meshes, b/4000 ")
    made.loc[[2, 3], "error"] = 4.0
    assert verdict_on(made)[0].startswith("Of 5 meshes, b/4000 ")


def test_the_nearest_of_all_is_compared_with_its_like() -> None:
    meshes = [("a", 10240, 0.01), ("b", 5120, 0.03)]
    _, rows, _ = verdict_on(frame(meshes))
    assert rows["nearest of all"][-1] == "3 times nearer than b/5120 of 5,120 triangles"
    _, rows, _ = verdict_on(frame([*meshes, ("b", 10000, 0.05)]))
    assert rows["nearest of all"][-1] == "5 times nearer than b/10000 of 10,000 triangles"
    _, rows, _ = verdict_on(frame([*meshes, ("c", 0, 0.02)]))
    assert rows["nearest of all"][-1] == "2 times nearer than c/0"


def test_failures_only() -> None:
    nothing = dict.fromkeys(("distance", "error", "relative", "relative_error"), np.nan)
    made = frame([("a", 0, 0.1)] * 5, resolved=False, within=False, **nothing)
    sentence, rows, _ = verdict_on(made, {f"a/{i}": "no triangles" for i in range(5)})
    assert sentence == "No mesh could be compared with the reference."
    assert rows == {"nearest of all": ["no distance is known"], "missing": ["a/0, a/1, a/2 and 2 more"]}


def test_hundreds_of_meshes_are_summed_up() -> None:
    meshes = [(f"f{i}", 100 * 2**k, 1 / 2**k + i / 1000) for i in range(20) for k in range(10)]
    _, rows, omitted = verdict_on(frame(meshes))
    assert len(rows) < 25
    assert omitted == "8 of 10 sizes and 6 of 20 families"
