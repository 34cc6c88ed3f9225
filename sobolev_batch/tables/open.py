"""A store that is open for reading, and what it has: groups, orders, families and units."""

import logging
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import xarray as xr

from sobolev_batch.errors import InputError, StoreError, one_line
from sobolev_batch.geometry.proximity import METRICS
from sobolev_batch.geometry.surface import Similarity, placement_doubt
from sobolev_batch.norms.fields import Quality
from sobolev_batch.sources.names import quoted
from sobolev_batch.store import layout
from sobolev_batch.store.encoding import with_coordinates
from sobolev_batch.store.layout import Store
from sobolev_batch.store.location import Location
from sobolev_batch.store.metadata import mapping_in, record_in
from sobolev_batch.store.objects import stores_below
from sobolev_batch.visible import FILE_UNITS

_log = logging.getLogger(__name__)

AnyStore = str | Path | Location | xr.DataTree
# The store of several objects, or of an only one; or stores of single objects by their names.
AnyStores = AnyStore | Mapping[str, AnyStore]

# Entries of the encoding of a tree: where it was opened, and the digest of its tables then.
_SOURCE, _STATE = "source", "state"
# Groups that may be larger than the memory: xarray computes with them chunk by chunk.
_LARGE = {"fourier", layout.OCTAVES_GROUP, layout.SPECTRA_GROUP}
# What zarr and xarray raise for metadata that nobody has written.
_MEANINGLESS = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, MemoryError, struct.error)


@dataclass(frozen=True)
class _Attributes:
    """Attributes of a table that are read."""

    reference: str = ""
    rtol: float = 0.0
    numerics: tuple[int, ...] = ()
    metadata: tuple[str, ...] = ()
    metrics: tuple[str, ...] = ()


def open_store(store: str | Path | Location) -> xr.DataTree:
    """Open a store lazily, as ``xarray.open_datatree(store, engine="zarr")`` does.

    Groups: fourier (the fields), spectra, meshes, norms, distances, convergence, records; where the study requests it
    also octaves and proximity. docs/store.md lists their variables with dimensions and units. All stay on disk until
    you ask for values of them. The root of several objects has meshes, convergence and proximity of all of them, with
    the coordinate `object`. Fields and spectra are Dask arrays, unless the store is in memory. The tree has the
    accessor `tree.sobolev`.

    Args:
        store: Path or URL of the store.

    Raises:
        StoreError: The location has no store of a study, or cannot be reached.
        DamageError: What is read at once is damaged. All else that is missing or damaged raises when it is read.

    >>> import sobolev_batch as sb
    >>> tree = sb.open_store("storage/icosphere.zarr")
    >>> tree["convergence"]["distance"].dims
    ('mesh', 'order')
    >>> tree["convergence"].attrs["reference"]
    'reference'
    """
    # The process may go to another folder before it reads values; zarr would take those of a relative path for missing.
    location = Location.parse(store).absolute()
    opened = Store(location)
    has_objects = layout.OBJECTS in opened.attributes(of_objects=None)["study"]
    # Left to itself, xarray looks for older formats, which nobody has checked, and lists keys again.
    has_tables = layout.table_attributes(opened, "convergence") is not None
    keys: Any = opened.checked_keys(layout.RECORD if has_objects else layout.FIELD, has_tables=has_tables)
    with opened.location.access("read"):
        try:
            tree = xr.open_datatree(keys, engine="zarr", consolidated=True, zarr_format=3)
            for group in tree.children:
                tree[group].dataset = with_coordinates(tree[group].to_dataset())
                if not all(index.is_unique for index in tree[group].indexes.values()):
                    raise ValueError(f"labels of {group} come twice")
                own = record_in(_Attributes, tree[group].attrs, f"{location}: what {group} says of itself")
                unknown = {*own.metadata} - tree[group].variables.keys() | {*own.metrics} - METRICS.keys()
                if group == "convergence" and not has_objects:
                    unknown |= {own.reference} - {*tree[group].indexes["mesh"]}
                if unknown:
                    raise ValueError(f"{group} names {quoted(min(unknown))}, which is not there")
            # The processes of a Dask client do not see the memory of this one.
            for group in () if opened.location.is_in_memory else _LARGE.intersection(tree.children):
                lazy = xr.open_dataset(keys, group=group, engine="zarr", consolidated=True, zarr_format=3, chunks={})
                # Coordinates are small.
                tree[group].dataset = tree[group].to_dataset().assign(lazy.data_vars)
        except _MEANINGLESS as error:
            raise opened.damage("the store", f"its metadata make no sense: {one_line(error)}") from error
    if len(numerics := (layout.table_attributes(opened, "convergence") or {}).get(layout.NUMERICS, ())) > 1:
        _log.warning(
            "%s: its fields were computed by numerics of versions %s, as the column numerics of /meshes says; run the "
            "study again, which computes those of others anew", *(location, " and ".join(map(str, numerics))),
        )  # fmt: skip
    tree.encoding = {**tree.encoding, _SOURCE: str(location), _STATE: tree.attrs.pop(layout.DIGEST, None)}
    return tree


def store_of(tree: xr.DataTree) -> Store:
    """Return the store of an open tree."""
    return Store.open(location_of(tree))


def as_tree(store: AnyStore) -> xr.DataTree:
    """Return a store as a DataTree, which it may be already."""
    return store if isinstance(store, xr.DataTree) else open_store(store)


def stores_of(store: AnyStores) -> Mapping[str, AnyStore]:
    """Return the stores of objects by name, which they may be already; "" names an only object."""
    if isinstance(store, Mapping) and not isinstance(store, xr.DataTree):
        return store
    if isinstance(store, xr.DataTree) and not has_objects(store):
        return {"": store}
    return {**stores_below(Location.parse(location_of(store)))}


def objects_of(store: AnyStores) -> tuple[str, ...]:
    """Return the names of a store's objects, or of stores by name; none where it is that of an only one."""
    if isinstance(store, xr.DataTree):
        return tuple(root_attribute(store, "study").get(layout.OBJECTS, ()))
    if isinstance(store, Mapping):
        return tuple(store)
    return tuple(Store(store).attributes(of_objects=None)["study"].get(layout.OBJECTS, ()))


def source_of(tree: xr.DataTree) -> str | None:
    """Return the path or URL at which a tree was opened by `open_store`; None for other trees."""
    source = tree.encoding.get(_SOURCE)
    return None if source is None else str(source)


def require_unchanged(tree: xr.DataTree) -> None:
    """Check that all that was read of a store is one state of it; StoreError where a run has changed it since."""
    source = source_of(tree)
    # One that xarray itself has opened says so among its attributes.
    state = tree.encoding.get(_STATE, tree.attrs.get(layout.DIGEST))
    if source is not None and Store.open(source).attributes().get(layout.DIGEST) != state:
        raise StoreError(f"{source}: a run has changed the store while it was read; try again once that run has ended")


def location_of(store: AnyStore) -> str | Path | Location:
    """Return the path or URL of a store; InputError for a DataTree from elsewhere."""
    if not isinstance(store, xr.DataTree):
        return store
    if (source := source_of(store)) is None:
        raise InputError("the DataTree does not say where it was opened; open it with open_store, or give its path")
    return source


def finished_group(tree: xr.DataTree, name: str, *, load: bool = True) -> xr.Dataset:
    """Return a table of an open store, in memory unless it may stay on disk; InputError if it has no such tables."""
    if name not in tree.children:
        require_one_object(tree)
        raise InputError("the store has no tables yet: run the study to its end")
    dataset = tree[name].to_dataset()
    return dataset.load() if load else dataset


def has_objects(tree: xr.DataTree) -> bool:
    """Return True for the root of several objects."""
    return layout.OBJECTS in root_attribute(tree, "study")


def require_one_object(tree: xr.DataTree) -> None:
    """Refuse the root of several objects, by an InputError that names the store of one."""
    if has_objects(tree):
        one = f"{source_of(tree)}/{next(iter(root_attribute(tree, 'study')[layout.OBJECTS]), 'NAME')}"
        raise InputError(f"{source_of(tree)}: the store of several objects; name that of one, such as {one}")


def root_attribute(tree: xr.DataTree, name: str) -> dict[str, Any]:
    """Return an attribute of the root of an open store that is a mapping; an empty one where it has none."""
    return _mapping_in(tree.attrs[name]) if name in tree.attrs else {}


# The attribute of many objects is long, and is read often.
_mapping_in = lru_cache(mapping_in)


def similarity_of(tree: xr.DataTree) -> Similarity:
    """Return the map from the unit of length of the files to that of the study of an open store."""
    table = root_attribute(tree, "similarity")
    return Similarity(table["scale"], tuple(table["origin"]))


def reference_of(tree: xr.DataTree) -> str:
    """Return the label of the reference of an object's study."""
    require_one_object(tree)
    return str(finished_group(tree, "convergence", load=False).attrs["reference"])


def metadata_of(tree: xr.DataTree) -> list[str]:
    """Return the names of the metadata that the study gives its meshes."""
    return list(finished_group(tree, "meshes", load=False).attrs.get("metadata", ()))


def complete_meshes(tree: xr.DataTree) -> list[str]:
    """Return the labels of all meshes that are computed, the reference among them."""
    meshes = finished_group(tree, "meshes", load=False)
    labels: list[str] = meshes["mesh"].values[meshes["status"].values == "complete"].tolist()
    return labels


def doubts_of(tree: xr.DataTree) -> dict[str, str]:
    """Return what one should know of how a mesh was made, or why it may not be comparable, by the label of the mesh."""
    complete, reference = complete_meshes(tree), reference_of(tree)
    doubts: dict[str, str | None] = {}
    if reference in complete:
        texts = tree["fourier"].to_dataset()["quality"].sel(mesh=complete).values.tolist()
        extents = {label: Quality.from_json(text).extent for label, text in zip(complete, texts, strict=True)}
        doubts = {label: placement_doubt(extent, extents[reference]) for label, extent in extents.items()}
    remarks = finished_group(tree, "meshes", load=False)["remark"].sel(mesh=complete).to_series()
    both = {str(label): "; ".join(filter(None, (remark, doubts.get(label)))) for label, remark in remarks.items()}
    return {label: text for label, text in both.items() if text}


def unit_of(tree: xr.DataTree) -> tuple[str, float]:
    """Return the name of the unit of length of the files, and the study's unit in terms of it."""
    header = root_attribute(tree, "study").get("table", {}).get("study", {})
    return header.get("length_unit", FILE_UNITS), 1 / root_attribute(tree, "similarity").get("scale", 1.0)


def study_unit(tree: xr.DataTree) -> str:
    """Return the study's unit of length in words, by the unit of the files."""
    name, size = unit_of(tree)
    return name if size == 1 else f"units of {size:.4g} {name}"
