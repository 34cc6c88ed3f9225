"""Meshes of a store, made again by its study, with witness functions at their vertices; and as files."""

import difflib
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

import xarray as xr

from sobolev_batch.batch.start import MADE_MESHES
from sobolev_batch.errors import InputError, SobolevBatchError, StoreError, from_extra, write_file
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.parameters import as_names, check_flags, path_of
from sobolev_batch.sources.mesh_cache import MeshCache
from sobolev_batch.sources.names import file_stem, fits
from sobolev_batch.sources.registry import Member
from sobolev_batch.store.location import Location
from sobolev_batch.store.objects import root_of
from sobolev_batch.study.study import Study
from sobolev_batch.tables.open import (
    AnyStore,
    as_tree,
    finished_group,
    location_of,
    reference_of,
    require_one_object,
    root_attribute,
    similarity_of,
)
from sobolev_batch.testing.difference import VertexWitness, named_distances, order_text, witness_at_vertices
from sobolev_batch.transform.lattice import Orders, check_orders

_MOST_LISTED = 3


@dataclass(frozen=True)
class StudyMeshes:
    """The meshes of an open store, made again by its study.

    Attributes:
        members: Family and member of each surface that the study lists on this machine, by label.
    """

    tree: xr.DataTree
    members: Mapping[str, tuple[str, Member]]
    table: xr.Dataset

    @classmethod
    def from_tree(cls, tree: xr.DataTree, folder: str | Path) -> Self:
        """List the meshes of an open store, with relative paths in a folder; InputError where that fails."""
        require_one_object(tree)
        table = finished_group(tree, "meshes")
        try:
            study = Study.from_table(root_attribute(tree, "study")["table"], folder=folder)
            # The place that the store itself names may be anybody's.
            with suppress(InputError):
                place = root_of(Location.parse(location_of(tree)))
                study = study.with_cache(MeshCache(place.absolute().beside(MADE_MESHES)))
            members = study.object.members
        except SobolevBatchError as error:
            hint = "name the folder of the study by --folder (in Python: folder=)"
            raise InputError(f"the study's meshes cannot be listed here: {error}; {hint}") from error
        return cls(tree, members, table)

    def make(self, label: str, most_triangles: float = math.inf) -> tuple[Mesh, Mesh]:
        """Return the mesh of a label in its own unit of length, and in the study's, or SobolevBatchError.

        Files may have changed, and a store may name files that its study never read: only a mesh with the stored digest
        passes.
        """
        row = self.table.sel(mesh=label)
        triangles = row["triangles"].item()
        if row["status"].item() != "complete":
            raise InputError(f"its status is {row['status'].item()!r}")
        if label not in self.members:
            raise InputError("the study makes no such mesh here")
        if not triangles:
            raise InputError("a surface that is no mesh has no triangles")
        if triangles > most_triangles:
            raise InputError(f"it has {triangles:,.0f} triangles; up to {most_triangles:,} are made again")
        own = self.members[label][1].load()
        scaled = similarity_of(self.tree).apply(own)
        if not isinstance(own, Mesh) or not isinstance(scaled, Mesh) or scaled.digest != row["digest"].item():
            raise InputError("the study makes another mesh here than the one that was computed; its files have changed")
        return own, scaled

    @cached_property
    def reference(self) -> Mesh:
        """The reference in its own unit; InputError where it is no mesh, or see `make`."""
        label = reference_of(self.tree)
        try:
            return self.make(label)[0]
        except SobolevBatchError as error:
            raise InputError(f"distances from the reference {label!r} cannot be written: {error}") from error

    def with_witness(self, label: str, orders: Sequence[float], reference: Mesh | None = None) -> VertexWitness:
        """Return the mesh of a label with its witness function, and with distances from a reference if one is given."""
        own, scaled = self.make(label)
        values = witness_at_vertices(*fields_of(self.tree, label), orders, scaled)
        title = f"{label} against {reference_of(self.tree)}, study {root_attribute(self.tree, 'study')['name']}"
        lengths = None if reference is None else named_distances(own, reference)
        return VertexWitness(own, values, orders, title, 1 / similarity_of(self.tree).scale, lengths)


def stem_of(tree: xr.DataTree, label: str) -> str:
    """Return the file name of a mesh without suffix: its number in the store and the plain letters of its label."""
    return file_stem(int(tree["meshes"].indexes["mesh"].get_loc(label)), label)


def matching_labels(tree: xr.DataTree, names: Sequence[str]) -> tuple[str, ...]:
    """Return the labels of an open store that are meant by labels or patterns such as ``scans/*``, each once.

    A pattern stands for computed meshes with triangles but the reference. InputError, with a suggestion, without a
    match.
    """
    meshes = finished_group(tree, "meshes")
    known: list[str] = meshes["mesh"].values.tolist()
    usable = (meshes["status"] == "complete") & (meshes["triangles"] > 0) & (meshes["mesh"] != reference_of(tree))
    candidates: list[str] = meshes["mesh"].values[usable.values].tolist()
    chosen, labels = list[str](), set(known)
    for name in as_names(names):
        is_pattern = name not in labels and any(character in name for character in "*?[")
        among = candidates if is_pattern else known
        matches = [name] if name in labels else [label for label in among if fits(label, name)]
        chosen += matches
        if not matches:
            similar = [] if is_pattern else difflib.get_close_matches(name, known, n=1)
            such = ", ".join(map(repr, (among or known)[:_MOST_LISTED]))
            remedy = f"did you mean {similar[0]!r}?" if similar else f"its labels are such as {such}"
            what = "computed mesh with triangles that matches" if is_pattern else "mesh"
            raise InputError(f"the store has no {what} {name!r}; {remedy}")
    return tuple(dict.fromkeys(chosen))


def fields_of(tree: xr.DataTree, label: str) -> tuple[xr.DataArray, xr.DataArray]:
    """Return the stored fields of a mesh and of the reference."""
    fields = tree["fourier"].to_dataset()["fourier"]
    return fields.sel(mesh=label), fields.sel(mesh=reference_of(tree))


def exported(
    store: AnyStore, meshes: Sequence[str] = (), order: Orders | None = None, folder: str | Path = "."
) -> tuple[StudyMeshes, tuple[str, ...], tuple[float, ...]]:
    """Return the meshes of a store, with the labels and the orders whose witness functions are to be written.

    By default these are all computed meshes with triangles but the reference, and the orders of the study.
    """
    tree = as_tree(store)
    orders = check_orders(finished_group(tree, "convergence")["order"].values.tolist() if order is None else order)
    made, reference = StudyMeshes.from_tree(tree, folder), reference_of(tree)
    status = made.table["status"].sel(mesh=reference).item()
    if status != "complete":
        raise InputError(f"the reference {reference!r} is not computed: no mesh can be compared with it")
    labels = matching_labels(tree, meshes or ["*"])
    if reference in labels:
        raise InputError(f"{reference!r} is the reference: its witness is zero everywhere")
    return made, labels, orders


def write_witness(
    store: AnyStore,
    mesh: str,
    path: str | Path,
    order: Orders | None = None,
    folder: str | Path = ".",
    *,
    distances: bool = False,
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
        distances: Also write the distance of each vertex from the closest point of the reference, as ``distance``, in
            the mesh's own unit.

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
    path = path_of(path)
    check_flags(distances=distances)
    if path.suffix not in (".ply", ".vtp"):
        raise InputError(f"{path}: a witness is written as .ply or .vtp, found {path.suffix!r}")
    made, labels, orders = exported(store, [mesh], order, folder)
    if len(labels) > 1:
        raise InputError(f"{mesh!r} stands for several meshes, and one is written; give its label")
    try:
        found = made.with_witness(labels[0], orders, made.reference if distances else None)
    except StoreError:
        raise
    except InputError as error:
        raise InputError(f"{labels[0]}: {error}") from error
    write_vertex_witness(path, found)
    return path


def write_vertex_witness(path: Path, found: VertexWitness) -> None:
    """Write a mesh with its witness function as .ply or .vtp; StoreError where the file cannot be written."""
    write_file(path, found.to_ply() if path.suffix == ".ply" else _vtp(found), "the witness")


def _vtp(found: VertexWitness) -> bytes:
    with from_extra("vtk", "a .vtp file needs"):
        from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter
    surface = found.mesh.to_pyvista()
    names = [f"witness, order {order_text(order)}" for order in found.orders]
    for name, row in zip(names, found.values, strict=True):
        surface.point_data[name] = row
    if found.distances is not None:
        surface.point_data.update(found.distances)
    surface.point_data.active_scalars_name = names[0]
    surface.field_data["notes"] = found.notes
    # VTK writes into memory, since it does not report a full disk.
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(surface)
    writer.SetDataModeToBinary()
    writer.WriteToOutputStringOn()
    writer.Write()
    return str(writer.GetOutputString()).encode("ascii")
