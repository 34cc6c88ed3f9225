"""The tables of the objects of a collection."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from sobolev_batch.batch.collection_store import CollectionStore
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.errors import StoreError
from sobolev_batch.results.open import AnyStore

# The store of a collection, or stores of single objects by their names.
AnyCollection = str | Path | Location | Mapping[str, AnyStore]


def stores_of(store: AnyCollection) -> tuple[dict[str, AnyStore], tuple[str, ...]]:
    """Return the store of each object that has one, by its name, and the names of all objects.

    Raises:
        StoreError: The location has no store of a collection.
    """
    if isinstance(store, Mapping):
        return dict(store), tuple(store)
    location = Location.of(store)
    found = CollectionStore.found(location)
    if found is None:
        raise StoreError(
            f"{location}: no store of a collection is there; run a study with several objects, or give the stores of "
            "single objects by their names"
        )
    return dict(found.begun), found.objects
