"""The tables of a study as datasets: of the meshes, and of their norms, distances and observed rates.

In the order of tables, families are as in the study, and the meshes of each from coarse to fine.
"""

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, Literal

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.arrays import Reals
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.norms.columns import VARIABLES, Columns, dataset_of, describe
from sobolev_batch.norms.estimate import AREA_AND_SHAPE, NormEstimate
from sobolev_batch.norms.rates import observed_rates
from sobolev_batch.sources.names import natural_key
from sobolev_batch.sources.programs import Cost
from sobolev_batch.store.layout import NUMERICS
from sobolev_batch.store.records import Facts, Record
from sobolev_batch.store.workspace import Workspace
from sobolev_batch.study.plan import Row
from sobolev_batch.study.study import Study
from sobolev_batch.tables.evaluator import Evaluator
from sobolev_batch.tables.stored_spectra import chunks_of_spectra, read_spectra

Criterion = Literal["level", "triangles", "names", "time"]
# A row, its place in its family, and what orders that.
Placed = tuple[int, int, Criterion]

# Least factor between numbers of triangles in a family that goes from coarse to fine: edges then differ by a tenth.
_SMALLEST_STEP = 1.2
# Meshes of about one size in such a family, on average.
_MOST_OF_ONE_SIZE = 10

# Columns of the table of meshes that all tables have as coordinates, besides times and other metadata.
_COORDINATES = (
    *("family", "name", "is_reference", "level", "status"),
    *("vertices", "triangles", "edge_length_mean", "seconds"),
)
_SOME_COORDINATES = {"time", *(item.name for item in fields(Cost))}
FROM_COARSE_TO_FINE = ("level", "triangles")


def table_order(workspace: Workspace) -> list[Placed]:
    """Return the rows of the study in the order of tables, each with its place in its family and what orders that."""
    complete, families = workspace.complete, {row.family: list[int]() for row in workspace.plan.rows}
    for i, row in workspace.rows.items():
        families[row.family].append(i)
    placed: list[Placed] = []
    for family, numbers in families.items():
        rows = [workspace.rows[i] for i in numbers]
        counts = {i: complete[i].facts.triangles for i in numbers if i in complete}
        criterion = _criterion(workspace.plan.study, family, rows, list(counts.values()))
        keys = {i: _key(criterion, workspace.rows[i], counts.get(i)) for i in numbers}
        placed += ((i, rank, criterion) for rank, i in enumerate(sorted(keys, key=keys.__getitem__)))
    return placed


def meshes_table(workspace: Workspace, placed: Sequence[Placed]) -> xr.Dataset:
    """Return the group /meshes: what is known of each mesh from the study, its place in the order, and its record."""
    numbers, ranks, criteria = zip(*placed, strict=True)
    rows, records = [workspace.rows[i] for i in numbers], [workspace.records[i] for i in numbers]
    filled = [record or Record(key="", status="failed", reason="not computed") for record in records]
    columns: dict[str, NDArray[np.generic]] = {
        "family": _strings([row.family for row in rows]),
        "name": _strings([row.member.name for row in rows]),
        "is_reference": np.array([row.label == workspace.plan.reference for row in rows]),
        "level": np.array([row.member.level for row in rows], dtype=np.int64),
        "rank": np.array(ranks, dtype=np.int64),
        "ordered_by": _strings(criteria),
        "row": np.array(numbers, dtype=np.int64),
        "status": _strings(["missing" if record is None else record.status for record in records]),
    }
    is_complete = np.array([record.status == "complete" for record in filled])
    for item in fields(Facts):
        values = [getattr(record.facts, item.name) for record in filled]
        # Nothing is known of a mesh that failed, which is not zero.
        unknown = -1 if "valid_min" in VARIABLES[item.name] else np.nan
        is_text = isinstance(item.default, str)
        columns[item.name] = _strings(values) if is_text else np.where(is_complete, values, unknown)
    if any(record.cost for record in filled):
        costs = [record.cost or Cost() for record in filled]
        columns |= {item.name: np.array([getattr(cost, item.name) for cost in costs]) for item in fields(Cost)}
    columns["seconds"] = np.array([record.seconds for record in filled])
    # numpy's times are in UTC, and know no zone.
    times_of_end = [record.finished.removesuffix("Z") or "NaT" for record in filled]
    columns["finished"] = np.array(times_of_end, dtype="datetime64[s]")
    columns[NUMERICS] = np.array([record.numerics for record in filled], dtype=np.int64)
    for name in ("reason", "remark", "worker", "backend", "key"):
        columns[name] = _strings([getattr(record, name) for record in filled])
    columns["mesh"], metadata = _strings([row.label for row in rows]), _metadata(rows)
    if any(row.member.time is not None for row in rows):
        columns["time"] = np.array([row.member.time for row in rows], dtype=np.float64)
    variables = {name: ("mesh", values) for name, values in {**columns, **metadata}.items()}
    table = xr.Dataset(variables, attrs={"metadata": list(metadata)})
    # Else xarray counts from the first of them, and no two tables have the same metadata.
    table["finished"].encoding = {"units": "seconds since 1970-01-01", "dtype": "int64"}
    # Texts have no missing value, which `where` needs of variables that are no coordinates.
    texts = [name for name, values in columns.items() if values.dtype == object]
    return describe(table.set_coords([*texts, *_COORDINATES, *sorted(_SOME_COORDINATES & columns.keys()), *metadata]))


def _metadata(rows: Sequence[Row]) -> dict[str, NDArray[np.generic]]:
    """Return the metadata of meshes by name: numbers with NaN, or texts with empty ones, where a mesh has none."""
    given = pd.DataFrame([dict(row.member.metadata) for row in rows], dtype=object)
    are_texts = given.map(lambda value: isinstance(value, str)).any()
    texts = given.where(given.notna(), "").map(str)
    return {
        name: _strings(texts[name].tolist()) if are_texts[name] else given[name].to_numpy(dtype=np.float64)
        for name in given
    }


def _strings(values: Sequence[str]) -> NDArray[np.generic]:
    # Object arrays become variable-length strings in zarr; fixed-length ones are outside its format.
    return np.array(values, dtype=object)


def _criterion(study: Study, family: str, rows: Sequence[Row], counts: Sequence[int]) -> Criterion:
    """Return what orders a family, given the numbers of triangles of its complete meshes."""
    if (chosen := next((one.order_by for one in study.object.families if one.name == family), None)) is not None:
        return chosen
    if any(row.member.time is not None for row in rows):
        return "time"
    if all(row.member.level >= 0 for row in rows):
        return "level"
    return "names" if len(counts) > 1 and not _are_graded(counts) else "triangles"


def _are_graded(counts: Sequence[int]) -> bool:
    """Tell whether meshes go from coarse to fine: scans of one object, or copies with noise, do not."""
    steps, largest = 0, 0.0
    for count in sorted(counts):
        if count > _SMALLEST_STEP * largest:
            steps, largest = steps + 1, float(count)
    # A few of other sizes may be parts of the object.
    return steps > 1 and _MOST_OF_ONE_SIZE * steps >= len(counts)


def _key(criterion: Criterion, row: Row, triangles: int | None) -> tuple[Any, ...]:
    """Return what a row is sorted by; where it is equal, names decide. A mesh that failed has no known triangles."""
    known = {"time": row.member.time, "level": row.member.level, "triangles": triangles, "names": 0}[criterion]
    return math.inf if known is None else known, natural_key(row.member.name)


def tables_from_spectra(
    evaluator: Evaluator, meshes: xr.Dataset, reference: str, accuracy: Accuracy | None
) -> tuple[NormEstimate, dict[str, xr.Dataset]]:
    """Return distances to the reference (orders, meshes), and the tables that follow from stored spectra by group.

    They are in the order of the table of meshes, with NaN where there are no numbers: in norms `norm` (mesh, order), in
    distances `distance` (mesh, other, order), whose only other is the reference, each with its error, and in
    convergence distances, relative ones and their parts, and observed orders of convergence.
    """
    norms, distances, parts, beyond = _from_spectra(evaluator, meshes["row"].values.tolist())
    at_reference = meshes.indexes["mesh"].get_loc(reference)
    families, ordered_by, sizes = (meshes[name].values for name in ("family", "ordered_by", "edge_length_mean"))
    # There are no rates in families that are not from coarse to fine.
    rates, is_ordered = np.full((2, *distances.values.shape), np.nan), np.isin(ordered_by, FROM_COARSE_TO_FINE)
    for family in dict.fromkeys(families[is_ordered].tolist()):
        members = is_ordered & (families == family)
        for k, (values, errors) in enumerate(zip(distances.values, distances.errors, strict=True)):
            rates[:, k, members] = observed_rates(values[members], errors[members], sizes[members])
    columns = {
        **distances.named("distance"),
        **distances.relative_to(NormEstimate(*norms.stacked[..., [at_reference]])),
        **dict(zip(AREA_AND_SHAPE, parts, strict=True)),
        "beyond": beyond[1],
        "rate": rates[0],
        "rate_error": rates[1],
        "resolved": distances.errors < distances.values,
        "within": np.ones_like(distances.values, dtype=bool) if accuracy is None else accuracy.met(distances),
    }
    attributes = {"reference": reference, **({} if accuracy is None else {"rtol": accuracy.rtol})}
    to_one = {name: values[:, :, None] for name, values in distances.named("distance").items()}
    other = "other", np.array([reference], dtype=object)
    return distances, {
        "norms": table_of({**norms.named("norm"), "beyond": beyond[0]}, meshes, evaluator.orders),
        "distances": describe(table_of(to_one, meshes, evaluator.orders, "mesh", "other").assign_coords(other=other)),
        "convergence": table_of(columns, meshes, evaluator.orders).assign_attrs(attributes),
    }


def _from_spectra(evaluator: Evaluator, rows: Sequence[int]) -> tuple[NormEstimate, NormEstimate, Reals, Reals]:
    """Return norms of rows, distances, the `AREA_AND_SHAPE` of these (4, orders, rows), and `Compared.beyond`."""
    arrays = [np.full((parts, len(evaluator.orders), len(rows)), np.nan) for parts in (5, 5, 4, 2)]
    places = {row: place for place, row in enumerate(rows)}
    complete, b = places.keys() & evaluator.complete, evaluator.reference
    of_reference = None if b is None else read_spectra(evaluator.store, [b]).norm
    for chunk in chunks_of_spectra(evaluator.store):
        if known := [row for row in chunk if row in complete]:
            found = evaluator.norms_of(known, read_spectra(evaluator.store, known), of_reference)
            parts = np.stack([*found.reference.area_and_shape(found.distances).values()])
            numbers = found.norms.stacked, found.distances.stacked, parts, np.stack(found.beyond)
            for array, values in zip(arrays, numbers, strict=True):
                array[..., [places[row] for row in known]] = values
    return NormEstimate(*arrays[0]), NormEstimate(*arrays[1]), arrays[2], arrays[3]


def table_of(columns: Columns, meshes: xr.Dataset, orders: Sequence[float], *dimensions: str) -> xr.Dataset:
    """Return values (orders, ...) by name over dimensions (default "mesh") and the order, as a table of meshes."""
    dimensions = dimensions or ("mesh",)
    moved = {name: np.moveaxis(values, 0, len(dimensions)) for name, values in columns.items()}
    return dataset_of(moved, (*dimensions, "order"), coordinates_of(meshes, orders).variables)


def coordinates_of(meshes: xr.Dataset, orders: Sequence[float]) -> xr.Dataset:
    """Return the coordinates that every table has, from the table of meshes."""
    names = [*_COORDINATES, *sorted(_SOME_COORDINATES & meshes.coords.keys()), *meshes.attrs.get("metadata", ())]
    coordinates = meshes.reset_coords()[names].rename(edge_length_mean="edge_length")
    axis = "order", np.array(orders, dtype=np.float64)
    return describe(xr.Dataset(coords={**coordinates.variables, "order": axis}))
