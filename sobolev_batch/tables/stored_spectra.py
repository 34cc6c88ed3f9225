"""Radial spectra in the store: computed from fields by tasks, one chunk of rows each, and read for any order."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress

import numpy as np

from sobolev_batch.errors import DamageError
from sobolev_batch.norms.spectrum import ComparedSpectra
from sobolev_batch.store.layout import SPECTRA_GROUP, SPECTRA_KEYS, Store
from sobolev_batch.store.metadata import chunk_shape
from sobolev_batch.store.sealed_chunks import arrays_of, key_in, key_of, missing_chunks, read_chunk, seal
from sobolev_batch.tables.evaluator import Evaluator

# Raise it whenever the same fields lead to other spectra: those of older versions are then made again.
_SPECTRA_VERSION = 3


def spectrum_keys(keys: Mapping[int, str], reference: int) -> dict[int, str]:
    """Return what tells which fields a row's spectra were computed from, by the keys of all rows with a field."""
    of_reference = keys.get(reference, "")
    return {row: key_of([key, of_reference, str(_SPECTRA_VERSION)]) for row, key in keys.items()}


def chunks_of_spectra(store: Store) -> Iterator[range]:
    """Yield the rows of each chunk of spectra."""
    document = store.document(SPECTRA_KEYS)
    (count,), (step,) = document["shape"], chunk_shape(document)
    for first in range(0, count, step):
        yield range(first, min(first + step, count))


def stale_chunks(store: Store, keys: Mapping[int, str]) -> dict[int, range]:
    """Return the rows of the chunks that lack spectra with these keys, by the chunk's number; no spectrum is read."""
    missing, stale = missing_chunks(store, SPECTRA_KEYS), dict[int, range]()
    for number, rows in enumerate(chunks_of_spectra(store)):
        expected = {row: keys[row] for row in rows if row in keys}
        texts: list[str] = []
        if expected and (number,) not in missing:
            with suppress(DamageError):
                texts = np.asarray(store.read(SPECTRA_KEYS, slice(rows.start, rows.stop))).tolist()
        if (number,) in missing or not expected.items() <= dict(zip(rows, map(key_in, texts), strict=False)).items():
            stale[number] = rows
    return stale


def fill_chunk(evaluator: Evaluator, number: int, keys: Mapping[int, str]) -> None:
    """Compute the spectra of a chunk's rows, but for those that it has with these keys, and write the chunk."""
    store, rows = evaluator.store, list(chunks_of_spectra(evaluator.store))[number]
    widths = {f"{SPECTRA_GROUP}/{name}": width for name, (width, *_) in evaluator.axis.arrays().items()}
    arrays = {name: np.full((len(rows), widths[name]), np.nan) for name in arrays_of(store, SPECTRA_KEYS)}
    kept: set[int] = set()
    with suppress(DamageError):
        stored_keys, stored = read_chunk(store, SPECTRA_KEYS, (number,))
        kept = {row for row, key in zip(rows, stored_keys, strict=True) if key and keys.get(row) == key}
        for name, values in stored.items():
            arrays[name][_places(kept, rows)] = values[_places(kept, rows)]
    missing = {row for row in rows if row in keys} - kept
    for name, values in evaluator.spectra(sorted(missing)).arrays.items() if missing else ():
        arrays[f"{SPECTRA_GROUP}/{name}"][_places(missing, rows)] = values

    def write_keys(of: set[int]) -> None:
        values_of_rows = zip(rows, zip(*arrays.values(), strict=True), strict=True)
        texts = [seal(keys[row], values) if row in of else "" for row, values in values_of_rows]
        store.write(SPECTRA_KEYS, [number], texts)

    # Should this be interrupted, no old key may stand for new values.
    write_keys(kept)
    for name, values in arrays.items():
        store.write(name, [number], values)
    write_keys(kept | missing)


def _places(of: set[int], rows: range) -> list[int]:
    return [row - rows.start for row in sorted(of)]


def read_spectra(store: Store, rows: Sequence[int]) -> ComparedSpectra:
    """Return the spectra of rows, in their order; a damaged chunk raises a `DamageError`."""
    parts, wanted = [], set(rows)
    for number, chunk in enumerate(chunks_of_spectra(store)):
        if of_chunk := wanted.intersection(chunk):
            _, arrays = read_chunk(store, SPECTRA_KEYS, (number,))
            chosen = {name.partition("/")[2]: values[_places(of_chunk, chunk)] for name, values in arrays.items()}
            parts.append(ComparedSpectra(chosen))
    places = {row: place for place, row in enumerate(sorted(wanted))}
    return ComparedSpectra.joined(parts)[[places[row] for row in rows]]
