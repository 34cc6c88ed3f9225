"""The store of a collection: a folder with the store of each object, and a document that names them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

from sobolev_batch.errors import DamageError, InputError, StoreError
from sobolev_batch.store.layout import COLLECTION, DIGEST, ROOT, Store, digest_of
from sobolev_batch.store.location import Location
from sobolev_batch.store.metadata import SCHEMA_VERSION
from sobolev_batch.study.study import Study

Result = TypeVar("Result")


@dataclass(frozen=True)
class CollectionStore:
    """The stores of the objects of a collection, below one location."""

    location: Location
    title: str
    name: str
    objects: tuple[str, ...]
    table: Mapping[str, Any]

    @property
    def existing_stores(self) -> dict[str, Location]:
        """Stores of the objects that have one, by name; see `existing_store`."""
        found = {name: self.existing_store(name) for name in self.objects}
        return {name: place for name, place in found.items() if place is not None}

    def existing_store(self, name: str) -> Location | None:
        """Return the store of an object, None before its reference was made; DamageError where it is another's."""
        store = Store(self.location.below(name))
        if not store.exists() or store.is_unfinished:
            return None
        study = store.attributes()["study"]["name"]
        if study != f"{self.name} {name}":
            problem = f"it holds the study {study!r}, not that of the object {name!r}"
            problem += "; put the store of this object back, or remove it"
            raise DamageError(f"{store.path}: {problem}", problem)
        return store.location

    @classmethod
    def read(cls, location: Location) -> CollectionStore | None:
        """Return the store of a collection at a location, None where there is none; DamageError if it was altered."""
        try:
            table = json.loads(location.read(ROOT) or b"")["attributes"][COLLECTION]
        except (ValueError, TypeError, KeyError, RecursionError):
            # There is nothing, or the store of one study.
            return None
        if not isinstance(table, dict) or table.pop(DIGEST, "") != digest_of(table):
            problem = "the list of its objects is not what was written"
            raise DamageError(f"{location}: {problem}; run the study again", problem)
        return cls(location, table["title"], table["name"], tuple(table["objects"]), table["table"])

    @classmethod
    def prepared(cls, location: Location, collection: Study) -> CollectionStore:
        """Write down at a location which objects a collection has, and return its store."""
        present = None
        with suppress(DamageError):
            present = cls.read(location)
        if present is None:
            # Where it is damaged, the stores of the objects are still there.
            location.require_free({ROOT, *collection.objects})
        elif present.name != collection.name:
            raise StoreError(
                f"{location}: it holds the store of another collection, {present.name!r}, not {collection.name!r}; "
                "name another store, or remove this one"
            )
        entry = {
            "name": collection.name,
            "title": collection.title,
            "objects": list(collection.objects),
            "lacking": {name: list(one.lacking) for name, one in collection.objects.items() if one.lacking},
            "table": dict(collection.table),
        }
        entry[DIGEST] = digest_of(entry)
        attributes = {"title": collection.title, "schema_version": SCHEMA_VERSION, COLLECTION: entry}
        root = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
        location.write({ROOT: json.dumps(root).encode()})
        return cls(location, collection.title, collection.name, tuple(collection.objects), collection.table)


def for_each_object(
    study: Study, location: Location, act: Callable[[str, Study, Location], Result]
) -> tuple[dict[str, Result], dict[str, str]]:
    """Act on the name, the study and the store of each object; return results, and why others have none, by name.

    A study that is none of a collection has the name "". Its errors are raised. Of objects, a StoreError ends it: the
    store of the next one would not fare better.
    """
    results: dict[str, Result] = {}
    refused: dict[str, str] = {}
    for name in study.objects:
        try:
            results[name] = act(name, study.of_object(name), location.below(name) if name else location)
        except StoreError:
            raise
        except InputError as error:
            if not name:
                raise
            refused[name] = str(error)
    return results, refused


def labelled(entries: Mapping[str, Mapping[str, Result]]) -> dict[str, Result]:
    """Return what the objects of a collection have by label, under labels that begin with the name of the object."""
    return {f"{name}/{label}": entry for name, own in entries.items() for label, entry in own.items()}
