"""The account of a study that a report gives: what was asked, what came out, of which meshes, by what."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import tomli_w
import xarray as xr

from sobolev_batch.batch.study.study import REFERENCE_LABEL
from sobolev_batch.results.status import Status
from sobolev_batch.results.tables.convergence import convergence_frame, finished_group, has_proximity
from sobolev_batch.results.tables.formatting import Digits
from sobolev_batch.spectral.lattice import Lattice

# Lines of a page in all; browsers become slow beyond.
_MOST_LINES = 10_000
_MOST_MESHES = 5_000
_LONGEST_VALUE = 300


@dataclass(frozen=True)
class Cell:
    """One cell of a table.

    Attributes:
        text: as it is shown.
        key: what it is sorted by: a number or a text; None comes last.
        mark: what has to be said of it, in a word.
    """

    text: str
    key: float | str | None = None
    mark: str = ""

    @classmethod
    def count(cls, value: int) -> Cell:
        """A whole number."""
        return cls(f"{value:,}", value)

    @classmethod
    def words(cls, text: str) -> Cell:
        """A text, which may be empty."""
        return cls(text, text or None)

    @classmethod
    def number(cls, value: float, text: str | None = None, mark: str = "") -> Cell:
        """A number; nothing where it is NaN."""
        return cls(f"{value:.4g}" if text is None else text, value, mark) if math.isfinite(value) else cls("")


@dataclass(frozen=True)
class Line:
    """A mesh in a table.

    Attributes:
        label: of the mesh.
        family: the number of its family, for its colour.
        status: "complete", "failed" or "missing".
        cells: the other columns.
    """

    label: str
    family: int
    status: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class OrderTable:
    """Convergence at one order.

    Attributes:
        order: as it is shown.
        lines: meshes.
    """

    order: str
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Account:
    """All that a report says in words and tables; every text is as it was found and still to be escaped.

    Attributes:
        title: of the study.
        name: of the study.
        reference: its label.
        families: names.
        asked: what was asked for, by keyword.
        summary: key figures, by keyword.
        orders: each as it is shown.
        tables: of convergence, one per order.
        meshes: sizes and times of each, in lines of `mesh_columns`.
        left_out: how many meshes the tables leave out, of convergence and of sizes.
        failed: the reason of each mesh that failed, or is missing.
        not_compared: what was asked of each mesh besides that could not be had, and why.
        accuracy: the rtol that was asked for, None where it was not.
        has_proximity: whether lines of `tables` end with Hausdorff and Chamfer distances.
        run: the latest run, by keyword.
        versions: by library.
        study_text: the study as TOML.
        store: where the store is.
    """

    title: str
    name: str
    reference: str
    families: tuple[str, ...]
    asked: Mapping[str, str]
    summary: Mapping[str, str]
    orders: tuple[str, ...]
    tables: tuple[OrderTable, ...]
    meshes: tuple[Line, ...]
    left_out: tuple[int, int]
    failed: Mapping[str, str]
    not_compared: Mapping[str, str]
    accuracy: float | None
    has_proximity: bool
    run: Mapping[str, str]
    versions: Mapping[str, str]
    study_text: str
    store: str

    @classmethod
    def of(cls, tree: xr.DataTree, status: Status) -> Account:
        """The account of an open store.

        Raises:
            InputError: the store has no tables yet.
        """
        meshes, convergence = finished_group(tree, "meshes"), finished_group(tree, "convergence")
        attributes: Mapping[str, Any] = {str(key): value for key, value in tree.attrs.items()}
        families = tuple(dict.fromkeys(meshes["family"].values.tolist()))
        orders = tuple(minus(f"{order:g}") for order in convergence["order"].values.tolist())
        tables, left_out = _tables(tree, families)
        lines = tuple(_mesh_lines(meshes, families))
        study = attributes["study"]
        return cls(
            title=attributes["title"],
            name=study["name"],
            reference=convergence.attrs["reference"],
            families=families,
            asked=dict(_asked(attributes, meshes)),
            summary=dict(_summary(meshes, convergence, orders)),
            orders=orders,
            tables=tables,
            meshes=lines[:_MOST_MESHES],
            left_out=(left_out, max(0, len(lines) - _MOST_MESHES)),
            failed=_failures(meshes),
            not_compared=status.not_compared,
            accuracy=convergence.attrs.get("rtol"),
            has_proximity=has_proximity(tree),
            run=dict(_run(status)),
            versions=attributes["versions"],
            study_text=study_text(study["table"]),
            store=status.store,
        )


def minus(text: str) -> str:
    """A number with a minus sign as wide as a digit."""
    return text.replace("-", "−")


def moment(text: str) -> str:
    """A time of a record, in UTC, for people."""
    return text.replace("T", " ").removesuffix("Z")


def study_text(table: Mapping[str, Any]) -> str:
    """The study file of a study as it was written, up to comments and layout."""
    return tomli_w.dumps(_without_nothing(table))


def _without_nothing(value: Any) -> Any:
    """TOML has no null; what is not given is left out."""
    if isinstance(value, Mapping):
        return {key: _without_nothing(entry) for key, entry in value.items() if entry is not None}
    return [_without_nothing(entry) for entry in value] if isinstance(value, list) else value


def _tables(tree: xr.DataTree, families: tuple[str, ...]) -> tuple[tuple[OrderTable, ...], int]:
    frame = convergence_frame(tree)
    groups = [(order, lines) for order, lines in frame.groupby("order", sort=False)]
    most = max(1, _MOST_LINES // max(1, len(groups)))
    tables = tuple(
        OrderTable(minus(f"{order:g}"), tuple(_line(line, families) for line in lines[:most].to_dict(orient="records")))
        for order, lines in groups
    )
    return tables, max((len(lines) - most for _, lines in groups), default=0) if len(groups[0][1]) > most else 0


def _line(line: Mapping[str, Any], families: tuple[str, ...]) -> Line:
    about = line["mesh"], families.index(line["family"]), line["status"]
    if line["status"] != "complete":
        return Line(*about, (Cell(line["status"]),))
    distance = Digits.of(line["distance"], line["error"])
    relative = Digits.of(line["relative"], line["relative_error"])
    rate = Digits.of(line["rate"], line["rate_error"])
    mark = "" if line["within"] else "above rtol"
    area = math.nan if not line["distance"] else (line["area_part"] / line["distance"]) ** 2
    cells: tuple[Cell, ...] = (
        Cell.count(line["triangles"]) if line["triangles"] else Cell(""),
        Cell.number(line["edge_length"]),
        Cell.number(line["distance"], distance.value, mark if line["resolved"] else "below its error"),
        Cell.number(line["error"], distance.error),
        Cell.number(line["relative"], relative.together),
        Cell.number(line["rate"], rate.together),
        Cell.number(area, f"{100 * area:.1f} %"),
    )
    if "hausdorff" in line:
        chamfer = Digits.of(line["chamfer"], line["chamfer_error"])
        cells = (
            *cells,
            Cell.number(line["hausdorff"], f"{line['hausdorff']:.3g}"),
            Cell.number(line["chamfer"], chamfer.together),
        )
    return Line(*about, cells)


def _mesh_lines(meshes: xr.Dataset, families: tuple[str, ...]) -> Iterator[Line]:
    columns = {name: meshes[name].values.tolist() for name in meshes.data_vars}
    for i, label in enumerate(meshes["mesh"].values.tolist()):
        about = {name: values[i] for name, values in columns.items()}
        is_mesh = about["triangles"] > 0
        counts = {
            name: Cell.count(about[name]) if is_mesh else Cell("")
            for name in ("vertices", "triangles", "points", "boundary_edges", "nonmanifold_edges")
        }
        cells = (
            counts["vertices"],
            counts["triangles"],
            Cell.number(about["seconds"], f"{about['seconds']:.2f}"),
            Cell.words(about["backend"]),
            Cell.number(about["area"]),
            counts["boundary_edges"],
            counts["nonmanifold_edges"],
            counts["points"],
            Cell.words(about["worker"]),
            Cell.words(moment(about["finished"])),
        )
        yield Line(label, families.index(about["family"]), about["status"], cells)


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
    triangles = int(meshes["triangles"].values.sum())
    yield "triangles in all", _rounded(triangles)
    yield "computing time", _span(float(np.nansum(meshes["seconds"].values)))


def _rounded(count: int) -> str:
    for size, unit in ((1e9, "billion"), (1e6, "million")):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count:,}"


def _span(seconds: float) -> str:
    for unit, size in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds:.3g} s"


def _asked(attributes: Mapping[str, Any], meshes: xr.Dataset) -> Iterator[tuple[str, str]]:
    study, table = attributes["study"], attributes["study"]["table"]
    similarity = attributes["similarity"]
    lattice = Lattice(**study["lattice"])
    own = 1 / similarity["scale"]
    of = meshes["family"].values.tolist()
    for family in table["family"]:
        yield f"family {family['name']}", f"{_counted(of.count(family['name']))}: {_described(family)}"
    described = _described(table["reference"])
    yield "reference", described if study["reference"] == REFERENCE_LABEL else f"{study['reference']}: {described}"
    if "accuracy" in table:
        yield "accuracy", f"rtol {table['accuracy']['rtol']:g} of every distance to the reference"
        for reason in (study.get("choice") or {}).get("reasons", ()):
            yield "chosen", reason
    yield (
        "lattice",
        f"frequencies up to {lattice.xi_max:.6g} cycles per unit length on each axis, {lattice.M} intervals "
        f"(spacing {lattice.spacing:.4g}): wavelengths down to {1 / lattice.xi_max:.4g} units",
    )
    eps = "" if study["eps"] is None else f", accuracy {study['eps']:g} of the nonuniform FFT"
    if table.get("witness") is not None:
        chosen = table["witness"].get("orders") or study["orders"]
        yield "witness", f"of order {minus(', '.join(f'{order:g}' for order in chosen))}, at the vertices of every mesh"
    if table.get("proximity") is not None:
        yield "proximity", "Hausdorff and Chamfer distances of every mesh to the reference"
    dtype = {"complex128": "double", "complex64": "single"}[study["dtype"]]
    yield "arithmetic", f"{dtype} precision{eps}"
    origin = ", ".join(f"{x:.6g}" for x in similarity["origin"])
    if own == 1 and not any(similarity["origin"]):
        yield "similarity", "none: lengths are in the meshes' own unit"
    else:
        yield (
            "similarity",
            minus(
                f"x ↦ {similarity['scale']:.6g} (x - ({origin})): one unit of length is {own:.6g} of the meshes' own"
            ),
        )


def _counted(count: int) -> str:
    return "1 mesh" if count == 1 else f"{count:,} meshes"


def _described(entry: Mapping[str, Any]) -> str:
    """A source and its parameters, on one line."""
    parts = [f"{key} {_value(value)}" for key, value in entry.items() if key not in ("name", "source")]
    text = ", ".join([str(entry.get("source", "")), *parts])
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 1] + "…"


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"({_described(value)})"
    if isinstance(value, list):
        return ", ".join(map(_value, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _run(status: Status) -> Iterator[tuple[str, str]]:
    yield "store", status.store
    yield "surfaces", f"{status.complete} of {status.total} complete, {len(status.failed)} failed"
    if status.run is not None:
        yield "state", status.run.state
        yield "driver", status.run.driver
        yield "begun", moment(status.run.started)
        yield "ended" if status.run.state in ("done", "failed") else "last sign of life", moment(status.run.seen)
        if status.run.error:
            yield "error", status.run.error
