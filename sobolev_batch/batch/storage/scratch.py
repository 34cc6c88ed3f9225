"""Scratch space of a store: the parts of huge meshes, while they are computed."""

from __future__ import annotations

import io
import logging
import zipfile
from dataclasses import dataclass

import numpy as np

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.errors import StoreError
from sobolev_batch.surfaces.shapes.mesh import Mesh

_log = logging.getLogger(__name__)

_FOLDER = "scratch"


@dataclass(frozen=True)
class Scratch:
    """Batches of the triangles of meshes, each one key with a checksum, by row, token of the cut, and number."""

    location: Location

    def write(self, row: int, token: str, number: int, mesh: Mesh) -> None:
        """Store a batch of a row's mesh until the row is discarded."""
        archive = io.BytesIO()
        np.savez(archive, vertices=mesh.vertices, triangles=mesh.triangles)
        self.location.write({_key(row, token, number): archive.getvalue()})

    def read(self, row: int, token: str, number: int) -> Mesh:
        """Return a batch that was stored.

        Raises:
            StoreError: It is missing or damaged, or cannot be read.
        """
        archive = self.location.read(_key(row, token, number))
        try:
            if archive is None:
                raise ValueError("it is not there")
            with np.load(io.BytesIO(archive), allow_pickle=False) as arrays:
                return Mesh.from_checked(arrays["vertices"], arrays["triangles"])
        except (ValueError, KeyError, zipfile.BadZipFile) as error:
            raise StoreError(
                f"{self.location}: batch {number} of the triangles of row {row} cannot be read ({error}); "
                "run the study again"
            ) from error

    def discard(self, row: int | None = None) -> None:
        """Remove the batches of a row, or of all rows. A failure does no harm and is only reported."""
        try:
            self.location.remove(_FOLDER if row is None else f"{_FOLDER}/{row}")
        except StoreError as error:
            _log.warning("scratch space is left behind: %s", error)


def _key(row: int, token: str, number: int) -> str:
    return f"{_FOLDER}/{row}/{token}/{number}.npz"
