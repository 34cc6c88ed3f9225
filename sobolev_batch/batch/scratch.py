"""The scratch space of a store: pieces of huge meshes, there only while they are computed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import zarr
from zarr.codecs import Crc32cCodec

from sobolev_batch.batch.location import Location
from sobolev_batch.errors import StoreError
from sobolev_batch.surfaces.mesh import Mesh

_FOLDER = "scratch"
_ARRAYS = ("vertices", "triangles")


@dataclass(frozen=True)
class Scratch:
    """Pieces of meshes, by the rows that they belong to."""

    location: Location

    def write(self, row: int, number: int, mesh: Mesh) -> None:
        """Keep a piece of a row's mesh until it is discarded.

        Raises:
            StoreError: it cannot be written.
        """
        with self.location.access("written"):
            for name in _ARRAYS:
                values = getattr(mesh, name)
                zarr.create_array(
                    self.location.keys(values.nbytes),
                    name=_key(row, number, name),
                    data=values,
                    chunks=values.shape,
                    compressors=(Crc32cCodec(),),
                    overwrite=True,
                )

    def read(self, row: int, number: int) -> Mesh:
        """A piece that was written.

        Raises:
            StoreError: it is not there, damaged, or cannot be reached.
        """
        keys = self.location.keys()
        with self.location.access("read"):
            try:
                vertices, triangles = (
                    np.asarray(zarr.open_array(keys, path=_key(row, number, name), mode="r")[:]) for name in _ARRAYS
                )
            except (FileNotFoundError, ValueError) as error:
                raise StoreError(
                    f"{self.location}: piece {number} of the mesh of row {row} cannot be read ({error}); "
                    "run the study again"
                ) from error
        return Mesh.of_checked(vertices, triangles)

    def discard(self, row: int | None = None) -> None:
        """Remove the pieces of a row, or of all."""
        self.location.remove(_FOLDER if row is None else f"{_FOLDER}/{row}")


def _key(row: int, number: int, name: str) -> str:
    return f"{_FOLDER}/{row}/{number}/{name}"
