"""Texts and tables of a report: the study's settings, its results, its meshes, and how to reproduce it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import tomli_w
import xarray as xr

from sobolev_batch.batch.study.study import REFERENCE_LABEL
from sobolev_batch.results.report.limits import ReportLimits
from sobolev_batch.results.status import Status
from sobolev_batch.results.tables.convergence import Column, shown_columns, shown_rows, table
from sobolev_batch.results.tables.formatting import duration, minus
from sobolev_batch.results.tables.groups import finished_group, has_proximity
from sobolev_batch.spectral.lattice import Lattice

_LONGEST_VALUE = 300


@dataclass(frozen=True)
class Cell:
    """One cell of a table.

    Attributes:
        text: Text as it is shown.
        key: Number or text that the column is sorted by; None comes last.
        mark: Short remark about the number.
    """

    text: str
    key: float | str | None = None
    mark: str = ""

    @classmethod
    def of_count(cls, value: int) -> Cell:
        """Return the cell of a whole number."""
        return cls(f"{value:,}", value)

    @classmethod
    def of_text(cls, text: str) -> Cell:
        """Return the cell of a text, which may be empty."""
        return cls(text, text or None)

    @classmethod
    def of_number(cls, value: float, text: str | None = None, mark: str = "") -> Cell:
        """Return the cell of a number, empty for NaN."""
        return cls(f"{value:.4g}" if text is None else text, value, mark) if math.isfinite(value) else cls("")


@dataclass(frozen=True)
class TableRow:
    """A mesh in a table.

    Attributes:
        label: Label of the mesh.
        family: Number of its family, for its colour.
        status: "complete", "failed" or "missing".
        cells: Other columns.
    """

    label: str
    family: int
    status: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class OrderTable:
    """Convergence at one order.

    Attributes:
        order: Order as it is shown.
        rows: Meshes.
    """

    order: str
    rows: tuple[TableRow, ...]


@dataclass(frozen=True)
class Content:
    """Texts and tables of a report, none of them escaped.

    Attributes:
        title: Title of the study.
        reference: Label of its reference.
        settings: Settings of the study, by keyword.
        summary: Key figures, by keyword.
        orders: Orders as they are shown.
        columns: Headings of the convergence tables, after that of the meshes.
        tables: Convergence tables, one for each order.
        meshes: Sizes and times of each mesh.
        omitted: Number of meshes that the tables of convergence and of sizes leave out.
        failed: Reason for each mesh that failed or is missing.
        not_compared: Comparisons of each mesh that could not be made, and why.
        rtol: Accuracy that the study asks for, or None.
        has_proximity: True if the tables end with Hausdorff and Chamfer distances.
        run: Facts about the latest run, by keyword.
        versions: Versions, by library.
        study_text: Study as TOML.
    """

    title: str
    reference: str
    settings: Mapping[str, str]
    summary: Mapping[str, str]
    orders: tuple[str, ...]
    columns: tuple[str, ...]
    tables: tuple[OrderTable, ...]
    meshes: tuple[TableRow, ...]
    omitted: tuple[int, int]
    failed: Mapping[str, str]
    not_compared: Mapping[str, str]
    rtol: float | None
    has_proximity: bool
    run: Mapping[str, str]
    versions: Mapping[str, str]
    study_text: str

    @classmethod
    def of(cls, tree: xr.DataTree, status: Status, limits: ReportLimits) -> Content:
        """Return the content for an open store.

        Raises:
            InputError: The store has no tables yet.
        """
        meshes, convergence = finished_group(tree, "meshes"), finished_group(tree, "convergence")
        attributes: Mapping[str, Any] = {str(key): value for key, value in tree.attrs.items()}
        families = tuple(dict.fromkeys(meshes["family"].values.tolist()))
        orders = tuple(minus(f"{order:g}") for order in convergence["order"].values.tolist())
        tables, omitted = _tables(tree, families, limits.convergence_rows)
        rows = tuple(_mesh_rows(meshes, families))
        return cls(
            title=attributes["title"],
            reference=convergence.attrs["reference"],
            settings=dict(_settings(attributes, meshes)),
            summary=dict(_summary(meshes, convergence, orders)),
            orders=orders,
            columns=tuple(column.heading for column in shown_columns(tree)),
            tables=tables,
            meshes=rows[: limits.mesh_rows],
            omitted=(omitted, max(0, len(rows) - limits.mesh_rows)),
            failed=_failures(meshes),
            not_compared=status.not_compared,
            rtol=convergence.attrs.get("rtol"),
            has_proximity=has_proximity(tree),
            run=dict(_run(status)),
            versions=attributes["versions"],
            study_text=study_text(attributes["study"]["table"]),
        )


def utc_text(time: str) -> str:
    """Return a time of a record, in UTC, for people."""
    return time.replace("T", " ").removesuffix("Z")


def study_text(table: Mapping[str, Any]) -> str:
    """Return the study file of a study, without its comments and layout."""
    return tomli_w.dumps(_without_nulls(table))


def _without_nulls(value: Any) -> Any:
    """TOML has no null; keys without a value are left out."""
    if isinstance(value, Mapping):
        return {key: _without_nulls(entry) for key, entry in value.items() if entry is not None}
    return [_without_nulls(entry) for entry in value] if isinstance(value, list) else value


def _tables(tree: xr.DataTree, families: tuple[str, ...], most_rows: int) -> tuple[tuple[OrderTable, ...], int]:
    """Return the table of each order, and how many meshes they leave out."""
    groups = list(table(tree).groupby("order", sort=False))
    most = max(1, most_rows // max(1, len(groups)))
    columns = shown_columns(tree)
    tables = tuple(
        OrderTable(
            minus(f"{order:g}"), tuple(_convergence_row(row, columns, families) for row in shown_rows(rows[:most]))
        )
        for order, rows in groups
    )
    return tables, max((len(rows) - most for _, rows in groups if len(rows) > most), default=0)


def _convergence_row(row: Mapping[str, Any], columns: Sequence[Column], families: tuple[str, ...]) -> TableRow:
    if row["status"] != "complete":
        cells = [Cell(row["status"])]
    else:
        cells = [
            Cell.of_number(row[column.name], column.page.format_map(row), row["mark"].page if column.is_marked else "")
            for column in columns
        ]
    return TableRow(row["mesh"], families.index(row["family"]), row["status"], tuple(cells))


def _mesh_rows(meshes: xr.Dataset, families: tuple[str, ...]) -> Iterator[TableRow]:
    for row in meshes.reset_coords().to_dataframe().reset_index().to_dict(orient="records"):
        counts = {
            name: Cell.of_count(row[name]) if row["triangles"] > 0 else Cell("")
            for name in ("vertices", "triangles", "points", "boundary_edges", "nonmanifold_edges")
        }
        cells = (
            counts["vertices"],
            counts["triangles"],
            Cell.of_number(row["seconds"], f"{row['seconds']:.2f}"),
            Cell.of_text(row["backend"]),
            Cell.of_number(row["area"]),
            counts["boundary_edges"],
            counts["nonmanifold_edges"],
            counts["points"],
            Cell.of_text(row["worker"]),
            Cell.of_text(utc_text(row["finished"])),
        )
        yield TableRow(row["mesh"], families.index(row["family"]), row["status"], cells)


def _failures(meshes: xr.Dataset) -> dict[str, str]:
    columns = (meshes[name].values.tolist() for name in ("mesh", "status", "reason"))
    return {
        label: reason or "not computed" for label, status, reason in zip(*columns, strict=True) if status != "complete"
    }


def _summary(meshes: xr.Dataset, convergence: xr.Dataset, orders: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    status = meshes["status"].values
    others = meshes["mesh"].values != convergence.attrs["reference"]
    done = int((status[others] == "complete").sum())
    yield "meshes compared", f"{done:,} of {int(others.sum()):,}"
    yield "orders" if len(orders) > 1 else "order", ", ".join(orders) if len(orders) < 5 else f"{len(orders)}"
    yield "triangles in all", _large_count(int(meshes["triangles"].values.sum()))
    yield "computing time", duration(float(np.nansum(meshes["seconds"].values)))


def _large_count(count: int) -> str:
    for size, unit in ((1e9, "billion"), (1e6, "million")):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count:,}"


def _settings(attributes: Mapping[str, Any], meshes: xr.Dataset) -> Iterator[tuple[str, str]]:
    study, table = attributes["study"], attributes["study"]["table"]
    lattice = Lattice(**study["lattice"])
    families = meshes["family"].values.tolist()
    for family in table["family"]:
        count = families.count(family["name"])
        yield f"family {family['name']}", f"{count:,} {'mesh' if count == 1 else 'meshes'}: {_source_text(family)}"
    reference = _source_text(table["reference"])
    yield "reference", reference if study["reference"] == REFERENCE_LABEL else f"{study['reference']}: {reference}"
    if "accuracy" in table:
        yield "accuracy", f"rtol {table['accuracy']['rtol']:g} of every distance to the reference"
        for reason in (study.get("choice") or {}).get("reasons", ()):
            yield "chosen", reason
    yield (
        "lattice",
        f"frequencies up to {lattice.xi_max:.6g} cycles per unit length on each axis, {lattice.M} intervals "
        f"(spacing {lattice.spacing:.4g}): wavelengths down to {1 / lattice.xi_max:.4g} units",
    )
    octaves = study.get("octaves")
    if octaves is not None:
        highest = octaves["cutoff"] * 2 ** len(octaves["octaves"])
        yield (
            "octaves",
            f"{len(octaves['octaves'])} beyond the lattice, at random frequencies up to {highest:.4g} cycles per unit "
            f"length: wavelengths down to {1 / highest:.4g} units",
        )
    if table.get("witness") is not None:
        chosen = table["witness"].get("orders") or study["orders"]
        yield (
            "witness",
            f"at the vertices of every mesh, order {minus(', '.join(f'{order:g}' for order in chosen))}; it holds the "
            f"wavelengths of the lattice, down to {1 / lattice.xi_max:.4g} units",
        )
    if table.get("proximity") is not None:
        yield "proximity", "Hausdorff and Chamfer distances of every mesh to the reference"
    dtype = {"complex128": "double", "complex64": "single"}[study["dtype"]]
    eps = "" if study["eps"] is None else f", nonuniform FFT accurate to {study['eps']:g}"
    yield "arithmetic", f"{dtype} precision{eps}"
    yield "similarity", _similarity_text(attributes["similarity"])


def _similarity_text(similarity: Mapping[str, Any]) -> str:
    scale, origin = similarity["scale"], similarity["origin"]
    if scale == 1 and not any(origin):
        return "none: lengths are in the meshes' own unit"
    point = ", ".join(f"{x:.6g}" for x in origin)
    return minus(f"x ↦ {scale:.6g} (x - ({point})): one unit of length is {1 / scale:.6g} of the meshes' own")


def _source_text(entry: Mapping[str, Any]) -> str:
    """Return a source and its parameters on one line."""
    parameters = [f"{key} {_value_text(value)}" for key, value in entry.items() if key not in ("name", "source")]
    text = ", ".join([str(entry.get("source", "")), *parameters])
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 1] + "…"


def _value_text(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"({_source_text(value)})"
    if isinstance(value, list):
        return ", ".join(map(_value_text, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _run(status: Status) -> Iterator[tuple[str, str]]:
    yield "store", status.store
    yield "surfaces", f"{status.complete} of {status.total} complete, {len(status.failed)} failed"
    if status.run is not None:
        yield "state", status.run.state
        yield "driver", status.run.driver
        yield "begun", utc_text(status.run.started)
        yield "ended" if status.run.state in ("done", "failed") else "last sign of life", utc_text(status.run.seen)
        if status.run.error:
            yield "error", status.run.error
