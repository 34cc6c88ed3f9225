"""The store of a collection: a folder with the store of each object, and a document that names them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.metadata import SCHEMA_VERSION
from sobolev_batch.batch.store.store import COLLECTION, ROOT, Store
from sobolev_batch.batch.study.collection import StudyCollection
from sobolev_batch.batch.study.study import Study
from sobolev_batch.errors import InputError, StoreError

Result = TypeVar("Result")


@dataclass(frozen=True)
class CollectionStore:
    """The stores of the objects of a collection, below one location.

    Attributes:
        location: Location of them all.
        title: Title of the collection.
        name: Name of the collection.
        objects: Names of the objects.
        table: Collection as it was written.
    """

    location: Location
    title: str
    name: str
    objects: tuple[str, ...]
    table: Mapping[str, Any]

    @property
    def existing_stores(self) -> dict[str, Location]:
        """Stores of the objects that have one, by name: none has until its reference was made."""
        stores = {name: Store(place) for name, place in self.stores.items()}
        return {name: store.location for name, store in stores.items() if store.exists() and not store.is_unfinished}

    @classmethod
    def read(cls, location: Location) -> CollectionStore | None:
        """Return the store of a collection at a location; None where there is none."""
        content = location.read(ROOT)
        document = _parsed(content) if content is not None else {}
        table = document.get("attributes", {}).get(COLLECTION)
        if not isinstance(table, dict):
            return None
        return cls(location, table["title"], table["name"], tuple(table["objects"]), table["table"])

    @classmethod
    def for_collection(cls, location: Location, collection: StudyCollection) -> CollectionStore:
        """Return the store that a collection has, or would have, at a location."""
        return cls(location, collection.title, collection.name, tuple(collection.studies), collection.table)

    @classmethod
    def prepared(cls, location: Location, collection: StudyCollection) -> CollectionStore:
        """Write down at a location which objects a collection has, and return its store.

        Raises:
            StoreError: The location holds something else, or cannot be written.
        """
        present = cls.read(location)
        if present is None:
            location.require_free()
        elif present.name != collection.name:
            raise StoreError(
                f"{location}: it holds the store of another collection, {present.name!r}, not {collection.name!r}; "
                "name another store, or remove this one"
            )
        entry = {
            "name": collection.name,
            "title": collection.title,
            "objects": list(collection.studies),
            "lacking": {name: list(methods) for name, methods in collection.lacking.items()},
            "table": dict(collection.table),
        }
        attributes = {"title": collection.title, "schema_version": SCHEMA_VERSION, COLLECTION: entry}
        root = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
        location.write({ROOT: json.dumps(root).encode()})
        return cls.for_collection(location, collection)

    @property
    def stores(self) -> dict[str, Location]:
        """Location of the store of each object, by its name."""
        return {name: self.location.below(name) for name in self.objects}


def for_each_object(
    collection: StudyCollection, location: Location, act: Callable[[str, Study, Location], Result]
) -> tuple[dict[str, Result], dict[str, str]]:
    """Act on the name, the study and the store of each object. An object that cannot be carried out stops no other.

    Returns:
        Results by the name of the object, and the reason for each object that has none.

    Raises:
        StoreError: A store cannot be used; that of the next object would not fare better.
    """
    results: dict[str, Result] = {}
    refused: dict[str, str] = {}
    stores = CollectionStore.for_collection(location, collection).stores
    for name, study in collection.studies.items():
        try:
            results[name] = act(name, study, stores[name])
        except StoreError:
            raise
        except InputError as error:
            refused[name] = str(error)
    return results, refused


def _parsed(content: bytes) -> dict[str, Any]:
    """Return a metadata document; an empty one where it is none."""
    try:
        document = json.loads(content)
        return document if isinstance(document["attributes"], dict) else {}
    except (ValueError, TypeError, KeyError):
        return {}
