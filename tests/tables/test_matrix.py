"""Distance matrices from a store put together by hand."""

from __future__ import annotations

import json
import re

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from sobolev_batch import matrix
from sobolev_batch.errors import InputError
from sobolev_batch.norms.estimate import PARTS
from sobolev_batch.tables import Format
from sobolev_batch.tables.matrix import format_matrix, matrix_frame
from sobolev_batch.tables.other_orders import distances_at
from tests.support.trees import tree_of


def made(count: int, failed: int = 1) -> xr.DataTree:
    """Meshes on a line, at 1, 2, 3, ..., and the reference at zero."""
    places = np.append(np.arange(1.0, count + 1), 0.0)
    places[failed] = np.nan
    return tree_of(places, [*(f"f/{i}" for i in range(count)), "reference"], {-4.0: 1.0, -2.0: 10.0})


def test_frame_becomes_the_matrix() -> None:
    frame = matrix_frame(distances_at(made(4), -2.0))
    assert frame.columns.tolist()[:4] == ["order", "mesh", "other", "distance"]
    pivoted = frame.pivot(index="mesh", columns="other", values="distance")
    public = matrix(made(4), -2.0)
    pd.testing.assert_frame_equal(public, pivoted.loc[public.index, public.columns], check_dtype=True)
    assert public.attrs == {"order": -2.0, "reference": "reference", "values": "distance"}
    assert public.loc["f/0", "f/3"] == public.loc["f/3", "f/0"] == 30.0
    assert public.loc["reference", "f/2"] == 30.0
    assert public.loc["f/0", "f/0"] == 0.0
    assert public["f/1"].isna().all()
    assert (frame["order"] == -2).all()
    assert matrix(made(4), -2.0, "error").loc["f/0", "f/3"] == 0.3
    with pytest.raises(InputError, match=r"values must be one of distance, error, .*, found 'rate'"):
        matrix(made(4), -2.0, "rate")  # type: ignore[arg-type]


def test_text_fits_a_terminal_and_has_a_table_for_each_order() -> None:
    lines = format_matrix(made(15)).splitlines()
    assert max(map(len, lines)) <= 100
    heads = [line for line in lines if line.startswith("Sobolev distances of order")]
    assert heads == [f"Sobolev distances of order {s}, in the square root of a unit length" for s in (-4, -2)]
    row = next(line for line in lines if line.startswith("4 f/3"))
    assert " ".join(row.split()) == "4 f/3 3.00 ± 0.03 missing 1.00 ± 0.01"


@pytest.mark.parametrize("style", ["text", "markdown", "latex"])
def test_people_get_per_cents_of_the_reference(style: Format) -> None:
    tree = made(4)
    columns = {"norm": (("mesh", "order"), np.full((5, 2), 50.0)), "error": (("mesh", "order"), np.full((5, 2), 0.5))}
    norms = xr.Dataset(columns, coords={"mesh": tree["meshes"]["mesh"], "order": [-4.0, -2.0]})
    text = format_matrix(xr.DataTree.from_dict({**tree.to_dict(), "/norms": norms}), style, [-4.0])
    assert "Sobolev distances of order -4, in % of the norm of reference" in text
    # 3 of 50, and (0.03 + 0.06 * 0.5)/49.5 = 0.0012.
    assert re.search(r"5 reference[ |&]+2\.00 ± 0\.05[ |&]+missing[ |&]+6\.0 ± 0\.2", text)
    # Programs get the distances themselves.
    assert matrix(tree, -4.0).loc["reference", "f/2"] == 3.0


def test_programs_get_lines_of_pairs() -> None:
    with pytest.raises(InputError, match=r"25 meshes is too large to be read as text.*--format csv"):
        format_matrix(made(24))
    assert len(format_matrix(made(24), "csv", [-4.0]).splitlines()) == 1 + 25**2
    lines = format_matrix(made(3), "csv").splitlines()
    assert lines[0] == "order,mesh,other,distance,error,truncation,aliasing,discretisation,statistical"
    assert len(lines) == 1 + 2 * 4 * 4
    assert "-4.0,f/0,f/1,,,,,," in lines
    records = json.loads(format_matrix(made(3), "json", [-4.0]))
    pair = {"order": -4.0, "mesh": "f/0", "other": "f/2"}
    assert records[2] == {**pair, "distance": 2.0, "error": 0.02, "truncation": 0.02, **dict.fromkeys(PARTS[1:], 0.0)}
    assert records[1]["distance"] is None


def test_distances_to_the_reference_alone() -> None:
    tree = made(4)
    tree["distances"] = xr.DataTree(tree["distances"].to_dataset().sel(other=["reference"]))
    assert len(matrix_frame(distances_at(tree, -4.0))) == 5
    assert "\n3 f/2        3.00 ± 0.03\n" in format_matrix(tree, "text", [-4.0])


@pytest.mark.parametrize("style", ["text", "markdown", "latex"])
def test_every_mesh_has_its_name(style: Format) -> None:
    text = format_matrix(made(15, failed=3), style)
    assert text.count("Sobolev distances of order") == 2
    for number, label in enumerate([*(f"f/{i}" for i in range(15)), "reference"], 1):
        assert re.search(rf"(^|\W){number} {label}\b", text, re.MULTILINE), label
