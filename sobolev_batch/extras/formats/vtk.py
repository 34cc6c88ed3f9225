"""VTK's files: polygons and strips of triangles, also in unstructured grids.

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
from sobolev_batch.geometry.formats.parsing import Raw, beside_volume, triangle_strips, xml_events
from sobolev_batch.geometry.formats.polygons import cut_polygons

# VTK's numbers for types of cells: vertices and lines, those with area, and those with flat faces around a volume.
_WITHOUT_AREA, _VTK_TRIANGLE, _STRIP, _POLYGON, _PIXEL, _QUAD = (1, 2, 3, 4), 5, 6, 7, 8, 9
_WITH_VOLUME = range(10, 17)
_SURFACE = "python -c \"import pyvista; pyvista.read('scan{}').extract_surface().triangulate().save('scan.vtp')\""
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
        cells = dataset.GetPolys()
        kinds = np.repeat([_POLYGON, _STRIP], [cells.GetNumberOfCells(), dataset.GetNumberOfStrips()])
        cells.Append(dataset.GetStrips())
    else:
        raise MeshError(f"the file holds {kind}, no polygons; take its surface: {_SURFACE.format(suffix)}")
    ghosts = dataset.GetCellGhostArray()
    if ghosts is not None and _vtk_values(ghosts).any():
        raise MeshError(
            "the file has ghost cells, which belong to other parts of a surface; remove them: in PyVista by "
            "mesh.remove_ghost_cells()"
        )
    corners, offsets = _vtk_values(cells.GetConnectivityArray()), _vtk_values(cells.GetOffsetsArray())
    *faces, notes = _faces(kinds, corners, offsets, suffix)
    raw = cut_polygons(_vtk_values(dataset.GetPoints().GetData()), *faces)
    return raw._replace(notes=raw.notes + notes)


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
    if report := reports.GetOutput():
        # It is bytes where it quotes what is no UTF-8. Each report begins with a place in VTK's code.
        text = report.decode(errors="replace") if isinstance(report, bytes) else report
        raise MeshError(f"VTK reports: {re.sub(r'.*, line [0-9]+|[(]0x[0-9a-f]+[)]', '', text)}")
    return reader.GetOutput()


def _vtk_values(array: Any) -> NDArray[Any]:
    """Return an array of VTK's, with integers in 64 bits."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    values = np.asarray(vtk_to_numpy(array))
    return values.astype(np.int64) if values.dtype.kind in "iu" else values


def _faces(kinds: Indices, corners: Indices, offsets: Indices, suffix: str) -> tuple[Indices, Indices, tuple[str, ...]]:
    """Return the corners of faces, and their numbers, from those of all cells and the places where each begins."""
    sizes = np.diff(offsets)
    if len(sizes) != len(kinds) or (sizes < 0).any() or sizes.sum() != len(corners):
        raise MeshError(f"the offsets of its {len(kinds)} cells do not run from 0 up to their {len(corners)} corners")
    has_area, has_volume = ~np.isin(kinds, _WITHOUT_AREA), np.isin(kinds, _WITH_VOLUME)
    # Without any face beside them, they are refused.
    has_area &= ~has_volume | ~(has_area & ~has_volume).any()
    is_strip, is_pixel = kinds == _STRIP, kinds == _PIXEL
    known = [kinds == _VTK_TRIANGLE, (kinds == _QUAD) | is_pixel, (kinds == _POLYGON) | is_strip]
    wrong = np.flatnonzero(has_area & (sizes != np.select(known, [3, 4, sizes], -1)))
    if wrong.size:
        raise MeshError(
            f"cell {wrong[0] + 1} is of VTK's type {kinds[wrong[0]]} with {sizes[wrong[0]]} corners, no flat polygon; "
            f"take the surface: {_SURFACE.format(suffix)}"
        )
    # The corners of a pixel lie row by row, and not around it.
    last = offsets[:-1][is_pixel, None] + [2, 3]
    corners[last] = corners[last[:, ::-1]]
    strips = triangle_strips(corners[np.repeat(is_strip, sizes)], sizes[is_strip])
    has_area &= ~is_strip
    corners = np.concatenate([corners[np.repeat(has_area, sizes)], strips.ravel()])
    sizes = np.concatenate([sizes[has_area], np.full(len(strips), 3)])
    return corners, sizes, beside_volume(int(has_volume.sum()), len(sizes))


FORMATS = (
    Format((".vtk",), partial(parse_vtk, suffix=".vtk"), 22, 290),
    *(Format((suffix,), partial(parse_vtk, suffix=suffix), 10, 215) for suffix in (".vtp", ".vtu")),
)
