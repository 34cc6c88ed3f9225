"""Witness functions of the meshes of a store as files: PLY, or PolyData of VTK."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from sobolev_batch.errors import InputError, StoreError
from sobolev_batch.results.figures.views import MeshRebuilder, matching_labels, witness_at_vertices
from sobolev_batch.results.open import AnyStore, as_tree, fields_read
from sobolev_batch.results.tables.groups import finished_group, reference_of
from sobolev_batch.spectral.shells import Orders, check_orders
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.sources.names import file_stem

SUFFIXES = (".ply", ".vtp")

# In a comment.
_LONGEST_NAME = 200


@dataclass(frozen=True)
class VertexField:
    """A mesh with its witness function at its vertices.

    Attributes:
        mesh: Mesh in its own unit of length.
        values: Witness function (orders, vertices) in 1 / unit length of the study or comparison.
        orders: Orders s.
        unit: Unit of length of the study or comparison, in that of the mesh.
        label: Label of the mesh.
        reference: Label of the reference.
        name: Name of the study or comparison.
        context: Where the mesh was compared: a "study" or a "comparison".
    """

    mesh: Mesh
    values: NDArray[np.float64]
    orders: tuple[float, ...]
    unit: float
    label: str
    reference: str
    name: str
    context: str = "study"

    def write(self, path: Path) -> None:
        """Write a file in the format of its suffix, one of `SUFFIXES`.

        Raises:
            InputError: The library that writes the format is not installed.
            StoreError: The file cannot be written.
        """
        data = self._ply() if path.suffix == ".ply" else self._vtp()
        try:
            path.write_bytes(data)
        except OSError as error:
            raise StoreError(f"{path}: the witness cannot be written there: {error.strerror or error}") from error

    def notes(self) -> list[str]:
        """Return lines of ASCII that explain the numbers."""
        label, reference, name = map(_ascii, (self.label, self.reference, self.name))
        return [
            f"witness function of the mesh {label} against {reference}, {self.context} {name}",
            "positive where the mesh has area that the reference lacks, negative where it lacks area",
            f"in 1 / unit length of the {self.context}, orders " + ", ".join(map(_number, self.orders)),
            f"coordinates are in the unit of the mesh; one unit of the {self.context} is {self.unit!r} of them",
        ]

    def _ply(self) -> bytes:
        names = [_property(order) for order in self.orders]
        kinds = [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("quality", "<f4"), *((name, "<f8") for name in names)]
        vertices = np.empty(len(self.mesh.vertices), dtype=kinds)
        for axis, column in zip("xyz", self.mesh.vertices.T, strict=True):
            vertices[axis] = column
        # The scalar that MeshLab and similar programs show.
        vertices["quality"] = self.values[0]
        for name, row in zip(names, self.values, strict=True):
            vertices[name] = row
        faces = np.empty(len(self.mesh.triangles), dtype=[("vertex_indices", "<i4", (3,))])
        faces["vertex_indices"] = self.mesh.triangles
        elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
        comments = [*self.notes(), f"quality repeats {names[0]}"]
        file = io.BytesIO()
        PlyData(elements, text=False, byte_order="<", comments=comments).write(file)
        return file.getvalue()

    def _vtp(self) -> bytes:
        try:
            import pyvista
            from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter
        except ImportError as error:
            raise InputError(
                f"a .vtp file needs the library {error.name}, which is not installed; "
                "the extra has it: pip install 'sobolev-batch[vtk]'"
            ) from error
        threes = np.full((len(self.mesh.triangles), 1), 3)
        surface = pyvista.PolyData(np.array(self.mesh.vertices), np.hstack([threes, self.mesh.triangles]).ravel())
        for order, row in zip(self.orders, self.values, strict=True):
            surface.point_data[f"witness, order {_number(order)}"] = row
        surface.point_data.active_scalars_name = f"witness, order {_number(self.orders[0])}"
        surface.field_data["notes"] = self.notes()
        # In memory: VTK does not report a full disk.
        writer = vtkXMLPolyDataWriter()
        writer.SetInputData(surface)
        writer.SetDataModeToBinary()
        writer.WriteToOutputStringOn()
        writer.Write()
        return str(writer.GetOutputString()).encode("ascii")


def _number(order: float) -> str:
    return repr(float(order)).removesuffix(".0")


def _property(order: float) -> str:
    """Return a name of letters, digits and underscores, which readers of PLY accept."""
    digits = _number(-order).replace(".", "_").replace("+", "")
    return f"witness_minus_{digits}"


def _ascii(text: str) -> str:
    escaped = text.encode("unicode_escape").decode("ascii")
    return escaped if len(escaped) <= _LONGEST_NAME else escaped[: _LONGEST_NAME - 3] + "..."


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
        own, scaled = self.rebuilder.rebuild(label)
        with fields_read(self.tree):
            values = witness_at_vertices(self.tree, label, scaled, self.orders)
        unit = 1 / self.rebuilder.similarity.scale
        return VertexField(own, values, self.orders, unit, label, self.reference, str(self.tree.attrs["study"]["name"]))


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
