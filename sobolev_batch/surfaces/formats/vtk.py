"""VTK files of polygons and of unstructured grids, read by the library VTK, which the extra vtk installs.

VTK reports what it cannot read and returns the rest. Here every report is an error.
"""

from __future__ import annotations

import re
from collections import deque
from pathlib import Path
from tempfile import NamedTemporaryFile
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.parsing import Raw, triangle_fans, triangle_strips, xml_events

Indices = NDArray[np.int64]

_POLYGON, _STRIP, _PIXEL = 7, 6, 8
# Types of cells with a number of corners of their own: triangles, pixels and quadrilaterals.
_CORNERS = {5: 3, _PIXEL: 4, 9: 4}
# Vertices and lines.
_WITHOUT_AREA = (1, 2, 3, 4)
_RAW_DATA = re.compile(rb"<AppendedData[^>]{0,200}encoding\s{0,9}=\s{0,9}[\"']raw[\"'][^>]{0,200}>\s{0,99}_")
_END = b"</VTKFile>"
# VTK has one place for the reports of all threads.
_shared = Lock()


def parse_vtk(data: bytes, path: Path) -> Raw:
    """Return the vertices and triangles of a VTK file: of polygons first, then of strips.

    Args:
        data: Contents of the file, legacy or XML.
        path: Path of the file, whose name shows which.
    """
    suffix = Path(path.name.lower().removesuffix(".gz")).suffix
    if suffix != ".vtk":
        _check_xml(data)
    try:
        import pyvista
    except ImportError as error:
        raise MeshError(
            f"VTK files need a library that is missing ({error}); install the extra: pip install 'sobolev-batch[vtk]'"
        ) from error
    dataset = _read(data, suffix)
    kind = "nothing" if dataset is None else dataset.GetClassName()
    if kind == "vtkUnstructuredGrid":
        cells = dataset.GetCells()
        # PyVista knows what each version of VTK calls them.
        parts = [(np.asarray(pyvista.wrap(dataset).celltypes, dtype=np.int64), cells)]
    elif kind == "vtkPolyData":
        all_cells = ((_POLYGON, dataset.GetPolys()), (_STRIP, dataset.GetStrips()))
        parts = [(np.full(cells.GetNumberOfCells(), type_), cells) for type_, cells in all_cells]
    else:
        raise MeshError(
            f"the file holds {kind}, no polygons; take its surface first: in PyVista by "
            "mesh.extract_surface().triangulate(), then save it as .vtp"
        )
    ghosts = dataset.GetCellGhostArray()
    if ghosts is not None and _values(ghosts).any():
        raise MeshError(
            "the file has ghost cells, which belong to other parts of a surface; remove them: in PyVista by "
            "mesh.remove_ghost_cells()"
        )
    triangles = [
        _triangles(types, _values(cells.GetConnectivityArray()), _values(cells.GetOffsetsArray()))
        for types, cells in parts
    ]
    if not sum(map(len, triangles)):
        raise MeshError("the file has no faces")
    return _values(dataset.GetPoints().GetData()), np.concatenate(triangles)


def _check_xml(data: bytes) -> None:
    """Refuse XML that would keep the library busy, and a file that breaks off."""
    if not data.rstrip().endswith(_END):
        raise MeshError(f"the file breaks off: it does not end with {_END.decode()}")
    raw = _RAW_DATA.search(data)
    # Raw bytes are no XML.
    document = data if raw is None else data[: raw.end()] + b"</AppendedData>" + _END
    deque(xml_events(document, "VTK"), maxlen=0)


def _read(data: bytes, suffix: str) -> Any:
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


def _values(array: Any) -> NDArray[Any]:
    """Return an array of VTK's, with integers in 64 bits."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    values = np.asarray(vtk_to_numpy(array))
    return values.astype(np.int64) if values.dtype.kind in "iu" else values


def _triangles(kinds: Indices, corners: Indices, offsets: Indices) -> Indices:
    """Return the triangles (m, 3) of cells: of polygons first, then of strips.

    Args:
        kinds: VTK's number for the type of each cell.
        corners: Vertex indices of all cells, one after the other.
        offsets: Place of each cell's first corner, and the end of the last one.
    """
    sizes = np.diff(offsets)
    if len(sizes) != len(kinds) or (sizes < 0).any() or sizes.sum() != len(corners):
        raise MeshError(f"the offsets of its {len(kinds)} cells do not run from 0 up to their {len(corners)} corners")
    expected = np.select([kinds == kind for kind in _CORNERS], list(_CORNERS.values()), sizes)
    flat = np.isin(kinds, (*_WITHOUT_AREA, *_CORNERS, _POLYGON, _STRIP))
    wrong = np.flatnonzero(~flat | (sizes != expected))
    if wrong.size:
        raise MeshError(
            f"cell {wrong[0] + 1} is of VTK's type {kinds[wrong[0]]} with {sizes[wrong[0]]} corners, no flat polygon; "
            "take the surface and cut it into triangles first: in PyVista by "
            "grid.extract_surface().triangulate(), then save it as .vtp"
        )
    of_corner = np.repeat(kinds, sizes)
    pixels = corners[of_corner == _PIXEL].reshape(-1, 4)
    if len(pixels):
        # The corners of pixels lie in rows.
        corners = corners.copy()
        corners[of_corner == _PIXEL] = pixels[:, [0, 1, 3, 2]].ravel()
    polygon, strip = np.isin(kinds, (*_CORNERS, _POLYGON)), kinds == _STRIP
    parts = [
        cut(corners[np.repeat(chosen, sizes)], sizes[chosen])
        for chosen, cut in ((polygon, triangle_fans), (strip, triangle_strips))
        if chosen.any()
    ]
    return np.concatenate(parts) if parts else np.empty((0, 3), dtype=np.int64)
