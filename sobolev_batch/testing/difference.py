"""Where two surfaces differ: meshes with their witness function at their vertices, as files and as pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from sobolev_batch.arrays import ComplexDtype, Reals
from sobolev_batch.errors import InputError, from_extra, write_file
from sobolev_batch.geometry.closest import signs
from sobolev_batch.geometry.formats.ply import write_ply
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.proximity import vertex_distances
from sobolev_batch.geometry.surface import Similarity, Surface, centering
from sobolev_batch.norms.accuracy.problem import support_of
from sobolev_batch.norms.accuracy.tolerance import Accuracy, core_lattice
from sobolev_batch.norms.causes import witness
from sobolev_batch.norms.fields import fourier_transform
from sobolev_batch.plugins import FEATURES, extra
from sobolev_batch.tables.text import place_text

_PICTURES = (".png", ".svg", ".pdf")
_PURPOSE = "a picture of meshes"
# Accuracy of the fields and of images in files, which are to be looked at.
_ACCURACY, _EPS = 1e-2, 1e-6
# Characters of a comment in a file.
_LONGEST_COMMENT = 600


@dataclass(frozen=True, eq=False)
class VertexWitness:
    """A mesh with its witness function at its vertices.

    Attributes:
        mesh: The mesh, in its own unit of length.
        values: Witness function (orders, vertices) in 1 / unit length of the context; NaN at vertices of no triangle.
        title: What was compared with what.
        unit: Unit of length of the context, in that of the mesh.
        distances: Distances (vertices,) of vertices from the reference by their names in files, in the unit of the
            mesh; see `named_distances`. None if not asked for.
        context: What the unit belongs to, a "study" or a "comparison".
    """

    mesh: Mesh
    values: Reals
    orders: Sequence[float]
    title: str
    unit: float
    distances: Mapping[str, Reals] | None = None
    context: str = "study"

    @property
    def largest(self) -> tuple[float, Reals]:
        """Value of the first order whose modulus is largest, and its place (3,) in the unit of the mesh."""
        vertex = int(np.nanargmax(np.abs(self.values[0])))
        return float(self.values[0, vertex]), self.mesh.vertices[vertex]

    @property
    def notes(self) -> list[str]:
        """Meaning of the numbers of a file, for its comments."""
        escaped = self.title.encode("unicode_escape").decode("ascii")
        notes = [
            f"witness function of the mesh {escaped[:_LONGEST_COMMENT]}",
            "positive where the mesh has area that the reference lacks, negative where it lacks area",
            f"in 1 / unit length of the {self.context}, orders " + ", ".join(map(order_text, self.orders)),
            f"coordinates are in the unit of the mesh; one unit of the {self.context} is {self.unit!r} of them",
        ]
        if self.distances is not None:
            notes.append("distance to the closest point of the reference, in the unit of the mesh")
        if self.distances is not None and "signed_distance" in self.distances:
            notes.append("signed_distance is positive outside of the reference and negative inside")
        return notes

    def to_ply(self) -> bytes:
        """Return the contents of a PLY file, in which the first order is also the quality that MeshLab shows."""
        # Readers of PLY accept letters, digits and underscores.
        rows = {
            f"witness_minus_{order_text(-order)}".replace(".", "_").replace("+", ""): row
            for order, row in zip(self.orders, self.values, strict=True)
        }
        first = next(iter(rows))
        columns = {"quality": rows[first].astype(np.float32), **rows, **(self.distances or {})}
        return write_ply(self.mesh, columns, [*self.notes, f"quality repeats {first}"])


def order_text(order: float) -> str:
    """Return an order as it is written in files.

    >>> order_text(-2.0), order_text(-2.5)
    ('-2', '-2.5')
    """
    return repr(float(order)).removesuffix(".0")


def witness_at_vertices(
    a: xr.DataArray, b: xr.DataArray, orders: Sequence[float], mesh: Mesh, dtype: ComplexDtype = "complex128"
) -> Reals:
    """Return the witness function of two fields, (orders, n), at a mesh's vertices; NaN where no triangle uses them."""
    used = mesh.used_vertices
    values = np.full((len(orders), len(mesh.vertices)), np.nan)
    values[:, used] = witness(a, b, list(orders), mesh.vertices[used], dtype=dtype)
    return values


def named_distances(mesh: Mesh, other: Mesh) -> dict[str, Reals]:
    """Return the distance (n,) of each vertex from another mesh, also with its sign where that mesh has sides."""
    distances = vertex_distances(mesh, other)
    sides = signs(other, mesh.vertices)
    return {"distance": distances} | ({} if sides is None else {"signed_distance": sides * distances})


def require_place(path: Path) -> None:
    """Create the folder of the files that `write_difference` writes; InputError where that cannot be done."""
    if path.suffix in _PICTURES:
        with from_extra("plot", "a picture needs"):
            extra(FEATURES, "picture", _PURPOSE)
    if not path.name:
        raise InputError(f"{str(path)!r} names no file; give a name such as {str(Path('failures', 'part'))!r}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise InputError(f"{str(path)!r}: its folder cannot be created: {error}") from error


def write_difference(
    a: Surface,
    b: Surface,
    path: Path,
    order: float,
    *,
    scaling: bool = True,
    names: tuple[str, str] = ("a", "b"),
    distances: str | None = None,
) -> str:
    """Write the meshes among two surfaces, each with the witness function of a against b at its vertices.

    If their unit is given, each vertex also has its distance from the other mesh. The path is that of a picture, .png,
    .svg or .pdf, or the beginning of those of files, to which "-a.ply" and "-b.ply" are added. Return where the
    surfaces differ most, and the files, as the end of a line in which surfaces have these names. StoreError where a
    file cannot be written; see also `require_place`.
    """
    require_place(path)
    similarity = Similarity.to_unit_ball(b) if scaling else Similarity()
    pair = [similarity.apply(surface) for surface in (a, b)]
    centered = list(map(centering(pair).apply, pair))
    fields = picture_fields(centered, order)
    is_picture = path.suffix in _PICTURES
    found, drawn = dict[Path, VertexWitness](), []
    for label, name, own, other, mesh in zip("ab", names, (a, b), (b, a), centered, strict=True):
        if isinstance(own, Mesh) and isinstance(mesh, Mesh):
            values = witness_at_vertices(*fields, (order,), mesh, dtype="complex64")
            is_measured = distances is not None and not is_picture
            lengths = named_distances(own, other) if is_measured and isinstance(other, Mesh) else None
            title = f"{label} against b, comparison {path.name}"
            one = VertexWitness(own, values, (order,), title, 1 / similarity.scale, lengths, "comparison")
            found[path.with_name(f"{path.name}-{label}.ply")] = one
            drawn.append((name, mesh))
    if not found:
        return "no witness: neither surface is a mesh"
    files = [*found]
    if is_picture:
        files = extra(FEATURES, "picture", _PURPOSE)(path, drawn, fields, order, distances, similarity.scale)
    for file, one in () if is_picture else found.items():
        write_file(file, one.to_ply(), "the witness")
    greatest, place = max((one.largest for one in found.values()), key=lambda largest: abs(largest[0]))
    kind = "more" if greatest > 0 else "less"
    near = f"{names[0]} has {kind} area near {place_text(place.tolist(), _ACCURACY / similarity.scale)}"
    return f"{near if greatest else 'they differ nowhere'}; witness: {' '.join(map(str, files))}"


def picture_fields(surfaces: Sequence[Surface], order: float) -> tuple[xr.DataArray, xr.DataArray]:
    """Return the Fourier fields of two surfaces around the origin, on a lattice for pictures."""
    lattice = core_lattice(support_of(surfaces), (order,), Accuracy(_ACCURACY))
    a, b = (fourier_transform(surface, lattice, _EPS, dtype="complex64", order=order) for surface in surfaces)
    return a, b
