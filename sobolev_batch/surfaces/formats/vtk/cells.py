"""Cells of VTK's data sets, cut into triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.polygons import triangle_fans, triangle_strips

Indices = NDArray[np.int64]

POLYGON, STRIP = 7, 6
_TRIANGLE, _PIXEL, _QUAD = 5, 8, 9
# Empty cells, vertices and lines.
_WITHOUT_AREA = (0, 1, 2, 3, 4)
_SIZES = {_TRIANGLE: 3, _PIXEL: 4, _QUAD: 4}


def cell_triangles(kinds: Indices, corners: Indices, sizes: Indices) -> Indices:
    """Return the triangles (m, 3) of cells: of polygons first, then of strips. Vertices and lines have none.

    Args:
        kinds: VTK's number for the kind of each cell.
        corners: Vertex indices of all cells, one after the other.
        sizes: Number of corners of each cell.

    Raises:
        MeshError: A cell has volume, curved sides or a wrong number of corners, or there are no triangles.
    """
    kinds = kinds.copy()
    of_corner = np.repeat(kinds, sizes)
    for kind, size in _SIZES.items():
        wrong = np.flatnonzero((kinds == kind) & (sizes != size))
        if wrong.size:
            raise MeshError(f"cell {wrong[0] + 1} has {sizes[wrong[0]]} corners, but cells of type {kind} have {size}")
        if kind == _PIXEL:
            # The corners of pixels lie in rows.
            pixels = corners[of_corner == kind].reshape(-1, 4)
            corners = corners.copy()
            corners[of_corner == kind] = pixels[:, [0, 1, 3, 2]].ravel()
        kinds[kinds == kind] = POLYGON
    unknown = np.flatnonzero(~np.isin(kinds, (*_WITHOUT_AREA, POLYGON, STRIP)))
    if unknown.size:
        raise MeshError(
            f"cell {unknown[0] + 1} is of VTK's type {kinds[unknown[0]]}, which is no flat polygon; take the surface "
            "and cut it into triangles first: in PyVista by grid.extract_surface().triangulate(), then save it as .vtp"
        )
    of_corner = np.repeat(kinds, sizes)
    parts = [
        cut(corners[of_corner == kind], sizes[kinds == kind])
        for kind, cut in ((POLYGON, triangle_fans), (STRIP, triangle_strips))
        if (kinds == kind).any()
    ]
    if not parts:
        raise MeshError("the file has no faces")
    return np.concatenate(parts)


def sizes_between(offsets: Indices, corner_count: int) -> Indices:
    """Return the numbers of corners of cells from the place of each one's first corner, and the end of the last one.

    Raises:
        MeshError: The offsets do not run from zero up to the number of corners.
    """
    sizes = np.diff(offsets)
    if not len(offsets) or offsets[0] != 0 or offsets[-1] != corner_count or (sizes < 0).any():
        raise MeshError(f"the offsets of its cells do not run from 0 up to the {corner_count} corners that there are")
    return sizes


def split_counted(numbers: Indices, count: int) -> tuple[Indices, Indices]:
    """Return corners and sizes of cells from numbers in which the size of each cell stands before its corners.

    Raises:
        MeshError: The numbers are not those of so many cells.
    """
    if not count or not len(numbers):
        sizes, places = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    elif len(numbers) % count == 0 and (numbers[:: len(numbers) // count] == len(numbers) // count - 1).all():
        # All cells are alike.
        places = np.arange(0, len(numbers), len(numbers) // count)
        sizes = numbers[places]
    else:
        listed, place = [], 0
        while place < len(numbers) and numbers[place] >= 0:
            listed.append(place)
            place += int(numbers[place]) + 1
        places = np.array(listed, dtype=np.int64)
        sizes = numbers[places]
    if len(sizes) != count or int(sizes.sum()) + count != len(numbers):
        raise MeshError(f"{len(numbers)} numbers do not make the {count} cells that are announced")
    return np.delete(numbers, places), sizes
