"""Meshes of a store for display: made again by its study, simplified, with their witness functions at vertices."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Literal, Self, get_args

import fast_simplification
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.batch.study.plan import members_of
from sobolev_batch.batch.study.study import Study
from sobolev_batch.errors import InputError, SobolevBatchError
from sobolev_batch.results.tables.convergence import table
from sobolev_batch.results.tables.groups import Families, chosen_families, finished_group, reference_of
from sobolev_batch.spectral.backends.arrays import ComplexDtype
from sobolev_batch.spectral.metrics.witness import witness
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.subdivision import subdivided
from sobolev_batch.surfaces.shapes.surface import Similarity
from sobolev_batch.surfaces.sources.registry import Member

# Labels that a message lists as examples.
_MOST_LISTED = 3


@dataclass(frozen=True)
class MeshRebuilder:
    """Makes meshes of a store again.

    Attributes:
        members: Family and member of each surface that the study lists on this machine, by label.
        meshes: Table of the store about the computed meshes.
        similarity: Similarity from the meshes' own unit of length to the study's.
    """

    members: Mapping[str, tuple[str, Member]]
    meshes: xr.Dataset
    similarity: Similarity

    @classmethod
    def from_tree(cls, tree: xr.DataTree, folder: str | Path) -> Self:
        """Return the rebuilder of an open store.

        Args:
            tree: Open store.
            folder: Folder where relative paths in its study start.

        Raises:
            InputError: The study's meshes cannot be listed on this machine, or the store has no tables yet.
        """
        meshes = finished_group(tree, "meshes")
        try:
            members = members_of(Study.from_table(tree.attrs["study"]["table"], folder=folder))
        except SobolevBatchError as error:
            raise InputError(f"the study's meshes cannot be listed here: {error}") from error
        similarity = tree.attrs["similarity"]
        return cls(members, meshes, Similarity(similarity["scale"], tuple(similarity["origin"])))

    def rebuild(self, label: str, most_triangles: float = math.inf) -> tuple[Mesh, Mesh]:
        """Return the mesh of a label in its own unit of length, and in the study's.

        Files may have changed, and a store may name files that its study never read: only a mesh with the
        stored digest passes.

        Raises:
            SobolevBatchError: The mesh cannot be made, is too large, or is not the one that was computed.
        """
        row = self.meshes.sel(mesh=label)
        triangles = row["triangles"].item()
        if row["status"].item() != "complete":
            raise InputError(f"its status is {row['status'].item()!r}")
        if label not in self.members:
            raise InputError("the study makes no such mesh here")
        if not triangles:
            raise InputError("a surface that is no mesh has no triangles")
        if triangles > most_triangles:
            raise InputError(f"it has {triangles:,} triangles; up to {most_triangles:,} are made again")
        own = self.members[label][1].load()
        scaled = self.similarity.apply(own)
        if not isinstance(own, Mesh) or not isinstance(scaled, Mesh) or scaled.digest != row["digest"].item():
            raise InputError("the study makes another mesh here than the one that was computed; its files have changed")
        return own, scaled


def matching_labels(names: Sequence[str], meshes: xr.Dataset, reference: str) -> tuple[str, ...]:
    """Return the labels that are meant by names, each once.

    Args:
        names: Labels, or patterns of them with the wildcards ``*``, ``?`` and ``[...]``. A pattern stands for meshes
            that are computed and have triangles.
        meshes: Table of all meshes.
        reference: Label of the reference, which no pattern stands for.

    Raises:
        InputError: The store has no such label; the message suggests one of the store.
    """
    known: list[str] = meshes["mesh"].values.tolist()
    usable = (meshes["status"] == "complete") & (meshes["triangles"] > 0) & (meshes["mesh"] != reference)
    candidates: list[str] = meshes["mesh"].values[usable.values].tolist()
    chosen: list[str] = []
    for name in names:
        if name in known:
            chosen.append(name)
            continue
        is_pattern = any(character in name for character in "*?[")
        matches = [label for label in candidates if fnmatchcase(label, name)] if is_pattern else []
        if not matches:
            similar = difflib.get_close_matches(name, known, n=1)
            remedy = f"did you mean {similar[0]!r}?" if similar else f"its labels are such as {_listed(known)}"
            raise InputError(
                f"the store has no computed mesh with triangles that matches {name!r}; "
                f"its labels are such as {_listed(candidates or known)}"
                if is_pattern
                else f"the store has no mesh {name!r}, {remedy}"
            )
        chosen += matches
    return tuple(dict.fromkeys(chosen))


def _listed(labels: Sequence[str]) -> str:
    return ", ".join(repr(label) for label in labels[:_MOST_LISTED])


def witness_at(
    tree: xr.DataTree, label: str, orders: Sequence[float], points: Reals, dtype: ComplexDtype = "complex128"
) -> Reals:
    """Return values (orders, n) from the stored fields at points (n, 3) in the study's unit; see `witness`."""
    fields = tree["fourier"].to_dataset()["fourier"]
    pair = fields.sel(mesh=label), fields.sel(mesh=reference_of(tree))
    return np.asarray(witness(*pair, list(orders), points, dtype=dtype).to_numpy(), dtype=np.float64)


def witness_at_vertices(tree: xr.DataTree, label: str, mesh: Mesh, orders: Sequence[float]) -> Reals:
    """Return values (orders, n) at a mesh's own vertices.

    Vertices that no triangle uses have NaN: they may lie beyond the lattice's period.

    Args:
        tree: Open store with tables.
        label: Label of the mesh.
        mesh: Mesh in the study's unit.
        orders: Orders s.
    """
    used = mesh.used_vertices
    values = np.full((len(orders), len(mesh.vertices)), np.nan)
    values[:, used] = witness_at(tree, label, orders, mesh.vertices[used])
    return values


Reals = NDArray[np.float64]
Triangles = NDArray[np.int32]

Axis = Literal["x", "y", "z"]
_AXES: tuple[Axis, ...] = get_args(Axis)

# Unit vector to the viewer of the usual view, with the third axis upwards.
FRONT: Reals = np.array([1.25, -1.4, 0.8]) / np.linalg.norm([1.25, -1.4, 0.8])
# Colours cover this fraction of the area, and all of it unless the largest value exceeds the others by the factor.
COVERED_AREA, _OUTLYING = 0.99, 1.25
# Places count by this power of their values: the worst ones alone decide.
_POWER = 4
# The worst places face one way if the mean of their normals is as long, and the usual view shows them if the cosine
# between both is as large. A view is not steeper than this height of the unit vector.
_ONE_WAY, _SHOWN, _STEEPEST = 0.5, 0.4, 0.9

# Of a store, unless meshes are named.
_MOST_EXTREMES = 4
_ENOUGH_TRIANGLES = 6_000
# Larger meshes take minutes to be made again.
_LARGEST_REBUILT = 2_000_000


@dataclass(frozen=True)
class ViewLimits:
    """Limits on the size of views.

    Attributes:
        meshes: Number of meshes.
        triangles: Number of triangles of each mesh; larger ones are simplified.
        values: Number of values of all meshes and orders together.
    """

    meshes: int
    triangles: int
    values: int


# Beyond, a page would take long to load and to turn; values take 4 bytes each.
PAGE = ViewLimits(meshes=4, triangles=8_000, values=300_000)
# A picture has hardly more dots on a mesh; values take 8 bytes each, in memory.
PICTURES = ViewLimits(meshes=100, triangles=200_000, values=50_000_000)


@dataclass(frozen=True)
class MeshView:
    """A mesh with its witness function.

    Attributes:
        label: Label of the mesh.
        vertices: Points (n, 3) in the study's unit of length, turned so that the third axis points upwards.
        triangles: Indices of vertices, (m, 3).
        values: Witness function (orders, n), positive where the mesh has area that the reference lacks, in
            1 / unit length.
        orders: Orders s.
        original_triangles: Number of triangles of the mesh itself; the view has fewer where it is a simplification,
            and more where it subdivides them.
        eye: Unit vector (3,) to the viewer of pictures.
    """

    label: str
    vertices: Reals
    triangles: Triangles
    values: Reals
    orders: tuple[float, ...]
    original_triangles: int
    eye: Reals = field(default_factory=FRONT.copy)

    @property
    def color_limits(self) -> Reals:
        """Ends (orders,) of scales of colours on which a few outliers do not make the rest white.

        The modulus that is not exceeded on 99 % of the area, or the largest one if that is hardly larger; 1 for zeros.
        """
        # A third of each triangle belongs to each of its corners.
        areas = np.repeat(np.linalg.norm(self._normals, axis=1), 3)
        areas = np.bincount(self.triangles.ravel(), areas, minlength=len(self.vertices))
        limits = []
        for moduli in np.abs(self.values):
            order = np.argsort(moduli)
            below = np.cumsum(areas[order])
            covering = moduli[order][min(np.searchsorted(below, COVERED_AREA * below[-1]), len(order) - 1)]
            largest = moduli.max()
            limits.append(largest if largest <= _OUTLYING * covering or covering == 0 else covering)
        return np.array([float(limit) or 1.0 for limit in limits])

    def towards_worst(self) -> Self:
        """Return the view from the side of the worst places at the first order, if the usual view hides them."""
        strength = (np.minimum(np.abs(self.values[0]) / self.color_limits[0], 1.0) ** _POWER)[self.triangles].mean(
            axis=1
        )
        # The orientation of triangles is not to be trusted: away from the middle of the mesh.
        middle = (self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2
        outwards = np.einsum("ij,ij->i", self._normals, self.vertices[self.triangles].mean(axis=1) - middle)
        facing = strength @ (self._normals * np.where(outwards < 0, -1, 1)[:, None])
        total = strength @ np.linalg.norm(self._normals, axis=1)
        length = float(np.linalg.norm(facing))
        if length <= _ONE_WAY * total or facing @ FRONT >= _SHOWN * length:
            return self
        eye = facing / length
        level = np.hypot(*eye[:2]) or 1.0
        height = float(np.clip(eye[2], -_STEEPEST, _STEEPEST))
        sideways = eye[:2] / level if np.hypot(*eye[:2]) > 1e-6 else FRONT[:2] / np.hypot(*FRONT[:2])
        return replace(self, eye=np.append(sideways * np.sqrt(1 - height**2), height))

    @property
    def _normals(self) -> Reals:
        """Normals (m, 3) of the triangles, whose lengths are twice the areas."""
        first, second, third = (self.vertices[self.triangles[:, k]] for k in range(3))
        return np.asarray(np.cross(second - first, third - first))


@dataclass(frozen=True)
class Views:
    """Views of meshes, and reasons for those that are missing.

    Attributes:
        views: Views in the order of the study.
        missing: Reason for each requested mesh without a view.
    """

    views: tuple[MeshView, ...]
    missing: Mapping[str, str]


def make_views(
    tree: xr.DataTree,
    folder: str | Path,
    meshes: Sequence[str] = (),
    limits: ViewLimits = PAGE,
    up: Axis = "z",
    orders: Sequence[float] | None = None,
    family: Families = None,
) -> Views:
    """Make a few meshes of a store again, by its study, and evaluate their witness functions on them.

    Args:
        tree: Open store.
        folder: Folder where relative paths in the study start.
        meshes: Labels, or patterns such as "scans/*"; by default the closest mesh of each chosen family at the first
            order, and the farthest ones.
        limits: Limits on the size of the views.
        up: Axis that points upwards in the meshes' own coordinates.
        orders: Orders s of the witness functions; default the store's.
        family: Families to choose from, by names or globs; default all.

    Raises:
        InputError: A label or family is unknown, or more meshes are named than may be shown.
    """
    named = matching_labels(meshes, finished_group(tree, "meshes"), reference_of(tree))
    if len(named) > limits.meshes:
        raise InputError(f"at most {limits.meshes} meshes can be shown, found {len(named)}")
    chosen = tuple(finished_group(tree, "convergence")["order"].values.tolist() if orders is None else orders)
    labels = named or tuple(_extremes(tree, chosen[0], chosen_families(tree, family)))
    try:
        rebuilder = MeshRebuilder.from_tree(tree, folder)
    except InputError as error:
        return Views((), dict.fromkeys(labels, str(error)))
    # A closed mesh has half as many vertices as triangles.
    most_triangles = min(limits.triangles, 2 * limits.values // (max(1, len(labels)) * len(chosen)))
    views, missing = [], {}
    for label in labels:
        try:
            _, mesh = rebuilder.rebuild(label, _LARGEST_REBUILT)
            views.append(_view(tree, label, mesh, chosen, most_triangles, up))
        except SobolevBatchError as error:
            missing[label] = str(error)
    return Views(tuple(views), missing)


def _extremes(tree: xr.DataTree, order: float, families: Sequence[str]) -> Iterator[str]:
    """Yield the mesh of each of some families that is closest to the reference, then those that are farthest."""
    frame = table(tree, order)
    frame = frame[frame["family"].isin(families) & (frame["distance"] > 0) & (frame["triangles"] > 0)]
    groups = [rows for _, rows in frame.groupby("family", sort=False)]
    extremes = [rows["distance"].idxmin() for rows in groups] + [rows["distance"].idxmax() for rows in groups]
    yield from frame.loc[list(dict.fromkeys(extremes))[:_MOST_EXTREMES], "mesh"]


def _view(tree: xr.DataTree, label: str, mesh: Mesh, orders: tuple[float, ...], most: int, up: Axis) -> MeshView:
    used = mesh.used_vertices
    number = np.empty(len(mesh.vertices), dtype=np.int32)
    number[used] = np.arange(len(used))
    own, corners = mesh.vertices[used], number[mesh.triangles]
    vertices, triangles = _for_display(own, corners, most)
    if vertices is own:
        values = witness_at_vertices(tree, label, mesh, orders)[:, used]
    else:
        # Collapsed edges may leave the period by a hair where the mesh fills it.
        vertices = np.clip(vertices, own.min(axis=0), own.max(axis=0))
        values = witness_at(tree, label, orders, vertices, dtype="complex64")
    # A cyclic permutation of the axes, which does not mirror the mesh.
    upright = np.roll(vertices, _AXES.index("z") - _AXES.index(up), axis=1)
    return MeshView(label, upright, triangles, values, orders, len(corners)).towards_worst()


def _for_display(vertices: Reals, triangles: Triangles, most: int) -> tuple[Reals, Triangles]:
    """Simplify a large mesh, and subdivide a small one so that values vary within its triangles."""
    if len(triangles) > most:
        simplified = fast_simplification.simplify(vertices, triangles, target_count=most)
        return np.asarray(simplified[0], dtype=np.float64), np.asarray(simplified[1], dtype=np.int32)
    while 4 * len(triangles) <= min(most, _ENOUGH_TRIANGLES):
        finer = subdivided(Mesh(vertices, triangles))
        vertices, triangles = finer.vertices, finer.triangles.astype(np.int32)
    return vertices, triangles
