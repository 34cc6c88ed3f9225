"""Texts and tables of a report: the study's settings, its results, its meshes, and how to reproduce it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from sobolev_batch.batch.study.study import REFERENCE_LABEL
from sobolev_batch.results.report.elements import (
    PageTable,
    ReportLimits,
    large_count,
    reasons_table,
    run_facts,
    source_text,
    study_text,
    utc_text,
)
from sobolev_batch.results.report.verdict import StudyVerdict
from sobolev_batch.results.status import Status
from sobolev_batch.results.tables.convergence import page_columns, table, with_remarks
from sobolev_batch.results.tables.formatting import duration, minus
from sobolev_batch.results.tables.groups import finished_group, has_proximity, placement_doubts
from sobolev_batch.results.tables.text import Column
from sobolev_batch.spectral.lattice import Lattice


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
    def from_tree(cls, tree: xr.DataTree, status: Status, limits: ReportLimits) -> Content:
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
            verdict=StudyVerdict.from_table(frame, failed),
            convergence=convergence_table(tree, frame, families, limits.convergence_rows // len(orders)),
            meshes=_meshes_table(meshes, families, limits.mesh_rows),
            failed=reasons_table("failed", "mesh", failed),
            not_compared=reasons_table("lacking", "mesh", status.not_compared),
            doubtful=reasons_table("doubtful", "mesh", placement_doubts(tree)),
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


def convergence_table(tree: xr.DataTree, frame: pd.DataFrame, families: Sequence[str], most: int) -> PageTable:
    """Return the convergence table of an open store, from the rows of `table`, with so many of each order."""
    orders, most = frame["order"].drop_duplicates().tolist(), max(1, most)
    longest = int(frame.groupby("order").size().max())
    rows = with_remarks(frame).groupby("order", sort=False).head(most)
    rows = rows.assign(color=rows["family"].map(families.index), reasons="failed")
    return PageTable(
        "convergence", page_columns(tree), rows.to_dict(orient="records"), orders, omitted=max(0, longest - most)
    )


_COUNTS = ["vertices", "triangles", "points", "boundary_edges", "nonmanifold_edges"]
_MESH_COLUMNS = (
    Column("mesh", "mesh", kind="label"),
    Column("vertices", "vertices", "{:,}".format),
    Column("triangles", "triangles", "{:,}".format),
    Column("seconds", "seconds", "{:.2f}".format),
    Column("backend", "backend", kind="text"),
    Column("area", "area", "{:.4g}".format),
    Column("boundary_edges", "boundary edges", "{:,}".format),
    Column("nonmanifold_edges", "non-manifold", "{:,}".format),
    Column("points", "quadrature points", "{:,}".format),
    Column("worker", "worker", kind="text"),
    Column("finished", "finished, UTC", kind="text"),
)


def _meshes_table(meshes: xr.Dataset, families: Sequence[str], most: int) -> PageTable:
    frame = meshes.reset_coords().to_dataframe().reset_index()
    # Surfaces in closed form have no counts.
    rows = frame[:most].assign(
        **{name: frame[name].astype(object).where(frame["triangles"] > 0, None) for name in _COUNTS},
        color=frame["family"].map(families.index),
        finished=frame["finished"].map(utc_text),
    )
    return PageTable("meshes", _MESH_COLUMNS, rows.to_dict(orient="records"), omitted=len(frame) - len(rows))


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
