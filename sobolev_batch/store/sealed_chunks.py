"""Chunks of numbers that tasks of the reduction fill, sealed by keys: radial spectra, and distances of all pairs.

Their groups have an array of keys, with a chunk for each chunk of the others along the meshes. Keys tell which fields
the numbers were computed from, so that they are computed again only where a field has changed. They are stored with
checksums of the numbers: a chunk that took the place of another is found.
"""

import hashlib
from collections.abc import Iterable, Iterator

import numpy as np

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import DamageError
from sobolev_batch.store.checked import CHANGED, checksum_of
from sobolev_batch.store.layout import Store
from sobolev_batch.store.metadata import chunk_shape

# Raise it where other numbers are computed from the same fields: all chunks are then stale.
_VERSION = "2"
# An index is the place of a chunk of keys, counted in chunks.
Index = tuple[int, ...]


def key_of(parts: Iterable[str]) -> str:
    """Return the key for what a chunk's numbers depend on."""
    return hashlib.sha256(" ".join([_VERSION, *parts]).encode()).hexdigest()[:32]


def arrays_of(store: Store, keys: str) -> list[str]:
    """Return the names of the arrays that an array of keys is for, sorted."""
    group = keys.split("/")[0]
    return sorted(name for name in store.keyed_arrays() if name.startswith(f"{group}/") and name != keys)


def missing_chunks(store: Store, keys: str) -> set[Index]:
    """Return the places that are not there as a whole. No chunk is read."""
    sizes, axes = store.location.sizes(keys.split("/")[0]), len(store.document(keys)["shape"])
    return {index[:axes] for name in [keys, *arrays_of(store, keys)] for index in store.incomplete_chunks(name, sizes)}


def damaged_chunks(store: Store) -> Iterator[tuple[tuple[str, Index], str]]:
    """Yield the array of keys with the place, and the damage, of each chunk that is not what was written."""
    for keys in store.keyed_arrays():
        if keys.endswith("/key"):
            for index in store.chunk_keys(keys).values():
                try:
                    read_chunk(store, keys, index)
                except DamageError as error:
                    yield (keys, index), error.what


def read_chunk(store: Store, keys: str, index: Index) -> tuple[list[str], dict[str, Reals]]:
    """Return a chunk of keys, flattened, and of their arrays by name; DamageError where they do not match."""
    sealed = np.asarray(store.read(keys, _region(store, keys, index)))
    arrays = {name: np.asarray(store.read(name, _region(store, name, index))) for name in arrays_of(store, keys)}
    # A single key is for the whole of a chunk, others are for its rows.
    for number, text in enumerate(sealed.ravel().tolist()):
        own = [values[number] if sealed.ndim == 1 else values for values in arrays.values()]
        if text and text != seal(key_in(text), own):
            raise store.damage(f"chunk {index} of {keys.split('/')[0]}", CHANGED)
    return [key_in(text) for text in sealed.ravel().tolist()], arrays


def seal(key: str, arrays: Iterable[Reals]) -> str:
    """Return a key with the checksums of the values that it is for, in the order of `arrays_of`."""
    return " ".join([key, *(str(checksum_of(np.ascontiguousarray(values))) for values in arrays)])


def key_in(text: str) -> str:
    """Return the key of a `seal`, or none of an empty text."""
    return text.partition(" ")[0]


def withdraw_chunk(store: Store, keys: str, index: Index) -> None:
    """Erase the keys of a damaged chunk: the next run computes it again."""
    store.write(keys, index, np.full(chunk_shape(store.document(keys)), ""))


def _region(store: Store, name: str, index: Index) -> tuple[slice, ...]:
    """Return the place of an array's chunk along the axes of its keys."""
    axes = zip(index, chunk_shape(store.document(name)), strict=False)
    return tuple(slice(step * number, step * (number + 1)) for number, step in axes)
