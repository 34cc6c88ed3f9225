"""VTK's files: polygons, and unstructured grids of polygons.

VTK, which the extra vtk installs, reports what it cannot read and returns the rest; here every report is an error.
"""

from __future__ import annotations

import re
from collections import deque
from functools import partial
from tempfile import NamedTemporaryFile
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Indices
from sobolev_batch.errors import MeshError, from_extra
from sobolev_batch.geometry.formats.by_name import Format
from sobolev_batch.geometry.formats.parsing import Raw, xml_events
from sobolev_batch.geometry.formats.polygons import cut_polygons

# VTK's numbers for types of cells: vertices and lines, then those with area, triangles, polygons and quadrilaterals.
_WITHOUT_AREA, _VTK_TRIANGLE, _POLYGON, _QUAD = (1, 2, 3, 4), 5, 7, 9
_RAW_DATA = re.compile(rb"<AppendedData[^>]{0,200}encoding\s{0,9}=\s{0,9}[\"']raw[\"'][^>]{0,200}>\s{0,99}_")
_END = b"</VTKFile>"
# VTK has one place for the reports of all threads.
_shared = Lock()


def parse_vtk(data: bytes, suffix: str) -> Raw:
    """Return the vertices and triangles of a VTK file, legacy (.vtk) or XML (.vtp, .vtu)."""
    if suffix != ".vtk":
        _check_xml(data)
    with from_extra("vtk", "VTK files need", MeshError):
        import pyvista
    dataset = _dataset(data, suffix)
    kind = "nothing" if dataset is None else dataset.GetClassName()
    if kind == "vtkUnstructuredGrid":
        cells = dataset.GetCells()
        # PyVista knows what each version of VTK calls them.
        kinds = np.asarray(pyvista.wrap(dataset).celltypes, dtype=np.int64)
    elif kind == "vtkPolyData":
        if dataset.GetNumberOfStrips():
            raise MeshError("the file has strips; cut them: in PyVista by mesh.triangulate()")
        cells = dataset.GetPolys()
        kinds = np.full(cells.GetNumberOfCells(), _POLYGON)
    else:
        raise MeshError(
            f"the file holds {kind}, no polygons; take its surface first: in PyVista by "
            "mesh.extract_surface().triangulate(), then save it as .vtp"
        )
    ghosts = dataset.GetCellGhostArray()
    if ghosts is not None and _vtk_values(ghosts).any():
        raise MeshError(
            "the file has ghost cells, which belong to other parts of a surface; remove them: in PyVista by "
            "mesh.remove_ghost_cells()"
        )
    faces = _faces(kinds, _vtk_values(cells.GetConnectivityArray()), _vtk_values(cells.GetOffsetsArray()))
    return cut_polygons(_vtk_values(dataset.GetPoints().GetData()), *faces)


def _check_xml(data: bytes) -> None:
    """Refuse XML that would keep the library busy, and a file that breaks off."""
    if not data.rstrip().endswith(_END):
        raise MeshError(f"the file breaks off: it does not end with {_END.decode()}")
    raw = _RAW_DATA.search(data)
    # Raw bytes are no XML.
    document = data if raw is None else data[: raw.end()] + b"</AppendedData>" + _END
    deque(xml_events(document, "VTK"), maxlen=0)


def _dataset(data: bytes, suffix: str) -> Any:
    """Return the data set in a file, if VTK reports nothing about it."""
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkIOLegacy import vtkDataSetReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    readers: dict[str, Any] = {
        ".vtk": vtkDataSetReader,
        ".vtp": vtkXMLPolyDataReader,
        ".vtu": vtkXMLUnstructuredGridReader,
    }
    reports, reader = vtkStringOutputWindow(), readers[suffix]()
    with NamedTemporaryFile(suffix=suffix) as file, _shared:
        file.write(data)
        file.flush()
        window, verbosity = vtkOutputWindow.GetInstance(), vtkLogger.GetCurrentVerbosityCutoff()
        vtkOutputWindow.SetInstance(reports)
        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
        try:
            reader.SetFileName(file.name)
            reader.Update()
        finally:
            vtkLogger.SetStderrVerbosity(verbosity)
            vtkOutputWindow.SetInstance(window)
    if reports.GetOutput():
        # Each report begins with a place in VTK's code.
        raise MeshError(f"VTK reports: {re.sub(r'.*, line [0-9]+|[(]0x[0-9a-f]+[)]', '', reports.GetOutput())}")
    return reader.GetOutput()


def _vtk_values(array: Any) -> NDArray[Any]:
    """Return an array of VTK's, with integers in 64 bits."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    values = np.asarray(vtk_to_numpy(array))
    return values.astype(np.int64) if values.dtype.kind in "iu" else values


def _faces(kinds: Indices, corners: Indices, offsets: Indices) -> tuple[Indices, Indices]:
    """Return the corners of cells with area, and their numbers, from those of all and the places where each begins."""
    sizes = np.diff(offsets)
    if len(sizes) != len(kinds) or (sizes < 0).any() or sizes.sum() != len(corners):
        raise MeshError(f"the offsets of its {len(kinds)} cells do not run from 0 up to their {len(corners)} corners")
    has_area = ~np.isin(kinds, _WITHOUT_AREA)
    expected = np.select([kinds == _VTK_TRIANGLE, kinds == _QUAD, kinds == _POLYGON], [3, 4, sizes], -1)
    wrong = np.flatnonzero(has_area & (sizes != expected))
    if wrong.size:
        raise MeshError(
            f"cell {wrong[0] + 1} is of VTK's type {kinds[wrong[0]]} with {sizes[wrong[0]]} corners, no flat polygon; "
            "take the surface and cut it into triangles first: in PyVista by "
            "grid.extract_surface().triangulate(), then save it as .vtp"
        )
    return corners[np.repeat(has_area, sizes)], sizes[has_area]


FORMATS = (
    Format((".vtk",), partial(parse_vtk, suffix=".vtk"), 22, 290),
    *(Format((suffix,), partial(parse_vtk, suffix=suffix), 10, 215) for suffix in (".vtp", ".vtu")),
)
