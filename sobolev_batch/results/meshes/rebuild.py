"""Meshes of a store, made again by its study: a store holds their fields, not their triangles."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Self

import xarray as xr

from sobolev_batch.batch.study.plan import members_of
from sobolev_batch.batch.study.study import Study
from sobolev_batch.errors import InputError, SobolevBatchError
from sobolev_batch.results.tables.groups import finished_group
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.sources.registry import Member

# Labels of which a message gives examples.
_MOST_LISTED = 3


@dataclass(frozen=True)
class RebuiltMesh:
    """A mesh that is, to the bit, the one whose field is stored.

    Attributes:
        own: Mesh in its own unit of length, as in its file or from its source.
        scaled: Mesh in the study's unit.
    """

    own: Mesh
    scaled: Mesh


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

    def rebuild(self, label: str, most_triangles: float = math.inf) -> RebuiltMesh:
        """Return the mesh of a label.

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
        return RebuiltMesh(own, scaled)


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
