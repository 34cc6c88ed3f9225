"""Preparing a store for a run: laying it out, or taking up what a study has gained."""

from __future__ import annotations

import json
import logging
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr
from zarr.abc.buffer import Buffer
from zarr.codecs import Crc32cCodec
from zarr.storage import MemoryStore

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import CLAIM_KEYS
from sobolev_batch.batch.store.comparison_records import KINDS, ComparisonRecords
from sobolev_batch.batch.store.metadata import SCHEMA_VERSION
from sobolev_batch.batch.store.store import (
    FIELD,
    LABELS,
    QUALITY,
    RECORD,
    ROOT,
    UNFINISHED,
    Store,
)
from sobolev_batch.batch.store.tables import Tables, table_encoding
from sobolev_batch.batch.study.plan import Plan
from sobolev_batch.errors import StoreError
from sobolev_batch.spectral.lattice import AXES
from sobolev_batch.surfaces.shapes.similarity import Similarity

_log = logging.getLogger(__name__)

_RECORDED_VERSIONS = ("sobolev-batch", "finufft", "modepy", "numpy", "scipy", "xarray", "zarr")


def require_place(location: Location) -> None:
    """Check, without writing, that a store is or may be laid out at a location.

    Raises:
        StoreError: it cannot be reached, or something else is there.
    """
    store = Store(location)
    if not store.is_there():
        location.require_free(besides=CLAIM_KEYS)
    elif not store.is_unfinished:
        store.attributes()


def prepare_store(place: str | Path | Location, plan: Plan) -> Store:
    """Create the store of a plan, or open it if it is already there and take up new meshes.

    Raises:
        StoreError: the place cannot be reached or written, holds something else, or a store of
            another study; nothing is changed then.
    """
    store = Store(place)
    if not store.is_there():
        store.location.require_free(besides=CLAIM_KEYS)
        _lay_out(store, plan)
        return store
    if store.is_unfinished:
        _replace_everything(store, plan)
        return store
    _check_same_study(store, plan)
    store.location.sweep()
    with store.location.access("written"):
        if _lattice(store) != _lattice_entry(plan):
            done = sum(record is not None for record in store.records())
            _log.warning(
                "%s: another lattice follows from the study now; all of %d fields are computed again", store.path, done
            )
            _replace_everything(store, plan)
        store.mend_labels()
        _extend(store, plan)
        _mend_axes(store, plan)
        if store.attributes().get("similarity") != _similarity_entry(plan.similarity):
            # In another unit of length, and the run may end before there are others.
            Tables(store).withdraw()
        store.documents[""]["attributes"].update(_attributes(plan))
        # Written even if nothing changed: a place that refuses it must do so before tasks start.
        store.consolidate()
    return store


def _replace_everything(store: Store, plan: Plan) -> None:
    """Remove everything that was computed and lay out the arrays for another lattice."""
    _mark_unfinished(store, plan)
    store.location.sweep()
    for name in sorted(store.location.names() - {*CLAIM_KEYS, ROOT}):
        store.location.remove(name)
    _lay_out(store, plan)


def _mark_unfinished(store: Store, plan: Plan) -> None:
    """Say that nothing of what is there counts until it is laid out: whoever does that may be killed before."""
    attributes = {"title": plan.study.title, "schema_version": SCHEMA_VERSION, UNFINISHED: True}
    root = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
    store.location.write({ROOT: json.dumps(root).encode()})


def _lay_out(store: Store, plan: Plan) -> None:
    labels = [row.label for row in plan.rows]
    lattice = plan.lattice
    chunk = plan.blocks[0].shape
    made: dict[str, Buffer] = {}
    root = zarr.create_group(MemoryStore(made), zarr_format=3)
    root.create_array(
        FIELD,
        shape=(len(labels), *lattice.shape),
        dtype=plan.choice.dtype,
        chunks=(1, *chunk),
        compressors=(Crc32cCodec(),),
        fill_value=complex(np.nan, np.nan),
        dimension_names=("mesh", *AXES),
        # xarray takes what `coordinates` names for coordinates, so it stays with a selected field.
        attributes={
            "long_name": "Fourier transform of the area measure, xi_z >= 0 half",
            "coordinates": "quality",
        },
    )
    root.create_array(
        QUALITY,
        shape=(len(labels),),
        dtype=str,
        chunks=(len(labels),),
        compressors=(Crc32cCodec(),),
        fill_value="",
        dimension_names=("mesh",),
    )
    axes = _axes(plan).assign_coords(mesh=np.array(labels, dtype=object))
    axes.to_zarr(
        MemoryStore(made),
        group="fourier",
        mode="a",
        zarr_format=3,
        consolidated=False,
        encoding=table_encoding(axes),
    )
    root.create_array(
        RECORD,
        shape=(len(labels),),
        dtype=str,
        chunks=(1,),
        compressors=(Crc32cCodec(),),
        dimension_names=("mesh",),
        fill_value="",
    )
    _mark_unfinished(store, plan)
    store.documents = {"": {**json.loads(made.pop(ROOT).to_bytes()), "attributes": _attributes(plan)}}
    store.publish(made, last="")
    store.consolidate()


def _axes(plan: Plan) -> xr.Dataset:
    units = {"units": "cycles per unit length"}
    return xr.Dataset(coords={name: (name, axis, units) for name, axis in zip(AXES, plan.lattice.axes, strict=True)})


def _mend_axes(store: Store, plan: Plan) -> None:
    """Write the coordinates of the lattice again where they are damaged: without them nothing can be selected."""
    for name, axis in zip(AXES, plan.lattice.axes, strict=True):
        array = store.array(f"fourier/{name}")
        try:
            sound = np.array_equal(array[...], axis)
        except ValueError:
            sound = False
        if not sound:
            array[...] = axis


def _check_same_study(store: Store, plan: Plan) -> None:
    study = store.attributes()["study"]
    # A lattice that was chosen may be chosen anew; one that was given is part of the study.
    chosen = plan.study.accuracy is not None
    differences = [
        f"{what} {old}, not {new}"
        for what, old, new in (
            ("the study", repr(study["name"]), repr(plan.study.name)),
            ("a lattice of", *map(_described, (study["lattice"], _lattice_entry(plan)["lattice"]))),
            ("dtype", repr(study["dtype"]), repr(plan.choice.dtype)),
        )
        if old != new and not (chosen and what != "the study" and study.get("choice"))
    ]
    removed = set(store.labels()) - {row.label for row in plan.rows}
    if removed:
        differences.append(f"meshes that this study lacks, such as {min(removed)!r}")
    if differences:
        raise StoreError(
            f"{store.path}: a store of another study is there, with {'; '.join(differences)}. "
            "Name another store, or remove this one"
        )


def _lattice(store: Store) -> dict[str, Any]:
    study = store.attributes()["study"]
    return {"lattice": study["lattice"], "dtype": study["dtype"]}


def _extend(store: Store, plan: Plan) -> None:
    """Append rows for meshes that the study has gained; the rows that are there stay."""
    there = store.labels()
    known = set(there)
    added = [row.label for row in plan.rows if row.label not in known]
    if not added:
        return
    for name in (RECORD, FIELD, QUALITY, LABELS):
        store.resize(name, (len(there) + len(added), *store.array(name).shape[1:]))
        if name in (LABELS, QUALITY):
            # Not left out: what is not there counts as lost.
            texts = added if name == LABELS else [""] * len(added)
            store.array(name)[len(there) :] = np.array(texts, dtype=object)
    for notes in (ComparisonRecords(store, kind) for kind in KINDS):
        # Arrays of one group that differ along `mesh` cannot be read together.
        if store.has(notes.name):
            notes.lay_out(len(there) + len(added))


def _attributes(plan: Plan) -> dict[str, Any]:
    """What the root of the store of a plan says."""
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


def _described(lattice: dict[str, Any]) -> str:
    return f"xi_max {lattice['xi_max']:.6g} and M {lattice['M']}"


def _lattice_entry(plan: Plan) -> dict[str, Any]:
    return {"lattice": {"xi_max": plan.lattice.xi_max, "M": plan.lattice.M}, "dtype": plan.choice.dtype}


def _similarity_entry(similarity: Similarity) -> dict[str, Any]:
    return {"scale": similarity.scale, "origin": list(similarity.origin)}
