"""Preparation of a store for a run: create it, or add what the study has gained."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import LOCK_KEYS
from sobolev_batch.batch.store.hierarchy import (
    FIELD,
    LABELS,
    OCTAVE_LABELS,
    OCTAVES,
    OCTAVES_GROUP,
    QUALITY,
    RECORD,
    RECORDS,
    ROOT,
)
from sobolev_batch.batch.store.layout import Layout
from sobolev_batch.batch.store.metadata import SCHEMA_VERSION
from sobolev_batch.batch.store.store import REMOVED, UNFINISHED, Store
from sobolev_batch.batch.store.tables import Tables
from sobolev_batch.batch.study.plan import Plan
from sobolev_batch.errors import DamageError, StoreError
from sobolev_batch.spectral.lattice import AXES
from sobolev_batch.spectral.octaves.tail_sampling import TailSampling
from sobolev_batch.surfaces.shapes.similarity import Similarity

_log = logging.getLogger(__name__)

_GROUPS_OF_FIELDS = ("fourier", OCTAVES_GROUP, RECORDS)
_RECORDED_VERSIONS = ("sobolev-batch", "finufft", "modepy", "numpy", "scipy", "xarray", "zarr")


def require_usable(location: Location) -> None:
    """Check, without writing, that a store exists or may be created at a location.

    Raises:
        StoreError: The location cannot be read, or holds something else.
    """
    store = Store(location)
    try:
        is_there = store.exists()
    except DamageError:
        # See `prepare_store`.
        return
    if not is_there:
        location.require_free(besides=LOCK_KEYS)
    elif not store.is_unfinished:
        store.attributes()


def prepare_store(location: str | Path | Location, plan: Plan) -> Store:
    """Create the store of a plan, or open it and add rows for new meshes.

    Rows of meshes that the study has lost stay. If one has come back under another name, it gets this name.

    Raises:
        StoreError: The location cannot be read or written, or holds something else or the store of another study,
            which then stays as it is.
    """
    store = Store(location)
    try:
        is_there = store.exists()
    except DamageError as damage:
        store, is_there = _with_new_root(store.location, plan, damage), True
    if not is_there:
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
        if any(study.get(name) != value for name, value in _lattice_entry(plan).items()):
            done = sum(record is not None for record in store.records())
            _log.warning(
                "%s: another lattice follows from the study now; all of %d fields are computed again", store.path, done
            )
            _replace_everything(store, plan)
        store.repair_labels()
        _rename(store, plan)
        _extend(store, plan)
        _repair_axes(store, plan)
        if store.attributes().get("similarity") != _similarity_entry(plan.similarity):
            # Tables are in another unit of length, and the run may end before there are others.
            Tables(store).invalidate()
        store.documents[""]["attributes"].update(_attributes(plan, store.labels()))
        # Written even if nothing changed: a location that cannot be written must fail before tasks start.
        store.consolidate()
    return store


def _with_new_root(location: Location, plan: Plan, damage: DamageError) -> Store:
    """Return a store whose metadata at the root are damaged, with new ones that follow from its arrays and the plan.

    Its tables are left out: they are made again.

    Raises:
        DamageError: The fields are not those of the plan's study, as far as that can be told.
    """
    store = Store.of_nodes(location, _GROUPS_OF_FIELDS)
    store.documents[""] = _root({})
    keys = {row.key for row in plan.rows}
    field = store.documents.get(FIELD, {})
    is_known = field and RECORD in store.documents and field["shape"][1:] == list(plan.lattice.shape)
    if not is_known or not any(record is not None and record.key in keys for record in store.records()):
        raise DamageError(
            f"{location}: {ROOT}, the metadata at the root, is damaged, and no field of this study is found in the "
            "store to make it again from; name another store, or remove this one",
            damage.what,
        )
    _log.warning("%s: the metadata at the root are damaged, and are made again with the tables", store.path)
    for name in [name for name, document in store.documents.items() if document["node_type"] == "array"]:
        if name not in (FIELD, OCTAVES) and not name.startswith(f"{RECORDS}/"):
            store.digest_stored(name)
    store.documents[""] = _root(_attributes(plan, store.labels()))
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
    if plan.tail is not None:
        layout.add_array(
            OCTAVES,
            plan.choice.dtype,
            (rows, plan.tail.size),
            (1, plan.tail.size),
            ("mesh", "sample"),
            long_name="Fourier transform of the area measure, beyond the lattice",
            description="the sum of weight (1 + |xi|²)^s |octaves|² is the tail of a squared norm to the last octave",
        )
        layout.add_dataset(OCTAVES_GROUP, xr.Dataset(coords={**_sample_columns(plan.tail), "mesh": labels}))
    _mark_unfinished(store, plan)
    store.documents = {"": _root(_attributes(plan, labels.tolist()))}
    groups = ("fourier", RECORDS, *([OCTAVES_GROUP] if plan.tail is not None else []))
    store.publish({key: content for group in groups for key, content in layout.keys(group).items()})
    store.consolidate()


def _sample_columns(tail: TailSampling) -> dict[str, tuple[str, NDArray[Any], dict[str, str]]]:
    """Return the coordinates of the samples of octaves."""
    units = {"units": "cycles per unit length"}
    columns = {name: ("sample", column, units) for name, column in zip(AXES, tail.frequencies.T, strict=True)}
    columns["weight"] = ("sample", tail.weights, {"long_name": "weight in the integral over all frequencies"})
    meanings = {
        "octave": "number of the octave, from 1",
        "lattice": "number of the random lattice in the octave; -1 for drawn samples",
        "sublattice": "number of the sublattice in the lattice; -1 for drawn samples",
    }
    labels = tail.labels()
    return columns | {name: ("sample", labels[name], {"long_name": meaning}) for name, meaning in meanings.items()}


def _root(attributes: dict[str, Any]) -> dict[str, Any]:
    return {"zarr_format": 3, "node_type": "group", "attributes": attributes}


def _repair_axes(store: Store, plan: Plan) -> None:
    """Write damaged coordinates of the lattice and of octaves again: nothing can be selected without them.

    Raises:
        StoreError: Octaves were sampled at other frequencies than this program would draw.
    """
    axes = {f"fourier/{name}": axis for name, axis in zip(AXES, plan.lattice.axes, strict=True)}
    columns = {} if plan.tail is None else _sample_columns(plan.tail)
    axes |= {f"{OCTAVES_GROUP}/{name}": values for name, (_, values, _) in columns.items()}
    for name, axis in axes.items():
        try:
            stored = np.asarray(store.read(name, ...))
        except DamageError:
            stored = None
        # Of a deleted array the fill values are left: NaN, or zeros for whole numbers.
        if stored is None or np.isnan(stored).any() or not stored.any():
            store.write(name, ..., axis)
        elif not np.allclose(stored, axis, rtol=1e-9, atol=1e-12):
            if name.startswith("fourier"):
                store.write(name, ..., axis)
                continue
            raise StoreError(
                f"{store.path}: its octaves were sampled at other frequencies than this version of NumPy draws; use "
                "the versions that the attributes of the store name, or name another store"
            )


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
        old, new = study.get("octaves"), plan.choice.octaves
        if old != new:
            first, second = (str(len(table["octaves"])) if table else "none" for table in (old, new))
            comparisons.append(("octaves:", first, second if first != second else f"{second} others"))
    differences = [f"{what} {old}, not {new}" for what, old, new in comparisons if old != new]
    if differences:
        raise StoreError(
            f"{store.path}: a store of another study is there, with {'; '.join(differences)}. "
            "Name another store, or remove this one"
        )


def _rename(store: Store, plan: Plan) -> None:
    """Give rows of meshes that the study has lost the labels of new meshes with the same fields."""
    labels, planned = list(store.labels()), {row.label: row for row in plan.rows}
    lost = [i for i, label in enumerate(labels) if label not in planned]
    added = {row.key: row.label for label, row in planned.items() if row.key and label not in set(labels)}
    if not lost or not added:
        return
    records = store.records()
    renamed = False
    for i in lost:
        record = records[i]
        if record is not None and record.status == "complete" and record.key in added:
            labels[i], renamed = added.pop(record.key), True
    if renamed:
        store.write_labels(labels)


def _extend(store: Store, plan: Plan) -> None:
    """Append rows for meshes that the study has gained."""
    labels = store.labels()
    existing = set(labels)
    added = [row.label for row in plan.rows if row.label not in existing]
    if not added:
        return
    rows = len(labels) + len(added)
    of_octaves = (OCTAVES, OCTAVE_LABELS) if store.has_octaves else ()
    for name in (RECORD, FIELD, QUALITY, LABELS, *of_octaves):
        store.resize(name, (rows, *store.array(name).shape[1:]))
    # Empty qualities are written too, since a missing chunk counts as lost.
    for name, values in ((QUALITY, [""] * len(added)), *((name, added) for name in (LABELS, *of_octaves[1:]))):
        store.write(name, slice(len(labels), None), np.array(values, dtype=object))


def _attributes(plan: Plan, labels: Sequence[str]) -> dict[str, Any]:
    """Return the attributes of the root of the store of a plan with some rows."""
    study, planned = plan.study, {row.label for row in plan.rows}
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
        REMOVED: [label for label in labels if label not in planned],
        "similarity": _similarity_entry(plan.similarity),
        "versions": {name: version(name) for name in _RECORDED_VERSIONS},
    }


def _describe(lattice: dict[str, Any]) -> str:
    return f"xi_max {lattice['xi_max']:.6g} and M {lattice['M']}"


def _lattice_entry(plan: Plan) -> dict[str, Any]:
    lattice = {"xi_max": plan.lattice.xi_max, "M": plan.lattice.M}
    return {"lattice": lattice, "dtype": plan.choice.dtype, "octaves": plan.choice.octaves}


def _similarity_entry(similarity: Similarity) -> dict[str, Any]:
    return {"scale": similarity.scale, "origin": list(similarity.origin)}
