"""Files that show where two surfaces differ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.results.figures.meshes import witness_at_vertices, write_vertex_values
from sobolev_batch.spectral.adaptive.lattice_selection import core_lattice
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.budget import Support
from sobolev_batch.spectral.fields import fourier_transform
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.surface import Extent, Similarity, Surface

Reals = NDArray[np.float64]

# Of the fields and of images; the files are to be looked at.
_ACCURACY = 1e-2
_EPS = 1e-6


def require_place(path: Path) -> None:
    """Create the folder of the files that `write_difference` writes.

    Raises:
        InputError: The path names no file, or its folder cannot be created.
    """
    if not path.name:
        raise InputError(f"{str(path)!r} names no file; files get {str(Path('failures', 'part'))!r} and an ending")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise InputError(f"{str(path)!r}: its folder cannot be created: {error}") from error


def write_difference(
    a: Surface, b: Surface, path: Path, order: float, *, scaling: bool = True, subject: str = "a"
) -> str:
    """Write two meshes, each with the witness function of a against b at its vertices.

    Surfaces that are no meshes have no file.

    Args:
        a: Surface.
        b: Reference.
        path: Beginning of the paths of the files, to which "-a.ply" and "-b.ply" are added. Its folder is created.
        order: Order s.
        scaling: See `same_surface`.
        subject: Name of the surface in the sentence that is returned.

    Returns:
        Where the surfaces differ most, and the files, as the end of a line.

    Raises:
        InputError: The order is out of range, or the path names no file, or its folder cannot be created.
        StoreError: A file cannot be written.
    """
    similarity = Similarity.to_unit_ball(b) if scaling else Similarity()
    pair = [similarity.apply(surface) for surface in (a, b)]
    middle = np.mean(Extent.union([surface.extent for surface in pair]).box, axis=0)
    x, y, z = middle.tolist()
    centered = [Similarity(1.0, (x, y, z)).apply(surface) for surface in pair]
    extent = Extent.union([surface.extent for surface in centered])
    area = np.array(sum(surface.area for surface in centered))
    lattice = core_lattice(Support(area, extent.widths, extent.reach), (order,), Accuracy(_ACCURACY))
    fields = [fourier_transform(surface, lattice, _EPS, dtype="complex64", order=order) for surface in centered]
    require_place(path)
    written, greatest, place = [], 0.0, (0.0, 0.0, 0.0)
    for label, own, mesh in zip("ab", (a, b), centered, strict=True):
        if not isinstance(own, Mesh) or not isinstance(mesh, Mesh):
            continue
        values = witness_at_vertices(fields[0], fields[1], (order,), mesh, dtype="complex64")
        vertex = int(np.nanargmax(np.abs(values[0])))
        if abs(values[0, vertex]) > abs(greatest):
            greatest, place = float(values[0, vertex]), tuple(own.vertices[vertex].tolist())
        file = path.with_name(f"{path.name}-{label}.ply")
        title = f"{label} against b, comparison {path.name}"
        write_vertex_values(file, own, values, (order,), title, 1 / similarity.scale, context="comparison")
        written.append(file)
    if not written:
        return "no witness: neither surface is a mesh"
    files = f"witness: {' '.join(map(str, written))}"
    if greatest == 0:
        return f"they differ nowhere; {files}"
    kind = "more" if greatest > 0 else "less"
    return f"{subject} has {kind} area near ({', '.join(f'{x:.4g}' for x in place)}); {files}"
