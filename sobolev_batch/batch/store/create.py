"""Preparation of a store for a run: create it, or add what the study has gained."""

from __future__ import annotations

import json
import logging
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import LOCK_KEYS
from sobolev_batch.batch.store.comparison_records import KINDS, ComparisonRecords
from sobolev_batch.batch.store.hierarchy import FIELD, LABELS, QUALITY, RECORD, RECORDS, ROOT
from sobolev_batch.batch.store.layout import Layout
from sobolev_batch.batch.store.metadata import SCHEMA_VERSION
from sobolev_batch.batch.store.store import UNFINISHED, Store
from sobolev_batch.batch.store.tables import Tables
from sobolev_batch.batch.study.plan import Plan
from sobolev_batch.errors import StoreError
from sobolev_batch.spectral.lattice import AXES
from sobolev_batch.surfaces.shapes.similarity import Similarity

_log = logging.getLogger(__name__)

_RECORDED_VERSIONS = ("sobolev-batch", "finufft", "modepy", "numpy", "scipy", "xarray", "zarr")


def require_usable(location: Location) -> None:
    """Check, without writing, that a store exists or may be created at a location.

    Raises:
        StoreError: The location cannot be read, or holds something else.
    """
    store = Store(location)
    if not store.exists():
        location.require_free(besides=LOCK_KEYS)
    elif not store.is_unfinished:
        store.attributes()


def prepare_store(location: str | Path | Location, plan: Plan) -> Store:
    """Create the store of a plan, or open it and add rows for new meshes.

    Raises:
        StoreError: The location cannot be read or written, or holds something else or the store of another study,
            which then stays as it is.
    """
    store = Store(location)
    if not store.exists():
        store.location.require_free(besides=LOCK_KEYS)
        _create(store, plan)
        return store
    if store.is_unfinished:
        _replace_everything(store, plan)
        return store
    _check_same_study(store, plan)
    store.location.remove_partial_files()
    with store.location.access("written"):
        study = store.attributes()["study"]
        if any(study[name] != value for name, value in _lattice_entry(plan).items()):
            done = sum(record is not None for record in store.records())
            _log.warning(
                "%s: another lattice follows from the study now; all of %d fields are computed again", store.path, done
            )
            _replace_everything(store, plan)
        store.repair_labels()
        _extend(store, plan)
        _repair_axes(store, plan)
        if store.attributes().get("similarity") != _similarity_entry(plan.similarity):
            # Tables are in another unit of length, and the run may end before there are others.
            Tables(store).invalidate()
        store.documents[""]["attributes"].update(_attributes(plan))
        # Written even if nothing changed: a location that cannot be written must fail before tasks start.
        store.consolidate()
    return store


def _replace_everything(store: Store, plan: Plan) -> None:
    """Remove everything that was computed and create the arrays for another lattice."""
    _mark_unfinished(store, plan)
    store.location.remove_partial_files()
    for name in sorted(store.location.names() - {*LOCK_KEYS, ROOT}):
        store.location.remove(name)
    _create(store, plan)


def _mark_unfinished(store: Store, plan: Plan) -> None:
    """Declare the content of the store invalid, since this process may be killed before it has created the arrays."""
    attributes = {"title": plan.study.title, "schema_version": SCHEMA_VERSION, UNFINISHED: True}
    store.location.write({ROOT: json.dumps(_root(attributes)).encode()})


def _create(store: Store, plan: Plan) -> None:
    labels = np.array([row.label for row in plan.rows], dtype=object)
    rows = len(labels)
    layout = Layout()
    layout.add_array(
        FIELD,
        plan.choice.dtype,
        (rows, *plan.lattice.shape),
        (1, *plan.blocks[0].shape),
        ("mesh", *AXES),
        long_name="Fourier transform of the area measure, xi_z >= 0 half",
        # xarray makes coordinates of what `coordinates` names, which then stay with a selected field.
        coordinates="quality",
    )
    layout.add_array(QUALITY, str, (rows,), (rows,), ("mesh",))
    units = {"units": "cycles per unit length"}
    axes = {name: (name, axis, units) for name, axis in zip(AXES, plan.lattice.axes, strict=True)}
    layout.add_dataset("fourier", xr.Dataset(coords={**axes, "mesh": labels}))
    layout.add_array(RECORD, str, (rows,), (1,), ("mesh",))
    _mark_unfinished(store, plan)
    store.documents = {"": _root(_attributes(plan))}
    store.publish({**layout.keys("fourier"), **layout.keys(RECORDS)})
    store.consolidate()


def _root(attributes: dict[str, Any]) -> dict[str, Any]:
    return {"zarr_format": 3, "node_type": "group", "attributes": attributes}


def _repair_axes(store: Store, plan: Plan) -> None:
    """Write damaged coordinates of the lattice again: nothing can be selected without them."""
    for name, axis in zip(AXES, plan.lattice.axes, strict=True):
        array = store.array(f"fourier/{name}")
        try:
            is_intact = np.array_equal(array[...], axis)
        except ValueError:
            is_intact = False
        if not is_intact:
            array[...] = axis


def _check_same_study(store: Store, plan: Plan) -> None:
    study = store.attributes()["study"]
    # A chosen lattice may be chosen anew; a given one is part of the study.
    may_change = plan.study.accuracy is not None and study.get("choice")
    comparisons = [("the study", repr(study["name"]), repr(plan.study.name))]
    if not may_change:
        planned = _lattice_entry(plan)["lattice"]
        comparisons += [
            ("a lattice of", _describe(study["lattice"]), _describe(planned)),
            ("dtype", repr(study["dtype"]), repr(plan.choice.dtype)),
        ]
    differences = [f"{what} {old}, not {new}" for what, old, new in comparisons if old != new]
    removed = set(store.labels()) - {row.label for row in plan.rows}
    if removed:
        differences.append(f"meshes that this study lacks, such as {min(removed)!r}")
    if differences:
        raise StoreError(
            f"{store.path}: a store of another study is there, with {'; '.join(differences)}. "
            "Name another store, or remove this one"
        )


def _extend(store: Store, plan: Plan) -> None:
    """Append rows for meshes that the study has gained."""
    labels = store.labels()
    existing = set(labels)
    added = [row.label for row in plan.rows if row.label not in existing]
    if not added:
        return
    rows = len(labels) + len(added)
    for name in (RECORD, FIELD, QUALITY, LABELS):
        store.resize(name, (rows, *store.array(name).shape[1:]))
    # Empty qualities are written too, since a missing chunk counts as lost.
    for name, values in ((QUALITY, [""] * len(added)), (LABELS, added)):
        store.array(name)[len(labels) :] = np.array(values, dtype=object)
    for records in (ComparisonRecords(store, kind) for kind in KINDS):
        # xarray cannot read arrays of one group together that differ along `mesh`.
        if store.has(records.name):
            records.create(rows)


def _attributes(plan: Plan) -> dict[str, Any]:
    """Return the attributes of the root of the store of a plan."""
    study = plan.study
    return {
        "title": study.title,
        "schema_version": SCHEMA_VERSION,
        "study": {
            "name": study.name,
            **_lattice_entry(plan),
            "eps": None if study.accuracy else study.transform.eps,
            "choice": plan.choice.to_table() if study.accuracy else None,
            "orders": list(study.orders),
            "reference": plan.reference,
            "table": dict(study.table),
        },
        "similarity": _similarity_entry(plan.similarity),
        "versions": {name: version(name) for name in _RECORDED_VERSIONS},
    }


def _describe(lattice: dict[str, Any]) -> str:
    return f"xi_max {lattice['xi_max']:.6g} and M {lattice['M']}"


def _lattice_entry(plan: Plan) -> dict[str, Any]:
    return {"lattice": {"xi_max": plan.lattice.xi_max, "M": plan.lattice.M}, "dtype": plan.choice.dtype}


def _similarity_entry(similarity: Similarity) -> dict[str, Any]:
    return {"scale": similarity.scale, "origin": list(similarity.origin)}
