"""Witness functions of the meshes of a store, exported for programs that show meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import xarray as xr

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.errors import InputError
from sobolev_batch.results.meshes.files import SUFFIXES, VertexField
from sobolev_batch.results.meshes.rebuild import Remaker, require_known
from sobolev_batch.results.meshes.witness import witness_at_vertices
from sobolev_batch.results.open import fields_read, open_store
from sobolev_batch.results.tables.convergence import finished_group
from sobolev_batch.spectral.shells import check_orders
from sobolev_batch.surfaces.sources.names import file_stem


@dataclass(frozen=True)
class Exporter:
    """Makes the meshes of a store again, each with its witness function.

    Attributes:
        place: of the store.
        tree: the store, open.
        remaker: of its meshes.
        orders: s, each.
    """

    place: str | Path | Location
    tree: xr.DataTree
    remaker: Remaker
    orders: tuple[float, ...]

    @classmethod
    def of(cls, place: str | Path | Location, orders: Sequence[float] | None = None, folder: str | Path = ".") -> Self:
        """For the store at a path or URL.

        Args:
            place: path or URL of the store.
            orders: any below -1/2; by default those of the study.
            folder: where relative paths in the study start.

        Raises:
            InputError: the store has no tables yet or no field of its reference, or the study's meshes cannot be
                listed here.
            OrderError: an order that is not below -1/2.
            StoreError: no store is there.
        """
        tree = open_store(place)
        of_study = finished_group(tree, "convergence")["order"].values.tolist()
        chosen = tuple(dict.fromkeys(of_study if orders is None else check_orders(list(orders))))
        remaker = Remaker.of(tree, tree.attrs["study"]["table"], folder)
        found = cls(place, tree, remaker, chosen)
        status = remaker.meshes["status"].sel(mesh=found.reference).item()
        if status != "complete":
            raise InputError(f"the reference {found.reference!r} is {status}: there is nothing to compare with")
        return found

    @property
    def reference(self) -> str:
        """The label of the reference, whose own witness is zero."""
        return str(self.tree["convergence"].attrs["reference"])

    def labels(self, wanted: Sequence[str] = ()) -> tuple[str, ...]:
        """The meshes to be exported: by default all that are complete and have triangles, without the reference.

        Raises:
            InputError: a label that the store does not have, or the reference's.
        """
        meshes = self.remaker.meshes
        require_known(wanted, meshes)
        if self.reference in wanted:
            raise InputError(f"{self.reference!r} is the reference: its witness is zero everywhere")
        if wanted:
            return tuple(dict.fromkeys(wanted))
        chosen = (meshes["status"] == "complete") & (meshes["triangles"] > 0) & (meshes["mesh"] != self.reference)
        return tuple(meshes["mesh"].values[chosen.values].tolist())

    def stem(self, label: str) -> str:
        """The name of a file for a mesh, without suffix: its number in the store, and what is plain of its label."""
        return file_stem(self.remaker.meshes["mesh"].values.tolist().index(label), label)

    def field(self, label: str) -> VertexField:
        """A mesh with its witness function.

        Raises:
            SobolevBatchError: the mesh cannot be made again, or its field is damaged.
        """
        mesh = self.remaker.make(label)
        with fields_read(self.place):
            values = witness_at_vertices(self.tree, label, mesh.scaled, self.orders)
        unit = 1 / self.remaker.similarity.scale
        study = str(self.tree.attrs["study"]["name"])
        return VertexField(mesh.own, values, self.orders, unit, label, self.reference, study)


def write_witness(
    store: str | Path | Location,
    label: str,
    path: str | Path,
    orders: Sequence[float] | None = None,
    folder: str | Path = ".",
) -> Path:
    """Write a mesh of a store with its witness function against the reference at its vertices.

    The mesh is made again by its study, and only written if it is, to the bit, the one that was computed. A
    PLY file holds the vertices in the mesh's own unit in double precision, a property such as
    ``witness_minus_2`` for each order, and the first order as ``quality``, which MeshLab shows; a .vtp file
    (XML PolyData, for ParaView) holds arrays such as ``witness, order -2``. Both tell what the numbers are.

    Args:
        store: path or URL of the store.
        label: of the mesh, such as "family/name".
        path: the file to write; its suffix is .ply or .vtp. The latter takes the extra "vtk".
        orders: any below -1/2; by default those of the study.
        folder: where relative paths in the study start.

    Returns:
        The path of the file. Its values are in 1 / unit length of the study, positive where the mesh has area
        that the reference lacks; see `witness`.

    Raises:
        InputError: an unknown label or suffix; a library that is not installed; a mesh that cannot be
            made again, or is not the one that was computed.
        StoreError: no store is there, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: a witness is written as {' or '.join(SUFFIXES)}, found {path.suffix!r}")
    exporter = Exporter.of(store, orders, folder)
    (chosen,) = exporter.labels([label])
    exporter.field(chosen).write(path)
    return path
