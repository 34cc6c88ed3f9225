"""Meshes that several benchmarks measure."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import sobolev_batch as sb
from benchmarks.timing import Effort
from sobolev_batch.surfaces.sources.files import FileSource
from sobolev_batch.surfaces.sources.generated import decimated

_CORTEX = "nilearn/datasets/data/fsaverage5/pial_left.gii.gz"


def pair_of_cortex(effort: Effort, triangles: int) -> tuple[sb.Mesh, sb.Mesh]:
    """A cortical surface decimated to some triangles, and itself; two icospheres where it is not installed."""
    if effort.quick or find_spec("nilearn") is None:
        return sb.shapes.icosphere(1), sb.shapes.icosphere(3)
    (original,) = FileSource(paths=(_CORTEX,), distribution="nilearn").members(Path())
    fine = original.load()
    assert isinstance(fine, sb.Mesh)
    coarse = decimated(fine, triangles)
    unit = sb.shapes.Similarity.to_unit_ball(fine)
    return coarse.moved(unit.scale, unit.origin), fine.moved(unit.scale, unit.origin)
