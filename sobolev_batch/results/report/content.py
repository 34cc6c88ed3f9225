"""Texts and tables of a report: the study's settings, its results, its meshes, and how to reproduce it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import tomli_w
import xarray as xr

from sobolev_batch.batch.study.study import REFERENCE_LABEL
from sobolev_batch.results.report.cells import Body, Cell, Heading, PageTable, TableRow
from sobolev_batch.results.report.limits import ReportLimits
from sobolev_batch.results.report.verdict import StudyVerdict
from sobolev_batch.results.status import Status
from sobolev_batch.results.tables.convergence import ERRORS, Column, shown_columns, shown_rows, table
from sobolev_batch.results.tables.doubts import doubts_of
from sobolev_batch.results.tables.formatting import duration, minus
from sobolev_batch.results.tables.groups import finished_group, has_proximity
from sobolev_batch.spectral.lattice import Lattice

_LONGEST_VALUE = 300


@dataclass(frozen=True)
class Content:
    """Texts and tables of a report, none of them escaped.

    Attributes:
        title: Title of the study.
        name: Name of the study, for names of files.
        reference: Label of its reference.
        settings: Settings of the study, by keyword.
        summary: Key figures, by keyword.
        orders: Orders as they are shown.
        verdict: Verdict on the study.
        convergence: Convergence tables of all orders.
        meshes: Sizes and times of each mesh.
        failed: Reason for each mesh that failed or is missing.
        not_compared: Comparisons of each mesh that could not be made, and why.
        doubtful: Why one doubts that a mesh can be compared with the reference.
        rtol: Accuracy that the study asks for, or None.
        has_proximity: True if the tables end with Hausdorff and Chamfer distances.
        run: Facts about the latest run, by keyword.
        versions: Versions, by library.
        study_text: Study as TOML.
    """

    title: str
    name: str
    reference: str
    settings: Mapping[str, str]
    summary: Mapping[str, str]
    orders: tuple[str, ...]
    verdict: StudyVerdict
    convergence: PageTable
    meshes: PageTable
    failed: PageTable | None
    not_compared: PageTable | None
    doubtful: PageTable | None
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
        frame, failed = table(tree), _failures(meshes)
        return cls(
            title=attributes["title"],
            name=attributes["study"]["table"]["study"]["name"],
            reference=convergence.attrs["reference"],
            settings=dict(_settings(attributes, meshes)),
            summary=dict(_summary(meshes, convergence, orders)),
            orders=orders,
            verdict=StudyVerdict.of(frame, failed),
            convergence=convergence_table(tree, frame, families, limits.convergence_rows // len(orders)),
            meshes=_meshes_table(meshes, families, limits.mesh_rows),
            failed=PageTable.of_reasons("failed", "mesh", failed),
            not_compared=PageTable.of_reasons("lacking", "mesh", status.not_compared),
            doubtful=PageTable.of_reasons("doubtful", "mesh", doubts_of(tree)),
            rtol=convergence.attrs.get("rtol"),
            has_proximity=has_proximity(tree),
            run=dict(run_facts(status)),
            versions=attributes["versions"],
            study_text=study_text(attributes["study"]["table"]),
        )

    @property
    def omissions(self) -> tuple[str, ...]:
        """Notes on what the tables leave out."""
        tables = {"distances": self.convergence, "meshes and timings": self.meshes}
        cut = (f"the table of {name}: {table.omitted:,} more meshes" for name, table in tables.items() if table.omitted)
        return (*cut, *([f"verdict: only {self.verdict.omitted} are shown"] if self.verdict.omitted else []))


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


def convergence_table(tree: xr.DataTree, frame: pd.DataFrame, families: Sequence[str], most: int) -> PageTable:
    """Return the convergence table of an open store, from the rows of `table`, with so many of each order."""
    # The relative distance comes first: a narrow screen shows no more without scrolling.
    columns = sorted(shown_columns(tree), key=lambda column: not column.is_marked)
    headings = (
        Heading("mesh", "mesh", "label"),
        *(Heading(column.header, column.name, second=ERRORS.get(column.name, "")) for column in columns),
    )
    groups = [(float(order), rows) for order, rows in frame.groupby("order", sort=False)]
    most = max(1, most)
    bodies = tuple(
        Body(tuple(_convergence_row(row, columns, families) for row in shown_rows(rows[:most])), order)
        for order, rows in groups
    )
    longest = max(len(rows) for _, rows in groups)
    return PageTable("convergence", headings, bodies, omitted=max(0, longest - most))


def _convergence_row(row: Mapping[str, Any], columns: Sequence[Column], families: Sequence[str]) -> TableRow:
    family = families.index(row["family"])
    if row["status"] != "complete":
        return TableRow(row["mesh"], (Cell(row["status"]),), family, reasons="failed")
    cells = (
        Cell.of_number(
            row[column.name],
            column.cell(row),
            row["mark"].page if column.is_marked else "",
            row.get(ERRORS.get(column.name, ""), math.nan),
        )
        for column in columns
    )
    return TableRow(row["mesh"], tuple(cells), family)


def _meshes_table(meshes: xr.Dataset, families: Sequence[str], most: int) -> PageTable:
    headings = (
        Heading("mesh", "mesh", "label"),
        Heading("vertices", "vertices"),
        Heading("triangles", "triangles"),
        Heading("seconds", "seconds"),
        Heading("backend", "backend", "text"),
        Heading("area", "area"),
        Heading("boundary edges", "boundary_edges"),
        Heading("non-manifold", "nonmanifold_edges"),
        Heading("quadrature points", "points"),
        Heading("worker", "worker", "text"),
        Heading("finished, UTC", "finished", "text"),
    )
    frame = meshes.reset_coords().to_dataframe().reset_index()
    rows = tuple(_mesh_row(row, families) for row in frame[:most].to_dict(orient="records"))
    return PageTable("meshes", headings, (Body(rows),), omitted=len(frame) - len(rows))


def _mesh_row(row: Mapping[str, Any], families: Sequence[str]) -> TableRow:
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
    return TableRow(row["mesh"], cells, families.index(row["family"]))


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
    yield "triangles in all", large_count(int(meshes["triangles"].values.sum()))
    yield "computing time", duration(float(np.nansum(meshes["seconds"].values)))


def large_count(count: int) -> str:
    """Return a count in words where it is large."""
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
        yield f"family {family['name']}", f"{count:,} {'mesh' if count == 1 else 'meshes'}: {source_text(family)}"
    reference = source_text(table["reference"])
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


def source_text(entry: Mapping[str, Any]) -> str:
    """Return a source and its parameters on one line."""
    parameters = [f"{key} {_value_text(value)}" for key, value in entry.items() if key not in ("name", "source")]
    text = ", ".join([str(entry.get("source", "")), *parameters])
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 1] + "…"


def _value_text(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"({source_text(value)})"
    if isinstance(value, list):
        return ", ".join(map(_value_text, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def run_facts(status: Status) -> Iterator[tuple[str, str]]:
    """Yield facts about the latest run, by keyword."""
    yield "store", status.store
    yield "surfaces", f"{status.complete} of {status.total} complete, {len(status.failed)} failed"
    if status.run is not None:
        yield "state", status.run.state
        yield "driver", status.run.driver
        yield "begun", utc_text(status.run.started)
        yield "ended" if status.run.state in ("done", "failed") else "last sign of life", utc_text(status.run.seen)
        if status.run.error:
            yield "error", status.run.error
