"""Meshes of a store, made again by its study: a store holds their fields, not their triangles."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import xarray as xr

from sobolev_batch.batch.study.plan import members_of
from sobolev_batch.batch.study.study import Study
from sobolev_batch.errors import InputError, SobolevBatchError
from sobolev_batch.results.tables.convergence import finished_group
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.sources.registry import Member


@dataclass(frozen=True)
class Remade:
    """A mesh that is, to the bit, the one whose field is stored.

    Attributes:
        own: in its own unit of length, as its file or its source has it.
        scaled: in the study's unit.
    """

    own: Mesh
    scaled: Mesh


@dataclass(frozen=True)
class Remaker:
    """Makes meshes of a store again.

    Attributes:
        members: family and member of each surface that the study lists here, by label.
        meshes: the table of the store that tells what was computed.
        similarity: from the meshes' own unit of length to the study's.
    """

    members: Mapping[str, tuple[str, Member]]
    meshes: xr.Dataset
    similarity: Similarity

    @classmethod
    def of(cls, tree: xr.DataTree, table: Mapping[str, Any], folder: str | Path) -> Self:
        """For an open store.

        Args:
            tree: the store.
            table: the study as it was written.
            folder: where relative paths in it start.

        Raises:
            InputError: the study's meshes cannot be listed here, or the store has no tables yet.
        """
        meshes = finished_group(tree, "meshes")
        try:
            members = members_of(Study.from_table(table, folder=folder))
        except SobolevBatchError as error:
            raise InputError(f"the study's meshes cannot be listed here: {error}") from error
        found = tree.attrs["similarity"]
        return cls(members, meshes, Similarity(found["scale"], tuple(found["origin"])))

    def make(self, label: str, most_triangles: float = math.inf) -> Remade:
        """The mesh of a label.

        Files may have changed, and a store may name files that its study never saw: only a mesh with the
        stored digest passes.

        Raises:
            SobolevBatchError: it cannot be made, is larger than it may be, or is not the one that was computed.
        """
        about = self.meshes.sel(mesh=label)
        if about["status"].item() != "complete":
            raise InputError(f"it is {about['status'].item()}")
        if label not in self.members:
            raise InputError("the study makes no such mesh here")
        if not about["triangles"].item():
            raise InputError("a surface in closed form has no triangles")
        if about["triangles"].item() > most_triangles:
            raise InputError(f"it has {about['triangles'].item():,} triangles; up to {most_triangles:,} are made again")
        own = self.members[label][1].load()
        scaled = self.similarity.apply(own)
        if not isinstance(own, Mesh) or not isinstance(scaled, Mesh) or scaled.digest != about["digest"].item():
            raise InputError("what the study makes here is not the mesh that was computed; its files may have changed")
        return Remade(own, scaled)


def require_known(labels: Sequence[str], meshes: xr.Dataset) -> None:
    """Refuse labels that a store does not have.

    Raises:
        InputError: with a label of the store that one may have been meant for.
    """
    known = meshes["mesh"].values.tolist()
    for label in labels:
        if label not in known:
            near = difflib.get_close_matches(label, known, n=1)
            remedy = f"did you mean {near[0]!r}?" if near else f"only such as {known[0]!r}"
            raise InputError(f"the store has no mesh {label!r}, {remedy}")
