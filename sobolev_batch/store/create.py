"""Preparation of a store for a run: create it, or lay it out again for what the study or its state has become."""

import json
import logging
from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import DamageError, ForeignError, StoreError
from sobolev_batch.norms.spectrum import RadialAxis
from sobolev_batch.norms.tail.sampling import TailSampling
from sobolev_batch.store import layout
from sobolev_batch.store.encoding import ROOT, array_keys, dataset_keys, documents_in, group_document
from sobolev_batch.store.layout import Store
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import LOCK_KEYS
from sobolev_batch.store.metadata import SCHEMA_VERSION, chunk_shape
from sobolev_batch.store.records import Record, Records
from sobolev_batch.study.plan import Plan
from sobolev_batch.study.study import Study
from sobolev_batch.transform.fourier import NUMERICS_VERSION
from sobolev_batch.transform.lattice import AXES, smooth_step

_log = logging.getLogger(__name__)

# Bytes and rows of a chunk of spectra: its rows are one task, and small ones would be many keys. A chunk is written as
# a whole, so a small store has short ones. Qualities have as many rows.
_SPECTRA_BYTES, _MOST_SPECTRA = 2 << 20, 512
# Records that lie together once a run has ended.
ROWS_PER_PAGE = 100
_RECORDED_VERSIONS = ("sobolev-batch", "finufft", "numpy", "scipy", "xarray", "zarr")
_version = cache(version)


def require_usable(location: Location, *, of_objects: bool = False) -> None:
    """Check, without writing, that a store exists or may be created at a location."""
    store = Store(location)
    # Damaged metadata are made again.
    with suppress(DamageError):
        if not store.exists():
            location.require_free(besides=LOCK_KEYS)
        elif not store.is_unfinished:
            store.attributes(of_objects=of_objects)


def reserve(location: Location, title: str) -> None:
    """Begin the store of a study where there is none, so that its run has a record while it is planned."""
    store = Store(location)
    with suppress(DamageError):  # It is made again with the tables.
        if not store.exists():
            location.write({ROOT: json.dumps(_unfinished(title)).encode()})
            list_records(store)


def give_up(location: Location) -> None:
    """Remove what was begun of a store, where its study turned out to be impossible."""
    with suppress(DamageError):
        if Store(location).is_unfinished and location.names() <= {ROOT, layout.RECORDS, *LOCK_KEYS}:
            location.remove(layout.RECORDS)
            location.discard(ROOT)


def list_records(store: Store) -> None:
    """List the group of records, whose own document has the record of a run that may be going on."""
    store.documents[layout.RECORDS] = group_document({})
    with suppress(StoreError):  # A damaged one is replaced.
        if store.stored_document(layout.RECORDS) is not None:
            return
    store.location.write({f"{layout.RECORDS}/{ROOT}": json.dumps(store.documents[layout.RECORDS]).encode()})


def prepare_store(location: str | Path | Location, plan: Plan) -> Store:
    """Create the store of a plan, or open it and add rows for new meshes. Rows that the study has lost stay.

    If tables, coordinates or metadata are not those that were written, all of them are made again, and the fields stay.
    A StoreError leaves the location as it is: it cannot be written, holds something else or the store of another study;
    or its root is damaged, and no field of the study is found (DamageError).
    """
    store = Store(location)
    try:
        if not (exists := store.exists()):
            store.location.require_free(besides=LOCK_KEYS)
        if not exists or store.is_unfinished:
            _create(store, plan)
            return store
        attributes, lattice = store.attributes(), _lattice_entry(plan)
    except DamageError as damage:
        return _mended(store, plan, damage)
    if not store.has_digest():
        is_same = attributes["study"].items() >= {"name": plan.name, **lattice}.items()
        altered = DamageError("the metadata at the root are damaged", "they are not what was written")
        return _mended(store, plan, None if is_same else altered)
    # The store of an object lies in that of the whole study.
    place = store.location.beside("") if plan.study.object.name else store.location
    require_same_study(place, attributes["study"], plan.name, plan.study)
    store.location.remove_partial_files()
    if not attributes["study"].items() >= lattice.items():
        _log.warning("%s: the study needs another lattice than its fields have; all are computed again", store.path)
        _create(store, plan)
    _require_same_samples(store, plan)
    stored = store.labels()
    # Only a row whose mesh the study has lost may serve another one.
    is_kept = set(stored) <= {row.label for row in plan.rows}
    labels = labels_for(plan, stored, [None] * len(stored) if is_kept else Records(store).read(), is_trusted=True)
    if labels != list(stored):
        _lay_out(store, plan, labels, store.read_strings(layout.QUALITY))
    current = _attributes(plan, labels)
    if attributes.get("similarity") != current["similarity"]:
        # Tables are in another unit of length, and the run may end before there are others.
        layout.hide_tables(store)
    store.documents[""]["attributes"].update(current)
    if plan.study.object.name:
        # The run has its record at the root of all objects, and writes this one nowhere else.
        list_records(store)
    # Written even if nothing changed: a location that cannot be written must fail before tasks start.
    store.consolidate()
    return store


def _mended(store: Store, plan: Plan, damage: DamageError | None) -> Store:
    """Return a store with new metadata, coordinates and labels, and without tables, around its fields and records.

    DamageError where, with this damage, it may be the store of another study: no field in it is one of this study.
    """
    stored: tuple[str, ...] = ()
    with suppress(StoreError, ValueError, TypeError, KeyError):
        stored = store.labels()
    last, last_page = (max(store.stored_chunks(name), default=-1) for name in (layout.RECORD, layout.PAGE))
    count = max(len(stored), 1 + last, ROWS_PER_PAGE * (1 + last_page))
    fresh = Store(store.location)
    fresh.documents = documents_in(record_keys(count))
    records, damaged = Records(fresh).examine()
    # Rows end before the last page does.
    count = max([len(stored), 1 + last, *(1 + row for row, record in enumerate(records) if record is not None)])
    records = records[:count]
    keys = {row.key for row in plan.rows}
    if damage is not None and not any(record is not None and record.key in keys for record in records):
        raise DamageError(
            f"{store.path}: {ROOT}, the metadata at the root, is damaged, and no field of this study is found in the "
            "store to make it again from; name another store, or remove this one",
            damage.what,
        )
    _log.warning("%s: tables or metadata are not what was written, and are made again", store.path)
    store.location.remove_partial_files()
    if plan.tail is not None:
        samples = xr.Dataset(coords=_sample_columns(plan.tail))
        fresh.documents |= documents_in(dataset_keys(layout.OCTAVES_GROUP, samples))
    _require_same_samples(fresh, plan)
    _lay_out(fresh, plan, labels_for(plan, (stored + ("",) * count)[:count], records, is_trusted=False), ())
    # Nothing else replaces the record of a row that has lost its label.
    for row in damaged:
        if row < count:
            Records(fresh).write(row, None)
    fresh.consolidate()
    return fresh


def _create(store: Store, plan: Plan) -> None:
    """Create all arrays, in place of everything that the store holds."""
    # This process may be killed before all of them exist: until then the content is declared invalid.
    store.location.write({ROOT: json.dumps(_unfinished(plan.study.object.title)).encode()})
    store.location.remove_partial_files()
    present = store.location.names()
    others = present - {*LOCK_KEYS, ROOT, layout.RECORDS}
    for name in (*sorted(others), *((layout.RECORD, layout.PAGE) if layout.RECORDS in present else ())):
        store.location.remove(name)
    store.documents = {}
    _lay_out(store, plan, [row.label for row in plan.rows], ())
    store.consolidate()


def _lay_out(store: Store, plan: Plan, labels: Sequence[str], qualities: Sequence[str]) -> None:
    """Write metadata and coordinates of all arrays that tasks fill, and first qualities; chunks and tables stay."""
    rows, mesh = len(labels), np.array(labels, dtype=object)
    padded = np.array([*qualities, *[""] * (rows - len(qualities))], dtype=object)
    # Whoever reads the field of one mesh reads the qualities of few.
    quality: Any = "mesh", padded, {}, {"chunks": (min(rows, _MOST_SPECTRA),)}
    units = {"units": "cycles per unit length"}
    axes = {name: (name, axis, units) for name, axis in zip(AXES, plan.lattice.axes, strict=True)}
    dtype, shape, chunks = plan.choice.dtype, (rows, *plan.lattice.shape), (1, *plan.blocks[0].shape)
    meaning = "Fourier transform of the area measure, xi_z >= 0 half"
    # xarray makes coordinates of what `coordinates` names, which then stay with a selected field.
    keys = array_keys(layout.FIELD, dtype, shape, chunks, ("mesh", *AXES), long_name=meaning, coordinates="quality")
    coordinates = {**axes, "mesh": mesh, **_weight_columns(plan)}
    keys |= dataset_keys("fourier", xr.Dataset({"quality": quality}, coords=coordinates)) | record_keys(rows)
    if plan.tail is not None:
        meaning = "Fourier transform of the area measure, beyond the lattice"
        sums = "the sum of weight (1 + |xi|²)^s |octaves|² is the tail of a squared norm to the last octave"
        attributes, size = {"long_name": meaning, "description": sums}, plan.tail.size
        keys |= array_keys(layout.OCTAVES, dtype, (rows, size), (1, size), ("mesh", "sample"), **attributes)
        keys |= dataset_keys(layout.OCTAVES_GROUP, xr.Dataset(coords={**_sample_columns(plan.tail), "mesh": mesh}))
    list_records(store)
    spectra, before = _spectra_keys(plan, mesh), store.documents.get(layout.SPECTRA_KEYS)
    if before is not None and chunk_shape(before) != chunk_shape(documents_in(spectra)[layout.SPECTRA_KEYS]):
        # They are summed up from the fields again.
        store.location.remove(layout.SPECTRA_GROUP)
    store.publish(keys | spectra)
    store.documents[""] = group_document(_attributes(plan, labels))


def _spectra_keys(plan: Plan, mesh: NDArray[Any]) -> dict[str, bytes]:
    axis, rows = RadialAxis(plan.lattice, plan.tail), len(mesh)
    step = min(max(1, _SPECTRA_BYTES // (8 * len(axis))), _MOST_SPECTRA, 1 << (rows - 1).bit_length())
    columns = {
        "radius": ("shell", axis.radii, {"units": "cycles per unit length"}),
        "weight": ("shell", axis.weights, {"long_name": "factor of an entry in the squared value"}),
        "octave": ("shell", axis.labels()["octave"], {"long_name": "number of the octave, 0 for the lattice"}),
        "lattice": ("shell", axis.labels()["lattice"], {"long_name": "lattice in the octave, -1 for drawn samples"}),
    }
    keys = dataset_keys(layout.SPECTRA_GROUP, xr.Dataset(coords={**columns, "mesh": mesh}))
    keys |= array_keys(layout.SPECTRA_KEYS, str, (rows,), (step,), ("mesh",))
    for name, (width, dimension, meaning) in axis.arrays().items():
        attributes = {"long_name": meaning, "coordinates": " ".join(["key", *columns])}
        path, dimensions = f"{layout.SPECTRA_GROUP}/{name}", ("mesh", dimension)
        keys |= array_keys(path, "float64", (rows, width), (step, width), dimensions, **attributes)
    return keys


def record_keys(rows: int, dimension: str = "row") -> dict[str, bytes]:
    """Return the keys of the arrays of records: a chunk for each row, which tasks write, and pages of many rows."""
    keys = array_keys(layout.RECORD, str, (rows,), (1,), (dimension,))
    keys |= array_keys(layout.PAGE, str, (rows,), (ROWS_PER_PAGE,), (dimension,))
    return {key: text for key, text in keys.items() if key != f"{layout.RECORDS}/{ROOT}"}


def _weight_columns(plan: Plan) -> dict[str, tuple[str, Reals, dict[str, str]]]:
    """Return the weights of samples in the integral over all frequencies: along each axis, and by the shell |k|²."""
    lattice = plan.lattice
    radii = lattice.spacing * np.sqrt(np.arange(lattice.shell_count))
    step = np.ones_like(radii) if plan.tail is None else smooth_step(radii, plan.tail.cutoff)
    columns = {
        name.replace("xi", "weight"): (name, weights, {"long_name": f"factor of the weight of a sample, by {name}"})
        for name, weights in zip(AXES, lattice.axis_weights(lattice.half), strict=True)
    }
    meaning = {"long_name": "factor of the weight of a sample, by the shell |k|² of xi = spacing k"}
    return {**columns, "weight_shell": ("shell", step, meaning)}


def _sample_columns(tail: TailSampling) -> dict[str, tuple[str, NDArray[Any], dict[str, str]]]:
    units = {"units": "cycles per unit length"}
    columns = {name: ("sample", column, units) for name, column in zip(AXES, tail.frequencies.T, strict=True)}
    weights = np.concatenate([octave.weights for octave in tail.octaves])
    columns["weight"] = ("sample", weights, {"long_name": "weight in the integral over all frequencies"})
    meanings = {
        "octave": "number of the octave, from 1",
        "lattice": "number of the random lattice in the octave; -1 for drawn samples",
        "sublattice": "number of the sublattice in the lattice; -1 for drawn samples",
    }
    labels = tail.labels()
    return columns | {name: ("sample", labels[name], {"long_name": meaning}) for name, meaning in meanings.items()}


def _unfinished(title: str) -> dict[str, Any]:
    return group_document({"title": title, "schema_version": SCHEMA_VERSION, layout.UNFINISHED: True})


def _require_same_samples(store: Store, plan: Plan) -> None:
    """Check that octaves have the frequencies that are drawn here; one axis is enough, since others may be damaged."""
    agree = []
    for name, expected in zip(AXES, () if plan.tail is None else plan.tail.frequencies.T, strict=False):
        with suppress(StoreError, ValueError, TypeError, KeyError):
            stored = np.asarray(store.read(f"{layout.OCTAVES_GROUP}/{name}"))
            agree.append(stored.shape == expected.shape and np.allclose(stored, expected, rtol=1e-9, atol=1e-12))
    if agree and not any(agree):
        raise StoreError(
            f"{store.path}: its octaves were sampled at other frequencies than this version of NumPy draws; use "
            "the versions that the attributes of the store name, or name another store"
        )


def require_same_study(location: Location, held: Mapping[str, Any], name: str, study: Study) -> None:
    """Refuse a study, by a ForeignError, of another name or of other fields than the entry in a store's attributes.

    A lattice that an accuracy has chosen may be chosen anew; a given one is part of the study.
    """
    compared = [("the study", repr(held["name"]), repr(name))]
    lattice = f"xi_max {held['lattice']['xi_max']:.6g} and M {held['lattice']['M']}"
    if study.lattice is not None:
        # The frequencies of octaves follow from the reference, which may change.
        octaves = len(held["octaves"]["octaves"]) if held.get("octaves") else 0
        compared += [
            ("a lattice of", lattice, f"xi_max {study.lattice.xi_max:.6g} and M {study.lattice.M}"),
            ("dtype", repr(held["dtype"]), repr(study.transform.dtype)),
            ("octaves:", str(octaves or "none"), str(study.octaves or "none")),
        ]
    elif not held.get("choice"):
        compared.append(("a lattice of", lattice, "an accuracy"))
    if differences := [f"{what} {old}, not {new}" for what, old, new in compared if old != new]:
        raise ForeignError(
            f"{location}: it holds a store of another study, with {'; '.join(differences)}. "
            "Name another store, or remove this one"
        )


def labels_for(plan: Plan, stored: Sequence[str], records: Sequence[Record | None], *, is_trusted: bool) -> list[str]:
    """Return a label for each stored row, followed by the labels of new meshes.

    A row whose mesh the study has lost gets the label of a new mesh with the same field. Labels that are not trusted
    count only where the key of the record is that of their mesh.
    """
    planned = {row.label: row.key for row in plan.rows}
    labels = [
        label if label in planned and (is_trusted or (record is not None and record.completes(planned[label]))) else ""
        for label, record in zip(stored, records, strict=True)
    ]
    taken, by_key = set(labels), defaultdict[str, deque[str]](deque)
    for label, key in planned.items():
        if key and label not in taken:
            by_key[key].append(label)
    for row, record in enumerate(records):
        if not labels[row] and record is not None and record.status == "complete" and by_key[record.key]:
            labels[row] = by_key[record.key].popleft()
    taken = set(labels)
    for row, label in enumerate(stored):
        if not labels[row]:
            labels[row] = label if label and label not in taken else f"removed/{row}"
            taken.add(labels[row])
    return [*labels, *(label for label in planned if label not in taken)]


def _attributes(plan: Plan, labels: Sequence[str]) -> dict[str, Any]:
    study, planned = plan.study, {row.label for row in plan.rows}
    return {
        "title": study.object.title,
        "description": layout.DESCRIPTION,
        "schema_version": SCHEMA_VERSION,
        "study": {
            "name": plan.name,
            **_lattice_entry(plan),
            "eps": None if study.accuracy else study.transform.eps,
            "choice": plan.choice.to_dict() if study.accuracy else None,
            "orders": list(study.orders),
            "reference": plan.reference,
            "table": dict(study.object.table),
            "mesh_cache": str(study.cache.folder) if study.cache else None,
        },
        layout.REMOVED: [label for label in labels if label not in planned],
        "similarity": {"scale": plan.similarity.scale, "origin": list(plan.similarity.origin)},
        "versions": {**{name: _version(name) for name in _RECORDED_VERSIONS}, layout.NUMERICS: NUMERICS_VERSION},
    }


def _lattice_entry(plan: Plan) -> dict[str, Any]:
    lattice = {"xi_max": plan.lattice.xi_max, "M": plan.lattice.M}
    return {"lattice": lattice, "dtype": plan.choice.dtype, "octaves": plan.tail and plan.tail.to_dict()}
