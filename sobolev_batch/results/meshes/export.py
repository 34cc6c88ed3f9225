"""Witness functions of the meshes of a store, exported for programs that show meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import xarray as xr

from sobolev_batch.errors import InputError
from sobolev_batch.results.meshes.files import SUFFIXES, VertexField
from sobolev_batch.results.meshes.rebuild import MeshRebuilder, matching_labels
from sobolev_batch.results.meshes.witness import witness_at_vertices
from sobolev_batch.results.open import AnyStore, as_tree, fields_read
from sobolev_batch.results.tables.groups import finished_group, reference_of
from sobolev_batch.spectral.shells import Orders, check_orders
from sobolev_batch.surfaces.sources.names import file_stem


@dataclass(frozen=True)
class Exporter:
    """Makes the meshes of a store again, each with its witness function.

    Attributes:
        tree: Open store.
        rebuilder: Rebuilder of its meshes.
        orders: Orders s.
        reference: Label of the reference, whose own witness function is zero.
    """

    tree: xr.DataTree
    rebuilder: MeshRebuilder
    orders: tuple[float, ...]
    reference: str

    @classmethod
    def from_store(cls, store: AnyStore, order: Orders | None = None, folder: str | Path = ".") -> Self:
        """Return the exporter of a store.

        Args:
            store: Path, URL or opened DataTree of the store.
            order: One order below -1/2, or several; by default those of the study.
            folder: Folder where relative paths in the study start.

        Raises:
            InputError: The store has no tables yet or no field of its reference, or the study's meshes cannot be
                listed on this machine.
            OrderError: An order is not below -1/2.
            StoreError: The location has no store of a study.
        """
        tree = as_tree(store)
        of_study = finished_group(tree, "convergence")["order"].values.tolist()
        orders = tuple(dict.fromkeys(check_orders(of_study if order is None else order)))
        rebuilder, reference = MeshRebuilder.from_tree(tree, folder), reference_of(tree)
        status = rebuilder.meshes["status"].sel(mesh=reference).item()
        if status != "complete":
            raise InputError(f"the reference {reference!r} is {status}: no mesh can be compared with it")
        return cls(tree, rebuilder, orders, reference)

    def labels(self, meshes: Sequence[str] = ()) -> tuple[str, ...]:
        """Return the meshes to export: by default all computed ones with triangles, without the reference.

        Args:
            meshes: Labels, or patterns such as "scans/*".

        Raises:
            InputError: The store lacks a label, or it is the reference's.
        """
        table = self.rebuilder.meshes
        labels = matching_labels(meshes, table, self.reference)
        if self.reference in labels:
            raise InputError(f"{self.reference!r} is the reference: its witness is zero everywhere")
        if labels:
            return labels
        chosen = (table["status"] == "complete") & (table["triangles"] > 0) & (table["mesh"] != self.reference)
        return tuple(table["mesh"].values[chosen.values].tolist())

    def stem(self, label: str) -> str:
        """Return the file name of a mesh without suffix: its number in the store and the plain letters of its label."""
        return file_stem(self.rebuilder.meshes["mesh"].values.tolist().index(label), label)

    def field(self, label: str) -> VertexField:
        """Return a mesh with its witness function.

        Raises:
            SobolevBatchError: The mesh cannot be made again, or its field is damaged.
        """
        mesh = self.rebuilder.rebuild(label)
        with fields_read(self.tree):
            values = witness_at_vertices(self.tree, label, mesh.scaled, self.orders)
        unit = 1 / self.rebuilder.similarity.scale
        return VertexField(
            mesh.own, values, self.orders, unit, label, self.reference, str(self.tree.attrs["study"]["name"])
        )


def write_witness(
    store: AnyStore,
    mesh: str,
    path: str | Path,
    order: Orders | None = None,
    folder: str | Path = ".",
) -> Path:
    """Write a mesh of a store with its witness function against the reference at its vertices.

    The study makes the mesh again, and it is written only if it is, to the bit, the one that was computed. A
    PLY file holds the vertices in the mesh's own unit in double precision, a property such as
    ``witness_minus_2`` for each order, and the first order as ``quality``, which MeshLab shows; a .vtp file
    (XML PolyData, for ParaView) holds arrays such as ``witness, order -2``. Both explain their numbers in comments.

    Args:
        store: Path, URL or opened DataTree of the store.
        mesh: Label of the mesh, such as "family/name".
        path: File to write; its suffix is .ply or .vtp. The latter needs the extra "vtk".
        order: One order below -1/2, or several; by default those of the study.
        folder: Folder where relative paths in the study start.

    Returns:
        The path of the file. Its values are in 1 / unit length of the study, positive where the mesh has area
        that the reference lacks; see `witness`.

    Raises:
        InputError: The label or suffix is unknown; a library is not installed; the mesh cannot be
            made again, or is not the one that was computed.
        StoreError: The location has no store, or the file cannot be written.

    >>> import sobolev_batch as sb
    >>> path = sb.write_witness("storage/icosphere.zarr", "icosphere/2", "icosphere-2.ply", order=-4)
    >>> sb.read_mesh(path).vertices.shape
    (162, 3)
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: a witness is written as {' or '.join(SUFFIXES)}, found {path.suffix!r}")
    exporter = Exporter.from_store(store, order, folder)
    (label,) = exporter.labels([mesh])
    exporter.field(label).write(path)
    return path
