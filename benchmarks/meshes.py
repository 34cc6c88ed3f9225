"""Meshes that several benchmarks measure."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import trimesh

import sobolev_batch as sb
from benchmarks.timing import Effort
from sobolev_batch.sources.derived import decimated
from sobolev_batch.sources.files import FileSource

_CORTEX = "nilearn/datasets/data/fsaverage5/pial_left.gii.gz"


def pair_of_cortex(effort: Effort, triangles: int) -> tuple[sb.Mesh, sb.Mesh]:
    """A cortical surface decimated to some triangles, and itself; two icospheres where it is not installed."""
    if effort.quick or find_spec("nilearn") is None:
        return sb.shapes.icosphere(1), sb.shapes.icosphere(3)
    (original,) = FileSource(paths=(_CORTEX,), distribution="nilearn").members(Path())
    fine = original.load()
    assert isinstance(fine, sb.Mesh)
    return _in_unit_ball(decimated(fine, triangles), fine)


def pair_of_parts(effort: Effort, triangles: int) -> tuple[sb.Mesh, sb.Mesh]:
    """A mechanical part decimated to some triangles, and itself: plane and curved faces, with sharp edges."""
    box = trimesh.creation.box()
    for _ in range(2 if effort.quick else 5):
        box = box.subdivide()
    x, y, z = box.vertices.T
    vertices = np.stack([(x + 2) * np.cos(0.6 * y), (x + 2) * np.sin(0.6 * y), z * (1 + 0.3 * x)], axis=1)
    fine = sb.Mesh(vertices, box.faces)
    return _in_unit_ball(decimated(fine, len(box.faces) // 8 if effort.quick else triangles), fine)


def _in_unit_ball(coarse: sb.Mesh, fine: sb.Mesh) -> tuple[sb.Mesh, sb.Mesh]:
    unit = sb.shapes.Similarity.to_unit_ball(fine)
    return coarse.moved(unit.scale, unit.origin), fine.moved(unit.scale, unit.origin)
