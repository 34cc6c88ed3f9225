"""A fit before it begins: mesh and target, checked and brought to a common centre."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.fitting.closeness import Closeness
from sobolev_batch.fitting.optimisation.descent import End
from sobolev_batch.fitting.optimisation.problem import FitProblem
from sobolev_batch.fitting.optimisation.stages import FitProgress, FitSettings, Run, stages_of
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.metrics.inputs import Operand, common_lattice, field_of, quality_of
from sobolev_batch.spectral.transform.settings import Execution
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.shapes.subdivision import Edges
from sobolev_batch.surfaces.shapes.surface import Extent, Surface

Reals = NDArray[np.float64]

# Start and target whose sizes differ by this factor are in different units.
_OTHER_UNIT = 20.0


@dataclass(frozen=True, eq=False)
class FitTask:
    """A fit, brought to a common centre and to vertices that all differ.

    Attributes:
        mesh: Mesh as it was given.
        start: The same mesh, prepared.
        place: Vertex of the prepared mesh for each vertex of the given one.
        move: Movement to the centre.
        target: Target, moved with the mesh.
        problem: Mesh and field of the target.
        settings: Settings.
    """

    mesh: Mesh
    start: Mesh
    place: NDArray[np.int64]
    move: Similarity
    target: Operand
    problem: FitProblem
    settings: FitSettings

    @classmethod
    def of(
        cls, mesh: Mesh, target: Operand, lattice: Lattice | None, settings: FitSettings, execution: Execution
    ) -> Self:
        """Check mesh and target, and prepare them.

        Raises:
            LatticeError: The mesh or target does not fit into the lattice.
            InputError: See `fit`.
        """
        require_comparable(mesh, target)
        start, place = welded(mesh)
        move = Similarity()
        if isinstance(target, xr.DataArray):
            field = field_of(target, common_lattice((target,), lattice), (settings.order,))
            problem = FitProblem.of_field(start, field, execution)
        else:
            if lattice is None:
                move = _centering(start, target)
            start, target = move.apply(start), move.apply(target)
            orders = tuple(dict.fromkeys((settings.order, settings.coarse_order)))
            problem = FitProblem.of_surface(start, target, lattice, orders, execution)
        return cls(mesh, start, place, move, target, problem, settings)

    @property
    def free(self) -> NDArray[np.int64]:
        """Vertices that may move."""
        return _free_vertices(self.start, keep_boundary=self.settings.keep_boundary)

    def run(self, notify: Callable[[FitProgress], None] | None = None) -> tuple[Mesh, Run]:
        """Carry the fit out, and return the prepared mesh at its end, or the start if that is nearer."""
        run = Run(self.problem, self.free, self.settings.steps, notify)
        begun = np.asarray(self.start.vertices)
        try:
            vertices = run.carried_out(stages_of(self.problem, self.settings))
            before, after = (self.problem.squares(one, [self.settings.order])[0] for one in (begun, vertices))
        except KeyboardInterrupt:
            run.end = End.INTERRUPTED
            return Mesh(run.vertices, self.start.triangles), run
        if after > before:
            vertices, run.end = begun, End.FARTHER
        return Mesh(vertices, self.start.triangles), run

    def closeness(self, mesh: Mesh) -> Closeness:
        """Measure how close a prepared mesh is to the target."""
        return Closeness.of(mesh, self.target, self.settings.order, self.problem.lattice)

    def own(self, mesh: Mesh) -> Mesh:
        """Return a mesh with the vertices and triangles of the given one, at its place.

        Args:
            mesh: Prepared start with its vertices moved.
        """
        vertices = np.asarray(mesh.vertices)[self.place] + np.asarray(self.move.origin)
        return Mesh(vertices, self.mesh.triangles)


def require_comparable(mesh: Mesh, target: Operand) -> None:
    """Refuse a mesh and target with which there is nothing to fit.

    Raises:
        InputError: See `fit`.
    """
    if isinstance(target, xr.DataArray):
        quality = quality_of(target)
        extent = None if quality is None else quality.extent
    else:
        extent = target.extent
    if extent is not None:
        _require_one_place(mesh.extent, extent)


def _require_one_place(start: Extent, target: Extent) -> None:
    ratio = float(start.widths.max() / target.widths.max())
    if not 1 / _OTHER_UNIT < ratio < _OTHER_UNIT:
        raise InputError(
            f"the start is {start.widths.max():.3g} units wide and the target {target.widths.max():.3g}: "
            "are both in the same unit of length?"
        )
    (low, high), (other_low, other_high) = start.box, target.box
    if np.any(low > other_high) or np.any(other_low > high):
        raise InputError(
            f"the start ({_corners(low, high)}) and the target ({_corners(other_low, other_high)}) do not overlap: "
            "move one of them to the other first"
        )


def _corners(low: Reals, high: Reals) -> str:
    return " to ".join("(" + ", ".join(f"{x:.3g}" for x in corner) + ")" for corner in (low, high))


def welded(mesh: Mesh) -> tuple[Mesh, NDArray[np.int64]]:
    """Return a mesh without coinciding vertices, and the vertex there of each vertex of the mesh."""
    # Zero has two signs.
    places, place = np.unique(mesh.vertices + 0.0, axis=0, return_inverse=True)
    return Mesh(places, place.reshape(-1)[mesh.triangles]), place.reshape(-1)


def _centering(start: Mesh, target: Surface) -> Similarity:
    low, high = Extent.union([start.extent, target.extent]).box
    x, y, z = ((low + high) / 2).tolist()
    return Similarity(1.0, (x, y, z))


def _free_vertices(mesh: Mesh, *, keep_boundary: bool) -> NDArray[np.int64]:
    """Return the vertices that may move: those of triangles, without boundaries if these are kept.

    Raises:
        InputError: There are none.
    """
    free = np.asarray(mesh.used_vertices)
    if keep_boundary:
        edges = Edges.from_mesh(mesh)
        free = np.setdiff1d(free, edges.ends[edges.on_boundary])
    if not len(free):
        raise InputError("all vertices lie on the boundary: there is nothing to move")
    return free
