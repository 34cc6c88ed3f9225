"""Files of a mesh with its witness function at the vertices: PLY, or PolyData of VTK."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from sobolev_batch.errors import InputError, StoreError
from sobolev_batch.surfaces.shapes.mesh import Mesh

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
